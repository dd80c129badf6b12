"""Breath in the course of a distance over time: what comes back in every breath, beside what a hand changes slowly or at random.

The distance of the face from the resting skin is a sum of Gaussian processes: a constant (gel, or pressure), its slow change, the
hand's unsteadiness, noise, and some harmonics of a breath. Each has a covariance over time, so their most likely courses and
standard deviations follow from linear algebra, and so does the likelihood of the whole with a breath of any period, or none.
Breath counts from the end of an expiration, where it is least: that is rest.
Source: Rasmussen and Williams 2006, Gaussian Processes for Machine Learning, 2.2 and 5.4.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve
from scipy.ndimage import median_filter

from recon.linear_algebra import on_one_thread

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Course:
    """How the distance of a face from the resting skin changes: standard deviations in mm, times in s; assumed."""

    constant_mm: float = 3.0
    slow: tuple[float, float] = (0.7, 3.0)  # of a hand that presses more or less, over a time longer than half a breath
    hand: tuple[float, float] = (0.2, 0.4)  # of its unsteadiness, and the time it takes
    noise_mm: float = 0.1  # of a B-scan, by its pose and the skin
    harmonics_mm: tuple[float, ...] = (1.5, 0.7, 0.3)  # amplitudes
    periods_s: tuple[float, float, int] = (2.5, 7.0, 28)  # of a breath: shortest, longest, and those that are tried
    regular_s: float = 30.0  # over which one breath resembles another
    cycles: float = 1.25  # of it, at least
    evidence: float = 4.0  # natural logarithm of the likelihoods' ratio, from which there is a breath
    least_mm: float = 0.5  # from expiration to inspiration
    resting: float = 0.1  # share of the time that it is at the end of an expiration, and of an inspiration
    outlier_mm: float = 1.0  # off the median of so many neighbours
    neighbours: int = 9
    most: int = 500  # moments; of more, neighbours are averaged


COURSE = Course()


class Parts(NamedTuple):
    """Parts of a distance at n moments, mm."""

    breath: Array  # (n,) by which the body has risen since the end of an expiration; 0 where there is none
    rest: Array  # (n,) distance without it, smoothed
    sigma: Array  # (n,) standard deviation of the breath, and of the rest against it; 0 where there is none
    period_s: float | None  # of the breath


@on_one_thread()
def part(times_s: Array, distances: Array, shares: Array) -> Parts:
    """Part distances : (n,) mm, NaN where they aren't known, at moments : (n,) s into breath and the rest.

    Parameters
    ----------
    shares : (n,) of the breath that the distance changes by: the cosine of the angle between both.
    """
    known = np.isfinite(distances)
    near = median_filter(np.interp(times_s, times_s[known], distances[known]), COURSE.neighbours)
    used = np.flatnonzero(np.abs(distances - near) < COURSE.outlier_mm)
    if not len(used):
        return Parts(np.zeros(len(distances)), near, np.zeros(len(distances)), None)
    bins = np.array_split(used, min(len(used), COURSE.most))
    t, y, share = (np.array([values[one].mean() for one in bins]) for values in (times_s, distances, shares))
    apart, mean = t[:, None] - t, float(np.median(y))
    calm = COURSE.constant_mm**2 + _smooth(apart, COURSE.slow) + _smooth(apart, COURSE.hand)
    seen = calm + COURSE.noise_mm**2 * np.diag([1 / len(one) for one in bins])
    shortest, longest, count = COURSE.periods_s
    tried = [one for one in np.geomspace(shortest, longest, count) if np.ptp(t) >= COURSE.cycles * one]
    likely = [_likelihood(seen + _periodic(apart, share, one), y - mean) for one in tried]
    best = int(np.argmax(likely)) if likely else -1
    longer = best == len(tried) - 1 < count - 1  # the most likely period may be one that lasts too long to be seen again
    if likely and not longer and likely[best] - _likelihood(seen, y - mean) > COURSE.evidence:
        period_s = tried[best]
        periodic = _periodic(apart, share, period_s)
        factor = cho_factor(seen + periodic)
        risen = periodic @ cho_solve(factor, y - mean) / share
        least, most = np.quantile(risen, [COURSE.resting, 1 - COURSE.resting])
        if most - least > COURSE.least_mm:
            rest = mean + calm @ cho_solve(factor, y - mean) + share * least
            sigma = np.sqrt(np.maximum(np.diag(periodic - periodic @ cho_solve(factor, periodic)), 0)) / share
            breath, rest, sigma = (np.interp(times_s, t, values) for values in (risen - least, rest, sigma))
            return Parts(breath, rest, sigma, period_s)
    rest = mean + calm @ cho_solve(cho_factor(seen), y - mean)
    return Parts(np.zeros(len(times_s)), np.interp(times_s, t, rest), np.zeros(len(times_s)), None)


def _smooth(apart: Array, size: tuple[float, float]) -> Array:
    return size[0] ** 2 * np.exp(-((apart / size[1]) ** 2) / 2)


def _periodic(apart: Array, share: Array, period_s: float) -> Array:
    waves = (one**2 * np.cos(2 * np.pi * k * apart / period_s) for k, one in enumerate(COURSE.harmonics_mm, start=1))
    return np.outer(share, share) * sum(waves, np.zeros_like(apart)) * _smooth(apart, (1.0, COURSE.regular_s))


def _likelihood(covariance: Array, values: Array) -> float:
    """Logarithm of the likelihood, but for a constant."""
    root, low = cho_factor(covariance)
    return float(-np.log(np.diag(root)).sum() - values @ cho_solve((root, low), values) / 2)
