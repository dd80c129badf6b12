"""Joint bundle adjustment: all devices, all poses of the board and, when asked, the board's own shape, in one least squares.

The unknowns are the devices' parameters and the board's shape, which all poses share, and each pose by itself. Poses don't know
of each other, so each is eliminated from the normal equations on its own (Schur's complement): the system that is solved is as
small as the shared unknowns, and its inverse is their covariance.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from recon.estimation.covariance import inverse, marginal, propagate
from recon.estimation.equations import Step, Undetermined
from recon.estimation.levenberg_marquardt import Descent, Rules, descend
from recon.geometry import rigid
from recon.geometry.board_shape import AS_DESIGNED, Tolerances
from recon.geometry.camera_jacobian import DISTORTION, MATRIX, MOTION
from recon.geometry.lens_domain import is_one_to_one
from recon.model.calibration import Calibration, Uncertainty
from recon.optical_calibration.bundle import Array, Estimate, Problem, System, lens_sigmas, linear_system, move
from recon.optical_calibration.observations import PROJECTOR, Observations

Mask = NDArray[np.bool_]

OUTLIER = 6.0  # normalised residual of a sighting that is named an outlier; 1 Gaussian one in 7e7 is beyond
MEDIAN = np.sqrt(2 * np.log(2))  # of the length of a vector of two standard normal numbers
LEAST_NOISE = 1e-3  # of the noise that the detection predicts: what is more exact counts as no more
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
    problem: Problem  # with the lenses that had to be held tighter than usual ones, so that they have no pole or fold

    @property
    def estimate(self) -> Estimate:
        """The values alone, to start another adjustment from."""
        return Estimate(self.calibration.cameras, self.poses, self.points)

    @property
    def levels(self) -> Array:
        """The noise : (d,) in the order of the devices."""
        return np.array(list(self.noise.values()))


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
    Undetermined
        If the observations don't determine the unknowns.
    """
    offsets = np.zeros_like(observations.pixels) if offsets is None else offsets
    problem = Problem(observations, offsets, free, tolerances or AS_DESIGNED, released, lenses)
    problem, (estimate, noise, converged) = _one_to_one(problem, start)
    shaped = replace(problem, released=released or bool(problem.tolerances.sigmas.any()))
    system = linear_system(shaped, estimate, noise)
    outliers = system.lengths > OUTLIER
    if PROJECTOR in observations.devices[1:]:  # one is the projector's where it is camera 1's: it was read there
        outliers[:, :, observations.devices.index(PROJECTOR)] |= outliers[:, :, 0]
    return Adjustment(
        Calibration(estimate.cameras, Uncertainty(problem.names, _covariance(system, problem, estimate))),
        estimate.poses,
        estimate.points,
        np.where(observations.seen[..., None], system.plain, np.nan),
        outliers,
        dict(zip(observations.devices, noise.tolist(), strict=True)),
        np.where(observations.seen, system.lengths, np.nan),
        converged,
        lens_sigmas(replace(problem, tightness={}), estimate.cameras),
        problem,
    )


def free_parameters(devices: Sequence[str], distortion: Mapping[str, Sequence[str]]) -> dict[str, tuple[str, ...]]:
    """All parameters of all devices, with the distortion coefficients given for each; the first device doesn't move."""
    return {device: (*MATRIX, *distortion[device], *(MOTION if number else ())) for number, device in enumerate(devices)}


class Fit(NamedTuple):
    """The values alone."""

    estimate: Estimate
    noise: Array  # (d,) of the devices, measured over predicted by the detection
    converged: bool  # the last descent, and the noise


def fit(problem: Problem, start: Estimate, noise: Array | None = None, converged: float = CONVERGED) -> Fit:
    """Fit the values, and measure the devices' noise.

    The robust weights need the noise, and the noise needs the residuals: both are found in turn, first roughly. While the noise
    is misjudged, most sightings may weigh like outliers, and the descent to a minimum that moves on takes long.

    noise : (d,) if it is nearly known, and the start near.
    converged : relative change of the cost.
    """
    rough, estimate = noise is None, start
    noise = np.ones(len(problem.observations.devices)) if noise is None else noise
    for number in range(MAX_ROUNDS):
        found = _descend(problem, estimate, noise, ROUGH if rough else FINE._replace(converged=converged))
        factor = np.maximum(_measured_noise(found.system, problem), LEAST_NOISE / noise)
        estimate, noise, change = found.estimate, noise * factor, np.abs(factor - 1).max()
        if change < SAME_NOISE and not rough:
            return Fit(estimate, noise, found.converged)
        rough = rough and change > SIMILAR_NOISE and number < MAX_ROUGH
    return Fit(estimate, noise, False)


def _one_to_one(problem: Problem, start: Estimate) -> tuple[Problem, Fit]:
    """Fit; lenses that come out with a pole or a fold near their image are held tighter, as far as the sightings allow."""
    free = found = fit(problem, start)
    given_up = {name for name in found.estimate.cameras if not any(part in DISTORTION for part in problem.free.get(name, ()))}
    held = problem
    while True:
        strained = {problem.observations.devices[d] for d in np.flatnonzero(found.noise > STRAINED * free.noise)}
        given_up |= strained & held.tightness.keys()
        bent = {name for name, camera in found.estimate.cameras.items() if not is_one_to_one(camera)} - given_up
        if not bent and not given_up & held.tightness.keys():
            return held, found
        tightness = {**held.tightness, **{name: TIGHTER * held.tightness.get(name, 1.0) for name in bent}}
        given_up |= {name for name in bent if tightness[name] > TIGHTEST}
        held = replace(problem, tightness={name: tight for name, tight in tightness.items() if name not in given_up})
        found = fit(held, start)


def _descend(problem: Problem, estimate: Estimate, noise: Array, rules: Rules) -> Descent[Estimate, System, Step]:
    """Levenberg-Marquardt from an estimate to the next minimum, at fixed noise."""
    prior = problem.prior(estimate)

    def held_system(estimate: Estimate) -> tuple[System, float]:
        """Equations and cost: Huber's loss, and the departure of lenses and board from the likely ones."""
        system, departures = linear_system(problem, estimate, noise), problem.departures(estimate)
        cost = float(system.losses.sum() + departures @ prior @ departures)
        return replace(system, equations=system.equations.held(prior, departures)), cost

    return descend(estimate, held_system, partial(move, problem), rules=rules)


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
        raise Undetermined("fewer observations than unknowns")
    lengths = [system.lengths[:, :, d][used[:, :, d]] for d in range(used.shape[2])]
    factors = [np.median(length) / MEDIAN / np.sqrt(left) if length.size else 1.0 for length in lengths]
    return np.array(factors)


def board_information(adjusted: Adjustment) -> tuple[Array, Array]:
    """Information of the sightings alone on board points : (3 n, 3 n), 1/mm^2, and times their departures : (3 n,), 1/mm."""
    problem = replace(adjusted.problem, released=True, lenses=adjusted.lenses, tightness={})
    own, every = len(problem.names), len(problem.blocks)
    lenses = np.diag(np.append(adjusted.lenses**-2, np.zeros(every - own)))
    return _information_alone(adjusted, problem, lenses, np.arange(own, every))


def lens_information(adjusted: Adjustment) -> tuple[Array, Array]:
    """Information of the sightings alone on coefficients of distortion : (k, k), and times the values they ask for : (k,).

    Poses, other parameters and, if it is released, the board, as far as its tolerances leave it open, are eliminated.
    """
    problem = replace(adjusted.problem, lenses=adjusted.lenses, tightness={})
    held, own = np.isfinite(adjusted.lenses), len(problem.names)
    prior = np.zeros((len(problem.blocks),) * 2)
    if problem.released:
        prior[own:, own:] = problem.tolerances.information(problem.observations.points)
    return _information_alone(adjusted, problem, prior, np.flatnonzero(held))


def _information_alone(adjusted: Adjustment, problem: Problem, prior: Array, chosen: NDArray[np.intp]) -> tuple[Array, Array]:
    """Information : (k, k) on chosen ones of the shared unknowns : (k,), and times the departures that the sightings ask for.

    prior : (g, g) information on the others without any sighting.
    """
    departures = problem.departures(adjusted.estimate)
    equations = linear_system(problem, adjusted.estimate, adjusted.levels).equations.held(prior, departures)
    information, right = marginal(*equations.reduced(), chosen)
    return information, right + information @ departures[chosen]


def _covariance(system: System, problem: Problem, estimate: Estimate) -> Array:
    """Covariance of the devices' parameters : (g, g); that of usual lenses, however tightly they had to be held."""
    own, (reduced, _) = len(problem.names), system.equations.reduced()
    prior = replace(problem, tightness={}).prior(estimate)
    if problem.released:
        scale = scale_errors(problem, estimate)
        return inverse(reduced + prior)[:own, :own] + np.outer(scale, scale)
    covariance = inverse(reduced[:own, :own] + prior)
    if len(reduced) > own:  # errors of the board that are not estimated carry over to the parameters
        carried = covariance @ reduced[:own, own:]
        covariance = covariance + propagate(carried, problem.tolerances.covariance(problem.observations.points))
    return covariance


def scale_errors(problem: Problem, estimate: Estimate) -> Array:
    """Errors : (g,) of the devices' parameters by the board's scale, 1 sigma: it moves them away from the first one, no more."""
    by_parameter, first = [], estimate.cameras[problem.observations.devices[0]]
    for device in problem.observations.devices:
        shift = rigid.apply(estimate.cameras[device].camera_from_world, first.centre[None])[0]
        larger = dict(zip(MOTION[3:], shift, strict=True))
        by_parameter += [larger.get(name, 0.0) for name in problem.free.get(device, ())]
    return np.array(by_parameter) * problem.tolerances.scale_sigma(problem.observations.points)
