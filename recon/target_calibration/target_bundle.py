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
from recon.geometry import camera_jacobian, rigid
from recon.geometry.camera import Camera
from recon.geometry.circle_outline import ellipses_of
from recon.geometry.levenberg_marquardt import Rules, descend
from recon.model import circle_layout
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

    def changed(self, change: Array) -> tuple[Camera, ...]:
        """Both cameras after a change : (g,)."""
        if not change.any():
            return self.cameras
        step = dict(zip(self.names, self.axes @ change, strict=True))
        cameras = []
        for device, camera in enumerate(self.cameras, start=1):
            own = {name.partition(".")[2]: value for name, value in step.items() if name.startswith(f"cam{device}.")}
            cameras.append(camera_jacobian.moved(camera, list(own), np.array(list(own.values()))))
        return tuple(cameras)


class _Unknowns(NamedTuple):
    target: Array  # (p,) of `target_files.parameters`
    optics: Array  # (g,) change of the cameras
    poses: Array  # (n, 4, 4) mm


class _System(NamedTuple):
    """Normal equations: each pose's own, and those of what all pairs share."""

    shared: Array  # (s, s)
    right: Array  # (s,)
    own: Array  # (n, 6, 6)
    own_right: Array  # (n, 6)
    mixed: Array  # (n, 6, s)


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
    for _ in range(ROUNDS):
        unknowns = _fitted(pairs, used, devices, noise, unknowns)
        levels = _levels(pairs, _residuals(pairs, devices, unknowns))
        typical = np.median(levels[used], axis=0)
        used = (levels < OUTLYING * typical).all(axis=1)
        noise = Noise(max(float(typical[0]), 1.0), float(typical[1]))
    system, _ = _linearised(_some(pairs, used), devices, noise, unknowns._replace(poses=unknowns.poses[used]))
    known = len(unknowns.target)
    covariance = np.linalg.inv(_reduced(system)[0])[:known, :known]
    covariance[DIAMETER, DIAMETER] += (RIM_BIAS * design.outer_diameter_mm) ** 2
    parts = _split(_residuals(pairs, devices, unknowns)[used])
    centres, shapes = (float(np.sqrt(np.mean(part**2))) for part in parts)
    target = _measured_target(unknowns.target, covariance, design)
    return Adjusted(target, covariance, noise, centres, shapes, used, tuple(pairs))


def _measured_target(values: Array, covariance: Array, design: Target) -> Target:
    """The design with the values : (p,) of its parameters, and the covariance : (p, p) of the lengths."""
    *lengths, diameter, xx, xy, yy = values.tolist()
    known = tuple(tuple(row) for row in covariance[:DIAMETER, :DIAMETER].tolist())
    update = {"outer_diameter_mm": diameter, "curvature_per_m": (xx, xy, yy), "covariance_mm2": known}
    return circle_layout.with_lengths(design, np.array(lengths)).model_copy(update=update)


def _devices(cameras: Sequence[Camera], optics: Uncertainty | None) -> _Devices:
    """Both cameras with the principal axes of their errors, scaled so that parameters of all units count alike."""
    kept = [k for k, name in enumerate(optics.names) if name.startswith(("cam1.", "cam2."))] if optics else []
    if optics is None or not kept:
        return _Devices(tuple(cameras), (), np.zeros((0, 0)))
    covariance = optics.covariance[np.ix_(kept, kept)]
    sigma = np.sqrt(np.diag(covariance))
    unit = np.where(sigma > 0, sigma, 1.0)
    variances, axes = np.linalg.eigh(covariance / np.outer(unit, unit))
    some = variances > LEAST_VARIANCE
    scaled = unit[:, None] * axes[:, some] * np.sqrt(variances[some])
    return _Devices(tuple(cameras), tuple(optics.names[k] for k in kept), scaled)


def _some(pairs: Sequence[Seen], used: NDArray[np.bool_]) -> list[Seen]:
    return [pair for pair, one in zip(pairs, used, strict=True) if one]


def _fitted(pairs: Sequence[Seen], used: NDArray[np.bool_], devices: _Devices, noise: Noise, start: _Unknowns) -> _Unknowns:
    """Least squares over the pairs of `used` : (n,); the poses of the others stay."""
    linearised = partial(_linearised, _some(pairs, used), devices, noise)
    found = descend(start._replace(poses=start.poses[used]), linearised, _solved, _moved, rules=RULES).estimate
    poses = start.poses.copy()
    poses[used] = found.poses
    return found._replace(poses=poses)


def predicted(cameras: Sequence[Camera], pose: Array, target: Array) -> Array:
    """Ellipses of n circles of a target : (p,) of its parameters, as (10 n,) px: all centres, then all shapes, view by view."""
    circles = circle_layout.laid_out(target[:DIAMETER], float(target[DIAMETER]), target[DIAMETER + 1 :])
    seen = [ellipses_of(camera, pose, *circles) for camera in cameras]
    return np.concatenate([centres.ravel() for centres, _ in seen] + [_numbers(shapes) for _, shapes in seen])


def _measured(pair: Seen) -> Array:
    return np.concatenate([view.centres.ravel() for view in pair.views] + [_numbers(view.shapes) for view in pair.views])


def _numbers(shapes: Array | None) -> Array:
    """The three numbers each of shapes : (n, 2, 2), which a pair of `whole` views always has."""
    return np.asarray(shapes)[:, [0, 0, 1], [0, 1, 1]].ravel()


def _residuals(pairs: Sequence[Seen], devices: _Devices, unknowns: _Unknowns) -> Array:
    """Of m pairs of n circles in each view : (m, 10 n) px."""
    cameras = devices.changed(unknowns.optics)
    shown = [predicted(cameras, pose, unknowns.target) for pose in unknowns.poses]
    return np.stack([_measured(pair) for pair in pairs]) - shown


def _linearised(pairs: Sequence[Seen], devices: _Devices, noise: Noise, unknowns: _Unknowns) -> tuple[_System, float]:
    """Normal equations at an estimate, and the sum of squares; the cameras' change is measured as zero, once."""
    known, optics = len(unknowns.target), unknowns.optics
    steps = np.repeat([LENGTH_STEP, CURVATURE_STEP], [known - 3, 3])
    shared, right = np.diag(np.repeat([0.0, 1.0], [known, len(optics)])), np.append(np.zeros(known), -optics)
    changed = [(devices.changed(optics + one), devices.changed(optics - one)) for one in np.eye(len(optics))]
    cameras, cost = devices.changed(optics), float(optics @ optics)
    own, own_right, mixed = [], [], []
    for pair, pose, residual in zip(pairs, unknowns.poses, _residuals(pairs, devices, unknowns), strict=True):
        by_pose = _slopes(POSE_STEPS, lambda d, pose=pose: predicted(cameras, rigid.moved(pose, d), unknowns.target))
        by_target = _slopes(steps, lambda d, pose=pose: predicted(cameras, pose, unknowns.target + d))
        shown = [[predicted(both, pose, unknowns.target) for both in pair_of] for pair_of in changed]
        by_shared = np.column_stack([by_target, *((more - less) / 2 for more, less in shown)])
        information = np.linalg.inv(_covariance(pair, noise))
        own.append(by_pose.T @ information @ by_pose)
        own_right.append(by_pose.T @ information @ residual)
        mixed.append(by_pose.T @ information @ by_shared)
        shared += by_shared.T @ information @ by_shared
        right += by_shared.T @ information @ residual
        cost += float(residual @ information @ residual)
    return _System(shared, right, np.stack(own), np.stack(own_right), np.stack(mixed)), cost


def _slopes(steps: Array, function: Callable[[Array], Array]) -> Array:
    """Derivatives : (m, n) of a function by n numbers about zero, by central differences."""
    return np.stack([(function(step) - function(-step)) / (2 * step.sum()) for step in np.diag(steps)], axis=1)


def _covariance(pair: Seen, noise: Noise) -> Array:
    """Covariance : (10 n, 10 n) px^2 of a pair's numbers: a shape is about as exact as its centre."""
    centres = block_diag(*(one for view in pair.views for one in view.covariance))
    shapes = []
    for view in pair.views:
        size = np.trace(np.asarray(view.shapes), axis1=1, axis2=2) / 2
        shapes.append(np.repeat(np.trace(view.covariance, axis1=1, axis2=2) / 2 + (SHAPE_FLOOR * size) ** 2, 3))
    return block_diag(noise.centres**2 * centres, noise.shapes**2 * np.diag(np.concatenate(shapes)))


def _levels(pairs: Sequence[Seen], residuals: Array) -> Array:
    """RMS : (n, 2) of each pair's centres and shapes over their prediction; of a pose's six numbers each takes off three."""
    whiten = [np.linalg.inv(np.linalg.cholesky(_covariance(pair, Noise()))) for pair in pairs]
    normal = np.stack([one @ residual for one, residual in zip(whiten, residuals, strict=True)])
    centres, shapes = _split(normal)
    free = centres.shape[1] - POSE, shapes.shape[1]
    return np.sqrt(np.column_stack([(part**2).sum(axis=1) / count for part, count in zip((centres, shapes), free, strict=True)]))


def _split(numbers: Array) -> tuple[Array, Array]:
    """Centres' and shapes' : (m, 4 n) and (m, 6 n) of pairs' numbers : (m, 10 n)."""
    centres, shapes = np.split(numbers, [numbers.shape[1] * 2 // 5], axis=1)
    return centres, shapes


def _reduced(system: _System) -> tuple[Array, Array]:
    """Equations : (s, s) and right-hand side : (s,) of what is shared, all poses eliminated."""
    gain = np.linalg.solve(system.own, np.concatenate([system.mixed, system.own_right[..., None]], axis=2))
    matrix = system.shared - np.einsum("nis,nit->st", system.mixed, gain[..., :-1])
    return matrix, system.right - np.einsum("nis,ni->s", system.mixed, gain[..., -1])


def _solved(_: _Unknowns, system: _System, damping: float) -> tuple[Array, Array]:
    """Steps : (s,) of what is shared, and (n, 6) of the poses."""
    damped = system._replace(
        shared=system.shared + damping * np.diag(np.diag(system.shared)),
        own=system.own * (1 + damping * np.eye(POSE)),
    )
    matrix, right = _reduced(damped)
    step = np.linalg.solve(matrix, right)
    left = damped.own_right - np.einsum("nis,s->ni", damped.mixed, step)
    return step, np.linalg.solve(damped.own, left[..., None])[..., 0]


def _moved(unknowns: _Unknowns, step: tuple[Array, Array]) -> _Unknowns:
    shared, poses = step
    target, optics = np.split(shared, [len(unknowns.target)])
    return _Unknowns(unknowns.target + target, unknowns.optics + optics, rigid.moved(unknowns.poses, poses))
