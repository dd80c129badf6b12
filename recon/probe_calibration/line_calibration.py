"""Calibration of a tracked ultrasound probe by the dots of N-wires, whose places in their phantom are known.

Each dot lies on its wire: with the phantom at rest, the place of its pixel,
`phantom_from_world @ world_from_target_i @ target_from_image @ [sx u, sy v, 0, 1]`, is on a known line, which makes two equations
a dot, in the plane across the wire. Unknown are the six of `target_from_image`, sx, sy and the six of the phantom's pose, which a
motion about two axes determines as well; a registration by a stylus can hold it. Holes of printed phantoms lie to some 0.1 mm, so
each wire may lie beside its place by as much: two more unknowns a wire, with that as their standard deviation.

The middle dots are places in the phantom by themselves (see `recon.model.wire_phantom`), so the start is linear: twelve unknowns
of the phantom's pose and nine of the image's. Least median of squares over random frames stands wrong dots.

All dots of a frame share the error of its pose, so a frame's equations are weighted by their full covariance. Of a frame single
dots can be outliers. Where residuals of neighbouring frames are alike, as in the distorted field of a magnetic tracker, frames
count as fewer.

Further unknowns, each with its own columns beside those of the adjustment, show mistakes: another size of the phantom, a lag of
the B-scans, a movement of the probe against its target or of the phantom, evenly or all at once (see `movement`).
"""

from collections.abc import Iterator
from dataclasses import dataclass, fields, replace
from itertools import product
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc, fdtrc

from recon.errors import InputError
from recon.estimation.covariance import inverse, propagate, whitening
from recon.estimation.equations import NormalEquations, Step
from recon.estimation.levenberg_marquardt import USUAL, Rules, descend
from recon.estimation.parameters import Blocks
from recon.estimation.persistence import persistence
from recon.geometry import rigid
from recon.model.calibration import Uncertainty
from recon.model.probe import NAMES, ProbeCalibration, place_slopes
from recon.model.wire_phantom import WirePhantom
from recon.probe_calibration import lateness, movement, probe_checks, wire_dots
from recon.probe_calibration.lateness import SURE, Lateness
from recon.probe_calibration.movement import LEAST_FRAMES, LEAST_FREEDOM, PROBE, WIRES, Movement
from recon.probe_calibration.point_calibration import MAX_FACTOR, MAX_RMS_MM, MIN_INLIERS, NAMED, SHIFT, Noise

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Size = tuple[int, int]  # width, height, px

MIN_FRAMES = 8  # also of a random start: eighteen unknowns, by three numbers a frame where there is one N-wire
DRAWS = 100  # random frames; at 20 % outliers 0.8**8 = 17 % of them are clean
REFINED = 3  # of these starts, the best
REFINE = Rules(steps=8, converged=1e-4)  # of these, which need not converge
ROUNDS = 20
ARM_MM = 50.0  # of a registration: its standard deviation over this is that of its turns, as landmarks lie apart
GATE = 13.8  # squared normalised residual of an outlier; exceeded by 1 of 1000 good dots (chi-square, 2)
MEDIAN = 1.386  # of chi-square with 2 degrees of freedom
SETTLED, LEAST_LEVEL = 0.01, 1e-3  # relative change of the noise that ends the rounds, and least noise over the assumed
FLOOR_MM = 1e-3  # no dot counts as more exact than this
LEAST_SHOWN = 1e-9  # of what a further unknown changes, that no other explains: less is rounding
HELD = 1e15  # information on unknowns that stay
FAR_MM = 1e3  # 1 sigma of dots that are left out
NEIGHBOURS = 4.0  # that count as one, from which on it is told
ALIKE = 1.5  # squared residuals of arrangements beside the best, of which the registration chooses
CHANCE = float(chdtrc(1, SURE**2))  # of as much by noise: of a movement
SAME_SIZE = 0.005  # of a phantom, and its definition
MAX_SIZE = 0.03  # beyond which it is another phantom
MOST_COURSES = 40  # of a sudden movement, evenly over the frames
LARGE = np.array([*np.radians(np.full(3, 5.0)), *np.full(3, 5.0)])  # rad and mm, 1 sigma of half a movement beforehand
MOST_ASTRAY = 1  # wires of which most dots lie elsewhere
DRAWS_TRIED = 20  # random starts, of a quick look
FLAT_MM = 1.0  # depth of all rows, below which there is but one


@dataclass(frozen=True)
class DotSightings:
    """The dots of k wires in n frames, in up to a arrangements; NaN where a frame has fewer."""

    poses: Array  # (n, 4, 4) world_from_target, mm
    pixels: Array  # (n, a, k, 2) px
    pixel_covariance: Array  # (n, a, k, 2, 2) px^2
    pose_covariance: Array | None = None  # (n, 6, 6) as in recon.model.tracks: a turn (rad) after the pose's own, a shift (mm)
    pose_rates: Array | None = None  # (n, 4, 4) change of the poses a second, by which a lag of the B-scans moves them back
    lag_sigma_s: float = 0.0  # s, standard deviation of the lag

    def of(self, chosen: NDArray) -> "DotSightings":
        """Those of some frames, by number or mask."""
        values = {name: getattr(self, name) for name in ("poses", "pixels", "pixel_covariance", "pose_covariance", "pose_rates")}
        return replace(self, **{name: None if value is None else value[chosen] for name, value in values.items()})


@dataclass(frozen=True)
class _Frames:
    """The dots of k wires in n frames, each known to be of its wire."""

    poses: Array  # (n, 4, 4) world_from_target, mm
    pixels: Array  # (n, k, 2) px
    pixel_covariance: Array  # (n, k, 2, 2) px^2
    pose_covariance: Array | None = None  # (n, 6, 6)
    pose_rates: Array | None = None  # (n, 4, 4)

    def of(self, chosen: NDArray) -> "_Frames":
        """Some of them, by number or mask."""
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        return _Frames(**{name: None if value is None else value[chosen] for name, value in values.items()})


@dataclass(frozen=True)
class Registration:
    """A phantom's pose as known beforehand."""

    world_from_phantom: Array  # (4, 4)
    sigma_mm: float  # standard deviation along each axis

    @property
    def sigma(self) -> Array:
        """Standard deviations : (6,) of a step of the pose, rad and mm."""
        return np.array([self.sigma_mm / ARM_MM] * 3 + [self.sigma_mm] * 3)


@dataclass(frozen=True)
class Wires:
    """A phantom, and what is known of its wires and its place."""

    phantom: WirePhantom
    place_sigma_mm: float = 0.1  # of each wire across itself
    registration: Registration | None = None
    echo_ahead_mm: float = 0.0  # distance of an echo before the wire's axis: see `recon.probe_calibration.wires.echo_ahead`
    echo_ahead_sigma_mm: float = 0.0  # its standard deviation, common to all frames


@dataclass(frozen=True)
class _Estimate:
    """The unknowns."""

    target_from_image: Array  # (4, 4)
    scale: Array  # (2,) mm/px
    world_from_phantom: Array  # (4, 4)
    beside: Array  # (k, 2) mm, of the wires from their places, in the plane across each

    def moved(self, step: Step) -> "_Estimate":
        """After a step of `unknowns`."""
        scale, probe, phantom, wires = _unknowns(len(self.beside)).split(step.shared)
        return _Estimate(
            rigid.moved(self.target_from_image, probe),
            self.scale + scale,
            rigid.moved(self.world_from_phantom, phantom),
            self.beside + wires.reshape(-1, 2),
        )

    def arms(self, frames: _Frames) -> Array:
        """Vectors : (n, k, 3) mm, along the world's axes, from the target's origin to the dots."""
        plane = (frames.pixels * self.scale) @ self.target_from_image[:3, :2].T + self.target_from_image[:3, 3]
        return plane @ np.swapaxes(frames.poses[:, :3, :3], 1, 2)

    def in_phantom(self, frames: _Frames) -> Array:
        """Places : (n, k, 3) mm of the dots in the phantom's frame."""
        world = self.arms(frames) + frames.poses[:, None, :3, 3]
        return rigid.apply(rigid.invert(self.world_from_phantom), world)


@dataclass(frozen=True)
class _Problem:
    """What an adjustment of n frames is made of."""

    wires: Wires
    frames: _Frames
    noise: Noise
    held: Mask | None = None  # (g,) unknowns that stay as they are

    @property
    def phantom(self) -> WirePhantom:
        """The wires' places."""
        return self.wires.phantom

    @property
    def known(self) -> Array:
        """Information : (g,) on the unknowns beforehand."""
        blocks = _unknowns(self.phantom.count)
        known = np.zeros(len(blocks))
        known[blocks["wires"]] = self.wires.place_sigma_mm**-2
        if self.wires.registration is not None:
            known[blocks["phantom"]] = self.wires.registration.sigma**-2
        return known

    def departures(self, estimate: _Estimate) -> Array:
        """Differences : (g,) of an estimate from what is known."""
        blocks = _unknowns(self.phantom.count)
        departures = np.zeros(len(blocks))
        departures[blocks["wires"]] = estimate.beside.ravel()
        if self.wires.registration is not None:
            departures[blocks["phantom"]] = rigid.difference(
                self.wires.registration.world_from_phantom, estimate.world_from_phantom
            )
        return departures

    def of(self, chosen: NDArray) -> "_Problem":
        """By some of the frames."""
        return replace(self, frames=self.frames.of(chosen))


@dataclass(frozen=True)
class _Fit:
    """An adjustment, and the dots that it is made of."""

    estimate: _Estimate
    inliers: Mask  # (n, k) dots
    level: float  # measured noise over the assumed


def _unknowns(wires: int) -> Blocks:
    """Of the adjustment by some wires; the first as `recon.model.probe.NAMES`."""
    return Blocks({"scale": 2, "probe": 6, "phantom": 6, "wires": 2 * wires})


def _residuals(estimate: _Estimate, problem: _Problem) -> Array:
    """Distances : (n, k, 2) mm of the dots from their wires, in the plane across each."""
    offsets = estimate.in_phantom(problem.frames) - problem.phantom.points
    return np.einsum("kij,nkj->nki", problem.phantom.normals, offsets) - estimate.beside


def _closed_form(phantom: WirePhantom, poses: Array, pixels: Array) -> tuple[Array, Array, Array]:
    """Least squares without iteration by the middle dots alone, for any number of sets of frames at once.

    `R_i (u a + v b + t) + t_i = Q p + q` is linear in a = sx x, b = sy y, t, and in the phantom's Q and q: p is the point of the
    diagonal that the dots of its row give. The lengths of a and b are the scales; the rotations are the nearest.

    Parameters
    ----------
    poses, pixels : (..., n, 4, 4) and (..., n, 3 p, 2)

    Returns
    -------
    target_from_image, scale, world_from_phantom : (..., 4, 4), (..., 2), (..., 4, 4)
    """
    rows = pixels.reshape(*pixels.shape[:-2], -1, 3, 2)
    frame = np.stack([phantom.along, *phantom.across])  # right-handed
    middle = phantom.points.mean(axis=0)
    points = (phantom.on_diagonals(wire_dots.shares(rows)) - middle) @ frame.T  # (..., n, p, 3)
    flat = np.ptp(phantom.sections[..., 1]) < FLAT_MM
    points = points[..., : 2 if flat else 3]
    turns, shifts = poses[..., None, :3, :3], poses[..., None, :3, 3]
    shape = (*points.shape[:-1], 3, 3)
    turns = np.broadcast_to(turns, shape)
    u, v = np.moveaxis(rows[..., 1, :], -1, 0)[..., None, None]
    by_points = [-points[..., k, None, None] / 10 * np.broadcast_to(np.eye(3), shape) for k in range(points.shape[-1])]
    held = np.broadcast_to(-np.eye(3), shape)
    design = np.concatenate([u / 100 * turns, v / 100 * turns, turns / 100, *by_points, held], axis=-1)
    flat_rows = (*design.shape[:-4], -1, design.shape[-1])
    right = np.broadcast_to(-shifts, (*points.shape[:-1], 3)).reshape(*design.shape[:-4], -1, 1)
    solution = (np.linalg.pinv(design.reshape(flat_rows)) @ right)[..., 0]
    solution[..., :9] /= 100
    columns = np.stack([solution[..., :3], solution[..., 3:6]], axis=-1)
    scale = np.maximum(np.linalg.norm(columns, axis=-2), 1e-12)
    turned = _nearest(columns / scale[..., None, :])
    phantom_columns = np.moveaxis(solution[..., 9:-3].reshape(*solution.shape[:-1], -1, 3), -2, -1) / 10
    world = _nearest(phantom_columns)
    place = solution[..., -3:] - world @ frame @ middle
    return _transforms(turned, solution[..., 6:9]), scale, _transforms(world @ frame, place)


def _nearest(columns: Array) -> Array:
    """The rotations : (..., 3, 3) nearest to two or three columns : (..., 3, 2 | 3)."""
    if columns.shape[-1] == 2:
        columns = np.concatenate([columns, np.cross(columns[..., 0], columns[..., 1])[..., None]], axis=-1)
    left, _, right = np.linalg.svd(columns)
    left[..., :, 2] *= np.sign(np.linalg.det(left @ right))[..., None]
    return left @ right


def _transforms(turns: Array, shifts: Array) -> Array:
    result = np.zeros((*turns.shape[:-2], 4, 4))
    result[..., :3, :3], result[..., :3, 3], result[..., 3, 3] = turns, shifts, 1
    return result


def _robust_start(problem: _Problem, rng: np.random.Generator, count: int = DRAWS, refined: int = REFINED) -> _Estimate:
    """Least median of squares over closed forms: of all frames, and of random ones. The best few are refined first."""
    phantom, frames = problem.phantom, problem.frames
    n = len(frames.poses)
    draws = np.argsort(rng.random((count, n)), axis=1)[:, :MIN_FRAMES]
    whole = [each[None] for each in _closed_form(phantom, frames.poses, frames.pixels)]
    drawn = _closed_form(phantom, frames.poses[draws], frames.pixels[draws])
    starts = [np.concatenate(pair) for pair in zip(whole, drawn, strict=True)]
    beside = np.zeros((phantom.count, 2))
    estimates = [_Estimate(pose, scale, world, beside) for pose, scale, world in zip(*starts, strict=True)]
    medians = [_median(each, problem) for each in estimates]
    best = [_refined_on_half(estimates[k], problem) for k in np.argsort(medians)[:refined]]
    return min(best, key=lambda each: _median(each, problem))


def _median(estimate: _Estimate, problem: _Problem) -> float:
    """Median, mm^2, of the squared distances of the dots from their wires."""
    return float(np.median((_residuals(estimate, problem) ** 2).sum(axis=-1)))


def _refined_on_half(start: _Estimate, problem: _Problem) -> _Estimate:
    """After two rounds of least squares on the better half of the frames."""
    keep = max(len(problem.frames.poses) // 2 + 1, MIN_FRAMES)
    for _ in range(2):
        chosen = np.argsort(np.median((_residuals(start, problem) ** 2).sum(axis=-1), axis=1))[:keep]
        half = problem.of(chosen)
        start = _fit(start, half, np.ones(half.frames.pixels.shape[:2], bool), rules=REFINE)
    return start


def _covariances(estimate: _Estimate, problem: _Problem, inliers: Mask, level: float) -> Array:
    """Of the residuals : (n, 2 k, 2 k) mm^2: the pose's, common to a frame, and in the image's axes each dot's own.

    A level of noise below 1 is that of the dots: how uneven echoes are is a guess, while the tracker says how sure poses are.
    """
    frames, noise = problem.frames, problem.noise
    n, k = frames.pixels.shape[:2]
    planes = problem.phantom.normals @ estimate.world_from_phantom[:3, :3].T  # (k, 2, 3), of the world
    local = np.zeros((n, k, 3, 3))
    local[..., :2, :2] = frames.pixel_covariance * np.outer(estimate.scale, estimate.scale)
    local[..., 2, 2] = noise.slice_mm**2
    by_dot = planes @ (frames.poses[:, None, :3, :3] @ estimate.target_from_image[:3, :3])
    own = level**2 * propagate(by_dot, local) + np.where(inliers, FLOOR_MM, FAR_MM)[..., None, None] ** 2 * np.eye(2)
    whole = max(level, 1.0) ** 2 * _of_poses(estimate, problem)
    for each in range(k):
        whole[:, 2 * each : 2 * each + 2, 2 * each : 2 * each + 2] += own[:, each]
    return whole


def _of_poses(estimate: _Estimate, problem: _Problem) -> Array:
    """The poses' part of these covariances : (n, 2 k, 2 k) mm^2, where their noise is as assumed."""
    frames = problem.frames
    pose = problem.noise.of_pose if frames.pose_covariance is None else frames.pose_covariance
    planes = problem.phantom.normals @ estimate.world_from_phantom[:3, :3].T
    return propagate((planes @ rigid.slopes(estimate.arms(frames))).reshape(len(frames.poses), -1, 6), pose)


def _slopes(estimate: _Estimate, problem: _Problem) -> Array:
    """Derivatives : (n, 2 k, g) of the residuals by the unknowns."""
    frames, phantom = problem.frames, problem.phantom
    n, k = frames.pixels.shape[:2]
    blocks = _unknowns(k)
    result = np.zeros((n, k, 2, len(blocks)))
    turned = phantom.normals @ estimate.world_from_phantom[:3, :3].T  # (k, 2, 3)
    places = place_slopes(estimate.target_from_image, estimate.scale, frames.pixels.reshape(-1, 2)).reshape(n, k, 3, -1)
    result[..., : len(NAMES)] = turned @ (frames.poses[:, None, :3, :3] @ places)
    apart = estimate.arms(frames) + frames.poses[:, None, :3, 3] - estimate.world_from_phantom[:3, 3]
    result[..., blocks["phantom"]] = -(turned @ rigid.slopes(apart))
    for each in range(k):
        result[:, each, :, blocks["wires"].start + 2 * each : blocks["wires"].start + 2 * each + 2] = -np.eye(2)
    return result.reshape(n, 2 * k, len(blocks))


def _whitened(estimate: _Estimate, problem: _Problem, inliers: Mask, level: float) -> tuple[Array, Array]:
    """Slopes : (n, 2 k, g) of the residuals and these : (n, 2 k), in standard deviations of a level of noise."""
    left = _residuals(estimate, problem).reshape(len(inliers), -1, 1)
    both = np.concatenate([_slopes(estimate, problem), left], axis=-1)
    both = whitening(_covariances(estimate, problem, inliers, level)) @ both
    return both[..., :-1], both[..., -1]


def _normal_equations(estimate: _Estimate, problem: _Problem, inliers: Mask, level: float) -> tuple[NormalEquations, float]:
    """Normal equations and cost; no frame has unknowns of its own."""
    by_unknowns, left = _whitened(estimate, problem, inliers, level)
    departures = problem.departures(estimate)
    equations = NormalEquations.of_rows(by_unknowns, np.zeros((*left.shape, 0)), -left)
    equations = equations.held(np.diag(problem.known), departures)
    if problem.held is not None:
        equations = equations.held(np.diag(HELD * problem.held), np.zeros(len(departures)))
    return equations, float(np.sum(left**2) + problem.known @ departures**2)


def _fit(start: _Estimate, problem: _Problem, inliers: Mask, level: float = 1.0, rules: Rules = USUAL) -> _Estimate:
    """Weighted least squares on some of the dots."""

    def linearise(estimate: _Estimate) -> tuple[NormalEquations, float]:
        return _normal_equations(estimate, problem, inliers, level)

    return descend(start, linearise, _Estimate.moved, rules=rules).estimate


def _squared(estimate: _Estimate, problem: _Problem, level: float) -> Array:
    """Squared normalised residuals : (n, k), chi-square with 2 degrees of freedom."""
    left = _residuals(estimate, problem)
    n, k = left.shape[:2]
    whole = _covariances(estimate, problem, np.ones((n, k), bool), level).reshape(n, k, 2, k, 2)
    own = np.stack([whole[:, each, :, each] for each in range(k)], axis=1)
    return np.einsum("nki,nki->nk", left, np.linalg.solve(own, left[..., None])[..., 0])


def _without_outliers(start: _Estimate, problem: _Problem) -> _Fit:
    """Least squares on the dots within the gate, until these are the same again, and the noise."""
    estimate, inliers = start, np.ones(problem.frames.pixels.shape[:2], bool)
    level, before, settled = 1.0, None, False
    for _ in range(ROUNDS):
        values = _squared(estimate, problem, level)
        scale = np.sqrt(max(np.median(values[inliers] if before is not None else values) / MEDIAN, 1e-12))
        inliers = values <= GATE * scale**2
        if before is not None and (inliers == before).all() and settled:
            break
        before = inliers
        estimate = _fit(estimate, problem, inliers, level)
        measured = _level(estimate, problem, inliers, level)
        settled, level = abs(measured / level - 1) < SETTLED, measured
    return _Fit(_fit(estimate, problem, inliers, level), inliers, level)


def _level(estimate: _Estimate, problem: _Problem, inliers: Mask, level: float) -> float:
    """Measured noise over the assumed, with the freedom that what is known leaves."""
    by_unknowns, left = _whitened(estimate, problem, inliers, level)
    flat = by_unknowns.reshape(-1, by_unknowns.shape[-1])
    spread = inverse(flat.T @ flat + np.diag(problem.known))
    freedom = 2 * inliers.sum() - len(spread) + float(problem.known @ np.diag(spread))
    return max(level * float(np.sqrt(np.sum(left**2) / max(freedom, 1.0))), LEAST_LEVEL)


@dataclass(frozen=True)
class LineAdjustment:
    """Adjusted values, their uncertainty, and the residuals."""

    calibration: ProbeCalibration
    wires: Wires
    world_from_phantom: Array  # (4, 4)
    beside_mm: Array  # (k, 2) of the wires from their places, across each
    residuals: Array  # (n, k, 2) mm, across the wires
    inliers: Mask  # (n, k) dots
    chi: Array  # (n, k) length of a residual over its standard deviation; sqrt(2) for a typical dot
    noise_factor: float  # measured noise over the assumed
    size: tuple[float, float]  # of the phantom beside its definition, by the poses; its standard deviation
    late: Lateness | None  # of the B-scans, beyond the lag of the poses; None without times
    held_out_mm: float  # RMS of dots of half of the frames, by the other half
    earlier_held_out_mm: float = np.nan  # the same by an earlier calibration; NaN without one
    moved: Movement | None = None  # of the probe or the phantom, which the covariance allows for
    persistence: float = 1.0  # frames that count as one in the covariance, as residuals of neighbours are alike

    @property
    def outliers(self) -> Mask:
        """Frames : (n,) of which half of the dots or more are left out."""
        return ~_used(self.inliers)

    @property
    def rms_mm(self) -> float:
        """Root mean square distance of the dots from their wires, outliers left out."""
        return _rms(self.residuals[self.inliers])

    @property
    def distances_mm(self) -> Array:
        """Root mean square distances : (n,) of a frame's dots."""
        return np.sqrt((self.residuals**2).sum(axis=-1).mean(axis=1))

    @property
    def normalised(self) -> Array:
        """The same : (n,) over their standard deviations."""
        return np.sqrt((self.chi**2).mean(axis=1))

    @property
    def registration_off(self) -> tuple[float, float]:
        """Turn, deg, and shift, mm, of the phantom from its registration; NaN where it has none."""
        if self.wires.registration is None:
            return np.nan, np.nan
        step = rigid.difference(self.wires.registration.world_from_phantom, self.world_from_phantom)
        return float(np.degrees(np.linalg.norm(step[:3]))), float(np.linalg.norm(step[3:]))

    def doubts(self) -> Iterator[str]:
        """What is unusual in a way that a mistake is."""
        if self.wires.registration is not None:
            step = rigid.difference(self.wires.registration.world_from_phantom, self.world_from_phantom)
            if (np.abs(step) > SURE * self.wires.registration.sigma).any():
                turn, shift = self.registration_off
                yield (
                    f"the phantom lies {turn:.1f} deg and {shift:.1f} mm from its registration: moved since, registered in "
                    "another reference frame, or poses of another unit? registration=free does without"
                )
        for k in np.flatnonzero(self.inliers.mean(axis=0) < MIN_INLIERS):
            share = 100 * (1 - self.inliers[:, k].mean())
            yield f"{share:.0f} % of the dots of wire {self.wires.phantom.names[k]} lie elsewhere: is it strung as defined?"
        size, sigma = self.size
        if abs(size - 1) > max(SURE * sigma, SAME_SIZE):
            yield f"by the poses the phantom is {100 * (size - 1):+.1f} ± {100 * sigma:.1f} % larger than its definition"
        if self.moved is not None:
            yield _described(self.moved)
        if self.late is not None and self.late.shown:
            yield self.late.described
        elif self.persistence > NEIGHBOURS:
            cause = "poses err from place to place, or something moves slowly"
            yield f"{self.persistence:.0f} neighbouring frames count as one, since their residuals are alike: {cause}"


def _used(inliers: Mask) -> Mask:
    """Frames : (n,) of which most dots are inliers : (n, k)."""
    return inliers.mean(axis=1) > 0.5


def _described(moved: Movement) -> str:
    what, cause = {
        PROBE: ("probe moved against its target", "a bracket that gives or slips"),
        WIRES: ("phantom moved", "a phantom or tank that was pushed"),
    }[moved.what]
    by = f"{moved.turn_deg:.2f} deg and {moved.shift_mm:.2f} mm between the first frame and the last (chance {moved.chance:.0e})"
    return f"the residuals show that the {what} by {by}: {cause}, or poses that err from place to place"


def calibrate(
    sightings: DotSightings,
    wires: Wires,
    size: Size,
    noise: Noise | None = None,
    expected: Array | None = None,
    seed: int = 0,
    max_sigma_mm: float = probe_checks.MAX_SIGMA_MM,
    numbers: NDArray[np.int64] | None = None,
    earlier: Array | None = None,
) -> LineAdjustment:
    """Calibrate a probe from poses and the dots of N-wires at rest.

    Parameters
    ----------
    size : (width, height) px
        Of the B-scans.
    noise : Noise
        For poses without a covariance. Only its proportions matter: the level is measured.
    expected : (4, 4)
        `target_from_image` as designed, as of `point_calibration.calibrate`.
    seed : int
        Of the random draws of frames for the robust start.
    max_sigma_mm : float
        Standard deviation of a pixel's place beyond which the outcome is refused, by noise and lag. What warnings tell of is in
        the covariance, too.
    numbers : (n,)
        Of the frames, for messages; from 0 on without them.
    earlier : (4, 4)
        An earlier calibration, from pixels to mm, whose held-out error is measured beside.

    Raises
    ------
    InputError
        If the frames are too few, contradict each other, or do not determine the calibration; or the outcome can't be right.
    """
    count = len(sightings.poses)
    if count < MIN_FRAMES:
        raise InputError(f"sightings: expected at least {MIN_FRAMES} frames with a pose and all dots, found {count}")
    probe_checks.poses(sightings.poses)
    rng = np.random.default_rng(seed)
    problem, start = _arranged(sightings, wires, noise or Noise(), rng)
    found = _without_outliers(start, problem)
    rms = _rms(_residuals(found.estimate, problem)[found.inliers])
    astray = (found.inliers.mean(axis=0) < MIN_INLIERS).sum()
    contradict = found.level > MAX_FACTOR or rms > MAX_RMS_MM or found.inliers.mean() < MIN_INLIERS or astray > MOST_ASTRAY
    if contradict or not probe_checks.plausible(found.estimate.scale):
        _refuse(problem, found, rms, numbers)
    several = np.repeat(problem.frames.poses, problem.phantom.count, axis=0), problem.frames.pixels.reshape(-1, 2)
    if wires.registration is None:
        probe_checks.motion(*several, size)
    solved = _solve(problem, found)
    sizes, late = _size(problem, solved), _lateness(problem, found, solved)
    if abs(sizes[0] - 1) > max(SURE * sizes[1], MAX_SIZE):
        raise probe_checks.Misread(
            f"wires: expected a phantom of the size that the probe's motion asks for, found it {100 * (sizes[0] - 1):+.1f} ± "
            f"{100 * sizes[1]:.1f} % larger: another phantom than defined, or poses of another unit or scale"
        )
    is_late = late is not None and late.shown
    named = None if is_late else _movement(solved, _used(found.inliers))
    count = persistence(solved.left) if named is None else named.persistence
    estimate, by_lag = found.estimate, np.zeros(len(NAMES))
    if sightings.lag_sigma_s and late is not None:
        by_lag = sightings.lag_sigma_s * late.change
    try:
        frames, own = _Placed(*several), _covariance(solved, 1.0) + np.outer(by_lag, by_lag)
        probe_checks.certainty(estimate.target_from_image, estimate.scale, own, frames, size, max_sigma_mm)
    except InputError as error:
        unsure = "the uncertainty of the lag is in it: hold still, or measure the lag" if sightings.lag_sigma_s else ""
        also = late.described if late is not None and late.shown else unsure
        raise InputError(f"{error}; {also}" if also else str(error)) from None
    covariance = _covariance(solved, count) + np.outer(by_lag, by_lag)
    if named is not None:
        covariance += named.squared
    covariance[SHIFT, SHIFT] += wires.echo_ahead_sigma_mm**2 * np.outer(*2 * (estimate.target_from_image[:3, 1],))
    ahead = rigid.transform(np.eye(3), [0, -wires.echo_ahead_mm, 0])
    uncertainty = Uncertainty(NAMES, (covariance + covariance.T) / 2)
    calibration = ProbeCalibration(estimate.target_from_image @ ahead, estimate.scale, uncertainty)
    probe_checks.outcome(calibration, size, expected)
    return LineAdjustment(
        calibration,
        wires,
        estimate.world_from_phantom,
        estimate.beside,
        _residuals(estimate, problem),
        found.inliers,
        np.sqrt(_squared(estimate, problem, found.level)),
        found.level,
        sizes,
        late,
        _held_out(problem, found, found.estimate),
        np.nan if earlier is None else _held_out_by(problem, found, earlier),
        None if named is None else named.movement,
        count,
    )


def misfit(sightings: DotSightings, wires: Wires, noise: Noise) -> float:
    """As `point_calibration.misfit`, of the dots from their wires."""
    if len(sightings.poses) < MIN_FRAMES:
        return np.inf
    problem, start = _arranged(sightings, wires, noise, np.random.default_rng(0), DRAWS_TRIED, refined=1)
    if not probe_checks.plausible(start.scale):
        return MAX_RMS_MM**2
    return float(np.minimum((_residuals(start, problem) ** 2).sum(axis=-1), MAX_RMS_MM**2).mean())


@dataclass(frozen=True)
class _Placed:
    """Of dots, each with its pose, for `probe_checks`."""

    poses: Array  # (m, 4, 4)
    pixels: Array  # (m, 2)


def _arranged(
    sightings: DotSightings,
    wires: Wires,
    noise: Noise,
    rng: np.random.Generator,
    draws: int = DRAWS,
    refined: int = REFINED,
) -> tuple[_Problem, _Estimate]:
    """Choose an arrangement of each frame's dots, and an estimate that it agrees with.

    Arrangements are of four classes: rows seen left to right or right to left, and upright or upside down. How the probe was
    held is not known beforehand, so each class of several frames is tried, and the likeliest of all frames where none has many;
    then each frame takes what agrees best.
    """
    everywhere = np.arange(len(sightings.poses))

    def problem_of(chosen: NDArray[np.int64], numbers: NDArray[np.int64] = everywhere) -> _Problem:
        picked = sightings.pixels[numbers, chosen], sightings.pixel_covariance[numbers, chosen]
        own, rates = (None if each is None else each[numbers] for each in (sightings.pose_covariance, sightings.pose_rates))
        return _Problem(wires, _Frames(sightings.poses[numbers], *picked, own, rates), noise)

    there = np.isfinite(sightings.pixels).all(axis=(2, 3))
    right = sightings.pixels[:, :, 2, 0] > sightings.pixels[:, :, 0, 0]
    down = sightings.pixels[:, :, -3, 1] >= sightings.pixels[:, :, 0, 1]
    trials = []
    for turned, upright in product((True, False), repeat=2):
        of_class = there & (right == turned) & (down == upright)
        numbers = np.flatnonzero(of_class.any(axis=1))
        if len(numbers) >= MIN_FRAMES:
            trials.append(problem_of(of_class[numbers].argmax(axis=1), numbers))
    trials = trials or [problem_of(0 * everywhere)]
    starts = [_robust_start(each, rng, draws, refined) for each in trials]
    medians = [_median(start, each) for start, each in zip(starts, trials, strict=True)]
    likely = [k for k, median in enumerate(medians) if median <= ALIKE * min(medians)]
    known = trials[0].known
    start = min((starts[k] for k in likely), key=lambda each: float(known @ trials[0].departures(each) ** 2))
    several = [problem_of(np.full(len(everywhere), each)) for each in range(there.shape[1])]
    misfits = [np.median((_residuals(start, each) ** 2).sum(axis=-1), axis=1) for each in several]
    return problem_of(np.where(there, np.transpose(misfits), np.inf).argmin(axis=1)), start


def _rms(distances: Array) -> float:
    """Root mean square length of vectors : (..., 2)."""
    return float(np.sqrt((distances**2).sum(axis=-1).mean()))


class _Solved(NamedTuple):
    """Whitened equations of n frames at the adjusted values."""

    slopes: Array  # (n, 2 k, g) of the residuals by the unknowns
    left: Array  # (n, 2 k) residuals
    whiten: Array  # (n, 2 k, 2 k)
    known: Array  # (g,) information beforehand
    spread: Array  # (g, g) covariance of the unknowns, of independent frames

    @property
    def rows(self) -> Array:
        """Slopes : (2 n k, g)."""
        return self.slopes.reshape(-1, self.slopes.shape[-1])


class _Named(NamedTuple):
    """A movement that residuals show."""

    movement: Movement
    squared: Array  # (8, 8) mean square by it of sx, sy and the probe's pose, over both ends
    persistence: float  # of the residuals without it


def _solve(problem: _Problem, found: _Fit) -> _Solved:
    """The equations at an adjustment."""
    slopes, left = _whitened(found.estimate, problem, found.inliers, found.level)
    whiten = whitening(_covariances(found.estimate, problem, found.inliers, found.level))
    flat = slopes.reshape(-1, slopes.shape[-1])
    return _Solved(slopes, left, whiten, problem.known, inverse(flat.T @ flat + np.diag(problem.known)))


def _further(solved: _Solved, columns: Array) -> tuple[Array, Array, Array]:
    """Adjust m further unknowns, of whitened slopes : (n, 2 k, m), with all others.

    Returns
    -------
    change : (g, m) of the others by one unit of each
    values : (m,)
    information : (m, m) on them, of independent frames
    """
    more = columns.reshape(solved.left.size, -1)
    change = -solved.spread @ (solved.rows.T @ more)
    information = more.T @ (more + solved.rows @ change)
    if (np.diag(information) < LEAST_SHOWN * (more**2).sum(axis=0)).any():
        return change, np.zeros(more.shape[1]), np.zeros_like(information)
    return change, -inverse(information) @ (more.T @ solved.left.ravel()), information


def _with_sigma(solved: _Solved, column: Array) -> tuple[float, float]:
    """One further unknown, whose whitened slopes : (n, 2 k, 1) are given, and its standard deviation."""
    _, (value,), ((information,),) = _further(solved, column)
    return float(value), float(np.sqrt(persistence(solved.left) / information)) if information else np.inf


def _size(problem: _Problem, solved: _Solved) -> tuple[float, float]:
    """Size of the phantom beside its definition, as the motion of the probe has it, and its standard deviation."""
    middle = problem.phantom.points.mean(axis=0)
    column = -np.einsum("kij,kj->ki", problem.phantom.normals, problem.phantom.points - middle)
    more, sigma = _with_sigma(solved, solved.whiten @ column.reshape(-1, 1))
    return 1 + more, sigma


def _lag_columns(problem: _Problem, found: _Fit, solved: _Solved) -> Array:
    """Whitened slopes : (n, 2 k, 1) of the residuals, a second of lag."""
    rates, frames, estimate = problem.frames.pose_rates, problem.frames, found.estimate
    assert rates is not None
    plane = (frames.pixels * estimate.scale) @ estimate.target_from_image[:3, :2].T + estimate.target_from_image[:3, 3]
    motion = plane @ np.swapaxes(rates[:, :3, :3], 1, 2) + rates[:, None, :3, 3]
    planes = problem.phantom.normals @ estimate.world_from_phantom[:3, :3].T
    return solved.whiten @ -np.einsum("kij,nkj->nki", planes, motion).reshape(*solved.left.shape, 1)


def _lateness(problem: _Problem, found: _Fit, solved: _Solved) -> Lateness | None:
    """Lag of the B-scans that the residuals show; None without times."""
    if problem.frames.pose_rates is None:
        return None
    column = _lag_columns(problem, found, solved)[..., 0]
    counted, level = 2 * found.inliers.sum(axis=1), max(found.level, 1.0)
    of_poses = level**2 * propagate(solved.whiten, _of_poses(found.estimate, problem))
    by_poses = float(np.trace(of_poses, axis1=1, axis2=2).sum())
    return lateness.of_residuals(column, solved.left, solved.slopes, solved.known, counted, level, by_poses)


def _movement(solved: _Solved, used: Mask) -> _Named | None:
    """The likeliest movement of the probe or the phantom; None where noise that is alike in neighbours may be all.

    used : (n,) frames that aren't outliers, of which some are before a sudden movement and some after it
    """
    n, blocks = len(used), _unknowns(solved.left.shape[1] // 2)
    inside = np.flatnonzero(used)[LEAST_FRAMES : 1 - LEAST_FRAMES]
    firsts = np.unique(inside[np.linspace(0, len(inside) - 1, MOST_COURSES).astype(int)])
    courses = [np.linspace(-1, 1, n), *(np.where(np.arange(n) < first, -1.0, 1.0) for first in firsts)]
    likeliest = {}
    for what, block in ((PROBE, blocks["probe"]), (WIRES, blocks["phantom"])):
        fits = [_moved(solved, what, growth, block, 2 * len(courses)) for growth in courses]
        sure = [one for one in fits if one is not None and one.movement.chance < CHANCE]
        if sure:
            likeliest[what] = min(sure, key=lambda one: one.movement.log_chance)
    if len(likeliest) < 2:
        return next(iter(likeliest.values()), None)
    sooner = likeliest[WIRES].movement.evidence - movement.CAUTION > likeliest[PROBE].movement.evidence
    return likeliest[WIRES if sooner else PROBE]


def _moved(solved: _Solved, what: str, growth: Array, block: slice, trials: int) -> _Named | None:
    """A movement of one kind and course, and the chance of as good a fit by noise in any of some trials."""
    columns = growth[:, None, None] * solved.slopes[..., block]
    change, free, information = _further(solved, columns)
    half = inverse(information + np.diag(LARGE**-2)) @ information @ free
    unexplained = columns + solved.slopes @ change
    rest = solved.left + unexplained @ half
    pulls = np.einsum("nim,ni->nm", unexplained, rest)  # of each frame, whose dots may err alike
    within = float(np.trace(inverse(information) @ pulls.T @ pulls)) / len(half)
    alike, explained = persistence(rest), float(half @ information @ (2 * free - half))
    count = alike * max(within, 1.0)
    freedom = (solved.left.size - len(solved.known) - len(half)) / count
    if freedom < LEAST_FREEDOM:
        return None
    after = max(float((solved.left**2).sum()) - explained, np.finfo(float).tiny) / count
    chance = fdtrc(len(half), freedom, explained / count / len(half) / (after / freedom))
    log_chance = float(np.log(trials) + np.log(np.maximum(chance, np.finfo(float).tiny)))
    found = Movement(what, half, log_chance, explained / count / 2, np.ones(len(growth), bool))
    kept, own = (change @ half)[: len(NAMES)], np.zeros(len(NAMES))
    if what == PROBE:
        own[block] = half
    return _Named(found, np.outer(kept, kept) + np.outer(own, own), alike)


def pose_of(target_from_pixel: Array) -> tuple[Array, Array]:
    """The pose : (4, 4) of an image and its scale : (2,) mm/px, nearest to a matrix : (4, 4) from pixels to mm."""
    scale = np.linalg.norm(target_from_pixel[:3, :2], axis=0)
    axes = target_from_pixel[:3, :2] / scale
    return rigid.nearest(rigid.transform(np.column_stack([axes, np.cross(*axes.T)]), target_from_pixel[:3, 3])), scale


def _covariance(solved: _Solved, count: float) -> Array:
    """Of sx, sy and the probe's pose : (8, 8), whatever phantom and wires are within what is known of them.

    count : frames that count as one
    """
    return inverse(solved.rows.T @ solved.rows / count + np.diag(solved.known))[: len(NAMES), : len(NAMES)]


def _held_out_by(problem: _Problem, found: _Fit, target_from_pixel: Array) -> float:
    """The same of an earlier calibration: by its registration, or else with the phantom's pose and wires adjusted as ours."""
    pose, scale = pose_of(target_from_pixel)
    earlier = replace(found.estimate, target_from_image=pose, scale=scale)
    if problem.wires.registration is not None:
        whole = replace(earlier, world_from_phantom=problem.wires.registration.world_from_phantom, beside=0 * earlier.beside)
        return _rms(_residuals(whole, problem)[found.inliers])
    held = np.arange(len(_unknowns(problem.phantom.count))) < len(NAMES)
    return _held_out(replace(problem, held=held), found, earlier)


def _held_out(problem: _Problem, found: _Fit, start: _Estimate) -> float:
    """RMS, mm, of the dots of odd frames by a calibration of the even ones, and the other way round."""
    even = np.arange(len(found.inliers)) % 2 == 0
    left = []
    for used in (even, ~even):
        estimate = _fit(start, problem.of(used), found.inliers[used], found.level)
        left.append(_residuals(estimate, problem.of(~used))[found.inliers[~used]])
    return _rms(np.concatenate(left))


def _refuse(problem: _Problem, found: _Fit, rms: float, numbers: NDArray[np.int64] | None) -> None:
    """Refuse dots that don't lie on the wires of a phantom at rest."""
    away = np.sqrt((_residuals(found.estimate, problem) ** 2).sum(axis=-1).mean(axis=1))
    names = np.arange(len(away)) if numbers is None else numbers
    farthest = ", ".join(f"frame {names[k]} by {away[k]:.2g} mm" for k in np.argsort(-away)[:NAMED])
    agree = 100 * found.inliers.mean()
    noise = (
        f"residuals of {rms:.1f} mm (rms), {found.level:.1f} times the assumed noise, of the {agree:.0f} % of the dots that agree"
    )
    raise probe_checks.Misread(f"dots: expected on the wires of a phantom at rest, found {noise}; farthest off: {farthest}")
