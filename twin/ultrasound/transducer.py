"""An array and the scanner behind it: their figures, with units."""

from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import ConfigDict, Field, ValidationError, model_validator

from recon import registry
from recon.errors import brief, one_line
from recon.model.rig import Finite, NotNegative, Part, Positive, Rig
from twin.ultrasound.scanner_picture import Picture

Array = NDArray[np.float64]
FACES = "twin.ultrasound.faces"  # a module each
Bandwidth = Annotated[float, Field(ge=0.05, le=1.5)]


class Transducer(Part):
    """An array, its beams, and the scanner's processing of the echoes; as conf/ultrasound/linear.yaml has it.

    A field beyond these names the array's face, such as `curved`; see `twin.ultrasound.faces`. A linear array has none: its face
    is as wide as the image, another begins in the image's first row.
    """

    model_config = ConfigDict(extra="allow")

    image_size: tuple[Annotated[int, Field(ge=16, le=4096)], Annotated[int, Field(ge=16, le=4096)]] = (321, 408)
    scale_mm_per_px: tuple[Positive, Positive] = (0.1229, 0.1225)  # sx, sy of the scanner, at its assumed speed
    assumed_speed: Annotated[float, Field(ge=300, le=5000)] = 1540.0  # m/s
    frequency_mhz: Annotated[float, Field(ge=0.5, le=40)] = 7.5
    bandwidth: tuple[Bandwidth, Bandwidth] = (0.5, 0.4)  # -6 dB of an echo, over the frequency: at the face, at the image's end
    band_loss: bool = False  # whether high frequencies of an echo are lost first, as in tissue; else all as the centre
    transmit_focus_mm: Positive = 25.0
    focal_zones_mm: tuple[Positive, ...] = ()  # further foci of a firing each; a depth is shown by the nearest one's
    transmit_f_number: Positive = 3.0  # focus over aperture
    receive_f_number: Positive = 2.0  # dynamic focus and aperture
    aperture_mm: Positive = 19.2  # widest, in receive: 64 elements of 0.3 mm
    elevation_mm: Positive = 4.5  # height of the elements
    elevation_focus_mm: Positive = 22.0  # of the lens
    reverberations: Annotated[int, Field(ge=0, le=5)] = 2  # repeats between a surface and the probe's face
    face_reflection: Annotated[float, Field(ge=0, le=1)] = 0.3  # of amplitude, for an echo that comes back to the face
    face_ring_mm: NotNegative = 0.35  # over which the ringing of the transducer itself falls to 1/e
    face_ring_db: Finite = 4.0  # its level at the face over the brightest grey; -200 is none
    refraction: bool = True
    aperture_rays: Annotated[int, Field(ge=1, le=31)] = (
        1  # over which paths are averaged; 1 is the middle one; see `aperture_paths`
    )
    gel_mm: Positive | None = None
    """mm of gel between face and skin, at most: lines that begin farther off have air before them, and no echo; null is any"""
    scatterers_per_mm3: Annotated[float, Field(ge=1, le=1000)] = 64.0
    tgc_db_per_cm_mhz: NotNegative = 0.5  # attenuation that the gain makes up for
    tgc_limit_db: NotNegative = 55.0  # most gain over depth
    gain_db: Finite = -28.0  # grey level of the reference tissue (echogenicity 0 dB), under the brightest grey
    noise_db: Finite = -58.0  # under the echo of the reference tissue at the transmit focus without attenuation
    dynamic_range_db: Annotated[float, Field(ge=10, le=120)] = 60.0
    bits: Annotated[int, Field(ge=1, le=8)] = 8
    picture: Picture = Picture()

    @model_validator(mode="before")
    @classmethod
    def _one_face(cls, fields: Any) -> Any:
        others = {name: fields[name] for name in fields if name not in cls.model_fields} if isinstance(fields, dict) else {}
        there, faces = registry.names(FACES), {}
        for name, value in others.items():
            if name not in there:
                raise ValueError(f"{name}: expected no such field, found {brief(value)}")
            try:
                faces |= {} if value is None else {name: registry.kind(FACES, name).Face.model_validate(value)}
            except ValidationError as error:
                said = one_line(error)
                raise ValueError(f"{name}{': ' if said.startswith('expected') else '.'}{said}") from None
        if len(faces) > 1:
            raise ValueError(f"{list(faces)[1]}: expected one face, found {' and '.join(faces)}")
        return {name: value for name, value in fields.items() if name not in others} | faces if others else fields

    @model_validator(mode="after")
    def _depth(self) -> "Transducer":
        if self.scale_mm_per_px[1] > 2 * self.wavelength_mm:
            raise ValueError(
                f"scale_mm_per_px: expected a row of at most two wavelengths of {self.wavelength_mm:.3f} mm, "
                f"found {self.scale_mm_per_px[1]:g}"
            )
        if self.depth_mm < 1:
            found = f"{self.scale_mm_per_px[1] * (self.image_size[1] - 1):g} mm, with {self.face_mm[1]:g} mm of the face's arc"
            raise ValueError(f"image_size: expected an image deeper than the face's arc by 1 mm or more, found {found}")
        return self

    @model_validator(mode="after")
    def _looks(self) -> "Transducer":
        if self.aperture_rays % 2 == 0:
            raise ValueError(f"aperture_rays: expected an odd number, with one ray in the middle, found {self.aperture_rays}")
        foci = (self.transmit_focus_mm, *self.focal_zones_mm)
        if len(set(foci)) < len(foci) or max(foci[1:], default=0.0) > self.depth_mm:
            expected = f"foci that differ, no deeper than {self.depth_mm:.4g} mm"
            raise ValueError(f"focal_zones_mm: expected {expected}, found {list(foci[1:])} beside {foci[0]:g}")
        for name, several in (("aperture_rays", self.aperture_rays > 1), ("picture.angles", self.picture.angles > 1)):
            if several and self.face is not None:
                raise ValueError(f"{name}: expected 1 for an array that isn't linear, found more")
        most = np.rad2deg(np.arcsin(min(self.wavelength_mm / (4 * self.scale_mm_per_px[0]), 1.0)))
        if self.picture.angles > 1 and self.picture.steered_deg >= most:
            raise ValueError(
                f"picture.steered_deg: expected less than {most:.1f} for lines {self.scale_mm_per_px[0]:g} mm apart, "
                f"beyond which echoes are those of the other side, found {self.picture.steered_deg:g}"
            )
        return self

    @property
    def face(self) -> Any:
        """The `Face` of an array that isn't linear; None of a linear one."""
        return next(iter((self.model_extra or {}).values()), None)

    @property
    def wavelength_mm(self) -> float:
        """At the assumed speed."""
        return 1e-3 * self.assumed_speed / self.frequency_mhz

    @property
    def wavenumber(self) -> float:
        """Radians a mm, one way, at the assumed speed."""
        return 2 * np.pi / self.wavelength_mm

    @property
    def depth_mm(self) -> float:
        """Of the image's last row under the middle of the face, as shown."""
        return self.scale_mm_per_px[1] * (self.image_size[1] - 1) - self.face_mm[1]

    @property
    def width_mm(self) -> float:
        """From the first column to the last."""
        return self.scale_mm_per_px[0] * (self.image_size[0] - 1)

    @property
    def face_mm(self) -> tuple[float, float]:
        """The middle of the face in the image's frame, x and y."""
        return self.width_mm / 2, 0.0 if self.face is None else self.face.sagitta_mm

    @property
    def foot_mm(self) -> float:
        """Width of the face, from end to end."""
        return self.width_mm if self.face is None else self.face.foot_mm

    @property
    def rows_mm(self) -> Array:
        """Shown depth of the rows : (h,), those of a linear array's image."""
        rows = self.image_size[1] if self.face is None else int(self.depth_mm / self.scale_mm_per_px[1]) + 1
        return self.scale_mm_per_px[1] * np.arange(rows)

    def focus_mm(self, depth_mm: Array) -> Array:
        """The transmit focus that depths : (m,) are shown by."""
        foci = np.array([self.transmit_focus_mm, *self.focal_zones_mm])
        return foci[np.abs(np.asarray(depth_mm)[:, None] - foci).argmin(axis=1)]

    def axial_sigma_mm(self, depth_mm: Array) -> Array:
        """Standard deviation in depth of the echo's Gaussian envelope (amplitude).

        A spectrum `exp(-(f-f0)²/(2 s²))` of full width B f0 at half amplitude (-6 dB) has s = B f0 / 2.355, and its pulse
        lasts 1/(2 pi s); depth is c/2 times that.
        """
        return 1e-3 * self.assumed_speed / 2 * np.sqrt(8 * np.log(2)) / (2 * np.pi * self.frequency_mhz * self._band(depth_mm))

    def spectral_variance(self, depth_mm: Array) -> Array:
        """Variance of an echo's spectrum at depths : (m,) over its squared frequency; 0 without `band_loss`."""
        return self._band(depth_mm) ** 2 / (8 * np.log(2)) * self.band_loss

    def _band(self, depth_mm: Array) -> Array:
        """Full width of an echo's spectrum at half amplitude over its frequency, at depths."""
        near, far = self.bandwidth
        return near + (far - near) * np.clip(np.asarray(depth_mm) / max(self.depth_mm, 1e-9), 0, 1)


def check_scanner(rig: Rig, transducer: Transducer) -> None:
    """Check that `rig.probe` and the transducer describe one scanner; ValueError if they don't."""
    for name in ("image_size", "scale_mm_per_px"):
        design, found = getattr(rig.probe, name), getattr(transducer, name)
        if design != found:
            raise ValueError(f"ultrasound.{name}: expected rig.probe's {list(design)}, found {list(found)}")
