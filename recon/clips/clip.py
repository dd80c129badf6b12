"""A clip of a scanner's screen: a DICOM file, a video, or a folder of images, read frame by frame as 8-bit grey."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from recon.errors import InputError

Grey = NDArray[np.uint8]
Box = tuple[int, int, int, int]  # u, v of the upper left pixel, width, height, px


@dataclass(frozen=True)
class Clip:
    """n frames; none is read yet."""

    name: str
    size: tuple[int, int]  # width, height, px
    count: int  # n
    seconds: NDArray[np.float64] | None  # (n,) from the first frame, increasing; None where the file doesn't say
    stream: Callable[[], Iterator[Grey]]  # frames (h, w), one by one, from the first at each call
    image: Box | None = None  # the B-scan's part of the frames, where the file says it
    mm_per_px: tuple[float, float] | None = None  # of the B-scan, where the file says it


def checked_seconds(path: Path, seconds: NDArray[np.float64]) -> NDArray[np.float64]:
    """Times of frames : (n,) s from the first one; InputError if they don't increase."""
    for number, (before, after) in enumerate(pairwise(seconds.tolist()), start=1):
        if not after > before:
            raise InputError(
                f"{path}: frame {number}: expected a time after that of the one before, {before:g} s, found {after:g} s; "
                "give rate_hz=..."
            )
    return seconds - seconds[0]
