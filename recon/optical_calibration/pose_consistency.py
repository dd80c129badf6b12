"""Consistency of the poses: what changes from one to the next, which residuals hardly show, as each pose has a place of its own.

Each pose by itself would move the devices' parameters a little; at the solution these pulls cancel. How large they are by the
sightings' noise is known. Two causes make them larger: a board that bends from pose to pose, by arches along its sides and a
twist, and anything else, such as a device that was touched or warms up, for which all sightings count as less exact. The
likeliest sizes of both are found, and their parts added to the covariance.

Source: Liang and Zeger 1986 (covariance by clusters).
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

BENDS_MM = np.append(0.0, np.geomspace(2e-4, 0.2, 16))  # standard deviations of each bend that are thought of, RMS over the board
FACTORS = np.geomspace(1.0, 100.0, 13)  # of variances
STEP_MM = 1e-3  # of a bend, for its slope
DETERMINED = 1e-2  # of the largest eigenvalue: directions of less are held by what is known without sightings, not shown by poses
SURE = 1e-4  # of the largest eigenvalue: no pull is surer in one direction
CONTRADICTING = 1.5  # scatter from which on it is worth a warning; noise leaves 1.0 +- 0.1
MATTERING = 1.1  # rise of the uncertainty from which on it is worth one
SHOWN = 2.0  # standard deviations from which on a bend is named
SOME_POINTS = 50  # of a board: enough to see the uncertainty rise


@dataclass(frozen=True)
class Consistency:
    """How well the poses agree."""

    scatter: float  # variance of their pulls over that by the sightings' noise; about 1 if they agree
    bend_mm: float  # standard deviation of each bend of the board, RMS over its points
    bend_sigma: float  # standard deviations by which the poses show a bend, by the ratio of likelihoods
    factor: float  # by which sightings count as less exact than their residuals besides
    rise: float  # standard deviation of projections with both causes over that without, in the device in which it rises most
    covariance: Array  # (g, g) of the devices' parameters, with both causes in it

    @property
    def warning(self) -> str | None:
        """The causes and their effect, if they have one that matters."""
        if self.scatter < CONTRADICTING or self.rise < MATTERING:
            return None
        named = self.bend_sigma > SHOWN
        bend = f"the board seems to bend by {self.bend_mm:.2g} mm (RMS) from pose to pose" if named else ""
        rest = f"poses contradict each other by {self.factor:.1f} times the residuals" if self.factor > 1 else ""
        causes = " and ".join(filter(None, (bend, rest))) or "poses contradict each other"
        effect = f"the uncertainty includes it, and is {self.rise:.1f} times as large"
        return f"{causes}: {effect}; is the board stiff, did a device move or warm up?"


class Pulls(NamedTuple):
    """Pulls of p poses on the devices' parameters, in coordinates in which those of all together are of variance 1 by noise."""

    found: Array  # (p, k)
    noise: Array  # (p, k, k) covariance by the sightings' noise
    bends: Array  # (p, k, 3) by a bend of 1 mm of each kind


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
        return Consistency(scatter, 0.0, 0.0, 1.0, 1.0, covariance)
    by_bends = pulls.bends @ pulls.bends.swapaxes(1, 2)
    likely = np.array([[_likelihood(pulls, b * pulls.noise + a**2 * by_bends) for b in FACTORS] for a in BENDS_MM])
    place = np.unravel_index(np.argmax(likely), likely.shape)
    bend, factor = float(BENDS_MM[place[0]]), float(FACTORS[place[1]])
    evidence = float(np.sqrt(2 * (likely.max() - likely[0].max())))  # BENDS_MM begins with none
    wider = covariance + _added(parts, carry, bend, factor)
    return Consistency(scatter, bend, evidence, float(np.sqrt(factor)), _rise(adjusted, wider), wider)


def added_covariance(adjusted: Adjustment, causes: Consistency) -> Array:
    """Covariance : (g, g) that causes, found in these and other poses, add to that of an adjustment's devices."""
    if not causes.bend_mm and causes.factor == 1:
        return np.zeros_like(causes.covariance)
    parts, _, carry = _parts(adjusted)
    return _added(parts, carry, causes.bend_mm, causes.factor**2)


def _parts(adjusted: Adjustment) -> tuple[list[tuple[Array, Array, Array]], Array, Array]:
    """What each pose has for all unknowns, as of `_of_pose`; the covariance of these; and its rows of the parameters."""
    problem = replace(adjusted.problem, lenses=adjusted.lenses, tightness={})
    observations = problem.observations
    parts = [_of_pose(problem, adjusted, p, bends(observations.points)) for p in range(len(observations.poses))]
    whole = inverse(sum(information for information, _, _ in parts) + problem.prior(adjusted.estimate))
    return parts, whole, whole[: len(problem.names)]


def _added(parts: Sequence[tuple[Array, Array, Array]], carry: Array, bend: float, factor: float) -> Array:
    """Covariance : (g, g) by bends and a factor of variances, carried to the parameters from all unknowns : (g, h)."""
    moved = np.hstack([carry @ slopes for _, _, slopes in parts])
    found = (factor - 1) * carry @ sum(information for information, _, _ in parts) @ carry.T + bend**2 * moved @ moved.T
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
    """One pose's information on the shared unknowns : (g, g), its pull : (g,), and the pull's slopes : (g, 3) by bends, 1/mm."""
    one = replace(problem, observations=problem.observations.of_poses([p]), offsets=problem.offsets[[p]])

    def pull(points: Array) -> tuple[Array, Array]:
        estimate = Estimate(adjusted.calibration.cameras, adjusted.poses[[p]], points)
        return linear_system(one, estimate, adjusted.levels).equations.reduced()

    information, right = pull(adjusted.points)
    bent = [pull(adjusted.points + STEP_MM * way.reshape(-1, 3))[1] for way in ways.T]
    return information, right, (np.stack(bent, axis=1) - right[:, None]) / STEP_MM


def _likelihood(pulls: Pulls, covariances: Array) -> float:
    """Logarithm of the probability of pulls with covariances : (p, k, k), up to a constant."""
    values, vectors = np.linalg.eigh(covariances)
    values = np.maximum(values, SURE * values.max())
    along = np.einsum("pka,pk->pa", vectors, pulls.found)
    return float(-(np.log(values) + along**2 / values).sum() / 2)
