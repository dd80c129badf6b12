"""Quantiles of the few values that count, sorted by insertion; compiled."""

import numpy as np

from recon.compiled import njit


@njit(error_model="numpy")
def quantile(values, counted, share):
    """The value below which lies a share of those counted : (n,) bool, as `numpy.quantile` interpolates; NaN without any."""
    ordered, n = np.empty(len(values)), 0
    for i in range(len(values)):
        if counted[i]:
            k = n
            while k > 0 and ordered[k - 1] > values[i]:
                ordered[k] = ordered[k - 1]
                k -= 1
            ordered[k] = values[i]
            n += 1
    if n == 0:
        return np.nan
    below = int((n - 1) * share)
    beyond = (n - 1) * share - below
    return ordered[below] * (1 - beyond) + ordered[min(below + 1, n - 1)] * beyond


@njit
def count(counted):
    """Number of those counted : (n,) bool."""
    total = 0
    for each in counted:
        total += each
    return total
