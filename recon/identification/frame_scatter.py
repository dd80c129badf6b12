"""Standard deviations of errors that each frame of a sequence has anew, from the errors found and their information."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

BLIND = 1e-9  # of the best known mode's information: a mode known less is one that the images can't show
AT_ZERO = 0.1  # of the largest density: one that is higher at zero doesn't exclude it
INTERVAL = 0.95
NINETY_FIVE = 1.96  # standard deviations to each side
GRID = 600  # standard deviations that are weighed


class Scatter(NamedTuple):
    """A standard deviation, by its posterior for a flat prior."""

    value: float  # median
    sigma: float  # by the longer arm of the interval of 95 %, as the posterior is skewed
    modes: float  # errors, or combinations of them, that are known better than they scatter


def scatter(information: Array, pull: Array, most: float) -> Scatter:
    """Estimate the standard deviation of n independent normal errors from an uncertain measurement of them.

    In the eigenvectors of its information the measurement is one of independent numbers, each with the variance of the errors
    and one of its own. Numbers as few as frames tell their standard deviation to `sqrt(1 / (2 (n - 1)))` of it at best, which
    the posterior has in it; where the errors are lost in those of the measurement, it reaches down to zero.

    Parameters
    ----------
    information : (n, n)
        Inverse covariance of the measurement; singular where errors can't be told from other things, such as their mean.
    pull : (n,)
        Information times measured errors.
    most : float
        Largest standard deviation that can be.

    Source: MacKay 1992 (evidence for a prior's width).
    """
    known, modes = np.linalg.eigh((information + information.T) / 2)
    seen = known > BLIND * max(known.max(), 1e-300)
    variances, errors = 1 / known[seen], (modes.T @ pull)[seen] / known[seen]
    found = most * np.linspace(0, 1, GRID + 1)[1:] ** 2
    total = variances + found[:, None] ** 2
    evidence = -0.5 * (np.log(total) + errors**2 / total).sum(axis=1)
    density = np.exp(evidence - evidence.max())
    below = np.cumsum(density * np.gradient(found))
    below /= below[-1]
    tails = np.array([(1 - INTERVAL) / 2, 0.5, (1 + INTERVAL) / 2])
    low, value, high = np.interp(tails, np.concatenate([[0], below]), np.concatenate([[0], found])).tolist()
    low = 0.0 if density[0] > AT_ZERO else low
    sigma = max(high - value, value - low) / NINETY_FIVE
    return Scatter(value, sigma, float((value**2 / (value**2 + variances)).sum()))
