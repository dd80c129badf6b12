"""A detector's result: each point's place and covariance, or the reason why the board isn't found."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

MIRRORED = "image is mirrored: turn off the flip of the camera's driver, or flip the images"
ENOUGH = 0.75  # of a board's points must be well measured


@dataclass(frozen=True)
class Detection:
    """A board found in an image, its n points in the order of `board.points()`."""

    pixels: Array  # (n, 2) px; NaN for points not found or badly measured
    covariance: Array  # (n, 2, 2) px^2, predicted from the noise beside the edges; NaN likewise
    radii: Array | None  # (n, 2) px, semi-axes of discs, the longer first; None for corners


class BoardNotFound(Exception):
    """The board is not in the image, or badly seen. The message is the reason, in a few words."""


def refuse_bad(faults: Sequence[str | None], expected: int, what: str) -> NDArray[np.bool_]:
    """Which of the points measured are good : (n,); refuses the board, with an example, if too few of those expected are."""
    bad = [fault for fault in faults if fault is not None]
    if len(faults) - len(bad) < ENOUGH * expected:
        reason = f", such as: {bad[0]}" if bad else ""
        raise BoardNotFound(f"{len(faults) - len(bad)} of {expected} {what} usable{reason}")
    return np.array([fault is None for fault in faults], dtype=bool)


def first_faults(tests: Sequence[tuple[NDArray[np.bool_], Array, str]], count: int) -> list[str | None]:
    """The first test that each point fails, with its value put into the text."""
    return [next((text.format(value[i]) for bad, value, text in tests if bad[i]), None) for i in range(count)]


def spread(values: Array, at: NDArray, count: int) -> Array:
    """Rows put in their places among `count`, NaN elsewhere."""
    result = np.full((count, *values.shape[1:]), np.nan)
    result[at] = values
    return result
