"""Residuals of neighbouring frames that are alike: these count as fewer."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def persistence(normalised: Array) -> float:
    """Frames that count as one, by whitened residuals : (n, m) of n frames in order; 1 of independent ones.

    Sum of their autocorrelation, of both signs of the delay, until it is lost in noise.
    """
    (n, m), total = normalised.shape, 1.0
    power = float((normalised**2).mean())
    for delay in range(1, n // 3):
        correlation = float((normalised[delay:] * normalised[:-delay]).mean()) / power
        if not correlation >= 2 / np.sqrt(m * (n - delay)):  # of no residuals at all neither
            break
        total += 2 * correlation
    return total
