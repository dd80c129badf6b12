"""The B-scan's part of a scanner's screen: what changes from frame to frame, less what is small, such as a clock.

The face's ringing above it never changes: a few rows as wide as the B-scan, brightest at the face. A frame or a header is wider,
darker, higher, or apart from it.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from recon.clips.clip import Box
from recon.errors import InputError
from recon.model.fan import Mask, box


@dataclass(frozen=True)
class RingingLimits:
    """Which rows right above what changes are the ringing of the probe's face. It fades with depth, by ripples."""

    dark_dn: float = 8.0  # in the mean over time; darker rows are none
    face_dn: float = 150.0  # of the brightest row, at least: transmission saturates the face, a title's ground is about 60
    as_bright: float = 0.8  # of the brightest row, from which on a row may be the face: a compressed one is a little darker
    across: float = 0.9  # share of the width that is above half of a row's level
    height: float = 0.05  # of what changes, at most: ringing is 0.2 to 1 mm of 30 mm and more
    ends: float = 0.05  # of the width, at most, on either side, at which an array has no contact throughout


def find(frames: Iterable[NDArray[np.uint8]], name: str, field: str) -> Box:
    """The box about the largest part that changes, with the face's ringing above it, from frames : (h, w) of one size.

    field : that a message names, by which the part is given

    Raises
    ------
    InputError
        If nothing of some size changes.
    """
    mean, deviation = over_time(frames)
    part = box(changing(deviation, name, field))
    return _whole_or(_with_ringing(mean, part, RingingLimits()), mean.shape)


def find_below_ringing(frames: Iterable[NDArray[np.uint8]], name: str, field: str) -> Box:
    """The same without the ringing, where echoes are looked for."""
    _, deviation = over_time(frames)
    return _whole_or(box(changing(deviation, name, field)), deviation.shape)


def _with_ringing(mean: NDArray[np.float32], part: Box, limits: RingingLimits) -> Box:
    """The part with the face's ringing: rows right above it that are bright across its width, and dark beside it, in the mean.

    The face is the topmost row about as bright as the brightest; what stands above it is a title. An end of the array that has no
    contact rings, too, though nothing changes below it: the part gets as wide as the face's row.
    """
    u, v, width, height = part
    most_px, levels, sides = limits.ends * width, [], []
    for row in mean[:v][::-1]:
        level = float(np.median(row[u : u + width]))
        lit = row > level / 2
        left, right = np.flatnonzero(~lit[:u]), np.flatnonzero(~lit[u + width :])
        if level < limits.dark_dn or lit[u : u + width].mean() < limits.across or not left.size or not right.size:
            break
        wider = u - 1 - int(left[-1]), int(right[0])
        if max(wider) > most_px:
            break
        levels.append(level)
        sides.append(wider)
    if max(levels, default=0.0) < limits.face_dn:
        return part
    rows = 1 + int(np.flatnonzero(np.array(levels) > limits.as_bright * max(levels))[-1])
    (left, right), level = sides[rows - 1], levels[rows - 1]
    ends = mean[v : v + height, u - left : u], mean[v : v + height, u + width : u + width + right]
    framed = any(still.size and np.median(still) > level / 2 for still in ends)
    return part if framed or rows > limits.height * height else (u - left, v - rows, left + width + right, height + rows)


def _whole_or(part: Box, shape: tuple[int, ...]) -> Box:
    """The part, or all of a screen (h, w) of which it is nearly all."""
    whole = 0.9  # share of the screen along both sides, from which on nothing is cut away
    (tall, wide), (_, _, width, height) = shape, part
    return (0, 0, wide, tall) if width > whole * wide and height > whole * tall else part


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
