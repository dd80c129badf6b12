"""Consistency of the poses: what changes from one to the next, which residuals hardly show, as each pose has a place of its own.

Each pose by itself would move the devices' parameters a little; at the solution these pulls cancel. How large they are by the
sightings' noise is known. Three causes make them larger: a board that bends from pose to pose, by arches along its sides and a
twist; projector coordinates that are off alike all over a pose, as by grey fringes whose shifts err, or by a hand that moves the
board between the images; and anything else, such as a device that was touched or warms up, for which all sightings count as less
exact. The likeliest sizes of all are found, and their parts added to the covariance.

Sources: Liang and Zeger 1986 (covariance by clusters); Woodbury 1950 (inverse of a sum of a matrix and one of low rank).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from recon.estimation.covariance import inverse, propagate
from recon.geometry import rigid
from recon.geometry.board_shape import bends
from recon.model.calibration import Calibration
from recon.optical_calibration import uncertainty
from recon.optical_calibration.adjustment import Adjustment
from recon.optical_calibration.bundle import Array, Estimate, Problem, linear_system
from recon.optical_calibration.observations import PROJECTOR

BENDS_MM = np.append(0.0, np.geomspace(2e-4, 0.2, 16))  # standard deviations of each bend that are thought of, RMS over the board
SHIFTS_PX = np.append(0.0, np.geomspace(1e-3, 1.0, 16))  # the same of the projector's coordinates along each axis
FACTORS = np.geomspace(1.0, 100.0, 13)  # of variances
STEP = 1e-3  # of a bend in mm and of a shift in px, for their slopes
DETERMINED = 1e-2  # of the largest eigenvalue: directions of less are held by what is known without sightings, not shown by poses
SURE = 1e-4  # of the largest eigenvalue: no pull is surer in one direction
CONTRADICTING = 1.5  # scatter from which on it is worth a warning; noise leaves 1.0 +- 0.1
MATTERING = 1.1  # rise of the uncertainty from which on it is worth one
SHOWN = 2.0  # standard deviations from which on a cause is named
SOME_POINTS = 50  # of a board: enough to see the uncertainty rise


@dataclass(frozen=True)
class Consistency:
    """How well the poses agree."""

    scatter: float  # variance of their pulls over that by the sightings' noise; about 1 if they agree
    bend_mm: float  # standard deviation of each bend of the board, RMS over its points
    bend_sigma: float  # standard deviations by which the poses show a bend, by the ratio of likelihoods
    shift_px: float  # standard deviation of the shift that all of the projector's coordinates of a pose have, along each axis
    shift_sigma: float  # as of the bend
    factor: float  # by which sightings count as less exact than their residuals besides
    rise: float  # standard deviation of projections with all causes over that without, in the device in which it rises most
    covariance: Array  # (g, g) of the devices' parameters, with all causes in it

    @property
    def warning(self) -> str | None:
        """The causes and their effect, if they have one that matters."""
        if self.scatter < CONTRADICTING or self.rise < MATTERING:
            return None
        causes, questions = [], ["is the board stiff", "did a device move or warm up"]
        if self.bend_sigma > SHOWN:
            causes.append(f"the board seems to bend by {self.bend_mm:.2g} mm (RMS) from pose to pose")
        if self.shift_sigma > SHOWN:
            causes.append(f"the projector's coordinates shift by {self.shift_px:.2g} px (RMS) from pose to pose")
            questions = [
                "does a hand move the board",
                "do the steps of grey fringes err (use binary ones, or a code)",
                *questions,
            ]
        if self.factor > 1:
            causes.append(f"poses contradict each other by {self.factor:.1f} times the residuals")
        effect = f"the uncertainty includes it, and is {self.rise:.1f} times as large"
        return f"{' and '.join(causes) or 'poses contradict each other'}: {effect}; {', '.join(questions)}?"


class Pulls(NamedTuple):
    """Pulls of p poses on the devices' parameters, in coordinates in which those of all together are of variance 1 by noise."""

    found: Array  # (p, k)
    noise: Array  # (p, k, k) covariance by the sightings' noise
    causes: Array  # (p, k, 5) by a bend of 1 mm of each kind, and by a shift of 1 px along each of the projector's axes


class Causes(NamedTuple):
    """Standard deviations of what changes from pose to pose, and a factor of the sightings' variances."""

    bend_mm: float
    shift_px: float
    factor: float

    @property
    def variances(self) -> Array:
        """Of each bend and shift : (5,)."""
        return np.square([*[self.bend_mm] * 3, *[self.shift_px] * 2])


NO_CAUSES = Causes(0.0, 0.0, 1.0)


def consistency(adjusted: Adjustment) -> Consistency:
    """Compare the poses of an adjustment."""
    assert adjusted.calibration.uncertainty is not None
    parts, whole, carry = _parts(adjusted)
    covariances = np.array([carry @ (part - part @ whole @ part) @ carry.T for part, _, _ in parts])
    scale = 1 / np.sqrt(np.maximum(np.diag(covariances.sum(axis=0)), 1e-300))
    values, vectors = np.linalg.eigh(scale[:, None] * covariances.sum(axis=0) * scale)
    shown = values > DETERMINED * values.max(initial=0.0)
    root = (vectors[:, shown] / np.sqrt(values[shown])).T * scale
    white = root @ carry  # from pulls on all shared unknowns
    pulls = Pulls(
        np.array([white @ right for _, right, _ in parts]),
        propagate(root, covariances),
        np.array([white @ slopes for _, _, slopes in parts]),
    )
    scatter = float((pulls.found**2).sum() / max(np.count_nonzero(shown), 1))
    covariance = adjusted.calibration.uncertainty.covariance
    if scatter <= 1:
        return Consistency(scatter, 0.0, 0.0, 0.0, 0.0, 1.0, 1.0, covariance)
    shifts = SHIFTS_PX if PROJECTOR in adjusted.problem.observations.devices[1:] else SHIFTS_PX[:1]
    likely = _likelihoods(pulls, BENDS_MM, shifts, FACTORS)
    bend, shift, factor = np.unravel_index(np.argmax(likely), likely.shape)
    causes = Causes(float(BENDS_MM[bend]), float(shifts[shift]), float(FACTORS[factor]))
    evidence = [float(np.sqrt(2 * (likely.max() - without.max()))) for without in (likely[0], likely[:, 0])]
    wider = covariance + _added(parts, carry, causes)
    rise = _rise(adjusted, wider)
    return Consistency(
        scatter, causes.bend_mm, evidence[0], causes.shift_px, evidence[1], float(np.sqrt(causes.factor)), rise, wider
    )


def added_covariance(adjusted: Adjustment, causes: Consistency) -> Array:
    """Covariance : (g, g) that causes, found in these and other poses, add to that of an adjustment's devices."""
    found = Causes(causes.bend_mm, causes.shift_px, causes.factor**2)
    if found == NO_CAUSES:
        return np.zeros_like(causes.covariance)
    parts, _, carry = _parts(adjusted)
    return _added(parts, carry, found)


def _parts(adjusted: Adjustment) -> tuple[list[tuple[Array, Array, Array]], Array, Array]:
    """What each pose has for all unknowns, as of `_of_pose`; the covariance of these; and its rows of the parameters."""
    problem = replace(adjusted.problem, lenses=adjusted.lenses, tightness={})
    observations = problem.observations
    parts = [_of_pose(problem, adjusted, p, bends(observations.points)) for p in range(len(observations.poses))]
    whole = inverse(sum(information for information, _, _ in parts) + problem.prior(adjusted.estimate))
    return parts, whole, whole[: len(problem.names)]


def _added(parts: Sequence[tuple[Array, Array, Array]], carry: Array, causes: Causes) -> Array:
    """Covariance : (g, g) by causes, carried to the parameters from all unknowns : (g, h)."""
    moved = np.hstack([carry @ slopes * np.sqrt(causes.variances) for _, _, slopes in parts])
    found = (causes.factor - 1) * carry @ sum(information for information, _, _ in parts) @ carry.T + moved @ moved.T
    return (found + found.T) / 2


def with_covariance(adjusted: Adjustment, covariance: Array) -> Adjustment:
    """The same adjustment with another covariance."""
    found = adjusted.calibration
    assert found.uncertainty is not None
    return replace(adjusted, calibration=Calibration(found.cameras, replace(found.uncertainty, covariance=covariance)))


def _rise(adjusted: Adjustment, covariance: Array) -> float:
    """Standard deviation of projections by a covariance over that by the adjustment's own, of the device in which it rises most.

    Of the board's points where they were seen; of a board with many some are enough.
    """
    observations, some = adjusted.problem.observations, slice(None, None, max(len(adjusted.points) // SOME_POINTS, 1))
    places = np.array([rigid.apply(pose, adjusted.points[some]) for pose in adjusted.poses])
    seen = observations.seen[:, some]
    volume = places[seen.any(axis=-1)]
    wider = with_covariance(adjusted, covariance).calibration
    rises = [1.0]
    for d, device in enumerate(observations.devices):
        points = places[seen[..., d]]
        before, after = (
            np.trace(uncertainty.projection(known, device, points, volume), axis1=1, axis2=2).mean()
            for known in (adjusted.calibration, wider)
        )
        rises.append(float(np.sqrt(after / before)))
    return max(rises)


def _of_pose(problem: Problem, adjusted: Adjustment, p: int, ways: Array) -> tuple[Array, Array, Array]:
    """One pose's information on the shared unknowns : (g, g), its pull : (g,), and the pull's slopes : (g, 5) by the causes."""
    one = replace(problem, observations=problem.observations.of_poses([p]), offsets=problem.offsets[[p]])
    estimate = Estimate(adjusted.calibration.cameras, adjusted.poses[[p]], adjusted.points)

    def pull(problem: Problem, estimate: Estimate) -> tuple[Array, Array]:
        return linear_system(problem, estimate, adjusted.levels).equations.reduced()

    information, right = pull(one, estimate)
    changed = [pull(one, replace(estimate, points=adjusted.points + STEP * way.reshape(-1, 3)))[1] for way in ways.T]
    for axis in range(2):
        offsets = one.offsets.copy()
        if PROJECTOR in one.observations.devices[1:]:
            offsets[:, :, one.observations.devices.index(PROJECTOR), axis] -= STEP
        changed.append(pull(replace(one, offsets=offsets), estimate)[1])
    return information, right, (np.stack(changed, axis=1) - right[:, None]) / STEP


def _likelihoods(pulls: Pulls, bends: Array, shifts: Array, factors: Array) -> Array:
    """Logarithm of the probability of pulls for each size of each cause : (bends, shifts, factors), up to a constant.

    The causes are of low rank beside the noise, whose covariance is inverted once.
    """
    values, vectors = np.linalg.eigh(pulls.noise)
    values = np.maximum(values, SURE * values.max(axis=1, keepdims=True))
    whiten = vectors.swapaxes(1, 2) / np.sqrt(values)[..., None]
    found, slopes = (whiten @ pulls.found[..., None])[..., 0], whiten @ pulls.causes
    products = slopes.swapaxes(1, 2) @ slopes  # (p, 5, 5)
    along = (slopes.swapaxes(1, 2) @ found[..., None])[..., 0]  # (p, 5)
    squares, count, likely = float((found**2).sum()), found.size, np.empty((len(bends), len(shifts), len(factors)))
    for place in np.ndindex(*likely.shape):
        causes = Causes(bends[place[0]], shifts[place[1]], factors[place[2]])
        sizes = np.sqrt(causes.variances / causes.factor)
        inner = np.eye(len(sizes)) + sizes[:, None] * products * sizes
        inside = sizes * along
        explained = float(np.sum(inside * np.linalg.solve(inner, inside[..., None])[..., 0]))
        spread = count * np.log(causes.factor) + float(np.linalg.slogdet(inner)[1].sum())
        likely[place] = -(spread + (squares - explained) / causes.factor) / 2
    return likely
