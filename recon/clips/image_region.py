"""The B-scan's part of a scanner's screen: what changes from frame to frame, less what is small, such as a clock."""

from collections.abc import Iterable

import cv2
import numpy as np
from numpy.typing import NDArray

from recon.clips.clip import Box
from recon.errors import InputError
from recon.model.fan import Mask, box


def find(frames: Iterable[NDArray[np.uint8]], name: str, field: str) -> Box:
    """The box about the largest part that changes, from frames : (h, w) of one size.

    field : that a message names, by which the part is given

    Raises
    ------
    InputError
        If nothing of some size changes.
    """
    _, deviation = over_time(frames)
    part = changing(deviation, name, field)
    (tall, wide), (u, v, width, height) = part.shape, box(part)
    whole = 0.9  # share of the screen along both sides, from which on nothing is cut away
    return (0, 0, wide, tall) if width > whole * wide and height > whole * tall else (u, v, width, height)


def changing(deviation: NDArray[np.float32], name: str, field: str) -> Mask:
    """The largest part that changes : (h, w), its gaps closed, by `over_time`; InputError if nothing of some size does."""
    changes_dn = 4.0  # standard deviation of a pixel over time: speckle has ten and more, compressed rests less
    changes = deviation > changes_dn
    join_px = 9  # gaps in what changes, such as dark tissue, that are closed
    joined = cv2.morphologyEx(changes.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((join_px, join_px), np.uint8))
    opened = cv2.morphologyEx(joined, cv2.MORPH_OPEN, np.ones((join_px, join_px), np.uint8))
    count, labels, figures, _ = cv2.connectedComponentsWithStats(opened)
    largest = int(figures[1:, cv2.CC_STAT_AREA].argmax()) + 1 if count > 1 else 0
    least_share = 0.05  # of the screen
    if largest == 0 or figures[largest, cv2.CC_STAT_AREA] < least_share * changes.size:
        raise InputError(f"{name}: expected a B-scan that changes from frame to frame, found none; give {field}")
    return labels == largest


def over_time(frames: Iterable[NDArray[np.uint8]]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Mean and standard deviation of each pixel over time : (h, w), by Welford's sums."""
    mean, squares, count = None, None, 0
    for frame in frames:
        level, count = np.float32(frame), count + 1
        if mean is None or squares is None:
            mean, squares = level, np.zeros_like(level)
            continue
        step = level - mean
        mean = mean + step / count
        squares += step * (level - mean)
    if mean is None or squares is None:
        return np.zeros((1, 1), np.float32), np.zeros((1, 1), np.float32)
    return mean, np.sqrt(squares / max(count - 1, 1))
