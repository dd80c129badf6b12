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

import cv2
import numpy as np
from numba import prange
from numpy.typing import ArrayLike, NDArray

from recon.compiled import njit
from recon.errors import InputError
from recon.structured_light.decode import ProjectorMap

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
    """Projector coordinates of n points that a camera sees; NaN where the neighbourhood says too little."""

    pixels: Array  # (n, 2) projector px
    covariance: Array  # (n, 2, 2) projector px^2, of the fringes' noise alone: the camera's pixels are taken as exact
    gradient: Array  # (n, 2, 2) d(projector px) / d(camera px)


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
        raise InputError(f"patterns: correspondences expect fringes along both axes, found none of {missing[0]}")
    if image.shape != found.status.shape:
        size, wanted = ("x".join(map(str, shape[::-1])) for shape in (image.shape, found.status.shape))
        raise InputError(f"lit image: expected {wanted} grey, as the fringes, found {size}")
    centres = np.asarray(centres, float).reshape(-1, 2)
    reach = np.broadcast_to(np.asarray(reach_px, float), len(centres)).copy()
    level, slope = _slope(image)
    blur = _blur(level, slope, centres, reach)
    n = len(centres)
    pixels, covariance, gradient = np.full((n, 2), np.nan), np.full((n, 2, 2), np.nan), np.full((n, 2, 2), np.nan)
    for axis, (x, sigma) in enumerate(axes):
        pixels[:, axis], variance, gradient[:, axis], chi, freedom = _parabolas(x, sigma, level, slope, centres, reach, blur)
        covariance[:, axis, axis] = variance * _excess(chi, freedom)
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
    blur = np.full(len(centres), np.float64(BLUR[0]))
    for i in range(len(centres)):
        top, bottom, left, right = _window(centres[i], reach[i], level.shape)
        if bottom <= top or right <= left:
            continue
        dark, bright = np.percentile(level[top:bottom, left:right], np.array([5.0, 95.0]))
        if bright - dark > CONTRAST * bright:
            steepest = slope[top:bottom, left:right].max()
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


@njit(parallel=True)
def _parabolas(x, sigma, level, slope, centres, reach, blur):
    """Value, its variance and gradient at each point, NaN where the window says too little; chi-square and degrees of freedom."""
    n = len(centres)
    chi, freedom = np.zeros((n, len(BLOCKS))), np.zeros((n, len(BLOCKS)))
    value, variance, gradient = np.full(n, np.nan), np.full(n, np.nan), np.full((n, 2), np.nan)
    for i in prange(n):
        design, measured, deviation = _gather(x, sigma, level, slope, centres[i], reach[i], blur[i])
        if len(measured) < FEWEST:
            continue
        middle = np.median(measured)  # fitted about it, for the sake of the digits
        kept, beta = _inliers(design, measured - middle, deviation)
        if not _surrounded(design, deviation, kept):
            continue
        normal = _normal(design, np.where(kept, deviation**-2.0, 0.0))
        inverse = np.linalg.inv(normal)
        residual = measured - middle - design @ beta
        value[i] = middle + beta[0]
        variance[i] = inverse[0, 0]
        chi[i], freedom[i] = _chi_square(design, residual, deviation, kept, reach[i])
        gradient[i] = beta[1:3] / reach[i]
    return value, variance, gradient, chi, freedom


@njit
def _gather(x, sigma, level, slope, centre, reach, blur):
    """The window's trustworthy pixels: terms of the parabola : (m, 6) in units of reach, coordinates and sigmas : (m,) px."""
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
            design[m] = 1.0, u, v, u * u, u * v, v * v
            measured[m], deviation[m] = x[row, column], sigma[row, column]
            m += 1
    return design[:m], measured[:m], deviation[:m]


@njit
def _normal(design, weight):
    """Normal matrix : (6, 6); a trace of ridge keeps it invertible where pixels lie on a line, and such fits are refused."""
    normal = np.zeros((TERMS, TERMS))
    for i in range(len(design)):
        for a in range(TERMS):
            for b in range(a, TERMS):
                normal[a, b] += weight[i] * design[i, a] * design[i, b]
    for a in range(TERMS):
        for b in range(a):
            normal[a, b] = normal[b, a]
    return normal + np.eye(TERMS) * (1e-12 * np.trace(normal) + 1e-300)


@njit
def _solve(design, measured, weight):
    return np.linalg.solve(_normal(design, weight), design.T @ (weight * measured))


@njit
def _inliers(design, measured, deviation):
    """Which pixels follow one parabola : (m,) bool, and the parabola : (6,).

    Reweighted least squares gives the least absolute deviations of a part of the pixels, which a third of outliers doesn't move
    far; then all pixels within the clip are fitted, until they stay the same.
    """
    stride = max(len(measured) // STARTERS, 1)
    part, goal, noise = design[::stride].copy(), measured[::stride].copy(), deviation[::stride].copy()
    beta = _solve(part, goal, noise**-2.0)
    for _ in range(ROUNDS):
        beta = _solve(part, goal, 1 / (noise * np.maximum(np.abs(goal - part @ beta), noise)))
    kept = np.zeros(len(measured), np.bool_)
    for _ in range(ROUNDS):
        z = np.abs(measured - design @ beta) / deviation
        inside = z < CLIP * max(1.4826 * np.median(z), 1.0)
        if (inside == kept).all():
            break
        kept = inside
        beta = _solve(design, measured, np.where(kept, deviation**-2.0, 0.0))
    return kept, beta


@njit
def _surrounded(design, deviation, kept):
    """Whether the weight is not mostly outliers, and lies on all sides of the point."""
    total, inside, sides, count = 0.0, 0.0, np.zeros(8), 0
    for i in range(len(design)):
        weight = deviation[i] ** -2.0
        total += weight
        if not kept[i]:
            continue
        inside += weight
        count += 1
        for k in range(8):
            if design[i, 1] * math.cos(k * math.pi / 4) + design[i, 2] * math.sin(k * math.pi / 4) > BEYOND:
                sides[k] += weight
    return count >= FEWEST and inside > KEPT * total and sides.min() > SIDE * inside


@njit
def _chi_square(design, residual, deviation, kept, reach):
    """Chi-square of the means over blocks of each size, and its degrees of freedom : (sizes,) each."""
    chi, freedom = np.zeros(len(BLOCKS)), np.full(len(BLOCKS), -float(TERMS))
    for k, block in enumerate(BLOCKS):
        side = int(2 * reach / block) + 1
        sums, weights = np.zeros((side, side)), np.zeros((side, side))
        for i in range(len(residual)):
            if kept[i]:
                weight = deviation[i] ** -2.0
                row, column = int((design[i, 2] + 1) * reach / block), int((design[i, 1] + 1) * reach / block)
                sums[row, column] += weight * residual[i]
                weights[row, column] += weight
        for row in range(side):
            for column in range(side):
                if weights[row, column] > 0:
                    chi[k] += sums[row, column] ** 2 / weights[row, column]
                    freedom[k] += 1
    return chi, freedom


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
