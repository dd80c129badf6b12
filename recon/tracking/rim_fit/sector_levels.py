"""What light does from sector to sector of a rim beyond a plane: fringes, the edge of a shadow, the sheen of a cable; compiled.

Each sector has three levels of its own, by which it is off the planes inside and outside (DN) and by which light grows outwards
there (DN/px). They are normal numbers of mean 0 whose spread the sectors themselves tell: under even light it vanishes, and with
it all that these levels cost; under fringes each sector all but stands alone. Light is taken to change outwards as much as along
the rim. Own levels are eliminated from a sector's normal equations before the rim's are solved.

Source of the idea: Morris 1983, Parametric empirical Bayes inference, J. Am. Stat. Assoc. 78.
"""

import math

import numpy as np

from recon.compiled import njit
from recon.tracking.rim_fit.cholesky import solve_and_invert
from recon.tracking.rim_fit.sectors import BRIGHT, COUNT, DARK, GROWTH, LEANING, RIGHT, SECTORS, UNKNOWNS, alone

MEDIAN = 0.455  # of a square of a normal number of mean 0 and variance 1
NONE = 1e-3  # DN, DN/px: a spread that is as good as none
COMMON = 4  # unknowns of a sector that follow from the rim's: edge, planes inside and outside, variance
REDUCED = 14  # the upper triangle of COMMON x COMMON and the right side
HELD = (1, 2, 4)  # of a sector's unknowns, those that have a level of its own


@njit(error_model="numpy")
def tell_spread(sums, own, weights, arc, spread):
    """Standard deviations of own levels : (3,), from medians over the sectors that count; `arc` is a sector's length, px.

    The noise is taken from the median itself, not its share of it: what chance makes of even light is told as even.
    """
    free, variance = alone(sums)
    counted = (weights > 0.5) & (variance[:, DARK] > 0)
    if counted.sum() > 0:
        for k in (DARK, BRIGHT):
            squares = (own[:, k] + free[:, k]) ** 2 - variance[:, k]
            spread[k] = math.sqrt(max(np.median(squares[counted]) / MEDIAN, NONE**2))
    leaning = own[:, LEANING][own[:, LEANING] != 0]  # of sectors between two that count
    if len(leaning) > 0:
        spread[GROWTH] = max(math.sqrt(np.median(leaning**2) / MEDIAN) / arc, NONE)


@njit(error_model="numpy")
def _unpack(row, table):
    """A sector's sums as its normal matrix and right side : (UNKNOWNS, UNKNOWNS + 1)."""
    k = 0
    for m in range(UNKNOWNS):
        for n in range(m, UNKNOWNS):
            table[m, n] = table[n, m] = row[k]
            k += 1
        table[m, UNKNOWNS] = row[RIGHT + m]


@njit(error_model="numpy")
def eliminate(sums, own, spread, reduced, follow):
    """Sums over what is common to the rim : (SECTORS, REDUCED), with own levels eliminated.

    `follow` : (SECTORS, 3, 5) is how these follow each of COMMON, and how far they are off where those stay.
    """
    reduced[:], follow[:] = 0, 0
    table = np.empty((UNKNOWNS, UNKNOWNS + 1))
    held, across, inverse, unused = np.empty((3, 3)), np.empty((3, 5)), np.empty((3, 3)), np.empty(3)
    for j in range(SECTORS):
        if not sums[j, COUNT] > 0:
            continue
        _unpack(sums[j], table)
        for p in range(3):
            hold = 1 / spread[p] ** 2
            for q in range(3):
                held[p, q] = table[HELD[p], HELD[q]]
            held[p, p] += hold
            for n in range(COMMON):
                across[p, n] = table[HELD[p], n]
            across[p, COMMON] = table[HELD[p], UNKNOWNS] - hold * own[j, p]
        if not solve_and_invert(held, across[:, COMMON], unused, inverse):
            continue
        for p in range(3):
            for n in range(COMMON + 1):
                for q in range(3):
                    follow[j, p, n] += inverse[p, q] * across[q, n]
        k = 0
        for m in range(COMMON):
            for n in range(m, COMMON):
                reduced[j, k] = table[m, n] - (across[:, m] * follow[j, :, n]).sum()
                k += 1
        for m in range(COMMON):
            reduced[j, k + m] = table[m, UNKNOWNS] - (across[:, m] * follow[j, :, COMMON]).sum()


@njit(error_model="numpy")
def move(own, follow, steps, weights):
    """Move own levels : (SECTORS, OWN) after steps : (SECTORS, COMMON), and tell from neighbours how light leans."""
    for j in range(SECTORS):
        for p in range(3):
            own[j, p] += follow[j, p, COMMON] - (follow[j, p, :COMMON] * steps[j]).sum()
    for j in range(SECTORS):
        before, after = (j - 1) % SECTORS, (j + 1) % SECTORS
        known = min(weights[before], weights[j], weights[after]) > 0.5
        own[j, LEANING] = (own[after, BRIGHT] - own[before, BRIGHT]) / 2 if known else 0.0
