"""Projector correspondences: which projector coordinate lights a board's point, read from the fringes around it.

A point that a camera finds, a disc's centre or a corner, lies between pixels, and single pixels are noisy. On the board's plane
the map from camera to projector pixels is a homography bent a little by two lenses, so a parabola over a window about the point
carries the coordinate of thousands of pixels to it. What the parabola leaves out is of third order, which is odd about the point
and moves the gradient only, and of fourth order, below 0.0001 px for a board tilted by 40 degrees.

A pixel beside an edge of the albedo is biased. It sees the fringes where its point spread is bright, not where its middle is. For
a Gaussian point spread of width s the shift is `s^2 grad(I) / I` exactly, with I the image as seen: pixels shifted further than
0.02 px are left out.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from recon.compiled import njit
from recon.errors import InputError
from recon.geometry.cholesky import solve_and_invert
from recon.geometry.order_statistics import NORMAL_MAD, quantile
from recon.structured_light.decode import ProjectorMap
from recon.threads import in_threads

Array = NDArray[np.float64]

SMOOTHING = 1.0  # px, sigma of the Gaussian before the gradient: against the lit image's noise
SHIFT = 0.02  # camera px by which an edge of the albedo may shift what a pixel sees
BLUR = 1.0, 4.0  # px, least and largest width of an edge: the smoothing's own, and a lens far out of focus
CONTRAST = 0.25  # of the bright side: windows of less hold no edge to measure the blur on
CLIP = 4.0  # sigmas from the parabola, beyond which a pixel is an outlier
KEPT = 0.6  # least share of the weight that must be no outlier
BEYOND = 0.3  # of the reach: pixels at least so far out in a direction hold the parabola on that side
SIDE = 0.1  # least share of the weight on each of eight such sides, of the 0.3 of an even window: no extrapolation
FEWEST = 60  # pixels, ten a coefficient
BLOCKS = 1, 5, 11  # px, sides of the blocks whose means tell whether errors are larger or correlated
SURE = 4.0  # sigmas by which a window's chi-square must exceed the median to count
STARTERS = 400  # pixels that the first, robust fit looks at
ROUNDS = 10  # of either iteration, at most
TERMS = 6  # of a parabola: 1, u, v, u^2, u v, v^2


@dataclass(frozen=True)
class Correspondences:
    """Projector coordinates of n points in a camera's image; NaN where the neighbourhood holds too few good pixels."""

    pixels: Array  # (n, 2) projector px
    covariance: Array  # (n, 2, 2) projector px^2, of the fringes' noise alone: the camera's pixels are taken as exact
    gradient: Array  # (n, 2, 2) d(projector px) / d(camera px)


class _Fringes(NamedTuple):
    """Images : (h, w) float32 along one axis."""

    x: NDArray[np.float32]  # projector px
    sigma: NDArray[np.float32]  # projector px
    level: NDArray[np.float32]  # DN, lit and smoothed
    slope: NDArray[np.float32]  # DN/px, the length of its gradient


class _Windows(NamedTuple):
    """The windows about n points."""

    centres: Array  # (n, 2) camera px
    reach: Array  # (n,) camera px
    blur: Array  # (n,) camera px, width of the edges


class _Parabolas(NamedTuple):
    """Values of the parabolas of n windows at their points; NaN where a window holds too few good pixels."""

    value: Array  # (n,) projector px
    variance: Array  # (n,) projector px^2
    gradient: Array  # (n, 2) projector px/camera px
    chi: Array  # (n, sizes) chi-square of the means over blocks
    freedom: Array  # (n, sizes) its degrees of freedom

    @staticmethod
    def of(fringes: _Fringes, windows: _Windows) -> "_Parabolas":
        """Fitted to the windows."""
        n, sizes = len(windows.reach), len(BLOCKS)
        value, variance, gradient = np.full(n, np.nan), np.full(n, np.nan), np.full((n, 2), np.nan)
        found = _Parabolas(value, variance, gradient, np.zeros((n, sizes)), np.zeros((n, sizes)))
        in_threads(_fit_parabolas, n, fringes, windows, found)
        return found


def correspondences(found: ProjectorMap, image: NDArray, centres: ArrayLike, reach_px: ArrayLike) -> Correspondences:
    """Projector coordinates of points on a smooth, patterned surface.

    A parabola in the camera's coordinates is fitted to the decoded coordinate, for each axis by itself, with the weights
    1 / sigma^2 of the predicted noise. Outliers (orders wrong by a period, dust, another surface) are found from a fit of least
    absolute deviations and clipped at four sigmas. Where the residuals are larger than predicted, of the pixels or of their means
    over blocks, the covariance grows by as much: the median of all windows, or that of a window that stands out.

    Parameters
    ----------
    found : ProjectorMap
        Of a sequence along both axes.
    image : (h, w), DN
        The same view, fully lit, for the edges of the albedo.
    centres : (n, 2) camera px
    reach_px : float or (n,), camera px
        Radius of the window; 1.7 times that of a disc takes in enough of the white around it.

    Raises
    ------
    InputError
        If an axis isn't encoded, or the lit image is of another size.

    Source: the mean of a Gaussian times a function, from the derivative of their convolution.
    """
    axes = ((found.columns, found.sigma_columns), (found.rows, found.sigma_rows))
    missing = [name for name, (x, _) in zip(("columns", "rows"), axes, strict=True) if x is None]
    if missing:
        raise InputError(f"patterns: correspondences expect fringes or Gray code along both axes, found none of {missing[0]}")
    if image.shape != found.status.shape:
        size, wanted = ("x".join(map(str, shape[::-1])) for shape in (image.shape, found.status.shape))
        raise InputError(f"lit image: expected {wanted} grey, as the fringes, found {size}")
    centres = np.asarray(centres, float).reshape(-1, 2)
    reach = np.broadcast_to(np.asarray(reach_px, float), len(centres)).copy()
    level, slope = _slope(image)
    windows = _Windows(np.ascontiguousarray(centres), reach, _blur(level, slope, centres, reach))
    n = len(centres)
    pixels, covariance, gradient = np.full((n, 2), np.nan), np.full((n, 2, 2), np.nan), np.full((n, 2, 2), np.nan)
    for axis, (x, sigma) in enumerate(axes):
        parabolas = _Parabolas.of(_Fringes(x, sigma, level, slope), windows)
        pixels[:, axis], gradient[:, axis] = parabolas.value, parabolas.gradient
        covariance[:, axis, axis] = parabolas.variance * _excess(parabolas.chi, parabolas.freedom)
    off = np.where(np.isfinite(pixels).all(axis=1), 0.0, np.nan)  # the fringes of the axes are different images
    covariance[:, 0, 1] = covariance[:, 1, 0] = off
    nowhere = np.isnan(off)
    pixels[nowhere], covariance[nowhere], gradient[nowhere] = np.nan, np.nan, np.nan
    return Correspondences(pixels, covariance, gradient)


def _slope(image: NDArray) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """The smoothed image and the length of its gradient : (h, w) DN and DN a px."""
    level = cv2.GaussianBlur(np.asarray(image, np.float32), (0, 0), SMOOTHING)
    across, down = (cv2.Sobel(level, cv2.CV_32F, du, dv, ksize=1, scale=0.5) for du, dv in ((1, 0), (0, 1)))
    return level, cv2.magnitude(across, down)


@njit
def _blur(level, slope, centres, reach):
    """Width of the edges in each window : (n,) px, from `contrast = sqrt(2 pi) * width * steepest slope`."""
    blur = np.empty(len(centres))
    for i in range(len(centres)):
        blur[i] = BLUR[0]
        top, bottom, left, right = _window(centres[i], reach[i], level.shape)
        if bottom <= top or right <= left:
            continue
        levels, m, steepest = np.empty((bottom - top) * (right - left)), 0, 0.0
        for row in range(top, bottom):
            for column in range(left, right):
                levels[m] = level[row, column]
                m += 1
                steepest = max(steepest, slope[row, column])
        dark, bright = quantile(levels, 0.05), quantile(levels, 0.95)
        if bright - dark > CONTRAST * bright:
            blur[i] = min(max((bright - dark) / (math.sqrt(2 * math.pi) * steepest), BLUR[0]), BLUR[1])
    return blur


@njit
def _window(centre, reach, shape):
    """The rows and columns within reach of a point: top, bottom, left, right, ends not included."""
    if not (math.isfinite(centre[0]) and math.isfinite(centre[1])):
        return 0, 0, 0, 0
    top, bottom = max(math.ceil(centre[1] - reach), 0), min(math.floor(centre[1] + reach) + 1, shape[0])
    left, right = max(math.ceil(centre[0] - reach), 0), min(math.floor(centre[0] + reach) + 1, shape[1])
    return top, bottom, left, right


@njit(nogil=True, error_model="numpy")
def _fit_parabolas(first, end, fringes, windows, found):
    """Fit the parabolas of windows `first` to `end`, not included; those with too few good pixels stay NaN."""
    for i in range(first, end):
        reach = windows.reach[i]
        design, measured, deviation = _gather(fringes, windows.centres[i], reach, windows.blur[i])
        if len(measured) < FEWEST:
            continue
        middle = quantile(measured.copy(), 0.5)  # fitted about it, for the sake of the digits
        for k in range(len(measured)):
            measured[k] -= middle
        kept, beta, inverse = _inliers(design, measured, deviation)
        if not _surrounded(design, deviation, kept):
            continue
        found.value[i] = middle + beta[0]
        found.variance[i] = inverse[0, 0]
        found.gradient[i, 0], found.gradient[i, 1] = beta[1] / reach, beta[2] / reach
        for k in range(len(measured)):
            measured[k] -= _at(design, k, beta)
        _chi_square(design, measured, deviation, kept, reach, found.chi[i], found.freedom[i])


@njit
def _gather(fringes, centre, reach, blur):
    """The window's trustworthy pixels: terms of the parabola : (m, 6) in units of reach, coordinates and sigmas : (m,) px."""
    x, sigma, level, slope = fringes
    top, bottom, left, right = _window(centre, reach, x.shape)
    room = max(bottom - top, 0) * max(right - left, 0)
    design, measured, deviation = np.empty((room, TERMS)), np.empty(room), np.empty(room)
    m = 0
    for row in range(top, bottom):
        for column in range(left, right):
            u, v = (column - centre[0]) / reach, (row - centre[1]) / reach
            if u * u + v * v > 1 or not sigma[row, column] > 0 or not math.isfinite(x[row, column]):
                continue
            if blur * blur * slope[row, column] > SHIFT * level[row, column]:
                continue
            design[m, 0], design[m, 1], design[m, 2] = 1.0, u, v
            design[m, 3], design[m, 4], design[m, 5] = u * u, u * v, v * v
            measured[m], deviation[m] = x[row, column], sigma[row, column]
            m += 1
    return design[:m], measured[:m], deviation[:m]


@njit(error_model="numpy")
def _solve(design, measured, weight, stride):
    """Least squares over every `stride`-th pixel: the parabola : (6,) and the inverse of the normal matrix : (6, 6).

    A trace of ridge keeps the matrix invertible where pixels lie on a line, and such fits are refused; else the parabola is NaN.
    """
    normal, right, beta, inverse = np.zeros((TERMS, TERMS)), np.zeros(TERMS), np.empty(TERMS), np.empty((TERMS, TERMS))
    for i in range(0, len(measured), stride):
        for a in range(TERMS):
            right[a] += weight[i] * design[i, a] * measured[i]
            for b in range(a + 1):
                normal[a, b] += weight[i] * design[i, a] * design[i, b]
    trace = 0.0
    for a in range(TERMS):
        trace += normal[a, a]
    for a in range(TERMS):
        normal[a, a] += 1e-12 * trace + 1e-300
    if not solve_and_invert(normal, right, beta, inverse):
        for a in range(TERMS):
            beta[a] = np.nan
    return beta, inverse


@njit(inline="always", error_model="numpy")
def _at(design, i, beta):
    """The parabola at a pixel."""
    total = 0.0
    for a in range(TERMS):
        total += design[i, a] * beta[a]
    return total


@njit(error_model="numpy")
def _inliers(design, measured, deviation):
    """Which pixels follow one parabola : (m,) bool, the parabola : (6,), and its covariance : (6, 6).

    Reweighted least squares gives the least absolute deviations of a part of the pixels, which a third of outliers doesn't move
    far; then all pixels within the clip are fitted, until they stay the same.
    """
    m = len(measured)
    stride = max(m // STARTERS, 1)
    weight, z, kept = np.empty(m), np.empty(m), np.zeros(m, np.bool_)
    for i in range(m):
        weight[i] = 1 / deviation[i] ** 2
    beta, inverse = _solve(design, measured, weight, stride)
    for _ in range(ROUNDS):
        for i in range(0, m, stride):
            weight[i] = 1 / (deviation[i] * max(abs(measured[i] - _at(design, i, beta)), deviation[i]))
        beta, inverse = _solve(design, measured, weight, stride)
    for _ in range(ROUNDS):
        for i in range(m):
            z[i] = abs(measured[i] - _at(design, i, beta)) / deviation[i]
        clip = CLIP * max(NORMAL_MAD * quantile(z.copy(), 0.5), 1.0)
        settled = True
        for i in range(m):
            settled &= kept[i] == (z[i] < clip)
            kept[i] = z[i] < clip
            weight[i] = 1 / deviation[i] ** 2 if kept[i] else 0.0
        if settled:
            break
        beta, inverse = _solve(design, measured, weight, 1)
    return kept, beta, inverse


@njit(error_model="numpy")
def _surrounded(design, deviation, kept):
    """Whether the weight is not mostly outliers, and lies on all sides of the point."""
    total, inside, sides, count = 0.0, 0.0, np.zeros(8), 0
    for i in range(len(design)):
        weight = 1 / deviation[i] ** 2
        total += weight
        if not kept[i]:
            continue
        inside += weight
        count += 1
        for k in range(8):
            if design[i, 1] * math.cos(k * math.pi / 4) + design[i, 2] * math.sin(k * math.pi / 4) > BEYOND:
                sides[k] += weight
    for k in range(8):
        if not sides[k] > SIDE * inside:
            return False
    return count >= FEWEST and inside > KEPT * total


@njit(error_model="numpy")
def _chi_square(design, residual, deviation, kept, reach, chi, freedom):
    """Chi-square of the means over blocks of each size, and its degrees of freedom : (sizes,) each, in place."""
    for k, block in enumerate(BLOCKS):
        chi[k], freedom[k] = 0.0, -TERMS
        side = int(2 * reach / block) + 1
        sums, weights = np.zeros((side, side)), np.zeros((side, side))
        for i in range(len(residual)):
            if kept[i]:
                weight = 1 / deviation[i] ** 2
                row, column = int((design[i, 2] + 1) * reach / block), int((design[i, 1] + 1) * reach / block)
                sums[row, column] += weight * residual[i]
                weights[row, column] += weight
        for row in range(side):
            for column in range(side):
                if weights[row, column] > 0:
                    chi[k] += sums[row, column] ** 2 / weights[row, column]
                    freedom[k] += 1


def _excess(chi: Array, freedom: Array) -> Array:
    """Factors on the variances : (n,), at least 1, from chi-square a degree of freedom : (n, sizes) of both.

    One window's is uncertain by a fifth: what all have in common is their median, and more than that must stand out by itself.
    """
    seen = (freedom > 0).all(axis=1)
    if not seen.any():
        return np.ones(len(chi))
    freedom = np.maximum(freedom, 1)
    own = chi / freedom
    common = np.median(own[seen], axis=0)
    factor = np.where(own > common + SURE * np.sqrt(2 / freedom), own, common)
    return np.maximum(factor.max(axis=1), 1)
