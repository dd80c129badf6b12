"""Least squares of what images of a board in several poses have in common, with scatter as the images themselves show it."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from recon.estimation.covariance import inverse
from recon.estimation.levenberg_marquardt import descend
from recon.geometry.order_statistics import NORMAL_MAD

Array = NDArray[np.float64]

ROUNDS = 3  # in which scatter is found and outliers are left out
CHANCE = 2.0  # standard deviations from which on scatter counts as more than noise
TINY = 1e-9  # of scatter between poses that show none, and of an unknown's slopes
LEAST_DAMPING = 1e-12  # keeps unknowns in place that nothing shows


class PoseFit(NamedTuple):
    """The unknowns that fit."""

    values: Array  # (g,)
    covariance: Array  # (g, g)
    kept: NDArray[np.bool_]  # (n,) no outliers
    scatter: float  # of one pose's values, over their noise; at least 1
    between: float  # standard deviation by which all values of a pose are off alike, beyond noise
    gain: Array  # (g, n) changes of the unknowns by one of each value; 0 of outliers


def fit_in_poses(
    measured: Array,
    sigma: Array,
    pose: NDArray[np.int64],
    predict: Callable[[Array], tuple[Array, Array]],
    start: Array,
    units: Array,
    held: Array,
    *,
    free: int,
    outlier: float = 5.0,
) -> PoseFit:
    """Fit unknowns to values that were measured in several poses.

    Values scatter in a pose as by their noise or more, and all of a pose may be off alike, by a normal number whose variance is
    that of the poses' means beyond what noise explains (DerSimonian & Laird 1986, by moments).

    Parameters
    ----------
    measured, sigma : (n,)
    pose : (n,) any numbers
    predict : (g,) -> (n,), (n, g)
        Expected values and their derivatives.
    start, units : (g,) of the unknowns, and the order of their errors
    held : (g,)
        Values to which unknowns are held by a standard deviation of one unit; NaN for those that may be anything.
    free : int
        Number of unknowns that the poses' means determine, more or less.
    outlier : float
        Standard deviations.
    """
    values, scatter, between, count = np.array(start, float), 1.0, 0.0, len(start)
    used = kept = np.ones(len(measured), bool)
    covariance, gain = np.diag(units**2), np.zeros((count, len(measured)))
    for _ in range(ROUNDS):
        used, number = kept, np.unique(pose[kept], return_inverse=True)[1]
        poses = number.max() + 1
        scale = np.append(units, np.full(poses, max(between, TINY)))
        prior = np.append(held, np.zeros(poses))
        problem = _Problem(measured, scatter * sigma, predict, count, used, number, scale, prior)
        ends = descend(np.append(values, np.zeros(poses)), problem.linearise, problem.move)
        values, rows = ends.estimate[:count], ends.system.slopes
        together = np.outer(scale, scale) * inverse(rows.T @ rows)
        covariance = together[:count, :count]
        gain = np.zeros((count, len(measured)))
        gain[:, used] = (together[:count] / scale) @ rows[: used.sum()].T / problem.noise[used]
        left = measured - predict(values)[0]
        weight = np.bincount(number, sigma[used] ** -2)
        mean = np.bincount(number, left[used] / sigma[used] ** 2) / weight
        within = NORMAL_MAD * float(np.median(np.abs((left[used] - mean[number]) / sigma[used])))
        scatter = within if within > 1 + CHANCE / np.sqrt(len(number)) else 1.0
        freedom = max(poses - free, 1)
        ratio = float((mean**2 * weight).sum()) / scatter**2 / freedom
        between = float(scatter * np.sqrt((ratio - 1) / weight.mean())) if ratio > 1 + CHANCE * np.sqrt(2 / freedom) else 0.0
        kept = np.abs(left) < outlier * np.hypot(scatter * sigma, between)
    return PoseFit(values, covariance, used, scatter, between, gain)


class _Rows(NamedTuple):
    """Equations `slopes @ step = left`, in standard deviations, some of whose unknowns may be undetermined."""

    slopes: Array  # (m, g)
    left: Array  # (m,)

    def step(self, damping: float) -> Array:
        """The step : (g,), damped by the unknowns' own slopes; zero along what is undetermined."""
        size = np.maximum(np.linalg.norm(self.slopes, axis=0), TINY)
        held = np.sqrt(damping + LEAST_DAMPING) * np.eye(len(size))
        return np.linalg.lstsq(np.vstack([self.slopes / size, held]), np.append(self.left, np.zeros(len(size))))[0] / size


class _Problem(NamedTuple):
    """What is fitted, with an unknown more for each pose."""

    measured: Array  # (n,)
    noise: Array  # (n,)
    predict: Callable[[Array], tuple[Array, Array]]
    count: int  # unknowns but for the poses'
    used: NDArray[np.bool_]  # (n,)
    number: NDArray[np.int64]  # of the pose, from 0 on, of those used
    scale: Array  # (g + p,) units of the unknowns
    prior: Array  # (g + p,) values that they are held to, or NaN

    def linearise(self, guess: Array) -> tuple["_Rows", float]:
        """Rows in units of the unknowns, and the sum of squares."""
        expected, slopes = self.predict(guess[: self.count])
        left = (self.measured - expected)[self.used] - guess[self.count :][self.number]
        noise, fixed = self.noise[self.used], np.flatnonzero(np.isfinite(self.prior))
        own = np.eye(len(guess) - self.count)[self.number]
        rows = np.column_stack([slopes[self.used], own]) * self.scale / noise[:, None]
        left = np.append(left / noise, ((self.prior - guess) / self.scale)[fixed])
        return _Rows(np.vstack([rows, np.eye(len(guess))[fixed]]), left), float(left @ left)

    def move(self, guess: Array, step: Array) -> Array:
        """Take a step."""
        return guess + self.scale * step
