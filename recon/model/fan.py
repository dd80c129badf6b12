"""The fan of a curved array's B-scan within its rectangular image: an annulus' sector, straight down the image."""

from dataclasses import dataclass
from math import isfinite
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import PlainValidator

Mask = NDArray[np.bool_]
Numbers = tuple[float, ...]  # six

STEEPEST_DEG = 89.0  # of a side
NEARLY_PX = 2.0**-17  # as near to the border a pixel counts for one on it, as in PLUS: sides at 45 deg run through centres


@dataclass(frozen=True)
class Fan:
    """Where its sides meet, the radii at which its lines begin and end, and the angles of its sides from straight down."""

    u: float  # px
    v: float  # px, mostly above the image: negative
    first_px: float
    last_px: float
    left_deg: float  # negative to the left
    right_deg: float

    def __post_init__(self) -> None:
        if not 0 <= self.first_px < self.last_px:
            raise ValueError(f"radii: expected two, the less one first, found {self.first_px:g} and {self.last_px:g} px")
        if not -STEEPEST_DEG <= self.left_deg < self.right_deg <= STEEPEST_DEG:
            expected = f"two from -{STEEPEST_DEG:g} to {STEEPEST_DEG:g}, the left one first"
            raise ValueError(f"angles: expected {expected}, found {self.left_deg:g} and {self.right_deg:g} deg")

    def __str__(self) -> str:
        """As a setting."""
        numbers = self.u, self.v, self.first_px, self.last_px, self.left_deg, self.right_deg
        return f"fan=[{','.join(f'{number:.1f}' for number in numbers)}]"

    def mask(self, shape: tuple[int, int], less_px: int = 1) -> Mask:
        """Pixels of an image (h, w) in the fan, but for some at the sides and the end: one, that scan conversion has blended.

        These are the pixels that the PLUS toolkit takes, for its volumes to be compared with ours.
        """
        down = np.arange(shape[0])[:, None] - self.v
        across = np.arange(shape[1]) - self.u
        left, right = np.tan(np.deg2rad([self.left_deg, self.right_deg]))
        less = less_px - NEARLY_PX
        within = (across >= left * down + less) & (across <= right * down - less) & (down > 0)
        begun = np.abs(across) > np.sqrt(np.maximum(self.first_px**2 - down**2, 0)) - less
        ended = np.abs(across) > np.sqrt(np.maximum(self.last_px**2 - down**2, 0)) - less
        return within & (begun | (down >= self.first_px)) & ~ended & (down <= self.last_px)


def _of_setting(value: Any) -> Numbers | Literal["find", "none"]:
    """Six numbers that make a fan, or the words find or none."""
    if value in ("find", "none"):
        return value
    numbers = value if isinstance(value, list | tuple) else ()
    if len(numbers) != 6 or not all(isinstance(number, int | float) and isfinite(number) for number in numbers):
        raise ValueError(f"expected find, none or [u,v,first,last,left,right], found {value}")
    Fan(*numbers)
    return tuple(numbers)


Sector = Annotated[Numbers | Literal["find", "none"], PlainValidator(_of_setting)]  # of a setting: u, v, radii px, angles deg


def box(mask: Mask) -> tuple[int, int, int, int]:
    """First column and row, width and height, of the rectangle about a mask : (h, w) that isn't empty."""
    columns, rows = np.flatnonzero(mask.any(axis=0)), np.flatnonzero(mask.any(axis=1))
    u, v = int(columns[0]), int(rows[0])
    return u, v, int(columns[-1]) - u + 1, int(rows[-1]) - v + 1
