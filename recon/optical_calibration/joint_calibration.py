"""Joint optics calibration: from sightings of a board's points to the devices' parameters and their covariance."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from scipy.spatial.transform import Rotation

from recon import arguments, linear_algebra
from recon.errors import InputError
from recon.estimation.equations import Undetermined
from recon.geometry import board_shape, usual_lenses
from recon.geometry.board_shape import Tolerances
from recon.geometry.camera_jacobian import difference
from recon.geometry.circle_projection import centre_offsets
from recon.model.boards import Board, Discs
from recon.model.calibration import Calibration
from recon.model.rig import NotNegative, Part
from recon.optical_calibration import half_turns, initial_estimate
from recon.optical_calibration import optical_checks as checks
from recon.optical_calibration.adjustment import (
    Adjustment,
    adjust,
    board_information,
    free_parameters,
    lens_information,
    scale_errors,
)
from recon.optical_calibration.bundle import Array, Estimate, lens_sigmas
from recon.optical_calibration.distortion_selection import MODELS, TRIED, ModelName, choose
from recon.optical_calibration.observations import PROJECTOR, Observations, Size
from recon.optical_calibration.pose_consistency import Consistency, added_covariance, consistency, with_covariance
from recon.optical_calibration.sightings import Sighting, gather, without_scraps
from recon.optical_calibration.sightings import light as sighted_light
from recon.structured_light import plausibility

BAD_POSE = 5.0  # times the noise: median residual of a pose in one device that doesn't fit the others
OUTSIDE_PX = 50.0  # of an image, where points may be found yet: the projector's, carried on
MANY_POINTS = 400  # of a board: the shape of one with more takes too long to find
ENOUGH = 2.0  # sightings' coordinates an unknown, the board's points among these, to find its shape by
UNSOLVED = (
    "equations without a solution: are poses few or nearly parallel, or is the board another one? "
    "shape.released=false takes it as designed, which needs less"
)
BENT = 0.9  # of a flatness tolerance's variance: bowing, which neighbours share


class Shape(Part):
    """The board's shape: found with the rest, held by its tolerances, or taken as designed."""

    released: bool = True
    """find the shape together with the rest; false takes the board as designed"""
    in_plane_mm: NotNegative = 0.0
    """mm, standard deviation of each point in x and y; office printers reach some 0.02. The shape is held to this; 0 holds it
    as the sightings ask for. Of a board taken as designed it adds to the uncertainty, and 0 is exact"""
    out_of_plane_mm: NotNegative = 0.0
    """mm, the same out of the plane; boards glued on glass bow by some 0.05, on cardboard by more"""

    @property
    def tolerances(self) -> Tolerances:
        """Those that are given."""
        bow, dent = np.sqrt(BENT / 3) * self.out_of_plane_mm, np.sqrt(1 - BENT) * self.out_of_plane_mm
        return Tolerances(print_mm=self.in_plane_mm, bow_mm=float(bow), dent_mm=float(dent))


class Settings(Part):
    """Settings of the calibration."""

    distortion: Literal["auto", ModelName] = "auto"  # auto: by cross-validation, for each device
    shape: Shape = Shape()
    """of the board: how far its points stand from their design"""


@dataclass(frozen=True)
class Result:
    """A calibration and all that there is to say of it."""

    observations: Observations  # of the poses that were used
    adjustment: Adjustment
    model: Mapping[str, ModelName]  # device: distortion model
    scores: Mapping[str, Mapping[ModelName, float]]  # device: model: cross-validated RMS, px; empty where it was given
    dropped: Mapping[str, str]  # pose, or pose and device: the reason
    halves: Array  # (g,) difference between the calibrations of two halves of the poses, in predicted standard deviations
    warnings: tuple[str, ...]
    offsets: Array  # (p, n, d, 2) px, from the projected centres of circles to those of their ellipses
    board: Board
    tolerances: Tolerances  # of the board, as given or as the sightings show
    released: bool  # the board's points were adjusted
    turned: Mapping[str, Sequence[str]] = field(default_factory=dict)  # device, or all: poses with points numbered the other way

    @property
    def rms(self) -> dict[str, float]:
        """Reprojection RMS by device, px: root of the mean squared distance of the points that are no outliers."""
        return reprojection_rms(self.observations, self.adjustment)


@linear_algebra.on_one_thread()
def calibrate(
    sightings: Sequence[Sighting], board: Board, sizes: Mapping[str, Size], settings: Settings | None = None, name: str = "board"
) -> Result:
    """Calibrate all devices that saw the board.

    The devices are calibrated one by one, then together; poses that contradict the others are left out; the centres of circles
    are corrected for perspective and lens; each device's distortion model is chosen; all is adjusted once more.

    Parameters
    ----------
    sightings : sequence of Sighting
        One a pose.
    sizes : device -> (width, height) px
        In the order in which devices are to stand: cam1, which defines the world, first.
    name : str
        Of the captures, for messages.

    Raises
    ------
    InputError
        If the sightings don't determine the devices, or contradict each other or the board's design.
    """
    _check(sightings, board, sizes, settings, name)
    try:
        with np.errstate(all="ignore"):  # what isn't finite is refused
            return _calibrate([without_scraps(sighting) for sighting in sightings], board, sizes, settings or Settings(), name)
    except np.linalg.LinAlgError:
        raise InputError(f"{name}: expected sightings that determine all devices, found {UNSOLVED}") from None
    except Undetermined as error:
        raise InputError(f"{name}: expected sightings that determine all devices, found {error}") from None


def _check(sightings: Sequence[Sighting], board: Board, sizes: Mapping[str, Size], settings: Settings | None, name: str) -> None:
    """Refuse what `calibrate` can't take, and points outside of their device's image."""
    arguments.of_kind(f"{name}: sightings", sightings, Sequence)
    arguments.of_kind(f"{name}: board", board, Board)
    arguments.of_kind(f"{name}: sizes", sizes, Mapping, way="width and height of each device: {'cam1': (1280, 1024)}")
    arguments.of_kind(f"{name}: settings", settings, Settings, type(None))
    extents = {device: np.array(arguments.image_size(f"{name}: sizes: {device}", size)) for device, size in sizes.items()}
    count = len(board.points())
    for sighting in sightings:
        arguments.of_kind(f"{name}: sightings", sighting, Sighting, way="sonotwin.find_board makes one of a pose's images")
        for device, pixels in sighting.pixels.items():
            place = f"{name}: {sighting.name} {device}"
            arguments.numbers(place, pixels, (count, 2), finite=False, what=f"{count} points of this board")
            if device in extents:
                middle = (extents[device] - 1) / 2
                beyond = (np.abs(pixels - middle) > middle + OUTSIDE_PX).any(axis=1)
                if beyond.any():
                    (u, v), size = pixels[beyond][0], "x".join(map(str, extents[device]))
                    raise InputError(
                        f"{place}: expected points in its image of {size} px, found ({u:.0f}, {v:.0f}): another size?"
                    )


def _calibrate(sightings: Sequence[Sighting], board: Board, sizes: Mapping[str, Size], settings: Settings, name: str) -> Result:
    """`calibrate`, with sightings of enough points."""
    dropped = {f"{sighting.name} {device}": str(reason) for sighting in sightings for device, reason in sighting.failures.items()}
    if not any(sighting.pixels for sighting in sightings):
        commonest = Counter(dropped.values()).most_common(1)[0][0] if dropped else "no images"
        raise InputError(f"{name}: expected the board in {len(sightings)} poses, found it in none: {commonest}")
    observations = gather(sightings, board, sizes)
    checks.refuse_unusable(observations, name)
    turn = half_turns.half_turn(board)
    observations, flipped = (observations, {}) if turn is None else half_turns.agreeing(observations, turn)
    shown = sighted_light(sightings)
    light = plausibility.suspected(shown.bends, shown.unknown, shown.clipped)
    first = initial_estimate.estimate(observations, light)
    checks.refuse_parallel(observations, first, name)
    seen = [sighting.radii for sighting in sightings if sighting.pixels]
    size_warning = checks.refuse_wrong_size(board, seen, first, name)

    free = _free(observations, dict.fromkeys(observations.devices, TRIED[0]))
    adjusted, observations, contradicting = _consistent(observations, first, free, board, name, light)
    checks.refuse_unusable(observations, name)
    estimate, offsets = adjusted.estimate, circle_offsets(observations, adjusted.estimate, board)
    released = settings.shape.released and _determine_shape(observations)
    if released and turn is not None:
        observations, estimate, others = half_turns.consistent(observations, adjusted, free, offsets, turn)
        flipped |= {"all devices": others} if others else {}
        offsets = circle_offsets(observations, estimate, board)
    tolerances = settings.shape.tolerances
    if released:  # the board's shape, first held by wide tolerances, shows its own
        wide = adjust(observations, estimate, free, offsets, board_shape.WIDE, released)
        estimate, tolerances = wide.estimate, _tolerances(wide, settings.shape)
    estimate = adjust(observations, estimate, free, offsets, tolerances, released).estimate
    offsets = circle_offsets(observations, estimate, board)
    model, scores = _models(observations, estimate, offsets, settings)
    free = _free(observations, model)
    bare = replace(estimate, cameras={name: replace(each, distortion=np.zeros(0)) for name, each in estimate.cameras.items()})
    adjusted = adjust(observations, bare, free, offsets, tolerances, released)
    offsets = circle_offsets(observations, adjusted.estimate, board)
    problem = replace(adjusted.problem, offsets=offsets)  # of the next adjustment, by which the evidence is weighed
    if released:
        tolerances = _tolerances(replace(adjusted, problem=problem), settings.shape)
    lenses = _lenses(replace(adjusted, problem=replace(problem, tolerances=tolerances)))
    adjusted = adjust(observations, adjusted.estimate, free, offsets, tolerances, released, lenses)
    agreement = consistency(adjusted)
    if not np.isfinite(agreement.covariance).all():
        raise Undetermined(UNSOLVED)
    halves = compare_halves(adjusted, agreement)
    adjusted = with_covariance(adjusted, agreement.covariance)
    found = [*checks.warnings(observations, adjusted), *filter(None, (agreement.warning, size_warning))]
    dropped |= contradicting
    return Result(
        observations, adjusted, model, scores, dropped, halves, tuple(found), offsets, board, tolerances, released, flipped
    )


def _determine_shape(observations: Observations) -> bool:
    """Whether there are sightings enough to find the board's shape by."""
    points, poses = observations.used.shape[1], np.count_nonzero(observations.used.any(axis=(1, 2)))
    unknowns = 3 * points + 6 * poses + 15 * len(observations.devices)
    return bool(points <= MANY_POINTS and 2 * np.count_nonzero(observations.used) > ENOUGH * unknowns)


def _tolerances(adjusted: Adjustment, shape: Shape) -> Tolerances:
    """Tolerances of the board by the evidence of the sightings."""
    information, pull = board_information(adjusted)
    return board_shape.estimate(information, pull, adjusted.problem.observations.points, shape.tolerances)


def _lenses(adjusted: Adjustment) -> Array:
    """Standard deviations : (g,) by which coefficients of distortion are held to zero, by the evidence of the sightings."""
    lenses, held = adjusted.lenses.copy(), np.isfinite(adjusted.lenses)
    if held.any():
        most = lens_sigmas(replace(adjusted.problem, lenses=None, tightness={}), adjusted.calibration.cameras)
        lenses[held] = usual_lenses.estimate(*lens_information(adjusted), lenses[held], most[held])
    return lenses


def circle_offsets(observations: Observations, estimate: Estimate, board: Board) -> Array:
    """From where devices see the points to where the detection puts them : (p, n, d, 2) px; zero for corners.

    The projector's coordinates were read at the ellipses' centres in camera 1, so they are off by as much, carried over.
    """
    offsets = np.zeros_like(observations.pixels)
    if not isinstance(board, Discs):
        return offsets
    for d, device in enumerate(observations.devices):
        if device != PROJECTOR:
            for p, pose in enumerate(estimate.poses):
                offsets[p, :, d] = centre_offsets(estimate.cameras[device], pose, estimate.points, board.diameter_mm / 2)
    if PROJECTOR in observations.devices[1:]:
        carried = np.einsum("pnij,pnj->pni", observations.gradient, offsets[:, :, 0])
        offsets[:, :, observations.devices.index(PROJECTOR)] = carried
    return offsets


def reprojection_rms(observations: Observations, adjusted: Adjustment) -> dict[str, float]:
    """Root mean square of the points' distances from where they are expected, by device, px; outliers left out."""
    squares = np.sum(np.where(adjusted.outliers[..., None], np.nan, adjusted.residuals) ** 2, axis=-1)
    number = np.isfinite(squares).sum(axis=(0, 1))
    means = np.where(number > 0, np.nansum(squares, axis=(0, 1)) / np.maximum(number, 1), np.nan)
    return dict(zip(observations.devices, np.sqrt(means).tolist(), strict=True))


def compare_halves(adjusted: Adjustment, agreement: Consistency | None = None) -> Array:
    """Calibrate every other pose, and the rest, and compare : (g,) differences over their predicted standard deviation.

    Standard normal if the predicted covariance is honest. What both halves share, as the board's scale and what lenses usually
    are, doesn't show. NaN if a device sees too few poses of a half.

    agreement : of all poses, whose causes of contradictions count in the halves as well
    """
    problem, uncertainty = adjusted.problem, adjusted.calibration.uncertainty
    assert uncertainty is not None
    halves = [np.arange(first, len(adjusted.poses), 2) for first in (0, 1)]
    if min(problem.observations.seen[half].any(axis=1).sum(axis=0).min() for half in halves) < checks.FEWEST_POSES:
        return np.full(len(uncertainty.names), np.nan)
    alone = problem.tolerances if problem.released else None  # of a board as designed the tolerances are common to both halves
    fits, variance = [], np.zeros(len(uncertainty.names))
    for half in halves:
        begin = Estimate(adjusted.calibration.cameras, adjusted.poses[half], adjusted.points)
        seen, offsets = problem.observations.of_poses(half), problem.offsets[half]
        fit = adjust(seen, begin, problem.free, offsets, alone, problem.released, adjusted.lenses)
        assert fit.calibration.uncertainty is not None
        fits.append(fit.calibration)
        variance += np.diag(fit.calibration.uncertainty.covariance)
        if problem.released:
            variance -= scale_errors(fit.problem, fit.estimate) ** 2
        if agreement is not None:
            variance += np.diag(added_covariance(fit, agreement))
    return deviation(*fits) / np.sqrt(variance)


def deviation(first: Calibration, second: Calibration) -> Array:
    """Differences of the second calibration's parameters from the first's : (g,), in the order of the first's uncertainty."""
    assert first.uncertainty is not None
    steps = []
    for device, name in (full.split(".") for full in first.uncertainty.names):
        steps.append(difference(first.cameras[device], second.cameras[device], [name])[0])
    return np.array(steps)


def _free(observations: Observations, model: Mapping[str, ModelName]) -> dict[str, tuple[str, ...]]:
    return free_parameters(observations.devices, {device: MODELS[model[device]] for device in observations.devices})


def _consistent(
    observations: Observations, estimate: Estimate, free: Mapping[str, Sequence[str]], board: Board, name: str, light: str
) -> tuple[Adjustment, Observations, dict[str, str]]:
    """Adjust, and leave out the pose that fits the others worst, until all fit.

    Returns
    -------
    The adjustment, the observations that are left, and what was left out with the reason.
    """
    dropped: dict[str, str] = {}
    contradicted = Counter[str]()  # poses by device
    total = len(observations.poses)
    while True:
        offsets = circle_offsets(observations, estimate, board)
        adjusted = adjust(observations, estimate, free, offsets)
        nothing = ~np.isfinite(adjusted.normalised).any(axis=1, keepdims=True)  # of a pose that a device doesn't see
        misfit = np.nan_to_num(np.nanmedian(np.where(nothing, 0.0, adjusted.normalised), axis=1))  # (p, d)
        worst, device = np.unravel_index(int(np.argmax(misfit)), misfit.shape)
        if misfit[worst, device] < BAD_POSE:
            return adjusted, observations, dropped
        contradicted[observations.devices[device]] += 1
        lengths = np.linalg.norm(adjusted.residuals[worst, :, device], axis=-1)
        dropped[observations.poses[worst]] = (
            f"contradicts the other poses by {np.nanmedian(lengths):.2g} px in {observations.devices[device]}"
        )
        if len(dropped) > initial_estimate.CONTRADICTING * total:
            ((most, _),) = contradicted.most_common(1)
            raise InputError(
                f"{name}: expected poses that fit one rig, found {len(dropped)} of {total} that don't, "
                f"most in {most}: {initial_estimate.causes(most, light)}?"
            )
        rest = np.delete(np.arange(len(observations.poses)), worst)
        observations = observations.of_poses(rest)
        estimate = Estimate(adjusted.calibration.cameras, adjusted.poses[rest], adjusted.points)


def _models(
    observations: Observations, estimate: Estimate, offsets: Array, settings: Settings
) -> tuple[dict[str, ModelName], dict[str, dict[ModelName, float]]]:
    """Each device's distortion model, and the scores it was chosen by."""
    if settings.distortion != "auto":
        return dict.fromkeys(observations.devices, settings.distortion), {}
    chosen = {device: choose(observations, estimate, device, offsets) for device in observations.devices}
    return {device: model for device, (model, _) in chosen.items()}, {device: scores for device, (_, scores) in chosen.items()}


def departure(points: Array, design: Array) -> tuple[float, float]:
    """RMS distance of points : (n, 3) mm from their design, in the plane and out of it, mm, once laid on it."""
    flat, placed = design - design.mean(axis=0), points - points.mean(axis=0)
    left = Rotation.align_vectors(flat, placed)[0].apply(placed) - flat  # laid on it: Kabsch
    return float(np.sqrt(np.mean(np.sum(left[:, :2] ** 2, axis=1)))), float(np.sqrt(np.mean(left[:, 2] ** 2)))
