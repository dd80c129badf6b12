"""The rig's description: what each instrument is and where it stands, read from `conf/rig/*.yaml`.

World is the frame of camera 1. Every field has a unit; nonsense is refused with the field's name.
"""

from collections.abc import Iterator, Mapping
from dataclasses import is_dataclass
from typing import Annotated, Any, Self

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationInfo, field_validator, model_validator

from recon.geometry import rigid
from recon.geometry.camera import DISTORTION_LENGTHS, Camera
from recon.model.lengths import TARGET_CIRCLE, TARGET_STEP

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
NotNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Fraction = Annotated[float, Field(ge=0, le=1)]
Finite = Annotated[float, Field(allow_inf_nan=False)]
Vector = tuple[Finite, Finite, Finite]

LARGEST = 1e12  # of any decimal number, whatever its unit: products of some stay finite
LARGEST_BY_UNIT = {"_mm": 1e6, "_px": 1e6, "_deg": 1e4, "_hz": 1e6, "_db": 1e3}  # by the ends of fields' names
FOCAL_TOLERANCE = 0.05  # a lens's nominal focal length against the calibrated one


class Part(BaseModel):
    """Base of settings and files' records: immutable, refuses unknown keys, and numbers that are endless or beyond reason."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False, use_attribute_docstrings=True)

    @field_validator("*")
    @classmethod
    def _within_reach(cls, value: Any, info: ValidationInfo) -> Any:
        name = info.field_name or ""
        most = next((most for unit, most in LARGEST_BY_UNIT.items() if name.endswith(unit)), LARGEST)
        for number in _decimals(value):
            if not abs(number) <= most:
                raise ValueError(f"expected numbers of up to {most:g}, found {number:g}")
        return value


def _decimals(value: Any) -> Iterator[float]:
    """Decimal numbers of a field, those in lists and maps included."""
    if isinstance(value, float):
        yield value
    elif isinstance(value, Mapping):
        for inner in value.values():
            yield from _decimals(inner)
    elif is_dataclass(value) and not isinstance(value, type):
        yield from _decimals(vars(value))
    elif isinstance(value, list | tuple | set | frozenset):
        for inner in value:
            yield from _decimals(inner)


class Pose(Part):
    """A rigid transform into a device's frame from the world."""

    rotation_deg: Vector = (0.0, 0.0, 0.0)  # rotation vector: axis times angle
    translation_mm: Vector = (0.0, 0.0, 0.0)

    def matrix(self) -> rigid.Array:
        """The 4x4 transform `device_from_world`."""
        return rigid.from_rotation_vector(np.deg2rad(self.rotation_deg), self.translation_mm)


class Optics(Part):
    """Pinhole and distortion, as OpenCV has them."""

    size: tuple[Annotated[int, Field(ge=8, le=20000)], Annotated[int, Field(ge=8, le=20000)]]  # width, height, px
    focal_px: tuple[Positive, Positive]  # fx, fy
    centre_px: tuple[Finite, Finite]  # cx, cy
    distortion: tuple[Finite, ...] = ()  # k1 k2 p1 p2 [k3 [k4 k5 k6 [s1 s2 s3 s4 [tau_x tau_y]]]]
    device_from_world: Pose = Pose()

    @field_validator("distortion")
    @classmethod
    def _length(cls, value: tuple[float, ...]) -> tuple[float, ...]:
        if len(value) not in DISTORTION_LENGTHS:
            raise ValueError(f"expected 0, 4, 5, 8, 12 or 14 coefficients, found {len(value)}")
        return value

    def camera(self) -> Camera:
        """The calibrated camera that this describes."""
        (fx, fy), (cx, cy) = self.focal_px, self.centre_px
        matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
        return Camera(self.size, matrix, np.array(self.distortion), self.device_from_world.matrix())


class Lens(Part):
    """A thin lens."""

    focal_length_mm: Positive
    f_number: Positive
    focus_mm: Positive  # distance of the plane in focus, along the optical axis
    blur_px: NotNegative = 0.0  # standard deviation of the point spread in focus: aberrations and diffraction
    vignetting: Fraction = 0.0  # light lost in the image corner, on top of the cosine law

    @property
    def aperture_mm(self) -> float:
        """Diameter of the entrance pupil."""
        return self.focal_length_mm / self.f_number


class Sensor(Part):
    """An image sensor by its EMVA 1288 figures."""

    pixel_um: Positive
    quantum_efficiency: Annotated[float, Field(gt=0, le=1)]  # at the projector's wavelength
    saturation_e: Positive  # electrons that fill the ADC's range at gain 1
    dark_noise_e: NotNegative  # temporal, one exposure
    dark_current_e_per_s: NotNegative
    dsnu_e: NotNegative  # spatial standard deviation of the dark signal
    prnu: Fraction  # spatial standard deviation of the response
    black_level_dn: NotNegative  # in 8-bit digital numbers
    adc_bits: Annotated[int, Field(ge=8, le=16)]


class CameraDevice(Part):
    """One camera of the rig."""

    optics: Optics
    lens: Lens
    sensor: Sensor
    serial: Annotated[int, Field(ge=0)]  # tells one camera's fixed pattern (PRNU, DSNU) from another's

    @model_validator(mode="after")
    def _one_focal_length(self) -> "CameraDevice":
        calibrated = self.optics.focal_px[0] * self.sensor.pixel_um * 1e-3
        if abs(self.lens.focal_length_mm / calibrated - 1) > FOCAL_TOLERANCE:
            expected = f"within {100 * FOCAL_TOLERANCE:.0f} % of focal_px * pixel_um = {calibrated:.2f} mm"
            raise ValueError(f"lens.focal_length_mm: expected {expected}, found {self.lens.focal_length_mm:g}")
        return self


class ProjectorDevice(Part):
    """The DLP projector."""

    optics: Optics
    lens: Lens
    radiant_flux_w: Positive  # out of the lens, all pixels on
    wavelength_nm: Positive
    gamma: Positive  # light = value ** gamma, for grey patterns; binary ones need none
    contrast: Annotated[float, Field(gt=1)]  # full on / full off; sets the black level


class Target(Part):
    """The probe's planar target of three circles: c0 the origin, c1 on the x axis, c2 on the y axis or a little beside it."""

    c1_mm: Positive
    c2_mm: Positive  # along y
    c2_aside_mm: Finite = 0.0  # along x
    outer_diameter_mm: Positive
    inner_diameter_mm: Positive
    board_mm: tuple[Positive, Positive]  # width, height
    curvature_per_m: Vector = (0.0, 0.0, 0.0)  # of a bowed board: d2z/dx2, d2z/dxdy, d2z/dy2
    tolerance_mm: Annotated[float, Field(ge=0, le=5)] = 0.1  # of each circle's place along each axis, one standard deviation
    covariance_mm2: tuple[Vector, Vector, Vector] | None = None  # of c1, c2_aside, c2 as measured; instead of the tolerance
    unusual: bool = False  # lengths that no usual target has, such as circles of less than 2.5 mm, are meant

    @model_validator(mode="after")
    def _usual_lengths(self) -> Self:
        for name, usual in (("c1_mm", TARGET_STEP), ("c2_mm", TARGET_STEP), ("outer_diameter_mm", TARGET_CIRCLE)):
            fault = usual.fault(getattr(self, name))
            if fault and not self.unusual:
                raise ValueError(f"{name}: expected {usual}, found {fault} If it is right, give unusual=true with it")
        return self

    @field_validator("inner_diameter_mm")
    @classmethod
    def _annulus(cls, value: float, info) -> float:
        outer = info.data.get("outer_diameter_mm", np.inf)
        if value >= outer:
            raise ValueError(f"expected less than outer_diameter_mm = {outer:g}, found {value:g}")
        return value

    @field_validator("covariance_mm2")
    @classmethod
    def _covariance(cls, value: tuple[Vector, Vector, Vector] | None) -> tuple[Vector, Vector, Vector] | None:
        if value is not None:
            matrix = np.array(value)
            if not np.allclose(matrix, matrix.T) or np.linalg.eigvalsh(matrix).min() < -1e-12 * np.trace(matrix):
                raise ValueError(f"expected a covariance of c1, c2_aside and c2, found {matrix.tolist()}")
        return value


class Probe(Part):
    """The ultrasound probe's image plane in the target's frame."""

    image_size: tuple[Annotated[int, Field(ge=8, le=20000)], Annotated[int, Field(ge=8, le=20000)]]  # width, height, px
    scale_mm_per_px: tuple[Positive, Positive]  # sx, sy
    target_from_image: Pose


class Rig(Part):
    """The whole rig: two cameras, the projector, the target and the probe."""

    cam1: CameraDevice
    cam2: CameraDevice
    projector: ProjectorDevice
    target: Target
    probe: Probe
