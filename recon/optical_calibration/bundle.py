"""The bundle adjustment's problem: its unknowns and observations, both linearised at an estimate."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from recon.geometry import rigid, usual_lenses
from recon.geometry.board_shape import AS_DESIGNED, Tolerances
from recon.geometry.camera import Camera
from recon.geometry.camera_jacobian import linearise, moved
from recon.geometry.levenberg_marquardt import Unreachable
from recon.optical_calibration.normal_equations import Equations, Sightings, added_up
from recon.optical_calibration.observations import PROJECTOR, Observations

Array = NDArray[np.float64]

ROBUST = 3.0  # normalised residual beyond which a sighting loses weight (Huber); 1 % of Gaussian ones are beyond
FLOOR_PX = 1e-4  # no sighting counts as more exact than this


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

    @cached_property
    def whitening(self) -> Array:
        """Matrices that turn residuals into standard normal numbers : (p, n, d, 2, 2); zero where nothing was seen."""
        seen, covariance = self.observations.seen[..., None, None], self.observations.covariance
        inverse = np.linalg.inv(np.linalg.cholesky(np.where(seen, covariance, np.eye(2)) + FLOOR_PX**2 * np.eye(2)))
        return np.where(self.observations.used[..., None, None], inverse, 0.0)


def lens_sigmas(problem: Problem, cameras: Mapping[str, Camera]) -> Array:
    """Standard deviations : (g,) by which the devices' parameters are held to zero; infinite but for those of distortion."""
    parts = _by_device(problem, cameras, usual_lenses.largest)
    sigmas = np.concatenate(parts) if problem.lenses is None else problem.lenses
    tight = [problem.tightness.get(device, 1.0) for device in problem.observations.devices]
    return sigmas / np.repeat(tight, [len(part) for part in parts])


def coefficients(problem: Problem, cameras: Mapping[str, Camera]) -> Array:
    """Coefficients of distortion among the devices' parameters : (g,); zero for other parameters."""
    return np.concatenate(_by_device(problem, cameras, usual_lenses.coefficients))


def _by_device(problem: Problem, cameras: Mapping[str, Camera], values: Callable[[Camera, Sequence[str]], Array]) -> list[Array]:
    """Values of each device's free parameters."""
    return [values(cameras[device], problem.free.get(device, ())) for device in problem.observations.devices]


@dataclass(frozen=True)
class System:
    """The problem linearised at an estimate."""

    equations: Equations  # of whitened, weighted residuals
    plain: Array  # (p, n, d, 2) px, observed less predicted
    lengths: Array  # (p, n, d) of the whitened residuals before robust weights


def linearised(problem: Problem, estimate: Estimate, noise: Array, shaped: bool) -> System:
    """Normal equations of the whitened residuals; with the board's points among the unknowns if it is `shaped`.

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
    equations, lengths = added_up(sightings, observations.gradient, shaped, ROBUST)
    return System(equations, residuals, lengths)


def stepped(problem: Problem, estimate: Estimate, shared: Array, poses: Array) -> Estimate:
    """An estimate with all unknowns changed by a step.

    Raises
    ------
    Unreachable
        If the step isn't finite, or a focal length wouldn't be positive.
    """
    if not (np.isfinite(shared).all() and np.isfinite(poses).all()):
        raise Unreachable("a step that is not finite")
    cameras, at = dict(estimate.cameras), 0
    for device in problem.observations.devices:
        names = problem.free.get(device, ())
        step = shared[at : at + len(names)]
        focal = {"fx": cameras[device].matrix[0, 0], "fy": cameras[device].matrix[1, 1]}
        if any(focal[name] + change <= 0 for name, change in zip(names, step, strict=True) if name in focal):
            raise Unreachable(f"{device}: a focal length that is not positive")
        cameras[device] = moved(cameras[device], names, step) if names else cameras[device]
        at += len(names)
    points = estimate.points + shared[at:].reshape(-1, 3) if problem.released else estimate.points
    return Estimate(cameras, rigid.moved(estimate.poses, poses), points)
