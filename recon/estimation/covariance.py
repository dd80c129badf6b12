"""Covariances: of what depends on parameters, from information, and as roots, of parameters that have any units."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

SINGULAR = 1e-14  # of the largest eigenvalue: below, rounding decides


def propagate(slopes: Array, covariance: Array) -> Array:
    """Covariances : (..., m, m) of values that depend on parameters of a covariance : (..., g, g) by slopes : (..., m, g)."""
    return slopes @ covariance @ np.swapaxes(slopes, -1, -2)


def root(covariance: Array, least: float = 0.0) -> Array:
    """A matrix : (g, j) whose product with its transpose is a covariance : (g, g), of any rank.

    Its columns are the effects of j independent standard normal numbers.

    least : variance of a principal axis of the correlation from which on it counts.
    """
    sigma = np.sqrt(np.diag(covariance))
    unit = np.where(sigma > 0, sigma, 1.0)
    variances, axes = np.linalg.eigh(covariance / np.outer(unit, unit))
    kept = variances > least
    return unit[:, None] * axes[:, kept] * np.sqrt(variances[kept])


def whitening(covariance: Array) -> Array:
    """Matrices : (..., m, m) by which residuals of a covariance : (..., m, m) become independent, of variance 1."""
    return np.linalg.inv(np.linalg.cholesky(covariance))


def inverse(information: Array) -> Array:
    """Covariance : (g, g) by an information : (g, g), or the reverse; what is hardly determined varies widely."""
    scale = 1 / np.sqrt(np.maximum(np.diag(information), 1e-30))
    values, vectors = np.linalg.eigh(scale[:, None] * information * scale)
    half = scale[:, None] * vectors / np.sqrt(np.maximum(values, SINGULAR * values.max(initial=0.0)))
    return half @ half.T


def marginal(information: Array, right: Array, kept: NDArray[np.intp]) -> tuple[Array, Array]:
    """Normal equations : (k, k), (k,) of some unknowns, by their numbers : (k,), the others eliminated (Schur's complement)."""
    others = np.setdiff1d(np.arange(len(right)), kept)
    eliminate = information[np.ix_(kept, others)] @ inverse(information[np.ix_(others, others)])
    alone = information[np.ix_(kept, kept)] - eliminate @ information[np.ix_(others, kept)]
    return alone, right[kept] - eliminate @ right[others]
