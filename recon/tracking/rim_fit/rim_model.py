"""The fit of a ring's outer rim to the pixels beside it, compiled.

The band of pixels about the rim is modelled as the image of an elliptical edge: dark inside, bright outside, each side a plane
with offsets by sector (`sector_levels`), blurred by the lens (Gaussian) and by motion (a box along one direction), which together
are three numbers, the variance of the profile across the edge as it turns with the normal: `V = v0 + v1 cos 2phi + v2 sin 2phi`.
Motion by b px along psi makes the profile a box of width `b |cos(phi - psi)|`; along the edge it pulls the rim inwards by
`curvature (b sin(phi - psi))^2 / 24`. The white middle is part of the model as far as it blurs into the band.

Fourteen parameters, Gauss-Newton. The pixels of a sector share their derivatives but for five (the edge's place, both levels,
the variance, the gradient of light), so the loop over pixels makes sums of five unknowns a sector (`rim_sums`). Sectors that look
otherwise (a finger, a cable, the image's border) lose their weight. The noise is estimated from the residuals, apart for the dark
and the bright side.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from recon.compiled import njit
from recon.geometry.cholesky import solve_and_invert
from recon.threads import in_threads
from recon.tracking.rim_fit import sector_levels
from recon.tracking.rim_fit.rim_parameters import Rim, largest, moved, plausible
from recon.tracking.rim_fit.rim_sums import add_up, first_levels, middle_level
from recon.tracking.rim_fit.sector_levels import COMMON, NONE, REDUCED, Spread
from recon.tracking.rim_fit.sectors import (
    EDGE,
    LEVELS,
    SECTORS,
    SUMS,
    even_noise,
    geometry,
    side_noise,
    weigh,
)

BLOCKS = (0, 5, 8, 11, 14)  # first parameter of each common unknown of a sector: edge, plane inside, plane outside, variance
GLOBAL = 14  # parameters, in the order of `Rim`
SHAPE, ELLIPSE = 2, 5  # the first of the parameters a, b, c, and that after them
DARK_X, DARK_Y, BRIGHT_X, BRIGHT_Y, VARIANCE_COS, VARIANCE_SIN = 6, 7, 9, 10, 12, 13  # parameters
CAPTURE_STEPS = 8  # on every second pixel of every second row, from a rough ellipse
STEPS = 8  # on all pixels
SPREAD_STEPS = 3  # first steps on all pixels, after which spreads stay as they are, so that the rest may settle
CAPTURED = 0.1  # px
SETTLED = 4e-3  # px; the step after that is a tenth of it
RESTLESS = 0.2  # px, of the last step: beyond, the fit has not converged
FEWEST = 4  # pixels of a sector that count


START = np.dtype([
    ("second", bool),  # in the second of two images
    ("x", float), ("y", float),  # px, the centre
    ("a", float), ("b", float), ("c", float),  # px, the shape (a b; b c)
    ("reach", float),  # px, largest error of the rough rim
    ("hole", float),  # inner over outer diameter of the ring
    ("place_sigma", float), ("shape_sigma", float),  # px, standard deviations of what is known of the rim before, else inf
], align=True)  # fmt: skip
"""A rough rim to start from."""

FIT = np.dtype([
    ("x", float), ("y", float), ("a", float), ("b", float), ("c", float),
    ("covariance", float, (5, 5)),  # px^2, of these five
    ("inside", float),  # DN, of the dark ring
    ("outside", float),  # DN, of the white around it
    ("middle", float),  # DN, of the white within it
    ("noise", float, 2),  # DN, standard deviations on the dark and on the bright side
    ("variance", float, 3),  # px^2, of the profile: mean, cos 2phi, sin 2phi
    ("seen", float),  # share of sectors that look like a rim
    ("excess", float),  # mean squared residual of the sectors' edges, over its expectation
    ("uneven", float),  # DN, spread of the white from sector to sector
    ("found", bool),
], align=True)  # fmt: skip
"""A fitted rim."""


class Prior(NamedTuple):
    """Centre and shape before the fit, and their standard deviations, px."""

    x: float
    y: float
    a: float
    b: float
    c: float
    place_sigma: float
    shape_sigma: float


def fit_rims(first: NDArray, second: NDArray, starts: NDArray, fits: NDArray) -> None:
    """Fit n rims in two images of one type, from `starts` : (n,) START to `fits` : (n,) FIT, written where a rim is found."""

    def fit(begin: int, end: int) -> None:
        for i in range(begin, end):
            _fit(second if starts["second"][i] else first, starts, i, starts["hole"][i], fits)

    in_threads(fit, len(starts))


@njit(nogil=True, error_model="numpy")
def _fit(image, starts, i, hole, fits):
    """Fit rim i by Gauss-Newton, first to few pixels of a wide band, then to all of a narrow one."""
    start = starts[i]
    reach, level, variance = start.reach, 0.0, (start.reach / 2.5) ** 2 + 0.25
    rim = Rim(start.x, start.y, start.a, start.b, start.c, level, 0.0, 0.0, level, 0.0, 0.0, variance, 0.0, 0.0)
    if not plausible(rim, image.shape):
        return
    prior = Prior(rim.x, rim.y, rim.a, rim.b, rim.c, start.place_sigma, start.shape_sigma)
    found, rim, noise = first_levels(image, rim, reach, hole)
    if not found:
        return
    own, spread, weights = np.zeros(SECTORS, LEVELS), Spread(NONE, NONE, NONE), np.zeros(SECTORS)
    sums, reduced = np.zeros(SECTORS, SUMS), np.zeros(SECTORS, REDUCED)
    step, inverse, slopes = np.zeros(GLOBAL), np.zeros((GLOBAL, GLOBAL)), np.zeros((SECTORS, GLOBAL))
    change = np.inf
    for capture in (True, False):
        stride = 2 if capture and rim.a + rim.c > 40 else 1
        for k in range(CAPTURE_STEPS if capture else STEPS):
            sectors = geometry(rim, reach if capture else 0.0, hole)
            add_up(image, rim, own, noise, sectors, stride, hole, sums)
            usual = weigh(sums, sectors, rim, own, FEWEST if stride == 1 else 1, weights)
            if usual == 0:
                return
            noise = even_noise(noise, usual) if capture else side_noise(sums, weights, noise)
            if not capture and k < SPREAD_STEPS:
                spread = sector_levels.estimate_spread(sums, own, weights, math.pi * (rim.a + rim.c) / SECTORS, spread)
            sector_levels.eliminate(sums, own, spread, reduced)
            _slopes(sectors, slopes)
            if not _solve(reduced, weights, slopes, rim, prior, step, inverse):
                return
            rim = moved(rim, step, reach)
            sector_levels.update(own, reduced, _by_sector(slopes, step), weights)
            if not plausible(rim, image.shape):
                return
            change = largest(step, 0, 5)
            if change < (CAPTURED if capture else SETTLED) and (capture or k > 0):  # gradients count from the second step on
                break
    if change < RESTLESS:
        fit = fits[i]
        fit.x, fit.y, fit.a, fit.b, fit.c = rim.x, rim.y, rim.a, rim.b, rim.c
        for m in range(5):
            for n in range(5):
                fit.covariance[m, n] = inverse[m, n]
        fit.inside, fit.outside, fit.middle = rim.dark, rim.bright, middle_level(image, rim, hole)
        fit.noise[0], fit.noise[1] = math.sqrt(noise.dark), math.sqrt(noise.bright)
        fit.variance[0], fit.variance[1], fit.variance[2] = rim.variance, rim.variance_cos, rim.variance_sin
        fit.seen = _seen(weights)
        fit.excess = _excess(reduced, weights)
        fit.uneven = spread.bright
        fit.found = True


@njit(inline="always", error_model="numpy")
def _seen(weights):
    """Share of the sectors that look like a rim."""
    total = 0
    for weight in weights:
        total += weight > 0.5
    return total / SECTORS


@njit(error_model="numpy")
def _excess(reduced, weights):
    """Mean squared residual of the sectors' edges, over its expectation by the noise."""
    scores, total = 0.0, 0.0
    for j in range(SECTORS):
        total += weights[j]
        certainty = reduced[j].normal[EDGE, EDGE]
        if certainty > 0:
            scores += weights[j] * reduced[j].right[EDGE] ** 2 / certainty
    return scores / max(total - 6, 1.0)


@njit(error_model="numpy")
def _slopes(sectors, slopes):
    """Derivatives of each sector's edge, levels and variance by the parameters : (SECTORS, GLOBAL)."""
    for j in range(SECTORS):
        for m in range(1, COMMON):
            slopes[j, BLOCKS[m]] = 1.0  # a level by itself, as the mean variance
        sector = sectors[j]
        ux, uy, nx, ny = sector.ux, sector.uy, sector.nx, sector.ny
        slopes[j, 0], slopes[j, 1] = nx, ny
        slopes[j, 2], slopes[j, 3], slopes[j, 4] = nx * ux, nx * uy + ny * ux, ny * uy
        slopes[j, DARK_X], slopes[j, DARK_Y] = sector.x, sector.y
        slopes[j, BRIGHT_X], slopes[j, BRIGHT_Y] = sector.x, sector.y
        slopes[j, VARIANCE_COS], slopes[j, VARIANCE_SIN] = sector.cos, sector.sin


@njit(error_model="numpy")
def _by_sector(slopes, step):
    """A step of the parameters as steps of each sector's common unknowns : (SECTORS, COMMON)."""
    steps = np.zeros((SECTORS, COMMON))
    for m in range(COMMON):
        for p in range(BLOCKS[m], BLOCKS[m + 1]):
            for j in range(SECTORS):
                steps[j, m] += slopes[j, p] * step[p]
    return steps


@njit(error_model="numpy")
def _solve(reduced, weights, slopes, rim: Rim, prior: Prior, step, inverse):
    """Solve for the step : (14,) and the inverse of the normal matrix : (14, 14); False if they are undetermined."""
    normal, right = np.zeros((GLOBAL, GLOBAL)), np.zeros(GLOBAL)
    for j in range(SECTORS):
        if not weights[j] < 1e-6:
            _add_sector(reduced[j].normal, reduced[j].right, weights[j], slopes[j], normal, right)
    for p in range(GLOBAL):
        for q in range(p):
            normal[p, q] = normal[q, p]
    for k in range(ELLIPSE):
        hold = 1 / (prior.place_sigma if k < SHAPE else prior.shape_sigma) ** 2
        normal[k, k] += hold
        right[k] += hold * (prior[k] - rim[k])
    level = (rim.bright - rim.dark) ** 2 + 1
    for k in (DARK_X, DARK_Y, BRIGHT_X, BRIGHT_Y):  # light hardly doubles from one side of a ring to the other
        normal[k, k] += 4 / level
        right[k] -= 4 / level * rim[k]
    for k in range(GLOBAL):
        normal[k, k] += 1e-10 * normal[k, k] + 1e-12
    return solve_and_invert(normal, right, step, inverse)


@njit(error_model="numpy")
def _add_sector(own_normal, own_right, weight, slopes, normal, right):
    """Add a sector's equations over its common unknowns to those over the parameters, by the chain rule."""
    for m in range(COMMON):
        for n in range(m, COMMON):
            _add_block(weight * own_normal[m, n], slopes, m, n, normal)
        for p in range(BLOCKS[m], BLOCKS[m + 1]):
            right[p] += weight * own_right[m] * slopes[p]


@njit(inline="always", error_model="numpy")
def _add_block(known, slopes, m, n, normal):
    """Add the products of two common unknowns' slopes to the upper triangle of the normal matrix."""
    for p in range(BLOCKS[m], BLOCKS[m + 1]):
        for q in range(max(BLOCKS[n], p), BLOCKS[n + 1]):
            normal[p, q] += known * slopes[p] * slopes[q]
