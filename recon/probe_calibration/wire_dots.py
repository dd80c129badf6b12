"""Dots of N-wires in a B-scan, and the wire that each is of.

A wire that is met across its length is a short bright echo. Seen in a plane, the sides of all rows are an affine image of their
places in a section across them, for they are parallel: lengths of parallel rows keep their ratio, and three sides give the place
of the others, at any scale of the image. Rows that fit so, each with a dot between its ends, are the phantom's; reverberations,
the tank's bottom and other echoes fit hardly ever.

A phantom that looks the same from two sides leaves open which side is which. All such arrangements are kept: the motion of the
probe tells them apart, as of the four ways to see rows left to right or right to left, and upright or upside down.
"""

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from recon.geometry.order_statistics import NORMAL_MAD
from recon.model.wire_phantom import WirePhantom
from recon.probe_calibration.cross_wire import FACE_PERCENT, SEVERAL, Appearance

Array = NDArray[np.float64]

MATCHED_PX = (3.0, 1.5)  # along the array, in depth: smoothing before the search
APART_PX = (25, 13)  # no second dot within half of this
NOISE = 6.0  # least height of an echo, in units of the noise
NO_ROW, UNLIKE = "no dots in a row of three", "no rows as the phantom's"  # reasons of a rejection
SPARE = 8  # echoes looked at beyond the phantom's wires, the brightest
TAIL_PX, TAIL_DB = (15.0, 25.0), 6.0  # place of a tail beside and below its echo, at most, and least difference of both
SLOPE_DB = 2.0  # by which an echo may rise beside its highest point, as such rows make it
CORE_DB = 8.0  # an echo's part of which the centre counts
RAGGED = 0.1  # standard deviation of a dot's centre, of its extent: echoes of oblique wires are uneven
FLOOR_PX = 0.3  # no dot counts as more exact than this
SHORTEST_PX = 20.0  # of a row
OFF_ROW = 0.03  # most distance of a middle dot from its row, of the row's length
ALIKE = 0.06  # most difference of rows from the phantom's, of the longest row's length: 1 sigma is SIGMA
SIGMA = 0.015
BEYOND = 0.08  # of a row's width, that a diagonal may be seen beyond its ends: wires go on to where they are fixed
LIKELY = 12.0  # squared residuals, in sigmas, by which another arrangement of the same dots must fit worse, to be left out
RIVAL = 3.0  # the same of other dots, within which none is chosen
UNEVEN = 3.0  # most ratio of the image's scales along its axes, with the stretch of a tilted plane
MOST_SETS = 5000  # rows together that are gone on with, those that fit best
BLOCK = 500  # rows compared with all others at once
SAME_PX = 3.0  # between centres of one echo that has two tops
DIM_DB = 6.0  # that is as unlikely as a residual of 1 sigma


@dataclass(frozen=True)
class Dots:
    """The dots of a phantom's wires in an image, or the reason of its rejection."""

    arrangements: Array  # (a, 3 p, 2) px: dots by wire, the likeliest first; several where sides can't be told apart
    covariance: Array  # (a, 3 p, 2, 2) px^2
    contrast_db: float  # of the strongest echo above the background; NaN without any
    reason: str | None = None  # of the rejection

    @property
    def found(self) -> bool:
        """Whether the dots of all wires were found."""
        return self.reason is None

    @property
    def pixel(self) -> Array:
        """Middle : (2,) px of the dots; NaN if there are none."""
        return self.arrangements[0].mean(axis=0) if len(self.arrangements) else np.full(2, np.nan)

    def shifted(self, corner: tuple[int, int]) -> "Dots":
        """The same in an image of which this one is a part, from a pixel on."""
        return replace(self, arrangements=self.arrangements + corner)


@dataclass(frozen=True)
class _Echoes:
    """Short echoes in an image, the brightest first."""

    centres: Array  # (n, 2) px
    covariance: Array  # (n, 2, 2) px^2
    contrast_db: Array  # (n,) above the background


def find(image: NDArray, phantom: WirePhantom, appearance: Appearance | None = None) -> Dots:
    """Find the dots of all wires in a B-scan : (h, w), 8-bit grey levels, log-compressed."""
    look = appearance or Appearance()
    echoes = _short_echoes(np.asarray(image, np.float32), look, phantom.count + SPARE)
    strongest = float(echoes.contrast_db.max(initial=-np.inf)) if len(echoes.centres) else np.nan
    if not len(echoes.centres):
        return _none("no echo stands out", strongest)
    if len(echoes.centres) < phantom.count:
        return _none(f"too few dots: {len(echoes.centres)} of {phantom.count} wires", strongest)
    rows = _rows_of_three(echoes.centres, phantom)
    if not len(rows):
        return _none(NO_ROW, strongest)
    chosen, costs = _arranged(echoes, rows, phantom)
    if not len(chosen):
        return _none(UNLIKE, strongest)
    best = np.sort(chosen[0])
    same = (np.sort(chosen, axis=1) == best).all(axis=1)
    if (~same & (costs < costs[0] + RIVAL)).any():
        return _none(f"{SEVERAL}: other dots fit the phantom as well", strongest)
    kept = chosen[same & (costs < costs[0] + LIKELY)]
    return Dots(echoes.centres[kept], echoes.covariance[kept], strongest)


def _short_echoes(level: NDArray[np.float32], look: Appearance, most: int) -> _Echoes:
    """Short bright echoes in a B-scan : (h, w), with their centres: the mean of their cores, weighted by level."""
    grey = 255 / look.dynamic_range_db  # levels a dB
    smooth = cv2.GaussianBlur(level, (0, 0), sigmaX=MATCHED_PX[0], sigmaY=MATCHED_PX[1], borderType=cv2.BORDER_REPLICATE)
    relief = smooth - np.percentile(smooth, FACE_PERCENT, axis=1, keepdims=True)  # rows bright along the whole array are no dots
    relief -= np.median(relief)
    noise = NORMAL_MAD * np.median(np.abs(relief))
    threshold = max(NOISE * noise, look.min_contrast_db * grey)
    around = cv2.dilate(relief, np.ones((APART_PX[1], APART_PX[0]), np.uint8))
    v, u = np.nonzero((relief >= around) & (relief > threshold))
    order = np.argsort(-relief[v, u], kind="stable")
    order = order[v[order] >= look.top_px]
    centres, covariance, contrasts = [], [], []
    for k in order:
        if len(centres) == most:
            break
        measured = _centre(smooth, (int(u[k]), int(v[k])), grey, look)
        if measured is not None and not _belongs(measured[0], relief[v[k], u[k]] / grey, centres, contrasts):
            centres.append(measured[0])
            covariance.append(measured[1])
            contrasts.append(relief[v[k], u[k]] / grey)
    return _Echoes(np.reshape(centres, (-1, 2)), np.reshape(covariance, (-1, 2, 2)), np.array(contrasts, float))


def _belongs(centre: Array, contrast_db: float, brighter: list[Array], their_db: list[float]) -> bool:
    """Whether an echo is a second top of a brighter one, or the comet tail of one close above it that is brighter by some dB."""
    for each, db in zip(brighter, their_db, strict=True):
        aside, below = centre - each
        tail = abs(aside) <= TAIL_PX[0] and 0 < below <= TAIL_PX[1] and contrast_db < db - TAIL_DB
        if tail or np.hypot(aside, below) < SAME_PX:
            return True
    return False


def _centre(smooth: NDArray[np.float32], peak: tuple[int, int], grey: float, look: Appearance) -> tuple[Array, Array] | None:
    """Centre : (2,) px of an echo and its covariance : (2, 2); None of one that is drawn out, or cut by the border."""
    u, v = peak
    reach = (int(look.max_extent_px[0]) + 2, int(look.max_extent_px[1]) + 2)
    top, left = max(v - reach[1], 0), max(u - reach[0], 0)
    window = smooth[top : v + reach[1] + 1, left : u + reach[0] + 1]
    edge = smooth[v, u] - CORE_DB * grey
    labels, _ = ndimage.label(window > edge)
    rows, columns = np.nonzero(labels == labels[v - top, u - left])
    if window[rows, columns].max() > smooth[v, u] + SLOPE_DB * grey:
        return None  # on the slope of a brighter one
    if np.ptp(columns) + 1 > look.max_extent_px[0] or np.ptp(rows) + 1 > look.max_extent_px[1]:
        return None
    height, width = smooth.shape
    if rows.min() + top == 0 or columns.min() + left == 0 or rows.max() + top == height - 1 or columns.max() + left == width - 1:
        return None
    weights = window[rows, columns].astype(float) - edge
    places = np.column_stack([columns + left, rows + top]).astype(float)
    centre = weights @ places / weights.sum()
    spread = np.cov(places.T, aweights=weights, bias=True) if len(places) > 1 else np.zeros((2, 2))
    return centre, 12 * RAGGED**2 * spread + FLOOR_PX**2 * np.eye(2)


def _rows_of_three(centres: Array, phantom: WirePhantom) -> NDArray[np.int64]:
    """Numbers : (r, 3) of dots : (n, 2) that lie on one line, the second between the others; each row both ways."""
    n = len(centres)
    first, last = np.nonzero(~np.eye(n, dtype=bool))
    ends = centres[last] - centres[first]
    length = np.linalg.norm(ends, axis=1)
    arms = centres[None] - centres[first][:, None]  # (pairs, n, 2)
    share = (arms * ends[:, None]).sum(axis=-1) / length[:, None] ** 2
    off = (arms[..., 0] * ends[:, None, 1] - arms[..., 1] * ends[:, None, 0]) / length[:, None] ** 2
    reach = phantom.shares_of_ends()
    fits = (share > reach.min() - BEYOND) & (share < reach.max() + BEYOND) & (np.abs(off) < OFF_ROW)
    fits &= (length > SHORTEST_PX)[:, None]
    fits[np.arange(len(first)), first] = fits[np.arange(len(first)), last] = False
    pair, middle = np.nonzero(fits)
    return np.column_stack([first[pair], middle, last[pair]])


def _arranged(echoes: _Echoes, rows: NDArray[np.int64], phantom: WirePhantom) -> tuple[NDArray[np.int64], Array]:
    """Dots by wire : (a, 3 p) that look as the phantom does, the likeliest first, and their costs : (a,) as squares of sigmas."""
    share, sides = shares(echoes.centres[rows]), echoes.centres[rows[:, ::2]]
    reach = np.sort(phantom.shares_of_ends(), axis=1)
    fit = [np.flatnonzero((share > low - BEYOND) & (share < high + BEYOND)) for low, high in reach]
    widths, along = phantom.sections[:, 1, 0] - phantom.sections[:, 0, 0], sides[:, 1] - sides[:, 0]
    sets = fit[0][:, None]
    for row, here in enumerate(fit[1:], start=1):
        first, second = _parallel(along[sets[:, 0]] * widths[row] / widths[0], along[here])
        sets = np.column_stack([sets[first], here[second]])
        off = _misfit(sides[sets], phantom.sections[: row + 1])
        sets = sets[np.argsort(off, kind="stable")[: min(MOST_SETS, int((off < ALIKE).sum()))]]
    wires = rows[sets].reshape(len(sets), phantom.count)
    distinct = (np.diff(np.sort(wires, axis=1), axis=1) > 0).all(axis=1) & _even(sides[sets], phantom.sections)
    wires, off = wires[distinct], _misfit(sides[sets[distinct]], phantom.sections)
    dim = (echoes.contrast_db.max() - echoes.contrast_db[wires]).sum(axis=1) / DIM_DB
    costs = (off / SIGMA) ** 2 + dim
    order = np.argsort(costs, kind="stable")
    return wires[order], costs[order]


def _parallel(one: Array, other: Array) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Numbers of the pairs of vectors : (n, 2) and : (m, 2) px that are nearly alike, for a part of the first at once."""
    pairs = []
    for begin in range(0, len(one), BLOCK):
        some = one[begin : begin + BLOCK, None]
        off = np.abs(some - other).max(axis=-1)
        first, second = np.nonzero(off < 2 * ALIKE * np.linalg.norm(some, axis=-1))
        pairs.append(np.stack([first + begin, second]))
    first, second = np.concatenate([np.zeros((2, 0), np.int64), *pairs], axis=1)
    return first, second


def shares(dots: Array) -> Array:
    """Shares : (...) of the way from the first of three dots : (..., 3, 2) to the last, at which the second lies."""
    length = dots[..., 2, :] - dots[..., 0, :]
    return ((dots[..., 1, :] - dots[..., 0, :]) * length).sum(axis=-1) / (length**2).sum(axis=-1)


def _affine(sides: Array, sections: Array) -> tuple[Array, Array]:
    """Affine maps : (n, 3, 2) px of places of sides in the phantom : (p, 2, 2) mm to dots : (n, p, 2, 2), and what they leave."""
    design = np.column_stack([sections.reshape(-1, 2), np.ones(sections.size // 2)])
    dots = sides.reshape(len(sides), len(design), 2)
    maps = np.linalg.pinv(design) @ dots
    return maps, dots - design @ maps


def _misfit(sides: Array, sections: Array) -> Array:
    """Length : (n,) of what an affine map leaves of dots, over that of the longest row."""
    longest = np.linalg.norm(sides[:, :, 1] - sides[:, :, 0], axis=-1).max(axis=1)
    return np.sqrt((_affine(sides, sections)[1] ** 2).sum(axis=(1, 2))) / longest


def _even(sides: Array, sections: Array) -> NDArray[np.bool_]:
    """Whether no direction is stretched much more than another : (n,); one row alone shows one direction."""
    if len(sections) == 1:
        return np.ones(len(sides), bool)
    stretch = np.linalg.svd(_affine(sides, sections)[0][:, :2], compute_uv=False)
    return stretch[:, 0] < UNEVEN * stretch[:, 1]


def _none(reason: str, contrast: float) -> Dots:
    return Dots(np.zeros((0, 0, 2)), np.zeros((0, 0, 2, 2)), contrast, reason)
