"""Black level, dark noise and spread of pixels from frames without light, where a digital number is much of the noise or more.

A pixel's dark signal is normal: the pixels' mean level, with a spread from pixel to pixel (DSNU) and noise from frame to frame.
The image shows `v` from `v - step` up to `v + 1 - step`, and 0 below. With few values the noise is no longer the variance, but
the mean, the temporal variance and the covariance between two frames still follow from the three, so they are solved for.

Source: EMVA 1288, Release 4.0 for temporal and spatial variance; sums over the steps of a quantiser are elementary.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.special import ndtr, ndtri

from recon.identification.photon_transfer import PhotonTransfer

Array = NDArray[np.float64]

SURE = 3.8415  # of chi^2 with one degree of freedom: 95 %
HALF_WIDTH = 1.959964  # standard deviations of that interval
NORMAL = 0.05  # of that chi^2, by which a normal posterior may differ from the profile
LOOSE, RIDGE = 0.2, 0.12  # relative standard deviation of noise that isn't shown, and a noise in DN to start from then
SHORTEST = 1e-3  # of the gain, and of the noise, a first step along the profile
HALVINGS = 6  # of the last stretch of a profile
TWO = 0.3  # DN of noise, below which mostly two values are seen
STIFF = 0.01  # of the way along the profile, the tolerance of the value that is held
REACH = 6.0  # standard deviations of a normal variable that count
FINEST = 3  # nodes a standard deviation of the noise, or more
NODES = (61, 1201)  # over the pixels' levels, at least and at most
STILL = 0.134  # DN of noise, that stays in one step but for 2e-4 of values, if it is in the step's middle
HIDDEN = 2.0  # DN of noise, which leaves nothing of the steps, and 1e-4 of what clipping does to them
ROUNDING = 1e-4  # of correlations: moments of two values are a function of each other


@dataclass(frozen=True)
class DarkLimits:
    """What dark frames must show."""

    changes: int = 50  # values other than the usual one: fewer have a variance that they don't show
    outlier: float = 8.0  # standard deviations of a pixel's mean from the others', and a DN: a hot pixel, no DSNU
    least_dn: float = 1e-3  # the lower end of noise and spread that is looked at


LIMITS = DarkLimits()


class DarkMoments(NamedTuple):
    """Moments of dark frames, of pixels that aren't hot."""

    values: Array  # (3,): mean, DN; temporal variance and covariance between frames, DN^2
    covariance: Array  # (3, 3), by the scatter of pixels
    usual: int  # DN, the most frequent value
    changes: int  # values of pixels and frames that differ from it


class Interval(NamedTuple):
    """Of 95 %."""

    low: float
    high: float

    @property
    def value(self) -> float:
        """Its middle."""
        return (self.low + self.high) / 2

    @property
    def sigma(self) -> float:
        """The standard deviation of a normal variable with this interval."""
        return (self.high - self.low) / (2 * HALF_WIDTH)


class Signal(NamedTuple):
    """Of frames without light."""

    gain: float  # K, DN an electron
    black: float  # DN
    noise: float  # electrons, from frame to frame
    spread: float  # electrons, from pixel to pixel


class DarkFit(NamedTuple):
    """What dark frames show, with a line of photon transfer."""

    gain: Interval  # K, DN an electron
    black: Interval  # DN
    noise: Interval  # electrons; from 0 if nothing bounds it below
    spread: Interval  # electrons, of pixels; likewise


def dark_moments(frames: NDArray) -> DarkMoments:
    """Moments of dark frames : (n, h, w), n >= 2."""
    n = len(frames)
    values = frames.reshape(n, -1)
    mean = values.mean(axis=0, dtype=np.float64)
    low, high = np.quantile(mean, [0.005, 0.995])
    usual_pixels = np.abs(mean - np.median(mean)) < LIMITS.outlier * (high - low) / 5.15 + 1
    values, mean = values[:, usual_pixels], mean[usual_pixels]
    temporal = values.var(axis=0, ddof=1, dtype=np.float64)
    deviation = mean - mean.mean()
    influences = np.stack([deviation, temporal, deviation**2 - temporal / n])
    counts = np.bincount(values.ravel())
    usual = int(counts.argmax())
    moments = np.array([mean.mean(), *influences[1:].mean(axis=1)])
    return DarkMoments(moments, np.cov(influences) / len(mean), usual, int(counts.sum() - counts[usual]))


def expected_moments(black: float, noise: float, spread: float, step: float) -> Array:
    """Mean, temporal variance and covariance between two frames : (3,) of quantised dark frames.

    Parameters
    ----------
    black, noise, spread : DN
        Of the signal: mean, and standard deviations from frame to frame and from pixel to pixel.
    step : DN
        By which each value begins below itself: 1/2 for rounding, 0 for truncation.
    """
    nodes = int(np.clip(2 * REACH * FINEST * spread / noise, *NODES))
    z = np.linspace(-REACH, REACH, nodes)
    weight = np.exp(-(z**2) / 2)
    weight /= weight.sum()
    mean, square = (_clipped if noise > HIDDEN else _stepped)(black + spread * z, noise, step)
    overall = weight @ mean
    return np.array([overall, weight @ (square - mean**2), weight @ (mean - overall) ** 2])


def _stepped(level: Array, noise: float, step: float) -> tuple[Array, Array]:
    """Mean and mean square of the values of a pixel at a level : (m,), as sums over the steps that frames pass."""
    first = max(int(np.floor(level.min() - REACH * noise + step)), 0)
    last = max(int(np.ceil(level.max() + REACH * noise + step)), first) + 1
    values = np.arange(first + 1, last + 1)
    above = ndtr((level[:, None] - (values - step)) / noise)
    return first + above.sum(axis=1), first**2 + above @ (2.0 * values - 1)


def _clipped(level: Array, noise: float, step: float) -> tuple[Array, Array]:
    """The same for noise that hides the steps: a normal variable, clipped at zero, and the first term of Euler and Maclaurin."""
    middle = level + step - 0.5
    share, density = ndtr(middle / noise), noise * np.exp(-((middle / noise) ** 2) / 2) / np.sqrt(2 * np.pi)
    mean = middle * share + density
    return mean - density / (24 * noise**2), middle * mean + (noise**2 + 1 / 12) * share


def fit_dark(moments: DarkMoments, line: PhotonTransfer, step: float) -> DarkFit:
    """Fit black level, noise and spread, and the gain, to dark frames and a line of photon transfer together.

    The line's intercept bounds the noise where dark frames show one or two values and so leave it open. Intervals are those of
    the profile of chi^2, as noise below a step is far from normal.

    Parameters
    ----------
    line : PhotonTransfer
        With the levels of images.
    step : DN
        As of `expected_moments`; levels of the signal are `1/2 - step` above those of images.
    """
    cut_off = 0.5 - step
    mean, temporal, spatial = moments.values
    dark, lit = temporal + max(spatial, 0), (line.darkest + line.brightest) / 2
    start_gain = line.gain
    if lit > mean:  # a line may be too short for a slope
        start_gain = max((line.variance(lit) - dark) / (lit - mean), 1e-6)
    edge = np.floor(mean) + 1 - step  # between the two values next to the mean
    most = 3 * (np.sqrt(dark) + 0.5)
    low = np.array([-2.5, -np.inf, np.log(LIMITS.least_dn), 0.0])
    high = np.array([2.5, np.inf, np.log(most), np.pi / 2])

    def signal(q: Array) -> Signal:
        by, total = start_gain * np.exp(q[0]), np.exp(q[2])
        return Signal(by, edge + q[1] * total, total * np.cos(q[3]) / by, total * np.sin(q[3]) / by)

    whiten_line = np.linalg.inv(np.linalg.cholesky(line.covariance))
    shown = moments.changes >= LIMITS.changes
    whiten = np.eye(3)
    if shown:
        deviation = np.sqrt(np.diag(moments.covariance))
        correlation = moments.covariance / np.outer(deviation, deviation) + ROUNDING * np.eye(3)
        whiten = np.linalg.inv(np.linalg.cholesky(correlation)) / deviation

    def residuals(q: Array) -> Array:
        by, black, noise, spread = signal(q)
        off_line = whiten_line @ [by - line.gain, (by * noise) ** 2 - by * (black - cut_off) - line.intercept]
        if not shown:  # one value: somewhere in its step
            return np.append(off_line, (black - (moments.usual + cut_off)) * np.sqrt(12))
        return np.append(off_line, whiten @ (moments.values - expected_moments(black, by * noise, by * spread, step)))

    def least(start: Array, held: tuple[int, float, float] | None = None) -> tuple[float, Array, Array]:
        def equations(q: Array) -> Array:
            return residuals(q) if held is None else np.append(residuals(q), (signal(q)[held[0]] - held[1]) / held[2])

        begin = np.clip(start, low + 1e-6, high - 1e-6)
        fit = least_squares(equations, begin, bounds=(low, high), x_scale=[0.1, 1, 0.3, 0.3], xtol=1e-9, ftol=1e-7, max_nfev=40)
        return 2 * float(fit.cost), fit.x, fit.jac

    def start(noise: float, angle: float) -> Array:
        share = float(ndtri(np.clip(mean - np.floor(mean), 1e-6, 1 - 1e-6)))  # of two values
        return np.array([0.0, share if noise < TWO else (mean + cut_off - edge) / noise, np.log(noise), angle])

    noises = (np.sqrt(max(dark - 1 / 12, TWO**2)), RIDGE)
    cost, best, slopes = min((least(start(noise, angle)) for noise in noises for angle in (0.3, 1.2)), key=lambda fit: fit[0])
    covariance, found = np.linalg.pinv(slopes.T @ slopes), np.array(signal(best))
    by_unknowns = np.array([(np.array(signal(best + 1e-5 * one)) - found) / 1e-5 for one in np.eye(4)])
    sigma = np.sqrt(np.einsum("ij,ik,kj->j", by_unknowns, covariance, by_unknowns))

    total = np.exp(best[2])
    units = [found[0], total, total / found[0], total / found[0]]
    starts = [best]
    if covariance[2, 2] > LOOSE**2:  # a ridge from the least noise to that of the next value, flat at its lower end
        starts.append(start(RIDGE, best[3]))

    def end(i: int, sign: int) -> float:
        """Where the least chi^2 has risen to `SURE`, from the normal posterior's; 0 or infinity if it doesn't."""
        limit = {-1: [0.0, -np.inf, 0.0, 0.0], 1: [np.inf, np.inf, most / start_gain, most / start_gain]}[sign][i]
        farthest = abs(limit - found[i])
        inner, outer = 0.0, max(HALF_WIDTH * sigma[i], SHORTEST * units[i])

        def rise(way: float) -> float:
            held = i, float(found[i] + sign * way), STIFF * max(way, SHORTEST * units[i])
            return min(least(begin, held)[0] for begin in starts) - cost - SURE

        while (height := rise(min(outer, farthest))) < 0 and abs(height) > NORMAL * SURE:
            if outer >= farthest:
                return 0.0 if sign < 0 else np.inf
            inner, outer = outer, 2 * outer
        outer = min(outer, farthest)
        for _ in range(HALVINGS if abs(height) > NORMAL * SURE else 0):
            middle = (inner + outer) / 2
            inner, outer = (middle, outer) if rise(middle) < 0 else (inner, middle)
        return float(found[i] + sign * outer)

    gain, black = (Interval(end(i, -1), end(i, 1)) for i in (0, 1))
    if not shown:
        hidden = Interval(0.0, STILL / gain.value)
        return DarkFit(gain, black, hidden, hidden)
    return DarkFit(gain, black, *(Interval(end(i, -1), end(i, 1)) for i in (2, 3)))
