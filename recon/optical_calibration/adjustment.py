"""Joint bundle adjustment: all devices, all poses of the board and, when asked, the board's own shape, in one least squares.

The unknowns are the devices' parameters and the board's shape, which all poses share, and each pose by itself. Poses don't know
of each other, so each is eliminated from the normal equations on its own (Schur's complement): the system that is solved is as
small as the shared unknowns, and its inverse is their covariance.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from recon.geometry import rigid
from recon.geometry.board_shape import AS_DESIGNED, Tolerances
from recon.geometry.camera_jacobian import DISTORTION, MATRIX, MOTION
from recon.geometry.lens_domain import is_one_to_one
from recon.geometry.levenberg_marquardt import Descent, Rules, Unreachable, descend
from recon.model.calibration import Calibration, Uncertainty
from recon.optical_calibration.bundle import (
    ROBUST,
    Array,
    Estimate,
    Problem,
    System,
    coefficients,
    lens_sigmas,
    linearised,
    stepped,
)
from recon.optical_calibration.observations import PROJECTOR, Observations

Mask = NDArray[np.bool_]

OUTLIER = 6.0  # normalised residual of a sighting that is named an outlier; 1 Gaussian one in 7e7 is beyond
MEDIAN = np.sqrt(2 * np.log(2))  # of the length of a vector of two standard normal numbers
LEAST_NOISE = 1e-3  # of the noise that was assumed
TINY = 1e-12  # keeps a pose that nobody sees from being singular
SINGULAR = 1e-14  # of the largest eigenvalue: below, rounding decides
MAX_ROUNDS, MAX_ROUGH = 10, 5  # of measuring the noise
SIMILAR_NOISE, SAME_NOISE = 0.2, 0.01  # relative change of the noise by which rough rounds end, and by which all do
TIGHTER, TIGHTEST = 2.0, 1e6  # by which a lens is held that has a pole or a fold: times this each time, and at most
STRAINED = 1.1  # times the residuals: what the sightings don't allow
ROUGH = Rules(converged=1e-2)
CONVERGED = 1e-10  # relative change of the cost
FINE = Rules(damping=1e-9)  # from nearby: damping would hold back what is hardly determined, for many steps


@dataclass(frozen=True)
class Adjustment:
    """The outcome: values, residuals and covariance."""

    calibration: Calibration  # with the uncertainty that follows from the measured noise, and from the board's if not released
    poses: Array  # (p, 4, 4) world_from_board
    points: Array  # (n, 3) mm, the board as adjusted
    residuals: Array  # (p, n, d, 2) px, observed less predicted, NaN where not seen
    outliers: Mask  # (p, n, d)
    noise: Mapping[str, float]  # by device: measured noise over that predicted by the detection
    normalised: Array  # (p, n, d) residuals over their measured noise, each device's own; NaN where not seen
    converged: bool
    lenses: Array  # (g,) standard deviations by which the parameters are held to zero; infinite but for those of distortion
    tightness: Mapping[str, float]  # of devices whose lens is held tighter than usual ones, so that it has no pole or fold

    @property
    def estimate(self) -> Estimate:
        """The values alone, to start another adjustment from."""
        return Estimate(self.calibration.cameras, self.poses, self.points)


def adjust(
    observations: Observations,
    start: Estimate,
    free: Mapping[str, Sequence[str]],
    offsets: Array | None = None,
    tolerances: Tolerances | None = None,
    released: bool = False,
    lenses: Array | None = None,
) -> Adjustment:
    """Adjust devices, poses and shape to the observations.

    Parameters
    ----------
    observations : Observations
        With the noise that the detection predicts. How large it really is, is measured on the residuals, device by device.
    start : Estimate
        Near the solution: see `initial_estimate.estimate`.
    free : device -> names of parameters
        Those to be adjusted, as in `calibration.Uncertainty`; the rest keep their values. The first device defines the world:
        it has no motion to adjust.
    offsets : (p, n, d, 2) px, optional
        From where a device would see a point to where the detection puts it: see `circle_projection.centre_offsets`.
    tolerances : Tolerances, optional
        Of the board.
    released : bool
        Whether the board's points are adjusted, too, held to their design by the tolerances. If not, the tolerances' effect is
        added to the covariance ("consider parameters", Schmidt 1966).
    lenses : (g,), optional
        Standard deviations by which coefficients of distortion are held to zero, infinite for other parameters; those of usual
        lenses if not given.

    Returns
    -------
    Adjustment

    Raises
    ------
    ValueError
        If the observations don't determine the unknowns.
    """
    offsets = np.zeros_like(observations.pixels) if offsets is None else offsets
    problem = Problem(observations, offsets, free, tolerances or AS_DESIGNED, released, lenses)
    problem, (estimate, noise, converged) = _one_to_one(problem, start)
    system = linearised(problem, estimate, noise, shaped=released or bool(problem.tolerances.sigmas.any()))
    return Adjustment(
        Calibration(estimate.cameras, Uncertainty(problem.names, _covariance(system, problem, estimate))),
        estimate.poses,
        estimate.points,
        np.where(observations.seen[..., None], system.plain, np.nan),
        _outliers(system.lengths, observations),
        dict(zip(observations.devices, noise.tolist(), strict=True)),
        np.where(observations.seen, system.lengths, np.nan),
        converged,
        lens_sigmas(replace(problem, tightness={}), estimate.cameras),
        problem.tightness,
    )


def free_parameters(devices: Sequence[str], distortion: Mapping[str, Sequence[str]]) -> dict[str, tuple[str, ...]]:
    """All parameters of all devices, with the distortion coefficients given for each; the first device doesn't move."""
    return {device: (*MATRIX, *distortion[device], *(MOTION if number else ())) for number, device in enumerate(devices)}


class Fitted(NamedTuple):
    """The values alone."""

    estimate: Estimate
    noise: Array  # (d,) of the devices, measured over predicted by the detection
    converged: bool  # the last descent


def fitted(problem: Problem, start: Estimate, noise: Array | None = None, converged: float = CONVERGED) -> Fitted:
    """Fit the values, and measure the devices' noise.

    The robust weights need the noise, and the noise needs the residuals: both are found in turn, first roughly. While the noise
    is misjudged, most sightings may weigh like outliers, and the descent to a minimum that moves on takes long.

    noise : (d,) if it is nearly known, and the start near.
    converged : relative change of the cost.
    """
    rough, estimate, arrived = noise is None, start, False
    noise = np.ones(len(problem.observations.devices)) if noise is None else noise
    for number in range(MAX_ROUNDS):
        found = _descend(problem, estimate, noise, ROUGH if rough else FINE._replace(converged=converged))
        factor = _measured_noise(found.system, problem)
        estimate, noise, arrived, change = found.estimate, noise * factor, found.converged, np.abs(factor - 1).max()
        if change < SAME_NOISE and not rough:
            break
        rough = rough and change > SIMILAR_NOISE and number < MAX_ROUGH
    return Fitted(estimate, noise, arrived)


def _one_to_one(problem: Problem, start: Estimate) -> tuple[Problem, Fitted]:
    """Fit; lenses that come out with a pole or a fold near their image are held tighter, as far as the sightings allow."""
    free = fit = fitted(problem, start)
    given_up = {name for name in fit.estimate.cameras if not any(part in DISTORTION for part in problem.free.get(name, ()))}
    held = problem
    while True:
        strained = {problem.observations.devices[d] for d in np.flatnonzero(fit.noise > STRAINED * free.noise)}
        given_up |= strained & held.tightness.keys()
        bent = {name for name, camera in fit.estimate.cameras.items() if not is_one_to_one(camera)} - given_up
        if not bent and not given_up & held.tightness.keys():
            return held, fit
        tightness = {**held.tightness, **{name: TIGHTER * held.tightness.get(name, 1.0) for name in bent}}
        given_up |= {name for name in bent if tightness[name] > TIGHTEST}
        held = replace(problem, tightness={name: tight for name, tight in tightness.items() if name not in given_up})
        fit = fitted(held, start)


def _descend(problem: Problem, estimate: Estimate, noise: Array, rules: Rules) -> Descent[Estimate, System, tuple[Array, Array]]:
    """Levenberg-Marquardt from an estimate to the next minimum, at fixed noise."""
    prior = prior_information(problem, estimate)

    def system_and_cost(estimate: Estimate) -> tuple[System, float]:
        system = linearised(problem, estimate, noise, problem.released)
        return system, _cost(system, estimate, problem, prior)

    def step(estimate: Estimate, system: System, damping: float) -> tuple[Array, Array]:
        return _step(system, _deviation(estimate, problem), prior, damping)

    return descend(estimate, system_and_cost, step, lambda estimate, step: stepped(problem, estimate, *step), rules=rules)


def prior_information(problem: Problem, estimate: Estimate) -> Array:
    """Information on the shared unknowns : (g, g) without any sighting: that of usual lenses, and the board's tolerances."""
    lenses = np.diag(lens_sigmas(problem, estimate.cameras) ** -2)
    if not problem.released:
        return lenses
    return block_diag(lenses, problem.tolerances.information(problem.observations.points))


def _deviation(estimate: Estimate, problem: Problem) -> Array:
    """Of the shared unknowns : (g,) from those that are most likely without any sighting; zero of those that may be anything."""
    lenses = coefficients(problem, estimate.cameras)
    return np.append(lenses, estimate.points - problem.observations.points) if problem.released else lenses


def _cost(system: System, estimate: Estimate, problem: Problem, prior: Array) -> float:
    """Huber's loss of the lengths, and the departure of lenses and board from the likely ones."""
    lengths, deviation = system.lengths, _deviation(estimate, problem)
    loss = np.where(lengths <= ROBUST, lengths**2, 2 * ROBUST * lengths - ROBUST**2).sum()
    return float(loss + deviation @ prior @ deviation)


def _step(system: System, deviation: Array, prior: Array, damping: float) -> tuple[Array, Array]:
    """One damped Gauss-Newton step: shared unknowns (g,), poses (p, 6).

    Raises
    ------
    Unreachable
        If the equations are singular.
    """
    equations = system.equations
    shared, right = equations.shared + prior, equations.right - prior @ deviation
    shared[np.diag_indices_from(shared)] *= 1 + damping
    corner = equations.corner + np.eye(6) * (damping * np.diagonal(equations.corner, axis1=1, axis2=2)[:, None, :] + TINY)
    each = np.concatenate([equations.cross.swapaxes(1, 2), equations.pose_right[..., None]], axis=2)  # (p, 6, g + 1)
    try:
        each = np.linalg.solve(corner, each)
        eliminate, alone = each[..., :-1], each[..., -1]
        reduced = shared - _sum_of_products(equations.cross, eliminate)
        solution = _solve(reduced, right - np.einsum("pga,pa->g", equations.cross, alone))
    except np.linalg.LinAlgError as singular:
        raise Unreachable(str(singular)) from None
    return solution, alone - eliminate @ solution


def _sum_of_products(left: Array, right: Array) -> Array:
    """Sum over p of the products of (p, g, k) and (p, k, h) : (g, h), as one product of two large matrices."""
    return np.concatenate(left, axis=1) @ np.concatenate(right)


def _solve(matrix: Array, right: Array) -> Array:
    """Solve a symmetric positive system : (g, g), (g,), whose unknowns have different units."""
    scale = 1 / np.sqrt(np.maximum(np.diag(matrix), 1e-30))
    return scale * np.linalg.solve(scale[:, None] * matrix * scale, scale * right)


def _measured_noise(system: System, problem: Problem) -> Array:
    """Noise of each device on the residuals over the noise assumed : (d,); 1 for a device that sees nothing.

    The median is used, as it doesn't mind outliers. The unknowns take their part of the residuals, evenly; a released board has
    three a point, less the six of its place, which the poses have already, and its scale, or fewer, if tolerances hold it.
    """
    used = problem.observations.used
    determined = problem.tolerances.determined
    board = (3 * used.shape[1] - 7 if determined is None else determined) if problem.released else 0
    unknowns = len(problem.names) + board + 6 * np.count_nonzero(used.any(axis=(1, 2)))
    left = 1 - unknowns / max(2 * np.count_nonzero(used), 1)
    if left <= 0:
        raise ValueError("fewer observations than unknowns")
    lengths = [system.lengths[:, :, d][used[:, :, d]] for d in range(used.shape[2])]
    factors = [np.median(length) / MEDIAN / np.sqrt(left) if length.size else 1.0 for length in lengths]
    return np.maximum(factors, LEAST_NOISE)


def board_information(
    observations: Observations, adjusted: Adjustment, free: Mapping[str, Sequence[str]], offsets: Array
) -> tuple[Array, Array]:
    """Information of the sightings alone on board points : (3 n, 3 n), 1/mm^2, and times their departures : (3 n,), 1/mm."""
    problem = Problem(observations, offsets, free, released=True, lenses=adjusted.lenses)
    system = linearised(problem, adjusted.estimate, np.array(list(adjusted.noise.values())), shaped=True)
    own, (reduced, right) = len(problem.names), without_poses(system)
    lenses, departures = adjusted.lenses**-2, _deviation(adjusted.estimate, problem)
    devices = inverse(reduced[:own, :own] + np.diag(lenses))
    pull = right[own:] - reduced[own:, :own] @ devices @ (right[:own] - lenses * departures[:own])
    information = reduced[own:, own:] - reduced[own:, :own] @ devices @ reduced[:own, own:]
    return information, pull + information @ departures[own:]


def lens_information(
    observations: Observations,
    adjusted: Adjustment,
    free: Mapping[str, Sequence[str]],
    offsets: Array,
    tolerances: Tolerances,
    released: bool,
) -> tuple[Array, Array]:
    """Information of the sightings alone on coefficients of distortion : (k, k), and times the values they ask for : (k,).

    Poses, other parameters and, if it is released, the board, as far as its tolerances leave it open, are eliminated.
    """
    problem = Problem(observations, offsets, free, tolerances, released, adjusted.lenses)
    system = linearised(problem, adjusted.estimate, np.array(list(adjusted.noise.values())), released)
    information, right = without_poses(system)
    held, departures = np.isfinite(adjusted.lenses), _deviation(adjusted.estimate, problem)
    if released:
        own, prior = len(problem.names), tolerances.information(observations.points)
        information[own:, own:] += prior
        right[own:] -= prior @ departures[own:]
    chosen = np.flatnonzero(held)
    others = np.setdiff1d(np.arange(len(right)), chosen)
    eliminate = information[np.ix_(chosen, others)] @ inverse(information[np.ix_(others, others)])
    alone = information[np.ix_(chosen, chosen)] - eliminate @ information[np.ix_(others, chosen)]
    return alone, right[chosen] - eliminate @ right[others] + alone @ departures[chosen]


def without_poses(system: System) -> tuple[Array, Array]:
    """Normal equations of the shared unknowns : (g, g), (g,), the poses eliminated."""
    equations = system.equations
    each = np.concatenate([equations.cross.swapaxes(1, 2), equations.pose_right[..., None]], axis=2)
    eliminate = np.linalg.solve(equations.corner + TINY * np.eye(6), each)
    alone = np.einsum("pga,pa->g", equations.cross, eliminate[..., -1])
    return equations.shared - _sum_of_products(equations.cross, eliminate[..., :-1]), equations.right - alone


def _covariance(system: System, problem: Problem, estimate: Estimate) -> Array:
    """Covariance of the devices' parameters : (g, g); that of usual lenses, however tightly they had to be held."""
    own, (reduced, _), prior = (
        len(problem.names),
        without_poses(system),
        prior_information(replace(problem, tightness={}), estimate),
    )
    if problem.released:
        scale = scale_errors(problem, estimate)
        return inverse(reduced + prior)[:own, :own] + np.outer(scale, scale)
    covariance = inverse(reduced[:own, :own] + prior)
    if len(reduced) > own:  # errors of the board that are not estimated carry over to the parameters
        carried = covariance @ reduced[:own, own:]
        covariance = covariance + carried @ problem.tolerances.covariance(problem.observations.points) @ carried.T
    return covariance


def scale_errors(problem: Problem, estimate: Estimate) -> Array:
    """Errors : (g,) of the devices' parameters by the board's scale, 1 sigma: it moves them away from the first one, no more."""
    by_parameter, first = [], estimate.cameras[problem.observations.devices[0]]
    for device in problem.observations.devices:
        shift = rigid.apply(estimate.cameras[device].camera_from_world, first.centre[None])[0]
        larger = dict(zip(MOTION[3:], shift, strict=True))
        by_parameter += [larger.get(name, 0.0) for name in problem.free.get(device, ())]
    return np.array(by_parameter) * problem.tolerances.scale_sigma(problem.observations.points)


def inverse(information: Array) -> Array:
    """Covariance from an information matrix whose unknowns have different units; what is hardly determined varies widely."""
    scale = 1 / np.sqrt(np.maximum(np.diag(information), 1e-30))
    values, vectors = np.linalg.eigh(scale[:, None] * information * scale)
    half = scale[:, None] * vectors / np.sqrt(np.maximum(values, SINGULAR * values.max(initial=0.0)))
    return half @ half.T


def _outliers(lengths: Array, observations: Observations) -> Mask:
    """Sightings far off : (p, n, d). The projector's is one where camera 1's is: it was read there."""
    outliers = lengths > OUTLIER
    if PROJECTOR in observations.devices[1:]:
        outliers[:, :, observations.devices.index(PROJECTOR)] |= outliers[:, :, 0]
    return outliers
