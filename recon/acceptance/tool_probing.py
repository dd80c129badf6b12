"""A tracked tool whose tip stands in divots of a calibrated plate: how far it scatters in one, and where it is between two.

The two tests are those of ASTM F2554 in kind: repeatability at a single point, with the tool at rest or turned about it, and
accuracy of distances. Neighbouring frames share errors, so that they count as fewer.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from recon.estimation.persistence import persistence

Array = NDArray[np.float64]


class Seated(NamedTuple):
    """The tip in a divot."""

    mean: Array  # (3,) mm in the world
    covariance: Array  # (3, 3) mm^2 of the mean
    rms_mm: float  # distance of the tip from its mean, root mean square
    rms_sigma_mm: float  # standard deviation of that, by another recording
    frames: int
    freedom: float  # degrees of freedom of the covariance


def probe_divot(places: Array) -> Seated:
    """Mean and scatter of a tip's places : (n, 3) mm in a divot, in the order of time, n >= 3.

    Squares of distances are alike among fewer neighbours than places are, so that their own persistence counts for the RMS.
    """
    away = places - places.mean(axis=0)
    independent = max(len(places) / persistence(away), 2.0)
    freedom = independent - 1
    scatter = away.T @ away / len(places) * independent / freedom  # of a frame
    rms = float(np.sqrt(np.trace(scatter)))
    squares = np.sum(away**2, axis=1, keepdims=True) - np.mean(np.sum(away**2, axis=1))
    sigma = float(squares.std()) * np.sqrt(persistence(squares) / len(places)) / (2 * rms) if rms > 0 else 0.0
    return Seated(places.mean(axis=0), scatter / independent, rms, sigma, len(places), freedom)
