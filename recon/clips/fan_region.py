"""The fan of a curved array's B-scan, from what changes on the screen from frame to frame."""

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from recon.clips import image_region
from recon.errors import InputError
from recon.model.fan import STEEPEST_DEG, Fan, Mask

Array = NDArray[np.float64]

LEAST_DEG = 5.0  # between the sides
LEAST_ROWS = 20  # of a side
AGREES = 0.9  # area of fan and changing part together over that of either
EDGE_PX = 12  # of the image, within which an arc may be cut off
BINS = 60  # of directions, in each of which the fan's first and last radius are taken


def find(frames: Iterable[NDArray[np.uint8]], name: str) -> Fan:
    """The fan that agrees with the largest part that changes, from frames : (h, w) of one size.

    Both sides are straight lines through the outermost pixels of rows down to the fan's widest; its arcs are those about their
    meeting point.

    Raises
    ------
    InputError
        If nothing of some size changes, or what does is no fan.
    """
    part = image_region.changing(frames, name)
    rows = np.flatnonzero(part.any(axis=1))
    left, right = part[rows].argmax(axis=1), part.shape[1] - 1 - part[rows, ::-1].argmax(axis=1)
    sides = [_side(rows, left.astype(float)), _side(rows, -right.astype(float))]
    if any(side is None for side in sides):
        raise InputError(f"{name}: {_expected()}, found one without straight sides")
    (slope, start), (mirrored, end) = (side for side in sides if side is not None)
    left_deg, right_deg = np.rad2deg(np.arctan([slope, -mirrored]))
    if right_deg - left_deg <= LEAST_DEG or max(-left_deg, right_deg) > STEEPEST_DEG:
        raise InputError(f"{name}: {_expected()}, found sides at {left_deg:.0f} and {right_deg:.0f} deg")
    v = (start + end) / -(slope + mirrored)
    u = start + slope * v
    fan = Fan(u, v, *_radii(part, u, v), float(left_deg), float(right_deg))
    inside = fan.mask((part.shape[0], part.shape[1]))
    agree = (inside & part).sum() / max((inside | part).sum(), 1)
    if agree < AGREES:
        raise InputError(f"{name}: {_expected()}, found one that agrees with a fan by {100 * agree:.0f} %")
    return fan


def _expected() -> str:
    return "expected a part between two sides and two arcs that changes from frame to frame; give fan=[u,v,first,last,left,right]"


def _side(rows: NDArray[np.int64], outermost: Array) -> tuple[float, float] | None:
    """Slope and start of the line `outermost = start + slope row` of the rows down to the widest; None if they are few."""
    count = int(outermost.argmin()) + 1
    if count < LEAST_ROWS:
        return None
    found = stats.theilslopes(outermost[:count], rows[:count])
    return float(found.slope), float(found.intercept)


def _radii(part: Mask, u: float, v: float) -> tuple[float, float]:
    """Radii of both arcs: the medians over directions of the first and the last pixel, where the image doesn't end before."""
    y, x = np.nonzero(part)
    radius, angle = np.hypot(x - u, y - v), np.arctan2(x - u, y - v)
    place = np.digitize(angle, np.linspace(*np.quantile(angle, [0.02, 0.98]), BINS))
    ends = np.array([np.quantile(radius[place == k], [0.002, 0.998]) for k in np.unique(place)[1:-1]])
    directions = np.array([angle[place == k].mean() for k in np.unique(place)[1:-1]])
    across, down = u + np.sin(directions) * ends[:, 1], v + np.cos(directions) * ends[:, 1]
    free = (across > EDGE_PX) & (across < part.shape[1] - EDGE_PX) & (down < part.shape[0] - EDGE_PX)
    last = np.median(ends[free, 1]) if free.any() else ends[:, 1].max()
    return float(np.median(ends[:, 0])), float(last)
