"""The rig's description: what each instrument is and where it stands, read from `conf/rig/*.yaml`.

World is the frame of camera 1. Every field has a unit; nonsense is refused with the field's name.
"""

from collections.abc import Iterator, Mapping, Sequence
from datetime import date
from itertools import combinations, islice, permutations
from typing import Annotated, Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, Field, field_validator, model_serializer, model_validator

from recon.errors import InputError
from recon.geometry import rigid
from recon.geometry.camera import DISTORTION_LENGTHS, Camera
from recon.model.calibration import Calibration, Uncertainty
from recon.model.lengths import TARGET_CIRCLE, TARGET_STEP
from recon.model.part import Finite, Fraction, Kinds, NotNegative, Part, Positive, Vector

MOST_CIRCLES = 8  # of a target, by the time that a search takes and the candidates that it has: half a second a window
LEAST_ASYMMETRY_MM = 2.0  # by which a target turned must miss itself, that its circles can be told apart
LEAST_PARTED_MM = 2.0  # by which distances of three circles of two bodies must differ, that one isn't taken for the other
PARTED_TOLERANCES = 10.0  # of a circle's place, by which they must differ, too
PARTED_SIZES = 0.2  # of a diameter, by which circles of two bodies differ that are never taken for each other
DEVICES = ("cam1", "cam2", "projector")  # those that are calibrated
PROBE = "probe"  # name of the body that carries `Rig.target`
PATIENT = "patient"  # name of the body in whose frame all is told, where a rig has it
FOCAL_TOLERANCE = 0.05  # a lens's nominal focal length against the calibrated one


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


class Target(Kinds):
    """The probe's planar target of three to eight circles, whose places are known by lengths; see `recon.model.circle_layout`.

    Which lengths there are, its kind tells: a module of `recon.model.targets`.
    """

    PACKAGE = "recon.model.targets"
    USUAL = "three_circles"
    LENGTHS: ClassVar[tuple[str, ...]]  # names of fields: c1_mm, then c2_aside_mm (along x) and c2_mm (along y), and so on

    outer_diameter_mm: Positive
    inner_diameter_mm: Positive
    board_mm: tuple[Positive, Positive]  # width, height
    curvature_per_m: Vector = (0.0, 0.0, 0.0)  # of a bowed board: d2z/dx2, d2z/dxdy, d2z/dy2
    tolerance_mm: Annotated[float, Field(ge=0, le=5)] = 0.1  # of each circle's place along each axis, one standard deviation
    covariance_mm2: tuple[tuple[Finite, ...], ...] | None = None  # of the lengths as measured; instead of the tolerance
    unusual: bool = False  # lengths that no usual target has, such as circles of less than 2.5 mm, are meant

    @classmethod
    def __pydantic_init_subclass__(cls, **_: Any) -> None:
        """Refuse a kind whose lengths aren't those of circles, one by one: their order tells which is which."""
        found = tuple(cls.LENGTHS)
        circles = max((len(found) + 4) // 2, 3)
        expected = ("c1_mm", *(name for k in range(2, circles) for name in (f"c{k}_aside_mm", f"c{k}_mm")))
        if found != expected:
            ordered = f"{' '.join(expected)}, in this order"
            raise InputError(f"expected LENGTHS in {cls.__module__} of {ordered}, found {' '.join(found)}")
        if missing := [name for name in found if name not in cls.model_fields]:
            raise InputError(f"expected a field in {cls.__module__} for each of its LENGTHS, found none for {' '.join(missing)}")

    @model_serializer(mode="plain")
    def _own_fields_first(self) -> dict[str, Any]:
        own = [name for name in type(self).model_fields if name not in Target.model_fields]
        usual = {"kind"} if self.kind == self.USUAL else set()
        return {name: getattr(self, name) for name in (*own, *Target.model_fields) if name not in usual}

    @model_validator(mode="after")
    def _usual_lengths(self) -> Self:
        for name in ("c1_mm", "c2_mm"):
            if getattr(self, name) <= 0:
                raise ValueError(f"{name}: expected more than 0, that c0, c1 and c2 span a plane, found {getattr(self, name):g}")
        sides = [name for name in self.LENGTHS if "aside" not in name]
        for name, usual in (*((side, TARGET_STEP) for side in sides), ("outer_diameter_mm", TARGET_CIRCLE)):
            fault = usual.fault(abs(getattr(self, name)))
            if fault and not self.unusual:
                raise ValueError(f"{name}: expected {usual}, found {fault} If it is right, give unusual=true with it")
        return self

    @property
    def places(self) -> NDArray[np.complex128]:
        """Places : (n,) mm of the circles in their plane, x + i y."""
        c1, *others = (getattr(self, name) for name in self.LENGTHS)
        return np.array([0, c1, *map(complex, others[::2], others[1::2])])

    @model_validator(mode="after")
    def _names_can_be_told(self) -> Self:
        places = self.places
        if len(places) > MOST_CIRCLES:
            raise ValueError(
                f"{self.LENGTHS[-1]}: expected up to {MOST_CIRCLES} circles, found {len(places)}: the search tries their orders"
            )
        if self.unusual:
            return self
        places = places - places.mean()
        for order in islice(_alike(np.abs(places[:, None] - places)), 1, None):
            turn = np.vdot(places, turned := places[list(order)])
            if np.abs(turned - places * turn / max(abs(turn), 1e-9)).max() < LEAST_ASYMMETRY_MM:
                raise ValueError(
                    f"{self.LENGTHS[-1]}: expected circles that no turn maps onto each other to {LEAST_ASYMMETRY_MM:g} mm, "
                    f"found c0 on c{order[0]}'s place: which is which can't be seen. If it is right, give unusual=true with it"
                )
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
    def _covariance(cls, value: tuple[tuple[float, ...], ...] | None) -> tuple[tuple[float, ...], ...] | None:
        if value is not None:
            rows, count = [list(row) for row in value], len(cls.LENGTHS)
            matrix = np.array(rows if [len(row) for row in rows] == [count] * count else np.full((count, count), np.nan))
            if not np.allclose(matrix, matrix.T) or np.linalg.eigvalsh(matrix).min() < -1e-12 * np.trace(matrix):
                *first, last = (name.removesuffix("_mm") for name in cls.LENGTHS)
                raise ValueError(f"expected a covariance of {', '.join(first)} and {last}, found {rows}")
        return value


def _alike(far: rigid.Array, first: tuple[int, ...] = ()) -> Iterator[tuple[int, ...]]:
    """Orders of n circles, first as they are, by whose distances : (n, n) mm a turn may map each nearly onto another."""
    if (k := len(first)) == len(far):
        yield first
        return
    for new in range(len(far)):
        if new not in first and np.all(np.abs(far[new, list(first)] - far[k, :k]) < 2 * LEAST_ASYMMETRY_MM):
            yield from _alike(far, (*first, new))


class Probe(Part):
    """The ultrasound probe's image plane in the target's frame."""

    image_size: tuple[Annotated[int, Field(ge=8, le=20000)], Annotated[int, Field(ge=8, le=20000)]]  # width, height, px
    scale_mm_per_px: tuple[Positive, Positive]  # sx, sy
    target_from_image: Pose


def parted_mm(one: Target, other: Target) -> float:
    """Least difference, mm, by which three circles of one target can't be three of another; infinite if circles' sizes tell them.

    Of each way to take three circles of one for three of the other, both seen from the front, one distance at least differs so.
    """
    sizes = one.outer_diameter_mm, other.outer_diameter_mm
    if max(sizes) > (1 + PARTED_SIZES) * min(sizes):
        return np.inf
    least = np.inf
    for a in combinations(one.places, 3):
        for b in permutations(other.places, 3):
            (p, q), (r, s) = np.diff(a), np.diff(b)
            if np.imag(np.conj(p) * q) * np.imag(np.conj(r) * s) > 0:
                off = np.abs([p, q, p + q]) - np.abs([r, s, r + s])
                least = min(least, float(np.abs(off).max()))
    return least


class Measured(Part):
    """How well a number of the rig is known, and from what."""

    sigma: NotNegative  # standard deviation, in the number's unit
    source: Annotated[str, Field(min_length=1, max_length=1000)]


class Identified(Part):
    """The capture that a rig was identified from."""

    day: date
    capture: Annotated[str, Field(min_length=1)]  # its name


class OpticsCovariance(Part):
    """Covariance of the devices' optics as calibrated: names and units are those of `recon.model.calibration.Uncertainty`."""

    names: tuple[Annotated[str, Field(pattern=r"^(cam1|cam2|projector)\.[a-z_0-9]+$")], ...]
    rows: tuple[tuple[Finite, ...], ...]  # of its lower triangle, the diagonal included

    @field_validator("rows")
    @classmethod
    def _triangle(cls, value: tuple[tuple[float, ...], ...], info) -> tuple[tuple[float, ...], ...]:
        lengths, names = [len(row) for row in value], info.data.get("names", ())
        if lengths != list(range(1, len(names) + 1)):
            raise ValueError(f"expected a row a name, of 1 to {len(names)} numbers, found {lengths}")
        if any(row[-1] < 0 for row in value):
            raise ValueError("expected variances of 0 or more at the rows' ends, found less")
        return value

    def matrix(self) -> NDArray[np.float64]:
        """The whole of it : (n, n)."""
        lower = np.zeros((len(self.rows), len(self.rows)))
        for k, row in enumerate(self.rows):
            lower[k, : k + 1] = row
        return lower + np.tril(lower, -1).T


BodyName = Annotated[str, Field(pattern=r"^[a-z][a-z0-9_]{0,31}$")]


def without_measures(fields: Mapping[str, Any], parts: Sequence[str]) -> dict[str, Any]:
    """A rig's `measured` and `optics_covariance`, less what they have of parts, such as `projector.optics`, by dotted names.

    Errors of all optics go together, so the covariance of all is lost with that of one.
    """

    def within(name: str) -> bool:
        return any(f"{name}.".startswith(f"{part}.") for part in parts)

    optics = any(within(f"{device}.optics") or part.startswith(f"{device}.optics.") for device in DEVICES for part in parts)
    kept = {name: one for name, one in fields["measured"].items() if not within(name)}
    return {"measured": kept, "optics_covariance": None if optics else fields.get("optics_covariance")}


class Rig(Part):
    """The whole rig: two cameras, the projector, the probe with its target, and further bodies with a target each."""

    version: Annotated[int, Field(ge=0)] = 0  # of the rig's file: one more with each identification; 0: written by hand
    identified: Identified | None = None
    cam1: CameraDevice
    cam2: CameraDevice
    projector: ProjectorDevice
    target: Target
    probe: Probe
    bodies: dict[BodyName, Target] = Field(default_factory=dict)  # such as a needle, or the patient
    measured: dict[str, Measured] = Field(default_factory=dict)  # by dotted names, such as cam1.lens.f_number
    optics_covariance: OpticsCovariance | None = None  # errors of measured optics go together: each alone says little

    def __hash__(self) -> int:
        """Of all parts, as frozen models have it; a mapping has none of its own."""
        mappings = "bodies", "measured"
        parts = (getattr(self, name) for name in type(self).model_fields if name not in mappings)
        return hash((*parts, *(frozenset(getattr(self, name).items()) for name in mappings)))

    def unmeasured(self, *parts: str) -> Self:
        """The rig, of whose parts, such as `projector.optics`, no number counts as measured: they are about to be changed."""
        fields = {"measured": self.measured, "optics_covariance": self.optics_covariance}
        return self.model_copy(update=without_measures(fields, parts))

    def number(self, name: str) -> float:
        """A number of the rig by its dotted name; KeyError if there is none."""
        value: Any = self
        for key in name.split("."):
            if isinstance(value, tuple) and key.isdecimal() and int(key) < len(value):
                value = value[int(key)]
            elif isinstance(value, BaseModel) and key in type(value).model_fields:
                value = getattr(value, key)
            elif isinstance(value, dict) and key in value:
                value = value[key]
            else:
                raise KeyError(name)
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise KeyError(name)
        return float(value)

    @model_validator(mode="after")
    def _measures_what_there_is(self) -> Self:
        for name in self.measured:
            try:
                self.number(name)
            except KeyError:
                raise ValueError(f"measured: expected names of numbers, such as cam1.lens.f_number, found {name}") from None
        return self

    def calibration(self) -> Calibration:
        """Cameras and projector, with the covariance of what was measured of them."""
        known = self.optics_covariance
        uncertainty = None if known is None else Uncertainty(known.names, known.matrix(), has_scale=True)
        return Calibration({name: getattr(self, name).optics.camera() for name in DEVICES}, uncertainty)

    @property
    def targets(self) -> dict[str, Target]:
        """Targets of all bodies by name, the probe's first."""
        return {PROBE: self.target, **self.bodies}

    @model_validator(mode="after")
    def _bodies_can_be_told(self) -> Self:
        if PROBE in self.bodies:
            raise ValueError(f"bodies: expected names besides {PROBE}, which carries target, found {PROBE}")
        for (name, one), (rival, other) in combinations(self.targets.items(), 2):
            parted, least = (
                parted_mm(one, other),
                max(LEAST_PARTED_MM, PARTED_TOLERANCES * max(one.tolerance_mm, other.tolerance_mm)),
            )
            if parted < least and not (one.unusual or other.unusual):
                own = f"bodies.{rival}"
                raise ValueError(
                    f"{own}: expected three circles whose distances differ by {least:g} mm or more from those of the "
                    f"{name}'s target, or circles {100 * PARTED_SIZES:.0f} % larger or smaller, found {parted:.1f} mm: either "
                    f"may be taken for the other. `sonotwin print part=target family={len(self.targets)}` proposes targets that "
                    f"can't; unusual=true takes them as they are"
                )
        return self
