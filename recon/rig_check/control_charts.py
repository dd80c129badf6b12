"""Control charts of a part's motion over the days of a calibration: drift that no single check shows.

Each check estimates a motion `x = b + d`: b is what the calibration's error makes of a part that hasn't moved, the same in all
checks until the next calibration; d has the noise of this check and the usual drift of its day. Estimates are therefore not
independent. Their one-step errors of prediction are: each estimate less the mean of all earlier ones, a mean that begins at
zero with the covariance that the calibration claims for b (Kalman 1960; recursive residuals of Brown, Durbin & Evans 1975;
self-starting charts of Hawkins 1987). Whitened they are independent standard normal numbers from the first check on, while
nothing drifts beyond the usual: no days are spent on learning the rig.

A Shewhart chart shows the length of each one, whose square is chi-square. The cumulative sum of Crosier 1988 (Multivariate
generalizations of cumulative sum quality-control schemes) adds up what goes on in one direction, whichever. Both have the same
rate of false alarms, together that of the verdict on the part.
"""

from collections.abc import Sequence
from datetime import datetime
from functools import cache
from math import erfc
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import stats
from scipy.optimize import root_scalar

from recon.rig_check import fault_tests
from recon.rig_check.check_log import EXACT, Check, Estimate
from recon.rig_check.verdicts import PARTS, described

Array = NDArray[np.float64]

DEVICES, BY_BOTTOM = PARTS[:4], PARTS[4:]  # parts that the same measurements show
ALLOWANCE = 0.5  # standard deviations a check, that the sum forgets: half of a shift that it finds soonest
SINGULAR = 1e-9  # of a variance, at least: directions that no check shows have none
NODES = 48  # of Gauss's rule over the sum, for its average run length: to 1e-6 of it
SELDOM = 1e-6  # chance of a false alarm, that of 4.9 standard deviations: limits of less would be lost in rounding
REPEATED = 1e-6  # of a standard deviation: checks of one recording differ by rounding alone
GAIN = 2 * fault_tests.RIVAL  # of chi-square, below the best one's: another part that may be it


class Limits(NamedTuple):
    """Limits of both charts."""

    sigma: float  # of a normal number as unlikely as a check's motion beside all earlier ones
    cusum: float
    run_length: float  # checks until a chart's first false alarm, in the mean, of each of both


class Change(NamedTuple):
    """What explains a part's motions best, of drift that is even since a check, and of a step after it."""

    since: datetime  # of the last check before
    motion: Array  # (k,) by now, as of the part
    even: bool
    gain: float  # of chi-square


class Chart(NamedTuple):
    """A part in n checks, two or more, by one calibration."""

    part: str
    times: tuple[datetime, ...]
    sigma: Array  # (n,) of a normal number as unlikely as the motion beside all earlier ones
    cusum: Array  # (n,) length of the cumulative sum
    limits: Limits
    change: Change
    repeated: tuple[datetime, ...]  # of checks of a recording that was checked before, which don't count

    @property
    def out(self) -> bool:
        """Whether the last check that counts is out of control."""
        return bool(self.sigma[-1] > self.limits.sigma or self.cusum[-1] > self.limits.cusum)

    @property
    def told(self) -> str:
        """The change in words."""
        days = (self.times[-1] - self.change.since).total_seconds() / 86400
        how = f"evenly in {days:.0f} days" if self.change.even else "at once"
        return f"since {self.change.since:%Y-%m-%d}, {how}: {described(self.part, self.change.motion)}"


def charts(log: Sequence[Check], alarm_sigma: float) -> list[Chart]:
    """Charts of the parts that the last check of a log shows, each over the checks by its present calibration, if two or more.

    A recording counts as often as it was made: checks that find the same again, to rounding, are no more days.

    alarm_sigma : of the verdict on a part, whose chance of a false alarm both charts of the part share.
    """
    found = []
    for part in PARTS if log else ():
        shown = [(made.time, one.estimate) for made in log for one in made.parts if one.part == part and one.estimate is not None]
        if not shown or shown[-1][0] != log[-1].time:
            continue
        last = shown[-1][1]
        own = [each for each in shown if (each[1].against, len(each[1].motion)) == (last.against, len(last.motion))]
        again = [any(same(one, other) for _, other in own[:k]) for k, (_, one) in enumerate(own)]
        if again.count(False) > 1:
            times, estimates = zip(*(one for one, seen in zip(own, again, strict=True) if not seen), strict=True)
            repeated = tuple(time for (time, _), seen in zip(own, again, strict=True) if seen)
            found.append(_chart(part, times, estimates, alarm_sigma)._replace(repeated=repeated))
    return found


def same(one: Estimate, other: Estimate) -> bool:
    """Whether two checks found one motion with one covariance: they are of one recording."""
    own, expected = np.array(one.own), np.array(other.own)
    sigma = np.sqrt(np.maximum(np.diag(expected), 0))
    apart = np.abs(np.array(one.motion) - other.motion)
    alike = np.abs(own - expected) <= REPEATED * np.outer(sigma, sigma) + EXACT**2
    return bool((apart <= REPEATED * sigma + EXACT).all() and alike.all())


def _chart(part: str, times: tuple[datetime, ...], estimates: Sequence[Estimate], alarm_sigma: float) -> Chart:
    steps = innovations(estimates)
    shown = freedom(np.array(estimates[0].common) + np.mean([one.own for one in estimates], axis=0))
    sigma = np.array([fault_tests.as_sigma(float(one @ one), shown) for one in steps])
    cusum = np.linalg.norm(cumulative_sums(steps), axis=1)
    return Chart(part, times, sigma, cusum, limits(shown, alarm_sigma), change(times, estimates), ())


@cache
def limits(dimension: int, alarm_sigma: float) -> Limits:
    """Limits of motions of some dimensions: each chart alarms half as often as one number beyond `alarm_sigma`, 4.9 at most."""
    chance = max(erfc(alarm_sigma / 2**0.5) / 2, SELDOM)
    return Limits(float(stats.norm.isf(chance / 2)), cusum_limit(1 / chance, dimension), 1 / chance)


def innovations(estimates: Sequence[Estimate]) -> Array:
    """One-step errors of prediction : (n, k) of checks by one calibration: standard normal numbers where nothing drifts."""
    left = np.array(estimates[0].common)  # covariance of the mean
    mean, found = np.zeros(len(left)), []
    for one in estimates:
        missing = np.array(one.motion) - mean
        whiten = _whitening(left + np.array(one.own))
        found.append(whiten @ missing)
        gain = left @ whiten.T @ whiten
        mean, left = mean + gain @ missing, left - gain @ left
    return np.array(found)


def _whitening(covariance: Array) -> Array:
    """The inverse of a covariance's symmetric root : (k, k), so that a direction stays one though covariances change a little.

    It is that of the correlations, over standard deviations; directions of no variance, which no check shows, stay at zero.
    """
    unit, variances, axes = _principal(covariance)
    return axes / np.sqrt(np.maximum(variances, SINGULAR)) @ axes.T / unit


def freedom(covariance: Array) -> int:
    """Directions that checks show, one at least: innovations along the others are 0, and count as none."""
    return max(int(np.sum(_principal(covariance)[1] > SINGULAR)), 1)


def _principal(covariance: Array) -> tuple[Array, Array, Array]:
    """Units : (k,), standard deviations or 1, and variances : (k,) and axes : (k, k) of a covariance in these units."""
    sigma = np.sqrt(np.maximum(np.diag(covariance), 0))
    unit = np.where(sigma > EXACT, sigma, 1.0)
    return unit, *np.linalg.eigh(covariance / np.outer(unit, unit))


def cumulative_sums(innovations: Array) -> Array:
    """Crosier's cumulative sums : (n, k), shortened by the allowance each time."""
    total, sums = np.zeros(innovations.shape[1]), []
    for one in innovations:
        total = total + one
        total = total * (1 - ALLOWANCE / max(float(np.linalg.norm(total)), ALLOWANCE))
        sums.append(total)
    return np.array(sums)


def run_length(limit: float, dimension: int) -> float:
    """Average number of checks until the sum's length is beyond a limit, from zero on, where nothing drifts.

    The next length depends on the present one alone: with the allowance it is the root of a noncentral chi-square. Source: the
    integral equation of Page 1954, solved by Gauss's rule.
    """
    nodes, weights = np.polynomial.legendre.leggauss(NODES)
    lengths, weights = limit * (nodes + 1) / 2, limit * weights / 2
    start = np.append(0.0, lengths)
    longer = lengths + ALLOWANCE
    density = 2 * longer * stats.ncx2.pdf(longer**2, dimension, start[:, None] ** 2)
    ended = stats.ncx2.cdf(ALLOWANCE**2, dimension, start**2)  # at zero again
    kernel = np.column_stack([ended, density * weights])
    return float(np.linalg.solve(np.eye(1 + NODES) - kernel, np.ones(1 + NODES))[0])


def cusum_limit(checks: float, dimension: int) -> float:
    """The limit of the sum's length, of an average run length where nothing drifts."""
    high = 1.0
    while run_length(high, dimension) < checks:
        high *= 1.5
    return root_scalar(lambda limit: np.log(run_length(limit, dimension) / checks), bracket=(0.0, high), xtol=1e-4).root


def change(times: Sequence[datetime], estimates: Sequence[Estimate]) -> Change:
    """Fit even drift since each check, and a step after it, to all motions, by least squares; the best one."""
    ages = np.array([(time - times[0]).total_seconds() for time in times])
    since = np.maximum(ages - ages[:-1, None], 0)
    steps = np.arange(len(times)) > np.arange(len(times) - 1)[:, None]
    even = np.where(since[:, -1:] > 0, since / np.maximum(since[:, -1:], 1.0), steps)  # checks of one second tell no course
    shares = np.concatenate([even, steps])
    whitens = np.array([_whitening(np.array(one.own)) for one in estimates])
    weights = np.swapaxes(whitens, 1, 2) @ whitens
    pulls = np.einsum("nij,nj->ni", weights, np.array([one.motion for one in estimates]))
    first = _whitening(np.array(estimates[0].common))
    alone, right = first.T @ first + weights.sum(axis=0), pulls.sum(axis=0)
    mixed, after = (np.einsum("sn,nij->sij", part, weights) for part in (shares, shares**2))
    across = np.swapaxes(np.linalg.solve(alone, mixed), 1, 2)  # Schur's complement of what was before
    information, left = after - across @ mixed, shares @ pulls - across @ right
    motions = np.linalg.solve(information, left[..., None])[..., 0]
    gains = np.sum(left * motions, axis=1)
    best = int(np.argmax(gains))
    start = best % (len(times) - 1)
    return Change(times[start], motions[best], best < len(times) - 1, float(gains[best]))


def drifting(charts: Sequence[Chart]) -> list[list[Chart]]:
    """Parts that are out of control: of those that the same measurements show the one that explains them best, and its rivals."""
    found = []
    for together in (DEVICES, BY_BOTTOM):
        out = sorted((one for one in charts if one.out and one.part in together), key=lambda one: -one.change.gain)
        if out:
            found.append([one for one in out if one.change.gain >= out[0].change.gain - GAIN])
    return found
