"""A surface's echo in a B-scan: the line of a wall, or the arc of a sphere, with covariance, or the reason of its rejection.

Columns are averaged in narrow blocks. Each has some echoes, and most blocks have one of the surface: a curve through few of
these, drawn by chance, agrees with most others if it is the surface's. The uppermost such curve counts, for what lies below a
surface may be its back or a reverberation between it and the probe.

A rough surface scatters all over the slice's thickness, so a tilt across the image plane draws its echo out in depth. The echo's
middle stays where the plane itself meets the surface, while its upper edge comes from the near edge of the beam. The middle of
the bright core is therefore measured, which clipped grey levels don't shift.
"""

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter1d

from recon import arguments
from recon.estimation.persistence import persistence
from recon.geometry.order_statistics import NORMAL_MAD
from recon.probe_calibration.cross_wire import Appearance

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

BLOCK_PX = 4  # columns taken together
SIGMA_PX = 1.5  # smoothing in depth
NOISE = 6.0  # least height of an echo, in units of the noise
APART_PX = 6  # no other echo of a block within this
CORE_DB, CORE_PX = 10.0, 16  # part of an echo whose middle counts, and its half height at most
ECHOES = 4  # of a block, the brightest
FAINT_DB = 30.0  # below the brightest: no echo of the surface
NEAR_PX = 3.0  # of a curve, within which an echo agrees with it
DRAWS = 500  # of a curve's few points; of a third of all echoes on it 4 % are good
STEEPEST = 1.2  # slope of a line, or of an arc's ends
CURVES = 4  # looked for in an image
MIN_BLOCKS = 8  # that a curve has
MIN_WIDTH = 0.35  # of the image's, that a wall's line covers
FILLED, EVEN_DB = 0.5, 12.0  # of the blocks between a curve's ends, whose echoes are by less below its brightest
SAGITTA_PX, SURE = 2.0, 5.0  # from which on, and standard deviations, a curve is no line
UNITS = np.array([1, 1, 1e-3])  # of an arc's parameters, px, px and 1/px
MOST_TURN, CLEAR_TURN = 0.95, 0.6  # sine of an arc's half angle, at most, and within which echoes aren't drawn out
BELOW_PX = 4.0  # by which all of another curve lies below one whose reverberation or back it may be
FLOOR_PX = 0.1  # no curve counts as more exact than this
NO_ECHO, NO_LINE, NO_ARC = "no echo stands out", "no line", "no arc"
SHORT, CURVED, STRAIGHT, HOLLOW = "too short a line", "a curved line", "a straight line", "a hollow arc"
SEVERAL = "several lines or arcs"
NODES = {1: np.array([-1, 1]) / np.sqrt(3), 2: np.array([-1, 0, 1]) * np.sqrt(3 / 5)}  # of Gauss and Legendre, by the degree


@dataclass(frozen=True)
class Curve:
    """A line by two of its points, or an arc by three; or the reason of its rejection."""

    nodes: Array  # (k, 2) px; NaN if there is none
    covariance: Array  # (k, k) px^2 of their rows
    contrast_db: float  # of the strongest echo above the background; NaN without any
    reason: str | None = None  # of the rejection

    @property
    def found(self) -> bool:
        """Whether there is a curve."""
        return self.reason is None

    @property
    def pixel(self) -> Array:
        """Middle : (2,) px of the points."""
        return self.nodes.mean(axis=0)

    def shifted(self, corner: tuple[int, int]) -> "Curve":
        """The same in an image of which this one is a part, from a pixel on."""
        return replace(self, nodes=self.nodes + corner)


@dataclass(frozen=True)
class _Trace:
    """A curve through some echoes, the offset of its apex or start, and where it ends."""

    parameters: Array  # row at the middle column and slope, of a line; row and column of the apex and curvature, of an arc
    on: Mask  # (n,) echoes on it
    ends: tuple[float, float]  # columns
    covariance: Array  # of the parameters

    def rows(self, columns: Array) -> Array:
        """Rows at columns, NaN beside an arc's circle."""
        return _rows(self.parameters, columns)


def find_line(image: NDArray, appearance: Appearance | None = None) -> Curve:
    """Find the line of a wall in a B-scan : (h, w), 8-bit grey levels, log-compressed."""
    return _find(image, appearance, degree=1)


def find_arc(image: NDArray, appearance: Appearance | None = None) -> Curve:
    """Find the arc of a sphere's near side in a B-scan : (h, w), 8-bit grey levels, log-compressed, of nearly square pixels."""
    return _find(image, appearance, degree=2)


def _find(image: NDArray, appearance: Appearance | None, degree: int) -> Curve:
    look = appearance or Appearance()
    level = np.asarray(arguments.numbers("image", image), np.float32)
    if level.ndim != 2 or min(level.shape) < 32:
        return _none(f"expected a grey image of at least 32x32 px, found shape {level.shape}", degree)
    echoes, heights = _echoes(level, look)
    grey = 255 / look.dynamic_range_db  # levels a dB
    strongest = float(heights.max() / grey) if len(echoes) else np.nan
    bright = heights > heights.max(initial=-np.inf) - FAINT_DB * grey
    echoes, heights = echoes[bright], heights[bright] / grey
    if len(echoes) < MIN_BLOCKS:
        return _none(NO_ECHO, degree, strongest)
    traces = _traces(echoes, degree)
    if not traces:
        return _none((NO_LINE, NO_ARC)[degree - 1], degree, strongest)
    faults = [_fault(each, echoes, heights, level.shape[1]) for each in traces]
    good = [trace for trace, fault in zip(traces, faults, strict=True) if fault is None]
    if not good:
        return _none(next(fault for fault in faults if fault), degree, strongest)
    first = min(good, key=lambda each: float(np.median(echoes[each.on, 1])))
    if not all(each is first or _below(echoes[each.on], first) for each in good):
        return _none(SEVERAL, degree, strongest)
    middle, half = np.mean(first.ends), np.ptp(first.ends) / 2
    columns = middle + half * NODES[degree]
    slopes = _slopes(first.parameters, columns)
    covariance = slopes @ first.covariance @ slopes.T + FLOOR_PX**2 * np.eye(len(columns))
    return Curve(np.column_stack([columns, first.rows(columns)]), covariance, strongest)


def block_profiles(level: NDArray[np.float32], block_px: int) -> NDArray[np.float32]:
    """Grey levels over depth : (h, w / block_px) of an image : (h, w), columns taken together, smoothed in depth."""
    blocks = level.shape[1] // block_px
    profiles = level[:, : blocks * block_px].reshape(level.shape[0], blocks, block_px).mean(axis=2)
    return cv2.GaussianBlur(profiles, (1, 0), sigmaX=1e-6, sigmaY=SIGMA_PX) if blocks else profiles


def block_columns(blocks: int, block_px: int) -> Array:
    """Columns : (blocks,) px of their middles."""
    return (np.arange(blocks) + 0.5) * block_px - 0.5


def _echoes(level: NDArray[np.float32], look: Appearance) -> tuple[Array, Array]:
    """Middles : (n, 2) px of the brightest echoes of each block of columns, and their heights : (n,) above the background."""
    grey = 255 / look.dynamic_range_db
    profiles = block_profiles(level, BLOCK_PX)
    relief = profiles - np.median(profiles, axis=0)
    noise = NORMAL_MAD * np.median(np.abs(np.diff(profiles, axis=1))) / np.sqrt(2)  # a surface goes on in the next block
    before = np.full_like(profiles, -np.inf)
    window = 2 * APART_PX + 1
    before[1:] = maximum_filter1d(profiles, window, axis=0, origin=APART_PX, mode="nearest")[:-1]
    tops = (profiles >= maximum_filter1d(profiles, window, axis=0)) & (profiles > before)  # of equal ones the first
    tops &= relief > max(NOISE * noise, look.min_contrast_db * grey)
    tops[: look.top_px] = False
    v, block = np.nonzero(tops)
    rank = np.lexsort((-relief[v, block], block))
    v, block = v[rank], block[rank]
    place = np.arange(len(v)) - np.searchsorted(block, block)
    v, block = v[place < ECHOES], block[place < ECHOES]
    around = v[:, None] + np.arange(-CORE_PX, CORE_PX + 1)
    core = profiles[np.clip(around, 0, len(profiles) - 1), block[:, None]] - (profiles[v, block] - CORE_DB * grey)[:, None]
    core = np.where((around >= 0) & (around < len(profiles)), np.maximum(core, 0), 0)
    inside = core > 0
    inside[:, CORE_PX:] = np.logical_and.accumulate(inside[:, CORE_PX:], axis=1)
    inside[:, : CORE_PX + 1] = np.logical_and.accumulate(inside[:, CORE_PX::-1], axis=1)[:, ::-1]
    weights = core * inside
    whole = ~inside[:, 0] & ~inside[:, -1]  # neither cut by the image nor drawn out
    middles = (weights * around).sum(axis=1) / np.maximum(weights.sum(axis=1), 1e-9)
    points = np.column_stack([block_columns(profiles.shape[1], BLOCK_PX)[block], middles])
    return points[whole], relief[v, block][whole]


def _traces(echoes: Array, degree: int) -> list[_Trace]:
    """Curves that most echoes agree with, one after the other."""
    rng, left, traces = np.random.default_rng(0), np.ones(len(echoes), bool), []
    for _ in range(CURVES):
        if left.sum() < MIN_BLOCKS:
            break
        agreed = left & _agreement(echoes, left, degree, rng)
        if agreed.sum() < MIN_BLOCKS:
            break
        trace = _fitted(echoes, agreed, left, degree)
        left &= ~agreed
        if trace is not None:
            traces.append(trace)
            left &= ~(np.abs(trace.rows(echoes[:, 0]) - echoes[:, 1]) < 2 * NEAR_PX)
    return traces


def _agreement(echoes: Array, left: Mask, degree: int, rng: np.random.Generator) -> Mask:
    """Echoes : (n,) near the polynomial, of many through few points, that most agree with."""
    some = echoes[left]
    drawn = some[rng.integers(len(some), size=(DRAWS, degree + 1))]
    drawn = drawn[np.diff(np.sort(drawn[..., 0], axis=1), axis=1).min(axis=1) > 2 * BLOCK_PX]
    if not len(drawn):
        return np.zeros(len(echoes), bool)
    middle = echoes[:, 0].mean()
    powers = np.arange(degree + 1)
    polynomials = np.linalg.solve(((drawn[..., 0] - middle) / 100)[..., None] ** powers, drawn[..., 1, None])[..., 0]
    near = np.abs(polynomials @ ((echoes[:, 0] - middle) / 100) ** powers[:, None] - echoes[:, 1]) < NEAR_PX
    return near[(near & left).sum(axis=1).argmax()]


def _fitted(echoes: Array, agreed: Mask, left: Mask, degree: int) -> _Trace | None:
    """Least squares on the echoes near a curve, until these are the same; None where it has no end."""
    on, u = agreed, echoes[:, 0]
    for _ in range(5):
        if on.sum() < MIN_BLOCKS or np.ptp(u[on]) < MIN_BLOCKS * BLOCK_PX:
            return None
        parameters = _least_squares(echoes[on], degree)
        away = np.abs(_rows(parameters, u) - echoes[:, 1])
        before, on = on, left & (away < max(min(NEAR_PX, 4 * NORMAL_MAD * float(np.median(away[on]))), 1.0))
        if degree == 2:
            on &= np.abs(parameters[2] * (u - parameters[1])) < CLEAR_TURN
        on &= (u > u[before].min() - 6 * BLOCK_PX) & (u < u[before].max() + 6 * BLOCK_PX)
        if (on == before).all():
            break
    if on.sum() < MIN_BLOCKS or np.ptp(u[on]) < MIN_BLOCKS * BLOCK_PX:
        return None
    rows = _slopes(parameters, u[on])
    rest = echoes[on, 1] - _rows(parameters, u[on])
    variance = float(rest @ rest) / max(len(rest) - rows.shape[1], 1) * persistence(rest[np.argsort(u[on])][:, None])
    return _Trace(parameters, on, (float(u[on].min()), float(u[on].max())), variance * np.linalg.pinv(rows.T @ rows))


def _least_squares(points: Array, degree: int) -> Array:
    """A line; or an arc of a circle by its algebraic form (Kasa 1976), then Gauss-Newton steps on the rows' distances."""
    u, v = points.T
    if degree == 1:
        return np.polynomial.polynomial.polyfit(u, v, 1)
    middle = points.mean(axis=0)
    x, y = (points - middle).T
    aside, down, power = np.linalg.lstsq(np.column_stack([2 * x, 2 * y, np.ones_like(x)]), x**2 + y**2)[0]
    side, radius = np.sign(down) or 1.0, float(np.sqrt(max(power + aside**2 + down**2, 1.0)))
    parameters = np.array([middle[1] + down - side * radius, middle[0] + aside, side / radius])
    for _ in range(6):
        rest = v - _rows(parameters, u)
        step = np.linalg.lstsq(_slopes(parameters, u) * UNITS, np.nan_to_num(rest))[0] * UNITS
        while not np.isfinite(_rows(parameters + step, u)).all() and np.abs(step).max() > 1e-9:
            step = step / 2
        parameters = parameters + step
    return parameters


def _rows(parameters: Array, columns: Array) -> Array:
    """Rows of a curve at columns; NaN beside an arc's circle."""
    if len(parameters) == 2:
        return parameters[0] + parameters[1] * columns
    apex, middle, bend = parameters
    x = columns - middle
    sine = bend * x
    cosine = np.sqrt(np.where(np.abs(sine) < MOST_TURN, 1 - np.minimum(sine**2, 1), np.nan))
    return apex + bend * x**2 / (1 + cosine)


def _slopes(parameters: Array, columns: Array) -> Array:
    """Derivatives : (n, 2 | 3) of a curve's rows by its parameters."""
    if len(parameters) == 2:
        return np.column_stack([np.ones_like(columns), columns])
    _, middle, bend = parameters
    x = columns - middle
    cosine = np.sqrt(1 - np.minimum((bend * x) ** 2, MOST_TURN**2))
    by_bend = x**2 / cosine - x**2 / (1 + cosine)
    return np.column_stack([np.ones_like(x), -bend * x / cosine, by_bend])


def _fault(trace: _Trace, echoes: Array, heights: Array, width: int) -> str | None:
    """The reason to reject a curve as the surface's; heights : (n,) of the echoes, dB."""
    degree, length = len(trace.parameters) - 1, float(np.ptp(trace.ends)) + BLOCK_PX
    even = trace.on & (heights > np.percentile(heights[trace.on], 90) - EVEN_DB)
    if len(np.unique(echoes[even, 0])) < FILLED * length / BLOCK_PX:
        return (NO_LINE, NO_ARC)[degree - 1]
    if degree == 1:
        if abs(trace.parameters[1]) > STEEPEST:
            return NO_LINE
        if length < MIN_WIDTH * width:
            return f"{SHORT}: {100 * length / width:.0f} % of the image's width"
        sagitta, sigma = _sagitta(echoes[trace.on])
        return f"{CURVED}: by {abs(sagitta):.1f} px" if abs(sagitta) > max(SAGITTA_PX, SURE * sigma) else None
    sagitta, sigma = _sagitta(echoes[trace.on])
    if abs(sagitta) < max(SAGITTA_PX, SURE * sigma):
        return STRAIGHT
    return HOLLOW if sagitta < 0 else None


def _sagitta(points: Array) -> tuple[float, float]:
    """Depth, px, of a parabola through points : (n, 2) over their width, and its standard deviation."""
    x = points[:, 0] - (points[:, 0].min() + points[:, 0].max()) / 2
    half = max(np.abs(x).max(), 1.0)
    rows = np.column_stack([np.ones_like(x), x / half, (x / half) ** 2])
    solution = np.linalg.lstsq(rows, points[:, 1])[0]
    rest = points[:, 1] - rows @ solution
    variance = float(rest @ rest) / max(len(rest) - 3, 1) * persistence(rest[np.argsort(x)][:, None])
    return float(solution[2]), float(np.sqrt(variance * np.linalg.inv(rows.T @ rows)[2, 2]))


def _below(points: Array, first: _Trace) -> bool:
    """Whether points : (n, 2) lie below a curve, all of them, where it goes on beyond its ends."""
    return bool((points[:, 1] > first.rows(points[:, 0]) + BELOW_PX).all())


def _none(reason: str, degree: int, contrast: float = np.nan) -> Curve:
    return Curve(np.full((degree + 1, 2), np.nan), np.full((degree + 1, degree + 1), np.nan), contrast, reason)
