"""Calibration of a tracked ultrasound probe by one point: the crossing of two wires, seen in many B-scans.

The crossing's place in the world is the same in all frames (equation 1 of Meza et al. 2021):
`world_from_target_i @ target_from_image @ [sx u_i, sy v_i, 0, 1] = wire`, the crossing, unknown and at rest. Unknown are the six
of `target_from_image`, sx, sy and the wire's three. Written with the columns `sx x`, `sy y` and the image's origin it is linear,
which gives a start in closed form; damped least squares do the rest. What may have moved meanwhile is the topic of `movement`.

**Which motion is best.** An error of the tracked angle moves the wire by the lever, here 94 mm, so 0.08 degrees are 0.13 mm: far
more than the errors of position or pixel. Frames are therefore weighted by their covariance, which has this lever in it. Turns
separate the image's place from the wire's: roll the probe about its depth axis as far as the tracking allows, tilt
it 35 degrees to all sides, mostly forward and backward, and bring the crossing near all corners of the image in turn. `motion`
lists such frames. Predicted errors (1 sigma, of the place in space) of 30 frames with 0.08 degrees and 0.05 mm of noise per axis,
for the rig of the paper:

    roll both ways     centre     corners
    180 degrees        0.07       0.09 to 0.10 mm
    90 degrees         0.07       0.09 to 0.11 mm
    35 degrees         0.09       0.10 to 0.12 mm

With the crossing at random places of the image, or with 0.3 mm of slice thickness, the corners are 50 % worse.

**A point that is known**, as a stylus' tip in the frame of its target, needs no turns: its place in the probe's frame then comes
from the poses alone, and the pixels' places from that of the point in three images or more, in closed form.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, fields, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import stats

from recon import arguments
from recon.errors import InputError
from recon.estimation.covariance import inverse, propagate, whitening
from recon.estimation.equations import NormalEquations, Step
from recon.estimation.levenberg_marquardt import USUAL, Rules, descend
from recon.estimation.parameters import Blocks
from recon.geometry import rigid
from recon.model.calibration import Uncertainty
from recon.model.probe import NAMES, ProbeCalibration, place_slopes
from recon.probe_calibration import cross_wire, lateness, movement, probe_checks, wires
from recon.probe_calibration.cross_wire import Appearance, Crossing
from recon.probe_calibration.lateness import Lateness
from recon.probe_calibration.movement import FrameEquations, Movement

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Size = tuple[int, int]  # width, height, px

UNKNOWNS = Blocks({"scale": 2, "probe": 6, "wire": 3, "apart": 1})  # as NAMES; the crossing's place; the wires' distance
SHIFT = slice(5, 8)  # of NAMES
NO_POSE = "the target was not tracked"
MIN_FRAMES = 6
DRAWS = 500  # random sixes of frames; at 30 % outliers 0.7**6 = 12 % of them are clean
REFINED = 5  # of these starts, the best
REFINE = Rules(steps=8, converged=1e-4)  # of these, which need not converge
GATE = 16.27  # squared normalised residual of an outlier; exceeded by 1 of 1000 good frames (chi-square, 3)
DRAWS_TRIED = 50  # of these, where many lags are tried
MEDIAN = 2.366  # of chi-square with 3 degrees of freedom
MAX_FACTOR = 8.0  # measured over assumed noise, of frames of one point at rest
MAX_RMS_MM = 3.0  # of their residuals, for any lever; Meza et al. 2021 have 0.423 in each coordinate
NAMED = 5  # frames, of a refusal
MOST_MOVED_DEG, MOST_MOVED_MM = 20.0, 30.0  # of a movement that a calibration allows for: beyond, it is something else
MIN_INLIERS = 0.5  # of the frames
REACH = (0.43, 0.40)  # of the crossing from the middle, of the image's width and height: spots stay whole and clear of the face
ROCK = 0.6  # greatest part of a tilt about the image's normal, by which wires are seen edge-on
FLOOR_MM = 1e-3  # no sighting counts as more exact than this
APART_MM = 1.0  # 1 sigma of the distance of wires that cross, before it is measured
FREE = np.full(3, np.inf)  # standard deviations of a point of which nothing is known beforehand


@dataclass(frozen=True)
class Noise:
    """Standard deviations, per axis, for sightings without a covariance of their own."""

    angle_deg: float = 0.08  # of the target's pose
    position_mm: float = 0.05  # of the target's pose
    pixel_px: float = 0.5  # of the crossing in the B-scan
    slice_mm: float = 0.2  # of the crossing across the image plane: the slice is thick, so the crossing shines from beside it

    @property
    def of_pose(self) -> Array:
        """Covariance : (6, 6) of a pose, rad and mm."""
        return np.diag([np.radians(self.angle_deg) ** 2] * 3 + [self.position_mm**2] * 3)

    def from_body(self, poses: Array) -> Array:
        """Covariance : (n, 6, 6) of poses : (n, 4, 4) in the frame of a body that is tracked with the same noise."""
        by_body = np.tile(-np.eye(6), (len(poses), 1, 1))
        by_body[:, 3:, :3] = rigid.cross(poses[:, :3, 3])
        return self.of_pose + propagate(by_body, self.of_pose)


@dataclass(frozen=True)
class Sightings:
    """The crossing in n frames."""

    poses: Array  # (n, 4, 4) world_from_target, mm
    pixels: Array  # (n, 2) px
    pose_covariance: Array | None = None  # (n, 6, 6) as in recon.model.tracks: a turn (rad) after the pose's own, a shift (mm)
    pixel_covariance: Array | None = None  # (n, 2, 2) px^2
    slice_mm: Array | None = None  # (n,) standard deviation across the image plane
    directions: Array | None = None  # (n, 2, 2) px, along the wires' lines; NaN for a spot
    pose_by_lag: Array | None = None  # (n, 4, 4) change of the poses by one standard deviation of the B-scans' lag
    pose_rates: Array | None = None  # (n, 4, 4) change of the poses a second, by which a lag of the B-scans moves them back
    beside: Array | None = None  # (n, 2) px a mm: shift of the lines' meeting point by the wires' distance; set by `calibrate`

    def of(self, chosen: ArrayLike) -> "Sightings":
        """Those of some frames, by number or mask."""
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        return Sightings(**{name: None if value is None else value[chosen] for name, value in values.items()})


@dataclass(frozen=True)
class Adjustment:
    """Adjusted values, their uncertainty, and the residuals."""

    calibration: ProbeCalibration
    wire: Array  # (3,) mm, in the world
    residuals: Array  # (n, 3) mm, in the world: the pixel's place less the wire
    normalised: Array  # (n,) length of the residual over its standard deviation; sqrt(3) for a typical frame
    outliers: Mask  # (n,)
    noise_factor: float  # measured noise over the assumed; the covariance is scaled by its square
    apart_mm: float = 0.0  # between the wires' axes, where they were seen as lines
    moved: Movement | None = None  # what moved while the frames were taken; the values are those of the middle
    by_lag: Array | None = None  # (8,) change of the calibration by one standard deviation of the lag, if the lag has one
    wire_covariance: Array | None = None  # (3, 3) mm^2, of the wire; None without an adjustment
    late: Lateness | None = None  # of the B-scans, beyond the lag of the poses; None without times
    persistence: float = 1.0  # frames that count as one in the covariance, as residuals of neighbours are alike

    @property
    def rms_mm(self) -> float:
        """Root mean square distance from the wire, outliers left out: sqrt(3) times the equation's RMS of Meza et al. 2021, whose
        program takes the three coordinates' mean square.
        """
        return float(np.sqrt((self.residuals[~self.outliers] ** 2).sum(axis=1).mean()))

    @property
    def noise_mm(self) -> float:
        """The same with the frames counted less a third of the unknowns: an estimate of the distance by noise alone."""
        return _noise_mm(self.residuals[~self.outliers], UNKNOWNS["wire"].stop + (self.apart_mm > 0))

    @property
    def distances_mm(self) -> Array:
        """Distances : (n,) from the wire."""
        return np.linalg.norm(self.residuals, axis=1)


@dataclass(frozen=True)
class _Estimate:
    target_from_image: Array  # (4, 4)
    scale: Array  # (2,)
    wire: Array  # (3,)
    apart: float = 0.0  # mm, of the wires
    wire_sigma: Array = field(default_factory=lambda: FREE)  # (3,) mm, of the wire about the origin beforehand
    level: float = 1.0  # of the noise over the assumed, beside which what is known counts

    @property
    def known(self) -> Array:
        """Information : (12,) on UNKNOWNS beforehand."""
        return np.concatenate([np.zeros(UNKNOWNS["wire"].start), (self.level / self.wire_sigma) ** 2, [APART_MM**-2]])

    @property
    def departures(self) -> Array:
        """UNKNOWNS : (12,) less what they are expected to be, where that is known."""
        return np.concatenate([np.zeros(UNKNOWNS["wire"].start), self.wire, [self.apart]])

    def moved(self, step: Step) -> "_Estimate":
        """After a step of UNKNOWNS."""
        scale, probe, wire, apart = UNKNOWNS.split(step.shared)
        pose = rigid.moved(self.target_from_image, probe)
        moved = {"target_from_image": pose, "scale": self.scale + scale, "wire": self.wire + wire}
        return replace(self, **moved, apart=self.apart + float(apart[0]))

    def pixels(self, sightings: Sightings) -> Array:
        """Pixels : (n, 2) of the midpoint between the wires."""
        return sightings.pixels if sightings.beside is None else sightings.pixels - self.apart * sightings.beside

    def points(self, sightings: Sightings) -> Array:
        """Places : (n, 3) mm of these pixels in the target's frame."""
        return (self.pixels(sightings) * self.scale) @ self.target_from_image[:3, :2].T + self.target_from_image[:3, 3]

    def arms(self, sightings: Sightings) -> Array:
        """Vectors : (n, 3) mm, along the world's axes, from the target's origin to the places of these pixels."""
        return np.einsum("nij,nj->ni", sightings.poses[:, :3, :3], self.points(sightings))


def calibrate(
    sightings: Sightings,
    size: Size,
    noise: Noise | None = None,
    expected: Array | None = None,
    seed: int = 0,
    ahead_mm: float = 0.0,
    ahead_sigma_mm: float = 0.0,
    max_sigma_mm: float = probe_checks.MAX_SIGMA_MM,
    numbers: NDArray[np.int64] | None = None,
    point_sigma_mm: Array | None = None,
) -> Adjustment:
    """Calibrate a probe from poses and pixels of one point at rest: of two wires, the midpoint between their axes.

    Seen as two lines, the wires meet beside that point, one being above the other. With lines in six frames or more, these are
    assigned to the wires, and the distance of the axes is adjusted with the rest.

    Parameters
    ----------
    size : (width, height) px
        Of the B-scans.
    noise : Noise
        For sightings without a covariance. Only its proportions matter: the level is measured.
    expected : (4, 4)
        `target_from_image` as designed, to within some 30 degrees and 30 mm. A mirrored image, or swapped axes of image or
        target, fit as well as the truth; beside their design they are refused, while any other bracket is taken.
    seed : int
        Of the random draws of frames for the robust start.
    ahead_mm : float
        Distance of the echo before the wires' axes: see `recon.probe_calibration.wires.echo_ahead`.
    ahead_sigma_mm : float
        Its standard deviation, common to all frames.
    max_sigma_mm : float
        Standard deviation of a pixel's place beyond which the outcome is refused.
    numbers : (n,)
        Of the frames, for messages; from 0 on without them.
    point_sigma_mm : (3,)
        Standard deviations of the point about the origin of the poses' frame, along its axes; None for an unknown one. With it
        the probe needs no turns.

    Raises
    ------
    InputError
        If there are too few frames, the poses or pixels are none, the motion leaves something undetermined, most frames
        contradict each other, or the outcome is impossible for a probe.
    """
    arguments.of_kind("sightings", sightings, Sightings)
    noise = noise or Noise()
    sightings = _checked(sightings, size)
    _check_motion(sightings, size, point_sigma_mm)
    start = _robust_start(sightings, noise, np.random.default_rng(seed), point_sigma_mm)
    estimate, inliers, factor = _without_outliers(start, sightings, noise)
    sightings = _with_wires(estimate, sightings, inliers)
    if sightings.beside is not None:
        estimate, inliers, factor = _without_outliers(estimate, sightings, noise)
    counted = inliers if inliers.any() else ~inliers
    rms = float(np.sqrt((_residuals(estimate, sightings.of(counted)) ** 2).sum(axis=1).mean()))
    if factor > MAX_FACTOR or rms > MAX_RMS_MM or inliers.mean() < MIN_INLIERS:
        _refuse(rms, factor, inliers, _farthest(estimate, sightings, numbers))
    slopes, left = _whitened(estimate, sightings, noise)
    used = UNKNOWNS["wire"].stop if sightings.beside is None else len(UNKNOWNS)
    equations = FrameEquations(slopes[..., :used], left, UNKNOWNS["probe"], UNKNOWNS["wire"], estimate.known[:used])
    moved = movement.find(equations, inliers)
    if moved is not None and (moved.turn_deg > MOST_MOVED_DEG or moved.shift_mm > MOST_MOVED_MM):
        least = f"more than {MOST_MOVED_DEG:g} deg or {MOST_MOVED_MM:g} mm"
        raise probe_checks.Misread(
            f"sightings: expected frames of one point at rest, found some that a movement by {least} parts"
        )
    solved, inliers = inliers, inliers if moved is None else moved.frames
    alike = movement.alike(slopes[inliers][..., :used], left[inliers], equations.known) if moved is None else moved.alike
    step, covariance = movement.average(equations, solved, inliers, factor, alike)
    estimate = estimate.moved(Step(np.pad(step, (0, len(UNKNOWNS) - used)), np.zeros((0, 0))))
    _check_motion(sightings.of(inliers), size, point_sigma_mm)
    of_wire, covariance = covariance[UNKNOWNS["wire"], UNKNOWNS["wire"]], covariance[: len(NAMES), : len(NAMES)].copy()
    by_lag = None if sightings.pose_by_lag is None else _by_lag(estimate, sightings, noise, inliers)
    late = None if sightings.pose_rates is None else _lateness(estimate, sightings.of(inliers), noise, factor)
    if by_lag is not None:
        covariance += np.outer(by_lag, by_lag)
    try:
        place = estimate.target_from_image, estimate.scale
        probe_checks.certainty(*place, covariance, sightings.of(inliers), size, max_sigma_mm)
    except InputError as error:
        unsure = "" if sightings.pose_by_lag is None else "; the uncertainty of the lag is in it: hold still, or measure the lag"
        also = f"; {late.described}" if late is not None and late.shown else unsure
        if moved is not None:  # what moves by much may be something else
            found = f"sightings: expected frames of one point at rest, found that {moved.described}"
            raise probe_checks.Misread(f"{found} ({error})", how="moved") from None
        raise InputError(f"{error}{also}") from None
    covariance[SHIFT, SHIFT] += ahead_sigma_mm**2 * np.outer(*2 * (estimate.target_from_image[:3, 1],))
    uncertainty = Uncertainty(NAMES, (covariance + covariance.T) / 2)
    ahead = rigid.transform(np.eye(3), [0, -ahead_mm, 0])
    calibration = ProbeCalibration(estimate.target_from_image @ ahead, estimate.scale, uncertainty)
    probe_checks.outcome(calibration, size, expected)
    chi = np.sqrt(_squared(estimate, sightings, noise)) / factor
    left = _residuals(estimate, sightings)
    apart = abs(estimate.apart)
    return Adjustment(calibration, estimate.wire, left, chi, ~inliers, factor, apart, moved, by_lag, of_wire, late, alike)


def misfit(sightings: Sightings, noise: Noise) -> float:
    """Mean square distance, mm^2, of the point from one place, of which each counts up to MAX_RMS_MM; infinite for few frames.

    All count so by scales that no scanner has: poses that hardly move fit an image that is a point.
    """
    if len(sightings.pixels) < MIN_FRAMES:
        return np.inf
    start = _robust_start(sightings, noise, np.random.default_rng(0), None, DRAWS_TRIED, refined=1)
    if not probe_checks.plausible(start.scale):
        return MAX_RMS_MM**2
    return float(np.minimum((_residuals(start, sightings) ** 2).sum(axis=1), MAX_RMS_MM**2).mean())


def held_out_mm(
    sightings: Sightings, found: Adjustment, probe: ProbeCalibration, noise: Noise | None = None, ahead_mm: float = 0.0
) -> float:
    """Distance, mm, of the crossing from one place by a calibration that these frames had no part in: root mean square.

    The crossing's place is unknown, so that and the wires' distance are adjusted, and no more. A probe that was turned to all
    sides shows an error of the calibration as scatter. `Adjustment.noise_mm` remains without such an error.

    Parameters
    ----------
    sightings, found : of the frames, and what was adjusted to them; its outliers are left out
    probe : for sound in the tank of the frames
    noise, ahead_mm : as of `calibrate`
    """
    noise = noise or Noise()
    behind = rigid.transform(np.eye(3), [0, ahead_mm, 0])
    start = _Estimate(probe.target_from_image @ behind, probe.scale, found.wire)
    seen = _with_wires(start, sightings, ~found.outliers) if found.apart_mm else sightings
    seen = seen.of(~found.outliers)
    slopes, left = _whitened(start, seen, noise)
    free = np.arange(UNKNOWNS["wire"].start, len(UNKNOWNS) if seen.beside is not None else UNKNOWNS["wire"].stop)
    information = np.einsum("nij,nik->jk", slopes, slopes) + np.diag(start.known)
    step = np.zeros(len(UNKNOWNS))
    step[free] = -np.linalg.solve(information[np.ix_(free, free)], np.einsum("nij,ni->j", slopes, left)[free])
    estimate = start.moved(Step(step, np.zeros((0, 0))))
    return _noise_mm(_residuals(estimate, seen), len(free))


def _noise_mm(residuals: Array, unknowns: int) -> float:
    """Root mean square length of residuals : (n, 3) mm, with as many unknowns less."""
    return float(np.sqrt((residuals**2).sum() / (len(residuals) - unknowns / 3)))


def from_images(
    images: Iterable[NDArray], poses: Array, appearance: Appearance | None = None
) -> tuple[Sightings, list[Crossing]]:
    """Find the crossing in B-scans : n of (h, w), tracked at poses : (n, 4, 4), NaN where the target wasn't found.

    Returns
    -------
    Sightings
        Of the m frames that have both a pose and a crossing.
    list of n
        Of all frames: the crossing, or the reason why the frame was rejected.
    """
    tracked = np.isfinite(poses).all(axis=(1, 2))
    found = [cross_wire.find(image, appearance) for image in images]
    found = [each if known else replace(each, reason=each.reason or NO_POSE) for each, known in zip(found, tracked, strict=True)]
    good = [k for k, each in enumerate(found) if each.found]
    return of_crossings([found[k] for k in good], poses[good]), found


def of_crossings(crossings: Sequence[Crossing], poses: Array) -> Sightings:
    """The crossing in n frames, found in each, at poses : (n, 4, 4)."""
    pixels = np.array([each.pixel for each in crossings]).reshape(-1, 2)
    covariance = np.array([each.covariance for each in crossings]).reshape(-1, 2, 2)
    unseen = np.full((2, 2), np.nan)
    lines = np.array([unseen if each.directions is None else each.directions for each in crossings]).reshape(-1, 2, 2)
    return Sightings(poses, pixels, pixel_covariance=covariance, directions=lines)


def joined(some: Sequence[Sightings]) -> Sightings:
    """Several sightings as one; what one of them lacks, all do."""
    values = {field.name: [getattr(one, field.name) for one in some] for field in fields(Sightings)}
    whole = {name: None if any(one is None for one in each) else np.concatenate(each) for name, each in values.items()}
    return Sightings(**whole)


def closed_form(poses: Array, pixels: Array) -> tuple[Array, Array, Array]:
    """Least squares without iteration, all frames alike, for any number of sets of frames at once.

    `R_i (u_i a + v_i b + t) + t_i = wire` is linear in a = sx x, b = sy y, t and the wire. The lengths of a and b are the scales;
    the rotation is the one nearest to their directions.

    Parameters
    ----------
    poses, pixels : (..., n, 4, 4) and (..., n, 2)
        n >= 4.

    Returns
    -------
    target_from_image, scale, wire : (..., 4, 4), (..., 2), (..., 3)
    """
    turns, shifts = poses[..., :3, :3], poses[..., :3, 3]
    u, v = pixels[..., 0, None, None], pixels[..., 1, None, None]
    fixed = np.broadcast_to(-np.eye(3), turns.shape)
    design = np.concatenate([u / 100 * turns, v / 100 * turns, turns / 100, fixed / 100], axis=-1)  # columns of like length
    rows = (*pixels.shape[:-2], -1)
    solution = -(np.linalg.pinv(design.reshape(*rows, 12)) @ shifts.reshape(*rows, 1))[..., 0] / 100
    pose, scale = _pose_of(np.stack([solution[..., :3], solution[..., 3:6]], axis=-1), solution[..., 6:9])
    return pose, scale, solution[..., 9:]


def closed_form_of_known(poses: Array, pixels: Array) -> tuple[Array, Array, Array]:
    """The same as `closed_form` of a point at the origin of the poses' frame, for n >= 3.

    Its places in the target's frame are linear in the pixels: `u a + v b + t = -R_i^T t_i`.
    """
    places = -np.einsum("...ji,...j->...i", poses[..., :3, :3], poses[..., :3, 3])
    design = np.concatenate([pixels / 100, np.ones_like(pixels[..., :1])], axis=-1)
    solution = np.linalg.pinv(design) @ places
    pose, scale = _pose_of(np.swapaxes(solution[..., :2, :], -1, -2) / 100, solution[..., 2, :])
    return pose, scale, np.zeros((*places.shape[:-2], 3))


def _pose_of(columns: Array, origin: Array) -> tuple[Array, Array]:
    """Poses : (..., 4, 4) and scales : (..., 2) nearest to the steps : (..., 3, 2) mm of a pixel along both axes of the image."""
    scale = np.linalg.norm(columns, axis=-2)
    left, _, right = np.linalg.svd(columns / np.maximum(scale, 1e-12)[..., None, :], full_matrices=False)
    axes = left @ right
    result = np.zeros((*origin.shape[:-1], 4, 4))
    result[..., :3, :2], result[..., :3, 2] = axes, np.cross(axes[..., 0], axes[..., 1])
    result[..., :3, 3], result[..., 3, 3] = origin, 1
    return result, scale


def point_covariance(calibration: ProbeCalibration, pixels: ArrayLike) -> Array:
    """Covariance : (k, 3, 3) mm^2, in the target's frame, of the places of pixels : (k, 2); zero if the calibration has none."""
    pixels = np.asarray(pixels, float)
    if calibration.uncertainty is None:
        return np.zeros((len(pixels), 3, 3))
    order = [NAMES.index(name) for name in calibration.uncertainty.names]
    slopes = place_slopes(calibration.target_from_image, calibration.scale, pixels)[..., order]
    return propagate(slopes, calibration.uncertainty.covariance)


def motion(size: Size, count: int = 30, tilt_deg: float = 35.0, roll_deg: float = 180.0) -> tuple[Array, Array]:
    """Frames of a good calibration: attitudes of the probe, and places of the crossing in the image.

    Returns
    -------
    turns : (count, 3) deg
        Tilt about the array's axis x, roll about the depth axis y and tilt about the normal z, done in the order y, x, z in
        axes that go with the image. Tilts are `tilt_deg` to all sides, but mostly forward and backward: rocked in its own plane
        only, the probe shows both wires on one line. Rolls are up to `roll_deg` both ways.
    pixels : (count, 2) px
        Near the four corners, each round in another order: they tell the scales and the image's attitude best.
    """
    steps = np.arange(count)
    phase = 2 * np.pi * np.sqrt(2) * steps  # irrational, as the roll's: no two frames are alike, and no two angles go together
    roll = roll_deg * (2 * ((steps * (np.sqrt(5) - 1) / 2) % 1) - 1)
    rock = ROCK * np.sin(phase)
    turns = np.column_stack([tilt_deg * np.sign(np.cos(phase)) * np.sqrt(1 - rock**2), roll, tilt_deg * rock])
    corners = np.array([[-1, -1], [1, 1], [1, -1], [-1, 1]])
    return turns, (np.array(size) - 1) / 2 + np.array(size) * REACH * corners[(steps + steps // 4) % 4]


def _checked(sightings: Sightings, size: Size) -> Sightings:
    """As float arrays, or refused."""
    given = probe_checks.arrays(sightings)
    poses, pixels = given["poses"], given["pixels"]
    if len(poses) < MIN_FRAMES:
        raise InputError(f"sightings: expected at least {MIN_FRAMES} frames with a pose and a crossing, found {len(poses)}")
    probe_checks.poses(poses)
    probe_checks.pixels(pixels, size)
    return Sightings(**given)


def _check_motion(sightings: Sightings, size: Size, point_sigma_mm: Array | None) -> None:
    """Refuse a motion that leaves unknowns undetermined at any noise."""
    if point_sigma_mm is None:
        probe_checks.motion(sightings.poses, sightings.pixels, size)
    else:
        probe_checks.places(sightings.pixels, size)


def _with_wires(estimate: _Estimate, sightings: Sightings, inliers: Mask) -> Sightings:
    """Add the shifts of the lines' meeting points by the wires' distance, if both wires can be separated."""
    if sightings.directions is None:
        return sightings
    lines = np.isfinite(sightings.directions).all(axis=(1, 2))
    turns, chosen = sightings.poses[:, :3, :3] @ estimate.target_from_image[:3, :3], lines & inliers
    found = wires.directions_of(wires.planes(turns[chosen], estimate.scale, sightings.directions[chosen]))
    if found is None:
        return sightings
    return replace(sightings, beside=np.where(lines[:, None], wires.beside(turns, estimate.scale, found), 0))


def _residuals(estimate: _Estimate, sightings: Sightings) -> Array:
    return estimate.arms(sightings) + sightings.poses[:, :3, 3] - estimate.wire


def _covariances(estimate: _Estimate, sightings: Sightings, noise: Noise) -> Array:
    """Of the residuals : (n, 3, 3) mm^2: the pose's, with its lever, and in the image's axes the crossing's."""
    n = len(sightings.pixels)
    local = np.broadcast_to(FLOOR_MM**2 * np.eye(3), (n, 3, 3)).copy()
    pixel = np.eye(2) * noise.pixel_px**2 if sightings.pixel_covariance is None else sightings.pixel_covariance
    local[:, :2, :2] += pixel * np.outer(estimate.scale, estimate.scale)
    local[:, 2, 2] += (noise.slice_mm if sightings.slice_mm is None else sightings.slice_mm) ** 2
    world_from_image = sightings.poses[:, :3, :3] @ estimate.target_from_image[:3, :3]
    return _of_poses(estimate, sightings, noise) + propagate(world_from_image, local)


def _of_poses(estimate: _Estimate, sightings: Sightings, noise: Noise) -> Array:
    """The poses' part of these covariances : (n, 3, 3) mm^2."""
    pose = noise.of_pose if sightings.pose_covariance is None else sightings.pose_covariance
    return propagate(rigid.slopes(estimate.arms(sightings)), pose)


def _squared(estimate: _Estimate, sightings: Sightings, noise: Noise) -> Array:
    """Squared normalised residuals : (n,), chi-square with 3 degrees of freedom."""
    residuals = _residuals(estimate, sightings)
    return np.einsum(
        "ni,ni->n", residuals, np.linalg.solve(_covariances(estimate, sightings, noise), residuals[..., None])[..., 0]
    )


def _whitened(estimate: _Estimate, sightings: Sightings, noise: Noise) -> tuple[Array, Array]:
    """Slopes : (n, 3, 12) of the residuals and these : (n, 3), in standard deviations."""
    turns = sightings.poses[:, :3, :3]
    both = np.zeros((len(turns), 3, len(UNKNOWNS) + 1))  # slopes, and the residuals as last column
    both[..., : len(NAMES)] = turns @ place_slopes(estimate.target_from_image, estimate.scale, estimate.pixels(sightings))
    both[..., UNKNOWNS["wire"]] = -np.eye(3)
    if sightings.beside is not None:
        beside = sightings.beside * estimate.scale
        both[..., -2] = -np.einsum("nij,nj->ni", turns, beside @ estimate.target_from_image[:3, :2].T)
    both[..., -1] = _residuals(estimate, sightings)
    both = whitening(_covariances(estimate, sightings, noise)) @ both
    return both[..., :-1], both[..., -1]


def _normal_equations(estimate: _Estimate, sightings: Sightings, noise: Noise, weights: Array) -> tuple[NormalEquations, float]:
    """Normal equations and cost, with the covariances as they are at the estimate; no frame has unknowns of its own."""
    slopes, residuals = _whitened(estimate, sightings, noise)
    root = np.sqrt(weights)[:, None]
    left, known, departures = -root * residuals, estimate.known, estimate.departures
    equations = NormalEquations.of_rows(root[..., None] * slopes, np.zeros((*left.shape, 0)), left)
    return equations.held(np.diag(known), departures), float(np.sum(left**2) + known @ departures**2)


def _fit(start: _Estimate, sightings: Sightings, noise: Noise, weights: Array | float = 1.0, rules: Rules = USUAL) -> _Estimate:
    """Weighted least squares."""
    weights = np.broadcast_to(weights, len(sightings.pixels))

    def linearise(estimate: _Estimate) -> tuple[NormalEquations, float]:
        return _normal_equations(estimate, sightings, noise, weights)

    return descend(start, linearise, _Estimate.moved, rules=rules).estimate


def _robust_start(
    sightings: Sightings,
    noise: Noise,
    rng: np.random.Generator,
    point_sigma_mm: Array | None = None,
    count: int = DRAWS,
    refined: int = REFINED,
) -> _Estimate:
    """Least median of squares over closed forms: of all frames, and of random sixes. The best few are refined first."""
    n = len(sightings.pixels)
    draws = np.argsort(rng.random((count, n)), axis=1)[:, :MIN_FRAMES]
    solve, sigma = (closed_form, FREE) if point_sigma_mm is None else (closed_form_of_known, point_sigma_mm)
    whole = [each[None] for each in solve(sightings.poses, sightings.pixels)]
    drawn = solve(sightings.poses[draws], sightings.pixels[draws])
    starts = [np.concatenate(pair) for pair in zip(whole, drawn, strict=True)]
    order = np.argsort(_medians(starts, sightings))[:refined]
    best = [_refined_on_half(_Estimate(*(each[k] for each in starts), wire_sigma=sigma), sightings, noise) for k in order]
    return min(best, key=lambda estimate: np.median(_squared(estimate, sightings, noise)))


def _medians(starts: list[Array], sightings: Sightings) -> Array:
    """Medians : (k,) mm^2 of the squared residuals of k starts: poses (k, 4, 4), scales (k, 2), wires (k, 3)."""
    target_from_image, scale, wire = starts
    plane = sightings.pixels * scale[:, None]
    points = plane @ np.swapaxes(target_from_image[:, :3, :2], 1, 2) + target_from_image[:, None, :3, 3]
    arms = np.einsum("nij,knj->kni", sightings.poses[:, :3, :3], points)
    return np.median(((arms + sightings.poses[:, :3, 3] - wire[:, None]) ** 2).sum(axis=-1), axis=1)


def _refined_on_half(start: _Estimate, sightings: Sightings, noise: Noise) -> _Estimate:
    """After two rounds of least squares on the better half of the frames, or on nine where that is fewer."""
    keep = max(len(sightings.pixels) // 2 + 1, min(9, len(sightings.pixels)))
    for _ in range(2):
        chosen = np.argsort((_residuals(start, sightings) ** 2).sum(axis=1))[:keep]
        start = _fit(start, sightings.of(chosen), noise, rules=REFINE)
    return start


def _without_outliers(start: _Estimate, sightings: Sightings, noise: Noise) -> tuple[_Estimate, Mask, float]:
    """Biweight least squares, then plain least squares on those within the gate, until these are the same ones again."""
    estimate = start
    for _ in range(5):
        squared = _squared(estimate, sightings, noise)
        scale = max(np.median(squared) / MEDIAN, 1e-12)
        weights = np.maximum(1 - squared / (2 * GATE * scale), 0) ** 2
        estimate = _fit(replace(estimate, level=float(np.sqrt(scale))), sightings, noise, weights)
    inliers = np.zeros(len(sightings.pixels), bool)
    factor, gate = np.sqrt(scale), GATE
    for _ in range(20):
        inside = _squared_as_predicted(estimate, sightings, noise, inliers) <= gate * factor**2
        if inside.sum() < MIN_FRAMES or (inside == inliers).all():
            break
        inliers = inside
        estimate = _fit(replace(estimate, level=float(factor)), sightings.of(inliers), noise)
        freedom = 3 * inliers.sum() - 11 - (sightings.beside is not None)
        factor = np.sqrt(max(_squared(estimate, sightings.of(inliers), noise).sum() / freedom, 1e-12))
        gate = 3 * stats.f.isf(stats.chi2.sf(GATE, 3), 3, freedom)  # GATE of a level that is itself measured by these frames
    return estimate, inliers, float(factor)


def _motions(estimate: _Estimate, sightings: Sightings, moved: Array) -> Array:
    """Shifts : (n, 3) mm of the places by changes : (n, 4, 4) of the poses."""
    return np.einsum("nij,nj->ni", moved[:, :3, :3], estimate.points(sightings)) + moved[:, :3, 3]


def _lateness(estimate: _Estimate, sightings: Sightings, noise: Noise, factor: float) -> Lateness:
    """Lag of the B-scans that the residuals of frames that aren't outliers show; a factor of noise over the assumed."""
    assert sightings.pose_rates is not None
    slopes, left = (each / factor for each in _whitened(estimate, sightings, noise))
    whiten = whitening(_covariances(estimate, sightings, noise))
    motion = (whiten @ _motions(estimate, sightings, sightings.pose_rates)[..., None])[..., 0] / factor
    by_poses = float(np.trace(propagate(whiten, _of_poses(estimate, sightings, noise)), axis1=1, axis2=2).sum())
    counted = np.full(len(left), left.shape[1])
    return lateness.of_residuals(-motion, left, slopes, estimate.known / factor**2, counted, factor, by_poses)


def _by_lag(estimate: _Estimate, sightings: Sightings, noise: Noise, used: Mask) -> Array:
    """Change of the calibration : (8,) by one standard deviation of the lag, which moves all poses along their motions."""
    assert sightings.pose_by_lag is not None
    moved = sightings.pose_by_lag[used]
    there = sightings.of(used)
    slopes = _whitened(estimate, there, noise)[0]
    left = whitening(_covariances(estimate, there, noise)) @ _motions(estimate, there, moved)[..., None]
    information = np.einsum("nij,nik->jk", slopes, slopes) + np.diag(estimate.known)
    return -np.linalg.solve(information, np.einsum("nij,nik->j", slopes, left))[: len(NAMES)]


def _squared_as_predicted(estimate: _Estimate, sightings: Sightings, noise: Noise, used: Mask) -> Array:
    """Squared normalised residuals : (n,), of frames that weren't used by the uncertainty of the estimate too.

    Without it, six frames that twelve unknowns fit well would make outliers of all others, good ones too.
    What the used frames leave open varies widely: frames that it explains are no outliers, and may be those that determine it.
    """
    slopes, residuals = _whitened(estimate, sightings, noise)
    covariance = np.broadcast_to(np.eye(3), (len(slopes), 3, 3)).copy()
    if used.any():
        equations, _ = _normal_equations(estimate, sightings.of(used), noise, np.ones(used.sum()))
        covariance[~used] += propagate(slopes[~used], inverse(equations.shared))
    return np.einsum("ni,ni->n", residuals, np.linalg.solve(covariance, residuals[..., None])[..., 0])


def _farthest(estimate: _Estimate, sightings: Sightings, numbers: NDArray[np.int64] | None) -> str:
    """The frames whose sightings lie farthest from the others', in words."""
    away = np.linalg.norm(_residuals(estimate, sightings), axis=1)
    names = np.arange(len(away)) if numbers is None else numbers
    return "farthest off: " + ", ".join(f"frame {names[k]} by {away[k]:.2g} mm" for k in np.argsort(-away)[:NAMED])


def _refuse(rms: float, factor: float, inliers: Mask, farthest: str) -> None:
    """Refuse frames that don't show one point at rest."""
    few = f"only {inliers.sum()} of {len(inliers)} that agree"
    found = few if inliers.mean() < MIN_INLIERS else f"residuals of {rms:.1f} mm (rms), {factor:.1f} times the assumed noise"
    raise probe_checks.Misread(f"sightings: expected frames of one point at rest, found {found}; {farthest}")
