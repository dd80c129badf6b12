"""The fan of a curved array's B-scan, from what changes on the screen from frame to frame."""

from collections.abc import Iterable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from recon.clips import image_region
from recon.errors import InputError
from recon.model.fan import STEEPEST_DEG, Fan, Mask, box

Array = NDArray[np.float64]

EXPECTED = "expected a part between two sides and two arcs that changes from frame to frame"
STIRS_DN = 0.3  # standard deviation over time, of what is dark but no border
WITHIN = 0.9  # share of the changing part in the fan


def find(frames: Iterable[NDArray[np.uint8]], name: str) -> Fan:
    """The fan about the largest part that changes, from frames : (h, w) of one size.

    Both sides are straight lines through the outermost pixels of rows down to the fan's widest; its arcs are those about their
    meeting point, the first one where the face's ringing begins, which never changes, as the water after it.

    Raises
    ------
    InputError
        If nothing of some size changes, or what does is no fan.
    """
    mean, deviation = image_region.over_time(frames)
    field = "fan=[u,v,first,last,left,right]"
    part = image_region.changing(deviation, name, field)
    expected = f"{EXPECTED}; give {field}, or clip=[{','.join(map(str, box(part)))}], a rectangle about it"
    rows = np.flatnonzero(part.any(axis=1))
    left, right = part[rows].argmax(axis=1), part.shape[1] - 1 - part[rows, ::-1].argmax(axis=1)
    sides = [_side(rows, left.astype(float)), _side(rows, -right.astype(float))]
    if any(side is None for side in sides):
        raise InputError(f"{name}: {expected}, found one without straight sides")
    (slope, start), (mirrored, end) = (side for side in sides if side is not None)
    left_deg, right_deg = np.rad2deg(np.arctan([slope, -mirrored]))
    least_deg = 5.0  # between the sides
    if right_deg - left_deg <= least_deg or max(-left_deg, right_deg) > STEEPEST_DEG:
        raise InputError(f"{name}: {expected}, found sides at {left_deg:.0f} and {right_deg:.0f} deg")
    v = (start + end) / -(slope + mirrored)
    u = start + slope * v
    first, last = _radii(part, u, v)
    before = Fan(u, v, 0.0, first, float(left_deg), float(right_deg))
    fan = replace(before, first_px=_face(mean, before), last_px=_end(deviation, replace(before, last_px=last)))
    inside = fan.mask((part.shape[0], part.shape[1]))
    within, stirring = inside[part].mean(), (deviation > STIRS_DN)[inside].mean()
    covered = 0.6  # share of the fan that stirs; black water doesn't, nor do shadows
    if within < WITHIN or stirring < covered:
        found = f"{100 * within:.0f} % of it in a fan, of which {100 * stirring:.0f} % change"
        raise InputError(f"{name}: {expected}, found {found}")
    return fan


def _face(mean: NDArray[np.float32], before: Fan) -> float:
    """Radius at which the face's ringing begins in the mean image, before the arc where changes do; there, if nothing rings."""
    ringing_dn = 8.0  # of the face, in the mean over time
    ringing = np.flatnonzero(_shares(mean > ringing_dn, before) > 0.5)
    return float(ringing[0]) if ringing.size else before.last_px


def _end(deviation: NDArray[np.float32], fan: Fan) -> float:
    """Radius at which the fan ends, maybe beyond its last clear changes: up to there at least the dark's noise stirs."""
    farthest = float(np.hypot(*deviation.shape) + abs(fan.v))
    stirring = np.flatnonzero(_shares(deviation > STIRS_DN, replace(fan, last_px=farthest)) > 0.5)
    return max(fan.last_px, float(stirring[-1]) + 1) if stirring.size else fan.last_px


def _shares(marked: Mask, fan: Fan) -> Array:
    """Share of marked pixels on each arc between a fan's sides, by its radius in px; 0 where it has no pixel."""
    y, x = np.nonzero(fan.mask((marked.shape[0], marked.shape[1])))
    ring = np.hypot(x - fan.u, y - fan.v).astype(int)
    pixels = np.bincount(ring, minlength=int(fan.last_px) + 1)
    return np.bincount(ring, marked[y, x], minlength=len(pixels)) / np.maximum(pixels, 1)


def _side(rows: NDArray[np.int64], outermost: Array) -> tuple[float, float] | None:
    """Slope and start of the line `outermost = start + slope row` near most of the rows down to the widest; None without one.

    Rows where the side is dark lie within it, be they as many as half of them.
    """
    count = int(outermost.argmin()) + 1
    least_rows = 20  # of a side
    if count < least_rows:
        return None
    rows, outermost = rows[:count], outermost[:count]
    tried_rows = 60  # of a side, through each two of which a line is laid
    tried = np.linspace(0, count - 1, min(tried_rows, count)).astype(int)
    one, other = tried[np.transpose(np.triu_indices(len(tried), 1))].T
    slopes = (outermost[other] - outermost[one]) / (rows[other] - rows[one])
    near_px = 2.0  # of a side
    near = np.abs(outermost - outermost[one, None] - slopes[:, None] * (rows - rows[one, None])) < near_px
    most = near[near.sum(axis=1).argmax()]
    straight = 0.5  # share of a side's rows near its line
    if most.mean() < straight:
        return None
    start, slope = np.polynomial.polynomial.polyfit(rows[most], outermost[most], 1)
    return float(slope), float(start)


def _radii(part: Mask, u: float, v: float) -> tuple[float, float]:
    """Radii of both arcs: the medians over directions of the first and the last pixel, where the image doesn't end before."""
    y, x = np.nonzero(part)
    radius, angle = np.hypot(x - u, y - v), np.arctan2(x - u, y - v)
    bins = 60  # of directions, in each of which the fan's first and last radius are taken
    place = np.digitize(angle, np.linspace(*np.quantile(angle, [0.02, 0.98]), bins))
    ends = np.array([np.quantile(radius[place == k], [0.002, 0.998]) for k in np.unique(place)[1:-1]])
    directions = np.array([angle[place == k].mean() for k in np.unique(place)[1:-1]])
    across, down = u + np.sin(directions) * ends[:, 1], v + np.cos(directions) * ends[:, 1]
    edge_px = 12  # of the image, within which an arc may be cut off
    free = (across > edge_px) & (across < part.shape[1] - edge_px) & (down < part.shape[0] - edge_px)
    last = np.median(ends[free, 1]) if free.any() else ends[:, 1].max()
    return float(np.median(ends[:, 0])), float(last)
