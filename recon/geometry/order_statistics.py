"""Quantiles, also in compiled code: `numpy.median` and its kin compile for seconds in each kernel that calls them."""

import numpy as np

from recon.compiled import njit

NORMAL_MAD = 1.4826  # standard deviation of a normal distribution over its median absolute deviation


@njit(error_model="numpy")
def quantile(values, share):
    """The value below which a share of the values : (n,) lies, as `numpy.quantile` interpolates. Puts them in another order.

    NaN of none.

    Source: Hoare 1961, Algorithm 65: find.
    """
    n = len(values)
    if n == 0:
        return np.nan
    at = (n - 1) * share
    below = int(at)
    low, high = 0, n - 1
    while low < high:  # until the value of this rank is in its place, with smaller ones before it
        pivot = values[(low + high) // 2]
        i, j = low, high
        while i <= j:
            while values[i] < pivot:
                i += 1
            while values[j] > pivot:
                j -= 1
            if i <= j:
                values[i], values[j] = values[j], values[i]
                i, j = i + 1, j - 1
        if below <= j:
            high = j
        elif below >= i:
            low = i
        else:
            break
    if at == below:
        return values[below]
    above = values[below + 1]
    for i in range(below + 2, n):
        above = min(above, values[i])
    return values[below] * (1 - (at - below)) + above * (at - below)


@njit(error_model="numpy")
def quantile_of(values, counted, share):
    """The same of those values that are counted : (n,) bool."""
    chosen, n = np.empty(len(values)), 0
    for i in range(len(values)):
        if counted[i]:
            chosen[n] = values[i]
            n += 1
    return quantile(chosen[:n], share)


@njit
def count(counted):
    """Number of those counted : (n,) bool."""
    total = 0
    for each in counted:
        total += each
    return total
