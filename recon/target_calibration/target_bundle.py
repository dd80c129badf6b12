"""Bundle adjustment of the target: its lengths, the diameter of its rims and its bow, with a pose of each pair of frames.

Measured are the ellipses of all rims, centres and shapes; predicted are those of circles in space. The cameras' parameters are
held by their covariance, so that the target's has their errors in it: its scale is that of the cameras' baseline.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from recon import arguments
from recon.estimation.covariance import inverse, root, whitening
from recon.estimation.equations import NormalEquations, Step
from recon.estimation.levenberg_marquardt import Rules, descend
from recon.estimation.parameters import Blocks
from recon.geometry import rigid
from recon.geometry.camera import Camera
from recon.geometry.circle_outline import ellipses_of
from recon.model import calibration, circle_layout
from recon.model.calibration import Uncertainty
from recon.model.rig import Target
from recon.target_calibration import target_poses
from recon.target_calibration.target_poses import Collected, Seen
from recon.tracking.tracker import Tracking

Array = NDArray[np.float64]

LENGTH_STEP, CURVATURE_STEP = 1e-2, 1e-1  # of derivatives by differences, mm and 1/m
POSE_STEPS = np.array([1e-4] * 3 + [1e-2] * 3)  # rad, mm
POSE = len(POSE_STEPS)
DIAMETER = -4  # of the target's parameters: after the lengths, before the bow's three
SHAPE_FLOOR = 3e-4  # of a disc's size: error of a shape that noise doesn't explain, before it is measured
RIM_BIAS = 2e-4  # of a disc's size, by which the model of a rim may put all rims too far in or out
LEAST_VARIANCE = 1e-9  # of a principal axis of the cameras' correlation
OUTLYING = 3.0  # times the residuals of the other pairs, beyond which one is left out
ROUNDS = 3  # of fits, each with the noise and the outliers of the one before
RULES = Rules(converged=1e-8)


class Noise(NamedTuple):
    """Standard deviations over the predicted ones; of centres at least those: their floor is of errors that pairs may share."""

    centres: float = 1.0
    shapes: float = 1.0


@dataclass(frozen=True)
class Adjusted:
    """The target as measured."""

    target: Target  # with the covariance of its lengths
    covariance: Array  # (p, p) of `target_files.parameters`
    noise: Noise
    centre_rms_px: float
    shape_rms_px: float
    used: NDArray[np.bool_]  # (n,) of the pairs
    pairs: tuple[Seen, ...]
    collected: Collected = field(default_factory=Collected)  # of the film that the pairs are from, by `calibrate`


class _Devices(NamedTuple):
    """Both cameras, and the independent standard normal numbers that their errors are made of."""

    cameras: tuple[Camera, ...]
    names: tuple[str, ...]  # of the parameters, (p,)
    axes: Array  # (p, g)

    def after(self, change: Array) -> tuple[Camera, ...]:
        """Both cameras after a change : (g,)."""
        named = {f"cam{k}": camera for k, camera in enumerate(self.cameras, start=1)}
        return tuple(calibration.moved(named, self.names, self.axes @ change).values()) if change.any() else self.cameras


class _Unknowns(NamedTuple):
    target: Array  # (p,) of `target_files.parameters`
    optics: Array  # (g,) change of the cameras
    poses: Array  # (n, 4, 4) mm

    @property
    def blocks(self) -> Blocks:
        """What all pairs share."""
        return Blocks({"target": len(self.target), "optics": len(self.optics)})


def calibrate(
    tracked: Iterable[Tracking],
    cameras: tuple[Camera, Camera],
    design: Target,
    optics: Uncertainty | None = None,
    most_poses: int = 100,
    least_tilt_deg: float = 5.0,
    least_range_mm: float = 20.0,
    name: str = "film",
) -> Adjusted:
    """Measure the target from what the tracker found in the pairs of frames of a film.

    Parameters
    ----------
    tracked : n results of a tracker's steps
        Taken one by one; those in which all rims are whole count, of poses that differ, in even light if these are enough.
    cameras : the tracker's
    design : where to start; its inner diameter and board stay.
    optics : of the cameras as they are now, `Tracker.optics_in_use`; None of exact ones.
    name : str
        Of the film, for messages.

    Raises
    ------
    InputError
        If poses, tilts or distances are missing.
    """
    arguments.of_kind("design", design, Target)
    arguments.of_kind("optics", optics, Uncertainty, type(None))
    arguments.of_kind("tracked", tracked, Iterable)
    collected = target_poses.collect(tracked, cameras)
    pairs = target_poses.spread(target_poses.evenly_lit(collected.seen), most_poses)
    target_poses.check(pairs, name, collected, least_tilt_deg, least_range_mm)
    return replace(adjust(pairs, design, optics), collected=collected)


def adjust(pairs: Sequence[Seen], design: Target, optics: Uncertainty | None) -> Adjusted:
    """Measure the target from n pairs of frames of the same cameras.

    Parameters
    ----------
    design : where to start; its inner diameter and board stay.
    optics : of the cameras' calibration; None where it isn't known, or exact.
    """
    devices = _devices([view.camera for view in pairs[0].views], optics)
    start = np.array([*circle_layout.lengths(design), design.outer_diameter_mm, *design.curvature_per_m])
    poses = np.stack([pair.world_from_target for pair in pairs])
    unknowns = _Unknowns(start, np.zeros(devices.axes.shape[1]), poses)
    used, noise = np.ones(len(pairs), bool), Noise()
    whiten = np.stack([whitening(_covariance(pair)) for pair in pairs])
    for _ in range(ROUNDS):
        unknowns = _fit(_Problem(pairs, whiten, used, devices, noise), unknowns)
        levels = _levels(whiten, _residuals(pairs, devices, unknowns))
        typical = np.median(levels[used], axis=0)
        used = (levels < OUTLYING * typical).all(axis=1)
        noise = Noise(max(float(typical[0]), 1.0), float(typical[1]))
    own = unknowns._replace(poses=unknowns.poses[used])
    equations, _ = _normal_equations(_Problem(pairs, whiten, used, devices, noise), own)
    known = own.blocks["target"]
    covariance = inverse(equations.reduced()[0])[known, known]
    covariance[DIAMETER, DIAMETER] += (RIM_BIAS * design.outer_diameter_mm) ** 2
    parts = _split(_residuals(pairs, devices, unknowns)[used])
    centres, shapes = (float(np.sqrt(np.mean(part**2))) for part in parts)
    *lengths, diameter, xx, xy, yy = unknowns.target.tolist()
    kept = tuple(tuple(row) for row in covariance[:DIAMETER, :DIAMETER].tolist())
    update = {"outer_diameter_mm": diameter, "curvature_per_m": (xx, xy, yy), "covariance_mm2": kept}
    target = circle_layout.with_lengths(design, np.array(lengths)).model_copy(update=update)
    return Adjusted(target, covariance, noise, centres, shapes, used, tuple(pairs))


def _devices(cameras: Sequence[Camera], optics: Uncertainty | None) -> _Devices:
    """Both cameras with the principal axes of their errors, scaled so that parameters of all units count alike."""
    kept = [k for k, name in enumerate(optics.names) if name.startswith(("cam1.", "cam2."))] if optics else []
    if optics is None or not kept:
        return _Devices(tuple(cameras), (), np.zeros((0, 0)))
    some = root(optics.covariance[np.ix_(kept, kept)], LEAST_VARIANCE)
    return _Devices(tuple(cameras), tuple(optics.names[k] for k in kept), some)


class _Problem(NamedTuple):
    """Pairs of which some are used."""

    pairs: Sequence[Seen]  # n
    whiten: Array  # (n, 10 c, 10 c) 1/px, of c circles, by the noise as predicted
    used: NDArray[np.bool_]  # (n,)
    devices: _Devices
    noise: Noise

    @property
    def some(self) -> list[Seen]:
        """Those that are used."""
        return [pair for pair, one in zip(self.pairs, self.used, strict=True) if one]


def _fit(problem: _Problem, start: _Unknowns) -> _Unknowns:
    """Least squares over the pairs that are used; the poses of the others stay."""
    used = problem.used
    begin = start._replace(poses=start.poses[used])
    found = descend(begin, partial(_normal_equations, problem), _move, rules=RULES).estimate
    poses = start.poses.copy()
    poses[used] = found.poses
    return found._replace(poses=poses)


def predicted(cameras: Sequence[Camera], pose: Array, target: Array) -> Array:
    """Ellipses of c circles of a target : (p,) of its parameters, as (10 c,) px: all centres, then all shapes, view by view."""
    circles = circle_layout.laid_out(target[:DIAMETER], float(target[DIAMETER]), target[DIAMETER + 1 :])
    seen = [ellipses_of(camera, pose, *circles) for camera in cameras]
    return np.concatenate([centres.ravel() for centres, _ in seen] + [_numbers(shapes) for _, shapes in seen])


def _measured(pair: Seen) -> Array:
    return np.concatenate([view.centres.ravel() for view in pair.views] + [_numbers(view.shapes) for view in pair.views])


def _numbers(shapes: Array | None) -> Array:
    """The three numbers each of shapes : (n, 2, 2), which a pair of `whole` views always has."""
    return np.asarray(shapes)[:, [0, 0, 1], [0, 1, 1]].ravel()


def _residuals(pairs: Sequence[Seen], devices: _Devices, unknowns: _Unknowns) -> Array:
    """Of n pairs of c circles in each view : (n, 10 c) px."""
    cameras = devices.after(unknowns.optics)
    shown = [predicted(cameras, pose, unknowns.target) for pose in unknowns.poses]
    return np.stack([_measured(pair) for pair in pairs]) - shown


def _normal_equations(problem: _Problem, unknowns: _Unknowns) -> tuple[NormalEquations, float]:
    """Normal equations at an estimate, and the sum of squares; the cameras' change is measured as zero, once."""
    devices, optics, blocks = problem.devices, unknowns.optics, unknowns.blocks
    steps = np.repeat([LENGTH_STEP, CURVATURE_STEP], [len(unknowns.target) - 3, 3])
    changed = [(devices.after(optics + one), devices.after(optics - one)) for one in np.eye(len(optics))]
    cameras, by_pose, by_shared = devices.after(optics), [], []
    for pose in unknowns.poses:
        by_pose.append(_slopes(POSE_STEPS, lambda d, pose=pose: predicted(cameras, rigid.moved(pose, d), unknowns.target)))
        by_target = _slopes(steps, lambda d, pose=pose: predicted(cameras, pose, unknowns.target + d))
        shown = [[predicted(both, pose, unknowns.target) for both in pair_of] for pair_of in changed]
        by_shared.append(np.column_stack([by_target, *((more - less) / 2 for more, less in shown)]))
    residuals = _residuals(problem.some, devices, unknowns)
    levels = np.repeat(problem.noise, [part.shape[1] for part in _split(residuals)])
    whiten = problem.whiten[problem.used] / levels[:, None]
    left = (whiten @ residuals[..., None])[..., 0]
    equations = NormalEquations.of_rows(whiten @ np.stack(by_shared), whiten @ np.stack(by_pose), left)
    known = np.repeat([0.0, 1.0], list(blocks.sizes.values()))
    held = equations.held(np.diag(known), np.append(unknowns.target, optics))
    return held, float(np.sum(left**2) + optics @ optics)


def _slopes(steps: Array, function: Callable[[Array], Array]) -> Array:
    """Derivatives : (m, n) of a function by n numbers about zero, by central differences."""
    return np.stack([(function(step) - function(-step)) / (2 * step.sum()) for step in np.diag(steps)], axis=1)


def _covariance(pair: Seen) -> Array:
    """Covariance : (10 c, 10 c) px^2 of a pair's numbers as predicted: a shape is about as exact as its centre."""
    centres = block_diag(*(one for view in pair.views for one in view.covariance))
    shapes = []
    for view in pair.views:
        size = np.trace(np.asarray(view.shapes), axis1=1, axis2=2) / 2
        shapes.append(np.repeat(np.trace(view.covariance, axis1=1, axis2=2) / 2 + (SHAPE_FLOOR * size) ** 2, 3))
    return block_diag(centres, np.diag(np.concatenate(shapes)))


def _levels(whiten: Array, residuals: Array) -> Array:
    """RMS : (n, 2) of each pair's centres and shapes over their prediction; of a pose's six numbers each takes off three."""
    centres, shapes = _split((whiten @ residuals[..., None])[..., 0])
    squares = (centres**2).sum(axis=1) / (centres.shape[1] - POSE), (shapes**2).sum(axis=1) / shapes.shape[1]
    return np.sqrt(np.column_stack(squares))


def _split(numbers: Array) -> tuple[Array, Array]:
    """Centres' and shapes' : (n, 4 c) and (n, 6 c) of pairs' numbers : (n, 10 c)."""
    centres, shapes = np.split(numbers, [numbers.shape[1] * 2 // 5], axis=1)
    return centres, shapes


def _move(unknowns: _Unknowns, step: Step) -> _Unknowns:
    target, optics = unknowns.blocks.split(step.shared)
    return _Unknowns(unknowns.target + target, unknowns.optics + optics, rigid.moved(unknowns.poses, step.own))
