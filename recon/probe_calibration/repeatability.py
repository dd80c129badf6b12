"""Agreement of several calibrations of one probe: CR1, CR2, their mean, and whether their scatter is what they predict.

CR1 and CR2 are those of Meza et al. 2021: of a pixel's place in the target's frame, `target_from_image @ [sx u, sy v, 0, 1]`.

**The mean** of n calibrations x_k with covariances C_k is weighted by `(C_k + T)^-1`, in steps of the eight parameters from their
plain mean, so that rotations are averaged as rotations. T is what their scatter has beyond the mean of all C_k, in the directions
in which it has: of a bracket that was taken off between runs, or of water that cooled. It is estimated by n - 1 differences, so
counts by the square of Student's factor, with which one standard deviation holds 68 %. Runs that agree as well as they claim have
some of it by chance: the mean's standard deviations are then 1.3 times as large as need be, of two runs 1.8 times.

What errs alike in all runs, such as by the radius of the one wire, isn't in their scatter, and doesn't shrink in their mean. It
is taken out of C_k first and put back in the end. An error of the cameras that all runs share is in none of these.

Sources: excess of the scatter by moments: DerSimonian and Laird 1986, in several dimensions Jackson et al. 2010.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import stats
from scipy.spatial.transform import Rotation

from recon.estimation.covariance import inverse, whitening
from recon.geometry import rigid
from recon.model.calibration import Uncertainty
from recon.model.probe import NAMES, ProbeCalibration

Array = NDArray[np.float64]
Size = tuple[int, int]  # width, height, px

DRAWS = 2000  # of errors, for their expected distances
MOST_SHARED = 0.999  # of a run's variance along any direction, that may err as in all others
ONE_SIGMA = float(stats.norm.cdf(1.0))


def five_points(size: Size) -> Array:
    """Centre and corners : (5, 2) px of a B-scan, in this order; the lower right corner last."""
    right, bottom = size[0] - 1, size[1] - 1
    return np.array([[right / 2, bottom / 2], [0, 0], [right, 0], [0, bottom], [right, bottom]], float)


def at_places(values: Array) -> dict[str, float]:
    """Figures of five points : (5,) by place: the centre, the lower right corner, the mean of all four, and that of all five."""
    places = {"centre": values[0], "corner": values[4], "corners": values[1:].mean(), "mean": values.mean()}
    return {place: float(value) for place, value in places.items()}


def cr1(calibrations: Sequence[ProbeCalibration], pixels: ArrayLike) -> Array:
    """Repeatability CR1 : (k,) mm: mean distance, over all pairs of calibrations, of the places of pixels : (k, 2)."""
    return between_pairs(np.stack([calibration.to_target(pixels) for calibration in calibrations]))


def cr2(calibrations: Sequence[ProbeCalibration], pixels: ArrayLike) -> Array:
    """Repeatability CR2 : (k,) mm: mean distance of the places of pixels : (k, 2) by each calibration from the mean place."""
    return from_mean(np.stack([calibration.to_target(pixels) for calibration in calibrations]))


def between_pairs(points: Array) -> Array:
    """Mean distance : (k,) over all pairs of n sets of points : (n, k, 3)."""
    first, second = np.triu_indices(len(points), 1)
    return np.linalg.norm(points[first] - points[second], axis=-1).mean(axis=0)


def from_mean(points: Array) -> Array:
    """Mean distance : (k,) of n sets of points : (n, k, 3) from the mean of the sets."""
    return np.linalg.norm(points - points.mean(axis=0), axis=-1).mean(axis=0)


def expected_cr1(covariances: Array) -> Array:
    """CR1 : (k,) mm that is expected of n calibrations by covariances : (n, k, 3, 3) mm^2 of k places."""
    return _expected_length(2 * covariances.mean(axis=0))


def expected_cr2(covariances: Array) -> Array:
    """CR2 : (k,) mm, likewise."""
    return _expected_length((1 - 1 / len(covariances)) * covariances.mean(axis=0))


def _expected_length(covariance: Array) -> Array:
    """Mean length : (k,) of normal vectors of covariances : (k, 3, 3)."""
    drawn = np.random.default_rng(0).standard_normal((DRAWS, 3))
    return np.linalg.norm(drawn @ np.swapaxes(np.linalg.cholesky(covariance), -1, -2), axis=-1).mean(axis=1)


def average(calibrations: Sequence[ProbeCalibration]) -> ProbeCalibration:
    """The plain mean of independent calibrations: rotations as rotations (least sum of squared chords), the rest as vectors.

    All have to hold for about the same speed of sound, as those of one tank do; so has the mean.
    """
    turns = Rotation.from_matrix(np.stack([calibration.target_from_image[:3, :3] for calibration in calibrations]))
    origin = np.mean([calibration.target_from_image[:3, 3] for calibration in calibrations], axis=0)
    scale = np.mean([calibration.scale for calibration in calibrations], axis=0)
    known = [calibration.uncertainty for calibration in calibrations if calibration.uncertainty is not None]
    alike = len(known) == len(calibrations) and all(each.names == known[0].names for each in known)
    covariance = np.sum([each.covariance for each in known], axis=0) / len(known) ** 2 if alike else None
    uncertainty = None if covariance is None else Uncertainty(known[0].names, covariance)
    return ProbeCalibration(
        rigid.transform(turns.mean().as_matrix(), origin),
        scale,
        uncertainty,
        float(np.mean([each.speed_m_s for each in calibrations])),
        float(np.mean([each.face_row for each in calibrations])),
    )


@dataclass(frozen=True)
class Mean:
    """The weighted mean of n calibrations, and how these lie about it."""

    calibration: ProbeCalibration  # its covariance has the single ones, the excess of their scatter, and what errs alike
    singles: Array | None  # (n, 8, 8) covariances of the calibrations, as NAMES, but for what errs alike in all; None without
    own: Array  # (8, 8) that of the mean, likewise
    chi_square: float  # of the steps by the single covariances; NaN without these
    freedom: int

    @property
    def chance(self) -> float:
        """Of as much scatter or more by the single covariances alone; NaN without these."""
        return float(stats.chi2.sf(self.chi_square, self.freedom))


def mean(calibrations: Sequence[ProbeCalibration], shared: Array | None = None) -> Mean:
    """The mean of two calibrations or more.

    Where one has no covariance, or one that leaves some parameter out, all weigh the same, and the mean has that of the scatter.

    Parameters
    ----------
    shared : (n, c, 8)
        Change of each calibration by one standard deviation of each of c causes that err alike in all; None for no such cause.
    """
    count = len(calibrations)
    shared = np.zeros((count, 0, len(NAMES))) if shared is None else shared
    middle = average(calibrations)
    steps = np.array([step_between(middle, each) for each in calibrations])
    own = own_covariances(calibrations, shared)
    if own is None:
        weights = np.broadcast_to(np.eye(len(NAMES)) / count, (count, len(NAMES), len(NAMES)))
        covariance = _student(count) * np.cov(steps.T) / count
        chi_square = np.nan
    else:
        _, weights = _weights(own)
        away = steps - np.einsum("kij,kj->i", weights, steps)
        chi_square = float(np.einsum("ki,kij,kj->", away, np.array([inverse(each) for each in own]), away))
        excess = _excess(steps, own.mean(axis=0))
        covariance, weights = _weights(own + excess)
    shift = np.einsum("kij,kj->i", weights, steps)
    alike = np.einsum("kij,kcj->ci", weights, shared)
    uncertainty = Uncertainty(NAMES, covariance + alike.T @ alike)
    found = replace(after(middle, shift), uncertainty=uncertainty)
    return Mean(found, own, covariance, chi_square, len(NAMES) * (count - 1))


def against_others(calibrations: Sequence[ProbeCalibration], shared: Array | None = None) -> list[tuple[ProbeCalibration, float]]:
    """Of each of n calibrations, the mean of all others, and the chance of lying as far from it or farther by the covariances of
    both; NaN without these.
    """
    found, own = list[tuple[ProbeCalibration, float]](), own_covariances(calibrations, shared)
    for k, left_out in enumerate(calibrations):
        rest = [j for j in range(len(calibrations)) if j != k]
        if len(rest) == 1:
            others, spread = calibrations[rest[0]], None if own is None else own[rest[0]]
        else:
            made = mean([calibrations[j] for j in rest], None if shared is None else shared[rest])
            others, spread = made.calibration, made.own
        away = step_between(others, left_out)
        chance = np.nan
        if own is not None:
            assert spread is not None
            chance = float(stats.chi2.sf(away @ inverse(own[k] + spread) @ away, len(NAMES)))
        found.append((others, chance))
    return found


def step_between(first: ProbeCalibration, second: ProbeCalibration) -> Array:
    """The step : (8,) from one calibration to another, as NAMES."""
    return np.concatenate([second.scale - first.scale, rigid.difference(first.target_from_image, second.target_from_image)])


def after(calibration: ProbeCalibration, step: Array) -> ProbeCalibration:
    """A calibration after a step : (8,): the inverse of `step_between`."""
    pose = rigid.moved(calibration.target_from_image, step[2:])
    return replace(calibration, target_from_image=pose, scale=calibration.scale + step[:2])


def own_covariances(calibrations: Sequence[ProbeCalibration], shared: Array | None = None) -> Array | None:
    """Covariances : (n, 8, 8) without what errs alike in all; None where one is unknown or leaves a parameter out.

    Of a calibration whose covariance holds less of a cause than is said, nearly all of it counts as alike.
    """
    found = []
    for k, calibration in enumerate(calibrations):
        known = calibration.uncertainty
        if known is None or set(known.names) != set(NAMES) or np.linalg.cond(_correlation(known.ordered(NAMES))) > 1e12:
            return None
        covariance = known.ordered(NAMES)
        if shared is not None and shared.shape[1]:
            share = float(np.linalg.eigvalsh(shared[k] @ inverse(covariance) @ shared[k].T)[-1])
            covariance = covariance - min(1.0, MOST_SHARED / max(share, 1e-12)) * shared[k].T @ shared[k]
        found.append(covariance)
    return np.array(found)


def _correlation(covariance: Array) -> Array:
    sigma = np.sqrt(np.maximum(np.diag(covariance), 1e-300))
    return covariance / np.outer(sigma, sigma)


def _weights(covariances: Array) -> tuple[Array, Array]:
    """Covariance : (8, 8) of the weighted mean, and the weights : (n, 8, 8), which sum up to the identity."""
    informations = np.array([inverse(each) for each in covariances])
    covariance = inverse(informations.sum(axis=0))
    return covariance, covariance @ informations


def _excess(steps: Array, expected: Array) -> Array:
    """Covariance : (8, 8) of the scatter of n steps : (n, 8) beyond an expected one, in the directions in which it is larger."""
    white = whitening(expected)
    variances, axes = np.linalg.eigh(white @ np.cov(steps.T) @ white.T - np.eye(len(expected)))
    along = np.linalg.solve(white, axes * np.sqrt(np.maximum(variances, 0)))
    return _student(len(steps)) * along @ along.T


def _student(count: int) -> float:
    """Factor of a variance that is estimated by n values, by which one standard deviation of their mean holds 68 %."""
    return float(stats.t.ppf(ONE_SIGMA, count - 1) ** 2)
