"""Light that differs from sector to sector beyond a plane: fringes, the edge of a shadow, the sheen of a cable; compiled.

Each sector has three levels of its own: offsets from the planes inside and outside (DN), and a gradient outwards (DN/px). They
are normal numbers of mean 0 with a spread that is estimated from the sectors themselves: under even light it vanishes, and with
it the cost of these levels; under fringes each sector all but stands alone. The gradient's spread is that of the gradient along
the rim. Own levels are eliminated from a sector's normal equations before the rim's are solved.

Source of the idea: Morris 1983, Parametric empirical Bayes inference, J. Am. Stat. Assoc. 78.
"""

import math
from typing import NamedTuple

import numpy as np

from recon.compiled import njit
from recon.tracking.rim_fit.cholesky import solve_and_invert
from recon.tracking.rim_fit.sectors import BRIGHT, DARK, GROWTH, SECTORS, free_levels

MEDIAN = 0.455  # of a square of a normal number of mean 0 and variance 1
NONE = 1e-3  # DN, DN/px: a spread that is as good as none
COMMON = 4  # unknowns of a sector that follow from the rim's: edge, planes inside and outside, variance
OWN = (DARK, BRIGHT, GROWTH)  # of a sector's unknowns, those with a level of its own


class Spread(NamedTuple):
    """Standard deviations of own levels over the sectors."""

    dark: float  # DN
    bright: float  # DN
    growth: float  # DN/px


REDUCED = np.dtype([
    ("normal", float, (COMMON, COMMON)),  # the upper triangle
    ("right", float, COMMON),
    ("response", float, (3, COMMON + 1)),  # of own levels to the common unknowns, and their step without these
])  # fmt: skip
"""A sector's normal equations over the common unknowns, with own levels eliminated."""


@njit(error_model="numpy")
def estimate_spread(sums, own, weights, arc, before: Spread):
    """Spread of own levels, from medians over the sectors that count, else as before; `arc` is a sector's length, px.

    The variance by noise is subtracted from each square before the median, so that even light keeps a spread of none.
    """
    free = free_levels(sums)
    dark, bright, growth = before.dark, before.bright, before.growth
    counted = (weights > 0.5) & (free.dark_variance > 0)
    if counted.sum() > 0:
        dark = _spread_beyond_noise(own.dark + free.dark, free.dark_variance, counted)
        bright = _spread_beyond_noise(own.bright + free.bright, free.bright_variance, counted)
    leaning = own.leaning[own.leaning != 0]  # of sectors between two that count
    if len(leaning) > 0:
        growth = max(math.sqrt(np.median(leaning**2) / MEDIAN) / arc, NONE)
    return Spread(dark, bright, growth)


@njit(error_model="numpy")
def _spread_beyond_noise(levels, variance, counted):
    """Robust standard deviation of levels, less their variance by noise."""
    squares = levels**2 - variance
    return math.sqrt(max(np.median(squares[counted]) / MEDIAN, NONE**2))


@njit(error_model="numpy")
def eliminate(sums, own, spread: Spread, reduced):
    """Fill the sectors' normal equations over the common unknowns : (SECTORS,) REDUCED, with own levels eliminated."""
    held, across, inverse, unused = np.empty((3, 3)), np.empty((3, COMMON + 1)), np.empty((3, 3)), np.empty(3)
    for j in range(SECTORS):
        normal, right, response = reduced[j].normal, reduced[j].right, reduced[j].response
        normal[:], right[:], response[:] = 0, 0, 0
        if not sums[j].count > 0:
            continue
        _hold(sums[j], own[j], spread, held, across)
        if not solve_and_invert(held, across[:, COMMON], unused, inverse):
            continue
        _multiply(inverse, across, response)
        for m in range(COMMON):
            for n in range(m, COMMON):
                normal[m, n] = sums[j].normal[m, n] - (across[:, m] * response[:, n]).sum()
            right[m] = sums[j].right[m] - (across[:, m] * response[:, COMMON]).sum()


@njit(inline="always", error_model="numpy")
def _hold(sums, own, spread: Spread, held, across):
    """Normal matrix of a sector's own levels with their prior : (3, 3); and their coupling to the rest : (3, COMMON + 1)."""
    normal, levels = sums.normal, (own.dark, own.bright, own.growth)
    for p in range(3):
        hold = 1 / spread[p] ** 2
        for q in range(3):
            held[p, q] = normal[OWN[p], OWN[q]]
        held[p, p] += hold
        for n in range(COMMON):
            across[p, n] = normal[OWN[p], n]
        across[p, COMMON] = sums.right[OWN[p]] - hold * levels[p]


@njit(inline="always", error_model="numpy")
def _multiply(left, right, product):
    """Add the product of two small matrices."""
    for p in range(left.shape[0]):
        for n in range(right.shape[1]):
            for q in range(left.shape[1]):
                product[p, n] += left[p, q] * right[q, n]


@njit(error_model="numpy")
def update(own, reduced, steps, weights):
    """Update the sectors' offsets and tangential gradients after steps of their common unknowns : (SECTORS, COMMON)."""
    for j in range(SECTORS):
        response = reduced[j].response
        own.dark[j] += response[0, COMMON] - (response[0, :COMMON] * steps[j]).sum()
        own.bright[j] += response[1, COMMON] - (response[1, :COMMON] * steps[j]).sum()
        own.growth[j] += response[2, COMMON] - (response[2, :COMMON] * steps[j]).sum()
    for j in range(SECTORS):
        before, after = (j - 1) % SECTORS, (j + 1) % SECTORS
        known = min(weights[before], weights[j], weights[after]) > 0.5
        own.leaning[j] = (own.bright[after] - own.bright[before]) / 2 if known else 0.0
