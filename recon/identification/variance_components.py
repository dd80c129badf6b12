"""Standard deviations of a random motion and of white noise, from recordings that hold both on top of a smooth course.

Which of the two a fluctuation belongs to is told by its spectrum, or by the speed that it goes with, and by nothing else.
Source: Patterson & Thompson 1971 (restricted maximum likelihood); the smooth course is a spline.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import BSpline

from recon.identification.frame_scatter import AT_ZERO, INTERVAL, NINETY_FIVE

Array = NDArray[np.float64]

RATIOS = (0.05, 20.0)  # of noise to the predicted one, any alike in the logarithm
STEPS = 72  # of each standard deviation that is weighed, twice: over all of its range, then where it is likely
UNLIKELY = 12.0  # logarithm of the largest density over one that is left out
DEGREE = 5  # of a course: of a cubic one's error, a part lies where its knots repeat, about 11 Hz
RANK = 1e-9  # of the largest singular value of a course: less is none


class Channel(NamedTuple):
    """n values of a smooth course with a motion and white noise."""

    values: Array  # (n,)
    variances: Array  # (n,) of the noise, as predicted
    motion: Array  # (n, n) covariance of a motion of unit standard deviation
    course: Array  # (n, p) what the course may be made of


class Modes(NamedTuple):
    """m independent numbers of variance `motion^2 gains + noise^2`."""

    squares: Array  # (m,)
    gains: Array  # (m,)


class Components(NamedTuple):
    """Both standard deviations by their posterior; sigma by the longer arm of the interval of 95 %.

    The motion's is as much larger as its numbers scatter more than their variances say, as of a spectrum with a peak.
    """

    motion: float  # median
    sigma: float
    seen: bool  # whether no motion at all is unlikely
    noise: Array  # (g,) of each group, over the predicted one; medians
    noise_sigma: Array  # (g,)
    modes: float  # numbers in which the motion is stronger than the noise


def smooth_course(times: Array, spacing_s: float) -> Array:
    """B-splines : (n, p) at times : (n,) s, with knots at least so far apart."""
    inner = max(int((times[-1] - times[0]) / spacing_s), 1)
    knots = np.linspace(times[0], times[-1], inner + 1)
    padded = np.concatenate([[knots[0]] * DEGREE, knots, [knots[-1]] * DEGREE])
    design = BSpline.design_matrix(times, padded, DEGREE).toarray()
    return design[:, design.any(axis=0)]


def modes_of(channel: Channel) -> Modes:
    """Independent numbers that the course leaves, whitened by the predicted noise."""
    scale = 1 / np.sqrt(channel.variances)
    left, singular, _ = np.linalg.svd(scale[:, None] * channel.course)
    beyond = left[:, int((singular > RANK * singular[0]).sum()) :]
    whitened = scale[:, None] * channel.motion * scale
    gains, axes = np.linalg.eigh(beyond.T @ whitened @ beyond)
    return Modes((axes.T @ (beyond.T @ (scale * channel.values))) ** 2, gains.clip(0))


def estimate(groups: Sequence[Sequence[Channel]], most: float) -> Components:
    """Estimate the standard deviation of the motion in all channels, and that of the noise in each group of them.

    Parameters
    ----------
    groups : channels whose noise is the same multiple of what is predicted.
    most : largest standard deviation of the motion that can be; all below are taken for alike.
    """
    parts = [Modes(*map(np.concatenate, zip(*map(modes_of, group), strict=True))) for group in groups]
    motions, ratios = most * np.geomspace(1e-5, 1, STEPS), np.geomspace(*RATIOS, STEPS)
    coarse = np.sum([np.logaddexp.reduce(_evidence(part, motions, ratios), axis=1) for part in parts], axis=0)
    likely = np.flatnonzero(coarse > coarse.max() - UNLIKELY)
    low = 0.0 if likely[0] == 0 else motions[likely[0] - 1]
    motions = low + (motions[min(likely[-1] + 1, STEPS - 1)] - low) * np.linspace(0, 1, STEPS + 1)[1:] ** 1.5
    finer = [_likely_ratios(part, motions) for part in parts]
    tables = [_evidence(part, motions, own) for part, own in zip(parts, finer, strict=True)]
    over_ratios = [np.logaddexp.reduce(table, axis=1) for table in tables]
    total = np.sum(over_ratios, axis=0)
    weights = np.exp(total - total.max()) * np.gradient(motions)
    lowest, motion, highest = _quantiles(motions, weights, start=low)
    seen = bool(low > 0 or np.exp(total[0] - total.max()) < AT_ZERO)
    sigma = max(highest - motion, motion - (lowest if seen else 0.0)) / NINETY_FIVE
    noise, noise_sigma = np.empty(len(parts)), np.empty(len(parts))
    for k, (table, own) in enumerate(zip(tables, finer, strict=True)):
        given = table - over_ratios[k][:, None] + (np.log(weights.clip(1e-300)))[:, None]
        below, noise[k], above = _quantiles(own, np.exp(np.logaddexp.reduce(given, axis=0)), start=own[0])
        noise_sigma[k] = max(above - noise[k], noise[k] - below) / NINETY_FIVE
    gains, squares = (np.concatenate([getattr(part, name) for part in parts]) for name in Modes._fields[::-1])
    levels = np.repeat(noise, [len(part.gains) for part in parts])
    total = motion**2 * gains + levels**2
    weights = (motion**2 * gains / total) ** 2
    excess = float(weights @ (squares / total - 1) ** 2 / (2 * max(weights.sum(), 1e-300)))
    return Components(motion, sigma * np.sqrt(max(excess, 1.0)), seen, noise, noise_sigma, float(weights.sum()))


def _evidence(modes: Modes, motions: Array, ratios: Array) -> Array:
    """Logarithm of the likelihood : (motions, ratios)."""
    table = np.empty((len(motions), len(ratios)))
    for row, motion in zip(table, motions, strict=True):
        total = motion**2 * modes.gains + ratios[:, None] ** 2
        row[:] = -0.5 * (np.log(total) + modes.squares / total).sum(axis=1)
    return table


def _likely_ratios(modes: Modes, motions: Array) -> Array:
    """Ratios of the noise, evenly in the logarithm, where they are likely."""
    ratios = np.geomspace(*RATIOS, STEPS)
    some = np.logaddexp.reduce(_evidence(modes, motions[:: STEPS // 12], ratios), axis=0)
    likely = np.flatnonzero(some > some.max() - UNLIKELY)
    return np.geomspace(ratios[max(likely[0] - 1, 0)], ratios[min(likely[-1] + 1, STEPS - 1)], STEPS)


def _quantiles(values: Array, weights: Array, start: float) -> tuple[float, float, float]:
    """Both ends of the interval of 95 %, about the median."""
    below = np.concatenate([[0], np.cumsum(weights)]) / weights.sum()
    tails = [(1 - INTERVAL) / 2, 0.5, (1 + INTERVAL) / 2]
    low, middle, high = np.interp(tails, below, np.concatenate([[start], values])).tolist()
    return low, middle, high
