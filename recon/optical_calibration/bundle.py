"""The bundle adjustment's problem: its unknowns and observations, both linearised at an estimate.

A sighting depends on its own device's parameters, on its own pose and, if the board is adjusted, on its own point: most of the
derivatives are zero. The normal equations are added up point by point, without these and without a matrix of all derivatives.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from recon.compiled import njit
from recon.estimation import covariance
from recon.estimation.equations import NormalEquations, Step
from recon.estimation.levenberg_marquardt import Unreachable
from recon.estimation.parameters import Blocks
from recon.geometry import rigid, usual_lenses
from recon.geometry.board_shape import AS_DESIGNED, Tolerances
from recon.geometry.camera import Camera
from recon.geometry.camera_jacobian import linearise, moved
from recon.optical_calibration.observations import PROJECTOR, Observations

Array = NDArray[np.float64]

ROBUST = 3.0  # normalised residual beyond which a sighting loses weight (Huber); 1 % of Gaussian ones are beyond
FLOOR_PX = 1e-4  # no sighting counts as more exact than this
BOARD = "board"  # the block of its points
POINT, POSE = 3, 6  # unknowns of a point and of a pose: its place, and a turn and a shift


@dataclass(frozen=True)
class Estimate:
    """Values of all unknowns."""

    cameras: Mapping[str, Camera]
    poses: Array  # (p, 4, 4) world_from_board
    points: Array  # (n, 3) mm, in the board's frame


@dataclass(frozen=True)
class Problem:
    """Observations, estimate and prior of one adjustment."""

    observations: Observations
    offsets: Array  # (p, n, d, 2) px, from where a device would see a point to where the detection puts it
    free: Mapping[str, Sequence[str]]  # device: parameters
    tolerances: Tolerances = AS_DESIGNED  # of the board
    released: bool = False  # the board's points are among the unknowns, held by the tolerances
    lenses: Array | None = None  # (g,) standard deviations by which the devices' parameters are held to zero; as usual if None
    tightness: Mapping[str, float] = field(default_factory=dict)  # device: by how much its lens is held tighter than that

    @property
    def names(self) -> tuple[str, ...]:
        """The devices' parameters : (g,), as in `calibration.Uncertainty`."""
        return tuple(f"{device}.{name}" for device in self.observations.devices for name in self.free.get(device, ()))

    @property
    def blocks(self) -> Blocks:
        """The shared unknowns: each device's parameters and, if it is released, the board's points."""
        sizes = {device: len(self.free.get(device, ())) for device in self.observations.devices}
        return Blocks({**sizes, BOARD: POINT * len(self.observations.points) if self.released else 0})

    @cached_property
    def whitening(self) -> Array:
        """Matrices that turn residuals into standard normal numbers : (p, n, d, 2, 2); zero where nothing was seen."""
        seen, noise = self.observations.seen[..., None, None], self.observations.covariance
        whiten = covariance.whitening(np.where(seen, noise, np.eye(2)) + FLOOR_PX**2 * np.eye(2))
        return np.where(self.observations.used[..., None, None], whiten, 0.0)

    def prior(self, estimate: Estimate) -> Array:
        """Information on the shared unknowns : (g, g) without any sighting: that of usual lenses, and the board's tolerances."""
        lenses = np.diag(lens_sigmas(self, estimate.cameras) ** -2)
        return block_diag(lenses, self.tolerances.information(self.observations.points)) if self.released else lenses

    def departures(self, estimate: Estimate) -> Array:
        """Differences : (g,) from values that are likeliest without any sighting; zero of unknowns that may be anything."""
        lenses = np.concatenate(_by_device(self, estimate.cameras, usual_lenses.coefficients))
        return np.append(lenses, estimate.points - self.observations.points) if self.released else lenses


def lens_sigmas(problem: Problem, cameras: Mapping[str, Camera]) -> Array:
    """Standard deviations : (g,) by which the devices' parameters are held to zero; infinite but for those of distortion."""
    parts = _by_device(problem, cameras, usual_lenses.largest)
    sigmas = np.concatenate(parts) if problem.lenses is None else problem.lenses
    tight = [problem.tightness.get(device, 1.0) for device in problem.observations.devices]
    return sigmas / np.repeat(tight, [len(part) for part in parts])


def _by_device(problem: Problem, cameras: Mapping[str, Camera], values: Callable[[Camera, Sequence[str]], Array]) -> list[Array]:
    """Values of each device's free parameters."""
    return [values(cameras[device], problem.free.get(device, ())) for device in problem.observations.devices]


@dataclass(frozen=True)
class System:
    """The problem linearised at an estimate."""

    equations: NormalEquations  # of whitened, weighted residuals
    plain: Array  # (p, n, d, 2) px, observed less predicted
    lengths: Array  # (p, n, d) of the whitened residuals before robust weights

    @property
    def losses(self) -> Array:
        """Huber's loss of each sighting : (p, n, d)."""
        return np.where(self.lengths <= ROBUST, self.lengths**2, 2 * ROBUST * self.lengths - ROBUST**2)

    def step(self, damping: float) -> Step:
        """Solve the equations."""
        return self.equations.step(damping)


def linear_system(problem: Problem, estimate: Estimate, noise: Array) -> System:
    """Normal equations of the whitened residuals, of sightings alone.

    noise : (d,) by which the devices' covariances are too small.
    """
    observations, turns = problem.observations, estimate.poses[:, :3, :3]
    free = [problem.free.get(device, ()) for device in observations.devices]
    arms = np.ascontiguousarray(estimate.points @ turns.swapaxes(1, 2))  # (p, n, 3)
    form, count = arms.shape[:2], len(free)
    residuals = observations.pixels - problem.offsets
    by_parameter, by_point = np.empty((count, *form, 2, max(map(len, free)))), np.empty((count, *form, 2, 3))
    world = (arms + estimate.poses[:, None, :3, 3]).reshape(-1, 3)
    for d, (device, names) in enumerate(zip(observations.devices, free, strict=True)):
        lines = linearise(estimate.cameras[device], world, names)
        residuals[:, :, d] -= lines.pixels.reshape(*form, 2)
        by_parameter[d, ..., : len(names)] = lines.by_parameter.reshape(*form, 2, -1)
        by_point[d] = lines.by_point.reshape(*form, 2, 3)
    first = np.cumsum([0, *map(len, free)])
    projector = observations.devices.index(PROJECTOR) if PROJECTOR in observations.devices else 0
    whitening = problem.whitening / noise[:, None, None]
    sightings = Sightings(residuals, by_parameter, by_point, arms, np.ascontiguousarray(turns), first, whitening, projector)
    equations, lengths = add_up(sightings, observations.gradient, problem.released, ROBUST)
    return System(equations, residuals, lengths)


def move(problem: Problem, estimate: Estimate, step: Step) -> Estimate:
    """An estimate with all unknowns changed by a step.

    Raises
    ------
    Unreachable
        If the step isn't finite, or a focal length wouldn't be positive.
    """
    if not (np.isfinite(step.shared).all() and np.isfinite(step.own).all()):
        raise Unreachable("a step that is not finite")
    cameras = dict(estimate.cameras)
    *changes, points = problem.blocks.split(step.shared)
    for device, change in zip(problem.observations.devices, changes, strict=True):
        names = problem.free.get(device, ())
        focal = {"fx": cameras[device].matrix[0, 0], "fy": cameras[device].matrix[1, 1]}
        if any(focal[name] + more <= 0 for name, more in zip(names, change, strict=True) if name in focal):
            raise Unreachable(f"{device}: a focal length that is not positive")
        cameras[device] = moved(cameras[device], names, change) if names else cameras[device]
    points = estimate.points + points.reshape(-1, POINT) if problem.released else estimate.points
    return Estimate(cameras, rigid.moved(estimate.poses, step.own), points)


class Sightings(NamedTuple):
    """Residuals of d devices in p poses of n points, and their derivatives; each device by itself."""

    residuals: Array  # (p, n, d, 2) px, observed less predicted
    by_parameter: Array  # (d, p, n, 2, k) px, of each device's prediction by its own parameters, as many as it has
    by_point: Array  # (d, p, n, 2, 3) px/mm, by the point in the world
    arms: Array  # (p, n, 3) mm, in the world, from the poses' origins to the points
    turns: Array  # (p, 3, 3) from the board's axes to the world's
    first: NDArray[np.int64]  # (d + 1,) of each device's parameters among all, and the number of all
    whitening: Array  # (p, n, d, 2, 2) 1/px, to standard normal numbers; zero where nothing was seen
    projector: int  # its place among the devices; 0 if there is none beside the first


def add_up(sightings: Sightings, gradient: Array, shaped: bool, robust: float) -> tuple[NormalEquations, Array]:
    """Normal equations, and lengths : (p, n, d) of the whitened residuals.

    Parameters
    ----------
    gradient : (p, n, 2, 2)
        Projector px / first device's px: the projector is read where the first device sees the point.
    shaped : bool
        Whether the points are unknowns.
    robust : float
        Length of a residual beyond which it loses weight (Huber).
    """
    p, n, d = sightings.residuals.shape[:3]
    g = int(sightings.first[-1]) + (POINT * n if shaped else 0)
    forms = (g, g), (p, g, POSE), (p, POSE, POSE), g, (p, POSE)
    equations = NormalEquations(*map(np.zeros, forms))
    lengths = np.zeros((p, n, d))
    _add_rows(sightings, gradient, shaped, robust, equations, lengths)
    return equations, lengths


@njit(error_model="numpy")
def _add_rows(sightings, gradient, shaped, robust, equations, lengths):
    poses, points, devices = lengths.shape
    own = sightings.first[devices]
    rows, left = np.empty((devices, 2, own + POINT + POSE)), np.empty((devices, 2))  # columns: parameters, point, pose
    for p in range(poses):
        for n in range(points):
            _fill(sightings, p, n, rows, left)
            if sightings.projector > 0:
                _take_error_along(gradient[p, n], rows, left, sightings.projector)
            for d in range(devices):
                whitening = sightings.whitening[p, n, d]
                if whitening[0, 0] > 0 and math.isfinite(left[d, 0] + left[d, 1]):  # seen
                    lengths[p, n, d] = _whiten(whitening, robust, rows[d], left[d])
                    _add(rows[d], left[d], (own, sightings.first[d + 1]), equations, p)
                    if shaped:
                        _add_point(rows[d], left[d], own, equations, (p, n))
    for a in range(len(equations.shared)):
        for b in range(a):
            equations.shared[a, b] = equations.shared[b, a]


@njit(error_model="numpy")
def _fill(sightings, p, n, rows, left):
    """Derivatives of one point's sightings : (d, 2, own + 9), and their residuals : (d, 2), in place."""
    turn, devices = sightings.turns[p], len(left)
    own = sightings.first[devices]
    x, y, z = sightings.arms[p, n, 0], sightings.arms[p, n, 1], sightings.arms[p, n, 2]
    for d in range(devices):
        start = sightings.first[d]
        for axis in range(2):
            left[d, axis] = sightings.residuals[p, n, d, axis]
            row = rows[d, axis]
            for k in range(own):
                row[k] = 0.0
            for k in range(sightings.first[d + 1] - start):
                row[start + k] = sightings.by_parameter[d, p, n, axis, k]
            slope = sightings.by_point[d, p, n, axis]
            a, b, c = slope[0], slope[1], slope[2]
            for k in range(3):
                row[own + k] = a * turn[0, k] + b * turn[1, k] + c * turn[2, k]
            row[own + 3], row[own + 4], row[own + 5] = y * c - z * b, z * a - x * c, x * b - y * a
            row[own + 6], row[own + 7], row[own + 8] = a, b, c


@njit(error_model="numpy")
def _take_error_along(gradient, rows, left, projector):
    """Take the first device's error out of the projector's rows: the fringes are read where the first device sees the point."""
    for axis in range(2):
        u, v = gradient[axis, 0], gradient[axis, 1]
        left[projector, axis] -= u * left[0, 0] + v * left[0, 1]
        for k in range(rows.shape[2]):
            rows[projector, axis, k] -= u * rows[0, 0, k] + v * rows[0, 1, k]


@njit(error_model="numpy")
def _whiten(whitening, robust, rows, left):
    """Whiten two rows, with the weight of Huber's loss, in place, and return the residual's length."""
    a, b, c, d = whitening[0, 0], whitening[0, 1], whitening[1, 0], whitening[1, 1]
    u, v = a * left[0] + b * left[1], c * left[0] + d * left[1]
    length = math.sqrt(u * u + v * v)
    root = math.sqrt(robust / max(length, robust))
    left[0], left[1] = root * u, root * v
    a, b, c, d = root * a, root * b, root * c, root * d
    for k in range(rows.shape[1]):
        first, second = rows[0, k], rows[1, k]
        rows[0, k], rows[1, k] = a * first + b * second, c * first + d * second
    return length


@njit(error_model="numpy")
def _add(rows, left, columns, equations, p):
    """Add a sighting's two equations, `row @ unknowns = left`, for parameters and pose; above the diagonal alone.

    columns : number of all parameters, and the first beyond those that the sighting depends on.
    """
    own, end = columns
    shared, cross, corner = equations.shared, equations.cross[p], equations.own[p]
    right, pose_right = equations.right, equations.own_right[p]
    first, second, pose = rows[0], rows[1], own + POINT
    for a in range(end):
        u, v = first[a], second[a]
        if u != 0 or v != 0:
            right[a] += u * left[0] + v * left[1]
            for b in range(a, end):
                shared[a, b] += u * first[b] + v * second[b]
            for b in range(POSE):
                cross[a, b] += u * first[pose + b] + v * second[pose + b]
    for a in range(POSE):
        u, v = first[pose + a], second[pose + a]
        pose_right[a] += u * left[0] + v * left[1]
        for b in range(POSE):
            corner[a, b] += u * first[pose + b] + v * second[pose + b]


@njit(error_model="numpy")
def _add_point(rows, left, own, equations, place):
    """Add the same equations' part for the point's place."""
    p, n = place
    shared, cross, right, at = equations.shared, equations.cross[p], equations.right, own + POINT * n
    first, second = rows[0], rows[1]
    for b in range(POINT):
        u, v = first[own + b], second[own + b]
        right[at + b] += u * left[0] + v * left[1]
        for a in range(own):
            shared[a, at + b] += u * first[a] + v * second[a]
        for a in range(b + 1):
            shared[at + a, at + b] += u * first[own + a] + v * second[own + a]
        for a in range(POSE):
            cross[at + b, a] += u * first[own + POINT + a] + v * second[own + POINT + a]
