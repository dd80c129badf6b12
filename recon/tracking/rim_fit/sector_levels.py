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
from recon.geometry.cholesky import solve_and_invert
from recon.geometry.order_statistics import count, quantile_of
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
    dark_squares, bright_squares, leaning_squares = np.empty(SECTORS), np.empty(SECTORS), np.empty(SECTORS)
    counted, between = np.empty(SECTORS, np.bool_), np.empty(SECTORS, np.bool_)
    for j in range(SECTORS):
        counted[j] = weights[j] > 0.5 and free.dark_variance[j] > 0
        between[j] = own[j].leaning != 0  # two that count
        dark_squares[j] = (own[j].dark + free.dark[j]) ** 2 - free.dark_variance[j]
        bright_squares[j] = (own[j].bright + free.bright[j]) ** 2 - free.bright_variance[j]
        leaning_squares[j] = own[j].leaning ** 2
    if count(counted) > 0:
        dark = math.sqrt(max(quantile_of(dark_squares, counted, 0.5) / MEDIAN, NONE**2))
        bright = math.sqrt(max(quantile_of(bright_squares, counted, 0.5) / MEDIAN, NONE**2))
    if count(between) > 0:
        growth = max(math.sqrt(quantile_of(leaning_squares, between, 0.5) / MEDIAN) / arc, NONE)
    return Spread(dark, bright, growth)


@njit(error_model="numpy")
def eliminate(sums, own, spread: Spread, reduced):
    """Fill the sectors' normal equations over the common unknowns : (SECTORS,) REDUCED, with own levels eliminated."""
    held, across, inverse, unused, goal = np.empty((3, 3)), np.empty((3, COMMON + 1)), np.empty((3, 3)), np.empty(3), np.empty(3)
    for j in range(SECTORS):
        normal, right, response = reduced[j].normal, reduced[j].right, reduced[j].response
        for m in range(COMMON):
            for n in range(COMMON):
                normal[m, n] = 0.0
            right[m] = 0.0
        for p in range(3):
            for n in range(COMMON + 1):
                response[p, n] = 0.0
        if not sums[j].count > 0:
            continue
        _hold(sums[j], own[j], spread, held, across)
        for p in range(3):
            goal[p] = across[p, COMMON]
        if not solve_and_invert(held, goal, unused, inverse):
            continue
        _multiply(inverse, across, response)
        for m in range(COMMON):
            for n in range(m, COMMON):
                normal[m, n] = sums[j].normal[m, n] - _product(across, m, response, n)
            right[m] = sums[j].right[m] - _product(across, m, response, COMMON)


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


@njit(inline="always", error_model="numpy")
def _product(left, m, right, n):
    """Inner product of column m and column n."""
    total = 0.0
    for p in range(3):
        total += left[p, m] * right[p, n]
    return total


@njit(error_model="numpy")
def update(own, reduced, steps, weights):
    """Update the sectors' offsets and tangential gradients after steps of their common unknowns : (SECTORS, COMMON)."""
    for j in range(SECTORS):
        response = reduced[j].response
        dark, bright, growth = 0.0, 0.0, 0.0
        for m in range(COMMON):
            dark += response[0, m] * steps[j, m]
            bright += response[1, m] * steps[j, m]
            growth += response[2, m] * steps[j, m]
        own[j].dark += response[0, COMMON] - dark
        own[j].bright += response[1, COMMON] - bright
        own[j].growth += response[2, COMMON] - growth
    for j in range(SECTORS):
        before, after = (j - 1) % SECTORS, (j + 1) % SECTORS
        known = min(weights[before], weights[j], weights[after]) > 0.5
        own[j].leaning = (own[after].bright - own[before].bright) / 2 if known else 0.0
