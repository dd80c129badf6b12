"""The ultrasound probe's calibration: where the pixels of its B-scans lie in the frame of the target that it carries."""

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import AfterValidator, Field

from recon import arguments
from recon.geometry import rigid
from recon.model.calibration import Uncertainty

Array = NDArray[np.float64]

NAMES = ("sx", "sy", "rx", "ry", "rz", "tx", "ty", "tz")  # of the uncertainty, as of `ProbeCalibration`
SPEEDS = (300.0, 5000.0)  # m/s, of anything that is scanned
SPEED_UNITS = {1e3: "km/s", 1e-2: "cm/s", 1e-3: "mm/s"}  # m/s of each


def speed_fault(value: float) -> str | None:
    """The fault of a speed of sound that nothing has which is scanned, with the unit in which it would be one; None of others."""
    least, most = SPEEDS
    if least <= value <= most:
        return None
    unit = next((name for factor, name in SPEED_UNITS.items() if least <= value * factor <= most), None)
    return f"expected a speed of sound of {least:g} to {most:g} m/s, found {value:g}" + (f": {unit}?" if unit else "")


def _speed(value: float) -> float:
    if fault := speed_fault(value):
        raise ValueError(fault)
    return value


Speed = Annotated[float, AfterValidator(_speed)]  # m/s; of a setting
SpeedSigma = Annotated[float, Field(ge=0, le=500)]  # m/s; of a setting
SCANNER_SPEED = 1540.0  # m/s, a mean of soft tissues, which scanners assume


@dataclass(frozen=True)
class ProbeCalibration:
    """A calibrated probe. The image's frame: x along the array, y into the depth, origin at the centre of pixel (0, 0).

    The uncertainty's names are `sx sy` in mm/px, and `rx ry rz` in rad and `tx ty tz` in mm, a turn and a shift of
    `target_from_image`: `R = exp([r]) R_calibrated`, `t = t_calibrated + (tx, ty, tz)`.
    """

    target_from_image: Array  # (4, 4), mm
    scale: Array  # (2,) sx, sy, mm/px
    uncertainty: Uncertainty | None = None
    speed_m_s: float = SCANNER_SPEED  # m/s, of the sound for which sy holds
    face_row: float = 0.0  # px, row of the image at which an echo has no delay: depths count from there

    def __post_init__(self) -> None:
        for name, shape in (("target_from_image", (4, 4)), ("scale", (2,))):
            object.__setattr__(self, name, np.asarray(arguments.numbers(name, getattr(self, name), shape), float))
        arguments.of_kind("uncertainty", self.uncertainty, Uncertainty, type(None))

    def to_target(self, pixels: ArrayLike) -> Array:
        """Pixels : (..., 2) of a B-scan, to points : (..., 3) mm in the target's frame."""
        pixels = np.asarray(pixels, float)
        plane = np.concatenate([pixels * self.scale, np.zeros_like(pixels[..., :1])], axis=-1)
        return rigid.apply(self.target_from_image, plane)


def place_slopes(target_from_image: Array, scale: Array, pixels: ArrayLike) -> Array:
    """Derivatives : (n, 3, 8) of the places of pixels : (n, 2), in the target's frame, by the parameters NAMES."""
    u, v = np.moveaxis(np.asarray(pixels, float)[..., None], 1, 0)
    x, y = target_from_image[:3, 0], target_from_image[:3, 1]
    arms = u * scale[0] * x + v * scale[1] * y
    return np.concatenate([(u * x)[..., None], (v * y)[..., None], rigid.slopes(arms)], axis=-1)
