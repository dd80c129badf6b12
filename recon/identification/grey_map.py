"""A scanner's grey map by the histograms of speckle: greys a dB, levels over depth, and curves of other forms.

A power of fully developed speckle is exponentially distributed; of n looks averaged, it has a gamma distribution of shape n.
That is a ruler in dB: the spread of its logarithm, 5.57 dB for one look, shows how many greys a dB has. What is clipped to black
or white counts as such. Pixels of a grain aren't independent: the scores of independent parts of the recording give the
covariance (Huber's sandwich).
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import stats
from scipy.special import gammainc, gammaln

Array = NDArray[np.float64]
Images = NDArray[np.uint8]

GREYS = 256
START_GREYS = 4.25  # a dB, of 60 dB
LEAST_SHARE = 1e-12  # of a bin
FAR_DB = 200.0


class Levels(NamedTuple):
    """A linear grey map, and the mean power of the tissue in bands of depth."""

    depth_mm: Array  # (b,)
    level_db: Array  # (b,) mean power, under white
    greys_a_db: float
    covariance: Array  # (1 + b, 1 + b) of greys_a_db (relative) and level_db

    def shares(self) -> Array:
        """Shares : (b, 256) of greys."""
        return _line_shares(self.greys_a_db, self.level_db)

    @property
    def dynamic_range_db(self) -> float:
        """From black to white."""
        return 255 / self.greys_a_db


class Curve(NamedTuple):
    """A grey map of any rising form."""

    greys: Array  # (j,) the upper ends of bins of greys, between two greys each
    power_db: Array  # (j,) at which they begin, over the middle one

    def cumulative(self, level_db: Array, looks: Array | float = 1.0) -> Array:
        """Shares : (..., 256) of greys up to each, of speckle of levels : (...)."""
        ends = np.arange(GREYS) + 0.5
        power = np.interp(ends, self.greys, self.power_db)
        power = np.where(ends < self.greys[0], -FAR_DB, np.where(ends > self.greys[-1], FAR_DB, power))
        return _below(power - np.asarray(level_db)[..., None], np.asarray(looks)[..., None])

    def db_of(self, grey: Array) -> Array:
        """Power by the grey."""
        return np.interp(grey, self.greys, self.power_db)


def histograms(images: Images, rows: list[slice], part: NDArray[np.int64]) -> Array:
    """Numbers : (k, b, 256) of greys of images : (n, h, w), by part : (n, w) of the recording and by band."""
    count = int(part.max()) + 1
    found = np.zeros((count, len(rows), GREYS))
    for b, band in enumerate(rows):
        greys = images[:, band].astype(np.int64)
        label = part[:, None] * GREYS + greys
        found[:, b] = np.bincount(label.ravel(), minlength=count * GREYS).reshape(count, GREYS)
    return found


def fit_line(depth_mm: Array, counts: Array, greys_a_db: float | None = None) -> Levels:
    """Fit levels, and greys a dB unless these are given, to histograms : (k, b, 256) of raw speckle by maximum likelihood."""
    known = greys_a_db is not None
    scale = greys_a_db if greys_a_db is not None else START_GREYS
    mean = (counts.sum(axis=0) @ np.arange(GREYS)) / counts.sum(axis=(0, 2))
    start = np.concatenate([[np.log(scale)], (mean - 255) / scale + 2.5])

    def shares(theta: Array) -> Array:
        return _line_shares(float(np.exp(theta[0])), theta[1:])

    theta, covariance = _fit(start, np.r_[not known, np.ones(len(mean), bool)], counts, shares)
    return Levels(depth_mm, theta[1:], float(np.exp(theta[0])), covariance)


def _line_shares(greys_a_db: float, level_db: Array) -> Array:
    ends = (np.arange(GREYS - 1) + 0.5 - 255) / greys_a_db
    return np.diff(_below(ends - level_db[:, None], 1.0), axis=1, prepend=0.0, append=1.0)


def skewness(shares: Array) -> Array:
    """Skewness of greys by their numbers or shares : (..., 256); -1.14 of raw speckle that doesn't clip."""
    shares = shares / shares.sum(axis=-1, keepdims=True)
    greys = np.arange(GREYS) - (shares @ np.arange(GREYS))[..., None]
    return (shares * greys**3).sum(axis=-1) / (shares * greys**2).sum(axis=-1) ** 1.5


def fit_curve(counts: Array, knots: Array, looks: Array | float = 1.0, steps: int = 60) -> tuple[Curve, Array]:
    """Fit a rising grey map and the level of each patch to histograms : (p, 256) of patches of even tissue.

    Levels of patches overlap, so that their spreads, chained, measure the curve in dB from the darkest to the brightest.

    Parameters
    ----------
    knots : (j,) ends of bins of greys between which the curve is a line in dB, between two greys each
    looks : averaged by power, of each patch : (p,) or of all: they set the length of a dB

    Returns
    -------
    curve
    level_db : (p,) over the middle of the curve
    """
    inner = np.diff(np.concatenate([np.zeros((len(counts), 1)), np.cumsum(counts, axis=1)[:, np.int64(knots)]], axis=1))
    shares_in = np.column_stack([inner, counts.sum(axis=1) - inner.sum(axis=1)])
    looks = np.broadcast_to(np.asarray(looks, float), len(counts))[:, None]
    power = (knots - np.median(knots)) / START_GREYS
    level = ((counts @ np.arange(GREYS)) / counts.sum(axis=1) - np.median(knots)) / START_GREYS
    for _ in range(steps):
        level = _level_step(level, power, shares_in, looks)
        power = _curve_step(power, level, shares_in, looks)
        middle = np.interp(np.median(knots), knots, power)
        power, level = power - middle, level - middle
    return Curve(np.asarray(knots, float), power), level


def _below(db: Array, looks: Array | float) -> Array:
    """Share of powers under db over their mean, of looks averaged by power."""
    power = 10 ** (np.clip(db, -FAR_DB, 60.0) / 10)
    return -np.expm1(-power) if np.all(looks == 1) else gammainc(looks, looks * power)


def _fit(start: Array, free: NDArray[np.bool_], counts: Array, shares: Callable[[Array], Array]) -> tuple[Array, Array]:
    """Maximum likelihood by Fisher's scoring; estimates and their sandwich covariance."""
    theta, numbers = start.copy(), counts.sum(axis=0)
    index, last = np.flatnonzero(free), -np.inf
    damping = 1.0
    for _ in range(60):
        p = np.maximum(shares(theta), LEAST_SHARE)
        slopes = np.stack(
            [
                (np.maximum(shares(theta + e), LEAST_SHARE) - np.maximum(shares(theta - e), LEAST_SHARE)) / 2e-4
                for e in 1e-4 * np.eye(len(theta))[index]
            ]
        )
        score = np.tensordot(slopes, numbers / p, axes=([1, 2], [0, 1]))
        information = np.einsum("aij,bij->ab", slopes, slopes * (numbers.sum(axis=1, keepdims=True) / p))
        information += 1e-9 * np.diag(np.diag(information)) + 1e-12 * np.eye(len(index))
        step = np.linalg.solve(information, score)
        step *= min(1.0, 3.0 / max(np.abs(step).max(), 1e-12)) * damping
        if np.abs(step).max() < 1e-7:
            break
        here = float((numbers * np.log(p)).sum())
        damping, last = (damping / 2, last) if here < last else (min(1.0, damping * 1.5), here)
        theta[index] += step
    k = len(counts)
    by_part = np.einsum("aij,kij->ka", slopes, counts / p - counts.sum(axis=2, keepdims=True))
    influence = np.linalg.solve(information, by_part.T)
    covariance = np.zeros((len(theta), len(theta)))
    covariance[np.ix_(index, index)] = k / max(k - 1, 1) * influence @ influence.T
    return theta, covariance * few(k - 1) ** 2


def few(freedom: int) -> float:
    """Factor by which a standard deviation of few degrees of freedom is widened, so that 1.96 of it cover 95 %: Student's."""
    return float(stats.t.ppf(0.975, max(freedom, 1)) / 1.96)


def _shares_of(power: Array, level: Array, looks: Array) -> Array:
    below = _below(power - level[:, None], looks)
    return np.maximum(np.diff(below, axis=1, prepend=0.0, append=1.0), LEAST_SHARE)


def _level_step(level: Array, power: Array, counts: Array, looks: Array) -> Array:
    """One scoring step of each patch's level."""
    p = _shares_of(power, level, looks)
    slope = (_shares_of(power, level + 1e-3, looks) - _shares_of(power, level - 1e-3, looks)) / 2e-3
    score, information = (slope * counts / p).sum(axis=1), (slope**2 / p).sum(axis=1) * counts.sum(axis=1)
    return level + np.clip(score / np.maximum(information, 1e-9), -3, 3)


def _curve_step(power: Array, level: Array, counts: Array, looks: Array) -> Array:
    """One scoring step of the curve's knots, which stay in order."""
    db = power - level[:, None]
    p = _shares_of(power, level, looks)
    x = looks * 10 ** (np.clip(db, -FAR_DB, 60) / 10)
    density = np.log(10) / 10 * np.exp(looks * np.log(x) - x - gammaln(looks))  # of a share below a knot, by the knot
    total = counts.sum(axis=1, keepdims=True)
    score = (density * (counts[:, :-1] / p[:, :-1] - counts[:, 1:] / p[:, 1:])).sum(axis=0)
    diagonal = (total * density**2 * (1 / p[:, :-1] + 1 / p[:, 1:])).sum(axis=0)
    beside = -(total * density[:, :-1] * density[:, 1:] / p[:, 1:-1]).sum(axis=0)
    information = np.diag(diagonal) + np.diag(beside, 1) + np.diag(beside, -1)
    information += 1e-6 * np.diag(diagonal) + 1e-9 * np.eye(len(power))
    step = np.linalg.solve(information, score)
    moved = power + step * min(1.0, 2.0 / np.abs(step).max())
    return np.maximum.accumulate(np.maximum(moved, np.r_[-np.inf, moved[:-1] - 10.0]))
