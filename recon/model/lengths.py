"""Plausibility of lengths that enter in files and settings: one that no such thing has is mostly in another unit."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from recon.errors import InputError, brief

UNITS = {1e3: "metres", 10.0: "centimetres", 25.4: "inches", 1e-3: "micrometres"}  # mm of each
UNIT_KEY = "mm_per_unit"  # of a file: 1 says that its lengths are in mm, however small; 1000 that they are in metres
SAID = f"give {UNIT_KEY} in the file: 1 if it is right, 10 for centimetres, 25.4 for inches, 1000 for metres"


@dataclass(frozen=True)
class Usual:
    """Bounds that hold every real length, mm, with a wide margin. A length of 0 is never a fault."""

    least: float
    most: float
    common: tuple[float, float] | None = None  # beyond these, one in another unit is as likely

    def fault(self, length_mm: float) -> str | None:
        """A length outside, with the unit in which it would lie well within; None for any other. Zero is none."""
        if length_mm == 0 or self.least <= length_mm <= self.most:
            return None
        unit = next((name for factor, name in UNITS.items() if self.least <= length_mm * factor <= self.most), None)
        return f"{length_mm:.4g} mm" + (f": {unit}?" if unit else "")

    def doubt(self, length_mm: float) -> str | None:
        """A length that there may be, with the units in which it would be a common one; None for any other."""
        return f"{length_mm:.4g} mm: is it in mm, not in {units}?" if (units := self.units(length_mm)) else None

    def units(self, length_mm: float) -> str:
        """The units in which a length that there may be would be a common one, in words; empty for any other."""
        if self.common is None or not 0 < length_mm < np.inf or self.common[0] <= length_mm <= self.common[1]:
            return ""
        return " or ".join(name for factor, name in UNITS.items() if self.common[0] <= length_mm * factor <= self.common[1])

    def is_unusual(self, length_mm: float) -> bool:
        """Whether a file had better state its unit."""
        return self.fault(length_mm) is not None or self.doubt(length_mm) is not None

    def __str__(self) -> str:
        return f"{self.least:g} to {self.most:g} mm"


BOARD_STEP = Usual(0.5, 1000.0)  # from point to point of a calibration board
DEVICES_APART = Usual(2.0, 20_000.0, (30.0, 3000.0))  # from camera to camera or projector
BRACKET = Usual(1.0, 2000.0, (25.0, 600.0))  # from a probe's target to its image's corner
TARGET_STEP = Usual(5.0, 1000.0)  # from circle to circle of a probe's target
TARGET_CIRCLE = Usual(2.5, 500.0)  # outer diameter of its circles
PIXEL = Usual(0.002, 5.0)  # of a B-scan
B_SCAN = Usual(2.0, 600.0, (15.0, 400.0))  # width and depth of a B-scan, or of a whole screen
MOST_COSINE = 0.17  # between the axes of a B-scan's image, which calibrations by point pairs leave 3 degrees off at times


def shift(translation: ArrayLike) -> float:
    """Length of a translation : (3,); 0 of one that is nearly zero."""
    length = float(np.linalg.norm(np.ravel(translation)))
    return length if length >= 1e-9 else 0.0


def unit_of(path: Path, stated: object) -> float:
    """The unit that a file states by UNIT_KEY, in mm; InputError if it is none."""
    try:
        unit = float(np.asarray(stated).item())  # of an array of one number, too
    except (TypeError, ValueError):
        unit = np.nan
    if not 1e-3 <= unit <= 1e3:
        raise InputError(f"{path}: {UNIT_KEY}: expected a number of 0.001 to 1000, found {brief(stated)}")
    return unit


def axes_fault(to_from: NDArray[np.float64]) -> str | None:
    """The fault of an image's axes, the first two columns of (4, 4), that aren't square; None where they are, nearly."""
    across, down = to_from[:3, 0], to_from[:3, 1]
    cosine = float(across @ down / (np.linalg.norm(across) * np.linalg.norm(down)))
    return f"axes at {np.degrees(np.arccos(cosine)):.0f} degrees" if abs(cosine) > MOST_COSINE else None
