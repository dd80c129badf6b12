"""The tip of a needle or stylus in a B-scan: the end of a bright line, or a spot, or the reason of its rejection.

Seen along its length, a shaft is a bright line with echoes from within behind it, and the tip is the line's end inside the image.
The line comes from Hough's transform and a robust fit to its first echoes. Blurred by the beam, the line falls off evenly about
its end, so that the amplitude there is half of the shaft's. A bevel goes on aside from the shaft, and its tip is a spot. A shaft
that leaves the image's plane fades over a longer way: its end isn't the tip, and is rejected. Where the shaft crosses the plane
it is a spot, found as crossed wires are.

A pose by tracking may say roughly where the tip is. It chooses among lines and between a line's ends, and moves neither; lines
that end elsewhere, such as skin, are none then.
"""

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from recon.geometry.order_statistics import NORMAL_MAD
from recon.probe_calibration import cross_wire
from recon.probe_calibration.cross_wire import FACE_PERCENT, MATCHED_PX, Appearance

Array = NDArray[np.float64]

STEEPEST = 72.0  # deg, of a shaft to the array; steeper lines are comet tails
ANGLES = np.radians(np.arange(-STEEPEST, STEEPEST + 2, 2.0))  # of lines, from the array's direction down
FACE_ROWS, DEPTH_ROWS = 60, 81  # to which the face's ringing reaches; over which the background changes deeper down
BIN_PX = 3.0  # of a line's offset
NOISE = 4.0  # least height of a shaft's echo, in units of the noise
CEILING_DB = 20.0  # above the least height, beyond which brightness counts no more: lines count by their length
LINES = 5  # looked at, the strongest
ABOVE_PX, BELOW_PX = 15.0, 60.0  # from a line: echoes there are its own
BEVEL_PX = 60  # before a straight run's end, from where on its end may turn
ASIDE_PX, TURN_PX = 60, 2  # from a line, to where its end may turn, as a bevel does, and by how much from column to column
STRIP_PX, CORE_PX = 12, 5  # to both sides of a line: its first echoes, and those that are its level
FRONT_DB = 8.0  # below the strongest of a column, that the first echo may be
EVEN_DB = 22.0  # below its strongest, within which a shaft's echo lies: a spot's side lobes don't
SHORTEST_PX = 40.0  # of a shaft that is a line: 5 mm
GAP_PX = 25.0  # in a shaft, at most
BORDER_PX = 6.0  # from the image's sides and the face, within which a shaft may go on
RIVAL = 0.6  # of the strongest shaft's weight, from which on another one makes the image ambiguous
NEAR_PX, SIGMAS = 60.0, 3.0  # from the expected tip, within which one is taken, with its standard deviations
FAR = "no tip near where tracking has it"  # reason of a rejection
HALF_DB = 6.0  # below the shaft's level, at the tip: half of the amplitude
LEVEL_PX = (8, 40)  # before the end, between which the shaft's level is taken
FADE_DB, FADE_PX = 15.0, 17.0  # beyond the tip the echo falls by this within this way; a slower one fades out of the plane
SPOT_PX = 8  # before the end of a bevel, within which the last peak is its tip; facets behind it may be as bright
EDGE_PX = 5.0  # such a way of an even shaft
OUTSIDE_DB = -1e3
GRAIN_PX = 5.0  # length with one independent level
BLUR_PX, FLOOR_PX = 1.0, 0.5  # standard deviations of a tip's place along its shaft and across, at least


@dataclass(frozen=True)
class Expected:
    """A tip in an image by tracking."""

    pixel: Array  # (2,) px
    covariance: Array  # (2, 2) px^2
    direction: Array | None = None  # (2,) px, from the handle to the tip; None where the axis isn't known


@dataclass(frozen=True)
class NeedleEcho:
    """A tip in an image, or the reason of its rejection."""

    pixel: Array  # (2,) u, v of its first echo; NaN if there is none
    covariance: Array  # (2, 2) px^2
    contrast_db: float  # of the strongest echo above the background; NaN without any
    reason: str | None = None  # of the rejection
    shaft: Array | None = None  # (2, 2) px, ends of the line, the tip last; None of a spot

    @property
    def found(self) -> bool:
        """Whether there is a tip."""
        return self.reason is None

    def shifted(self, corner: tuple[int, int]) -> "NeedleEcho":
        """The same in an image of which this one is a part, from a pixel on."""
        return replace(self, pixel=self.pixel + corner, shaft=None if self.shaft is None else self.shaft + corner)


@dataclass(frozen=True)
class _Line:
    """A line in an image."""

    point: Array  # (2,) px
    along: Array  # (2,) of length 1, to larger u

    @property
    def normal(self) -> Array:
        """Towards the probe : (2,)."""
        return np.array([self.along[1], -self.along[0]])


@dataclass(frozen=True)
class _Shaft:
    """A line with its longest bright run."""

    line: _Line
    sigma_px: float  # of the line, across
    levels: Array  # (n,) dB along the line, a px
    first_px: float  # place of the first level from the line's point
    aside_px: Array  # (n,) of the echo from the line, towards the probe: beyond the straight run it may turn
    begin: int  # of the run, in the levels
    end: int

    @property
    def weight(self) -> float:
        """Its levels together."""
        return float(self.levels[self.begin : self.end].sum())

    @property
    def ends(self) -> Array:
        """Of the run : (2, 2) px."""
        return np.stack([self.pixel(self.begin), self.pixel(self.end - 1)])

    def pixel(self, place: float) -> Array:
        """Pixel : (2,) of a place in the levels."""
        aside = np.interp(place, np.arange(len(self.aside_px)), self.aside_px)
        return self.line.point + (self.first_px + place) * self.line.along + aside * self.line.normal


def find(image: NDArray, appearance: Appearance | None = None, expected: Expected | None = None) -> NeedleEcho:
    """Find the tip in a B-scan : (h, w), 8-bit grey levels, log-compressed."""
    look, level = appearance or Appearance(), np.asarray(image, np.float32)
    if level.ndim != 2 or min(level.shape) < 32:
        return _none(f"expected a grey image of at least 32x32 px, found shape {level.shape}")
    relief, least = _relief(level, look)
    if not (relief > least).any():
        return _none("no echo stands out")
    shafts, strongest = _shafts(relief, least), float(relief.max())
    if not shafts:
        spot = cross_wire.find(image, appearance)
        if spot.found and expected is not None and _off(spot.pixel[None], expected) > 1:
            return _none(FAR, strongest)
        return NeedleEcho(spot.pixel, spot.covariance, spot.contrast_db, spot.reason)
    low, high = np.array([0, look.top_px]) + BORDER_PX, np.array(relief.shape[::-1]) - 1 - BORDER_PX
    inside = [((one.ends > low) & (one.ends < high)).all(axis=1) for one in shafts]
    ending = [k for k, ends in enumerate(inside) if ends.any()]
    if not ending:
        return _none("ends at the image's border: the shaft goes through all of it", strongest)
    tips = [_tip(shafts[k], inside[k], least, strongest, expected) for k in ending]
    if expected is not None:
        ends = [one.pixel[None] if one.found else shafts[k].ends for k, one in zip(ending, tips, strict=True)]
        near = [k for k, each in enumerate(ends) if _off(each, expected) < 1]
        if not near:
            return _none(FAR, strongest)
        tips, ending = [tips[k] for k in near], [ending[k] for k in near]
    if len(tips) > 1 and shafts[ending[1]].weight > RIVAL * shafts[ending[0]].weight:
        places = ", ".join(f"({u:.0f}, {v:.0f})" for u, v in (shafts[k].ends.mean(axis=0) for k in ending[:2]))
        return _none(f"two candidates: shafts about {places}", strongest)
    return tips[0]


def _relief(level: NDArray[np.float32], look: Appearance) -> tuple[NDArray[np.float32], float]:
    """Levels above the background, dB : (h, w), smoothed, and the least of an echo."""
    smooth = cv2.GaussianBlur(level, (0, 0), sigmaX=MATCHED_PX[0], sigmaY=MATCHED_PX[1], borderType=cv2.BORDER_REPLICATE)
    rows = np.percentile(smooth, FACE_PERCENT, axis=1)
    evenly = ndimage.median_filter(rows, DEPTH_ROWS, mode="nearest")  # a bottom along the array is no background
    background = np.where(np.arange(len(rows)) < FACE_ROWS, rows, evenly)
    relief = (smooth - background[:, None]) / (255 / look.dynamic_range_db)
    relief -= np.median(relief)
    relief[: look.top_px] = 0
    return relief.astype(np.float32), max(NOISE * NORMAL_MAD * float(np.median(np.abs(relief))), look.min_contrast_db)


def _shafts(relief: NDArray[np.float32], least: float) -> list[_Shaft]:
    """The shafts in an image, the strongest first."""
    v, u = np.nonzero(relief > least)
    places, found = np.column_stack([u, v]).astype(float), []
    weights = np.minimum(relief[v, u] - least, CEILING_DB).astype(float)
    for _ in range(LINES):
        if len(places) < SHORTEST_PX:
            break
        line = _strongest_line(places, weights, float(np.hypot(*relief.shape)))
        shaft = _shaft(relief, least, line)
        if shaft is not None:
            found.append(shaft)
            line = shaft.line
        off = (places - line.point) @ line.normal
        others = (off > ABOVE_PX) | (off < (-BELOW_PX if shaft is not None else -ABOVE_PX))
        places, weights = places[others], weights[others]
    return sorted(found, key=lambda one: -one.weight)


def _strongest_line(places: Array, weights: Array, reach: float) -> _Line:
    """The line with the largest sum of weights beside it: Hough's transform."""
    best, line = -1.0, _Line(np.zeros(2), np.array([1.0, 0.0]))
    for angle in ANGLES:
        along = np.array([np.cos(angle), np.sin(angle)])
        depth = places[:, 1] * along[0] - places[:, 0] * along[1]
        sums = np.bincount(((depth + reach) / BIN_PX).astype(int), weights)
        sums = sums + np.append(sums[1:], 0)
        if sums.max() > best:
            best, middle = float(sums.max()), (int(sums.argmax()) + 1) * BIN_PX - reach
            line = _Line(middle * np.array([-along[1], along[0]]), along)
    return line


def _shaft(relief: NDArray[np.float32], least: float, line: _Line) -> _Shaft | None:
    """The line fitted to the first echoes beside it, with its longest bright run; None if that is short."""
    reach, sigma = np.hypot(*relief.shape), np.nan
    along, across = np.arange(-reach, reach + 1), np.arange(STRIP_PX, -STRIP_PX - 1, -1.0)
    for _ in range(4):
        strip = _sampled(relief, line, along, across)
        echo = (strip > least) & (strip > strip.max(axis=0) - FRONT_DB)
        echo[1:-1] &= (strip[1:-1] >= strip[:-2]) & (strip[1:-1] >= strip[2:])
        echo[[0, -1]] = False
        there = echo.any(axis=0)
        if there.sum() < SHORTEST_PX:
            return None
        row = echo.argmax(axis=0)[there]
        before, here, after = (strip[row + k, there] for k in (-1, 0, 1))
        front = across[row] - (before - after) / np.minimum(2 * (before - 2 * here + after), -1e-3)
        (height, slope), sigma = _robust_line(along[there], front)
        turned = line.along + slope * line.normal
        line = _Line(line.point + height * line.normal, turned / np.linalg.norm(turned))
    if abs(line.along[1]) > np.sin(np.radians(STEEPEST)):
        return None
    across = np.arange(ASIDE_PX, -ASIDE_PX - 1, -1.0)
    strip = _sampled(relief, line, along, across)
    core = strip[ASIDE_PX - CORE_PX : ASIDE_PX + CORE_PX + 1].max(axis=0)
    there = np.flatnonzero(core > OUTSIDE_DB)
    strip, core, first = strip[:, there[0] : there[-1] + 1], core[there[0] : there[-1] + 1], float(along[there[0]])
    begin, end = max(_runs(core > max(least, core.max() - EVEN_DB)), key=lambda run: run[1] - run[0], default=(0, 0))
    if end - begin < SHORTEST_PX:
        return None
    rows = _followed(strip, begin, end, least)
    beside = np.clip(rows + np.arange(-CORE_PX, CORE_PX + 1)[:, None], 0, len(strip) - 1)
    levels = strip[beside, np.arange(len(rows))].max(axis=0)
    levels[begin:end] = np.maximum(levels[begin:end], core[begin:end])
    longest = max(_runs(levels > max(least, core.max() - EVEN_DB)), key=lambda run: min(run[1], end) - max(run[0], begin))
    return _Shaft(line, sigma, levels, first, across[rows], *longest)


def _followed(strip: Array, begin: int, end: int, least: float) -> NDArray[np.intp]:
    """Rows : (n,) of a strip : (m, n) along which the echo goes on where it leaves the line at its ends, as a bevel's does."""
    middle = len(strip) // 2
    rows = np.full(strip.shape[1], middle)
    for columns in (range(max(end - BEVEL_PX, begin), len(rows)), range(min(begin + BEVEL_PX, end) - 1, -1, -1)):
        row, course = middle, np.full(len(columns), middle)
        for k, column in enumerate(columns):
            low = max(row - TURN_PX, 0)
            window = strip[low : row + TURN_PX + 1, column]
            row = low + int(window.argmax()) if window.max() > least else row
            course[k] = row
        bright = np.flatnonzero(strip[course, columns] > least)
        if len(bright) and abs(course[bright[-1]] - middle) > CORE_PX:
            rows[columns] = course
    return rows


def _sampled(relief: NDArray[np.float32], line: _Line, along: Array, across: Array) -> Array:
    """Levels : (m, n) at places along a line and across it, towards the probe; OUTSIDE_DB outside of the image."""
    places = line.point[:, None, None] + along * line.along[:, None, None] + across[:, None] * line.normal[:, None, None]
    inside = ((places >= 0) & (places <= np.array(relief.shape[::-1])[:, None, None] - 1)).all(axis=0)
    return np.where(inside, ndimage.map_coordinates(relief, places[::-1], order=1, mode="nearest"), OUTSIDE_DB)


def _robust_line(x: Array, y: Array) -> tuple[Array, float]:
    """Offset and slope : (2,) of a line through points, by the biweight, and the standard deviation of its offset."""
    fit, spread = np.array([np.median(y), 0.0]), np.inf
    for _ in range(8):
        left = y - fit[0] - fit[1] * x
        spread = max(NORMAL_MAD * float(np.median(np.abs(left))), 0.3)
        weights = np.maximum(1 - (left / (4.7 * spread)) ** 2, 0) ** 2
        design = np.column_stack([np.ones_like(x), x])
        fit = np.linalg.lstsq(np.sqrt(weights)[:, None] * design, np.sqrt(weights) * y)[0]
    return fit, 2 * spread * np.sqrt(GRAIN_PX / len(x))  # at a line's end twice that of its middle


def _runs(bright: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Begins and ends of bright runs, those with short gaps between joined."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], bright.astype(np.int8), [0]])))
    runs: list[tuple[int, int]] = []
    for begin, end in edges.reshape(-1, 2).tolist():
        joined = bool(runs) and begin - runs[-1][1] <= GAP_PX
        runs[len(runs) - joined :] = [(runs[-1][0] if joined else begin, end)]
    return runs


def _tip(shaft: _Shaft, inside: NDArray[np.bool_], least: float, contrast: float, expected: Expected | None) -> NeedleEcho:
    """The end of a shaft that is its tip: inside the image; of two such ends the one that is expected, or else the deeper one.

    inside : (2,) which ends are.
    """
    forward = bool(inside[1])
    if inside.all():
        if expected is None:
            towards = np.array([0.0, 1.0])
        else:
            towards = expected.pixel - shaft.ends.mean(axis=0) if expected.direction is None else expected.direction
        forward = bool(towards @ shaft.line.along > 0)
    levels = shaft.levels if forward else shaft.levels[::-1]
    begin, end = (shaft.begin, shaft.end) if forward else (len(levels) - shaft.end, len(levels) - shaft.begin)
    before = levels[max(end - LEVEL_PX[1], begin) : end - LEVEL_PX[0]]
    height = float(np.median(before))
    uneven = NORMAL_MAD * float(np.median(np.abs(before - height)))
    half, floor = height - HALF_DB, max(height - HALF_DB - FADE_DB, least)
    last = begin + int(np.flatnonzero(levels[begin:end] >= half)[-1])
    dark = levels[last + 1 :] < floor
    way = (int(dark.argmax()) + 1 if dark.any() else len(dark)) * FADE_DB / max(half - floor, 1.0)
    if way > FADE_PX:
        return _none(f"fades out over {way:.0f} px: the tip isn't in the image's plane", contrast)
    aside = shaft.aside_px if forward else shaft.aside_px[::-1]
    if abs(aside[last]) > CORE_PX:  # the end of a bevel, which is seen by what it diffracts: a spot
        start = max(last - SPOT_PX, begin + 1)
        near = levels[start - 1 : last + 2]
        peaks = np.flatnonzero((near[1:-1] >= near[:-2]) & (near[1:-1] >= near[2:]))
        place = float(start + (peaks[-1] if len(peaks) else near[1:-1].argmax()))
    else:
        place = last + (levels[last] - half) / max(levels[last] - levels[last + 1], 1e-6)
    pixel = shaft.pixel(place if forward else len(levels) - 1 - place)
    along = BLUR_PX**2 + (uneven * way / FADE_DB) ** 2 + (max(way - EDGE_PX, 0) / 2) ** 2
    axes = np.stack([shaft.line.along, shaft.line.normal], axis=1)
    covariance = axes @ np.diag([along, FLOOR_PX**2 + shaft.sigma_px**2]) @ axes.T
    return NeedleEcho(pixel, covariance, contrast, None, np.stack([shaft.ends[0 if forward else 1], pixel]))


def _off(ends: Array, expected: Expected) -> float:
    """Distance of the nearer of ends : (n, 2) from where the tip is expected, over the most that is near."""
    sigma = np.sqrt(np.linalg.eigvalsh(expected.covariance).max())
    return float(np.linalg.norm(ends - expected.pixel, axis=1).min() / (NEAR_PX + SIGMAS * sigma))


def _none(reason: str, contrast: float = np.nan) -> NeedleEcho:
    return NeedleEcho(np.full(2, np.nan), np.full((2, 2), np.nan), contrast, reason)
