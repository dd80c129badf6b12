"""Information of board poses on a calibration, and the errors of measured points that it leaves.

The information of a pose is that of its sightings on the devices' parameters, the pose itself eliminated (Schur's complement):
informations of poses add up. What they are worth is said in the mean variance of points over the working volume: in the world,
and within a shape, for each pair of camera 1 with another device. That the next pose be the one that lowers the mean variance of
predictions most is I-optimal design, pose by pose.

Source: Atkinson, Donev and Tobias 2007, "Optimum experimental designs, with SAS" (linear and I-optimality, sequential design).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from recon.errors import InputError
from recon.estimation.covariance import inverse
from recon.estimation.equations import TINY
from recon.geometry import rigid, usual_lenses
from recon.geometry.camera import Camera
from recon.geometry.camera_jacobian import MOTION, linearise
from recon.model.calibration import Calibration, Uncertainty
from recon.optical_calibration import uncertainty
from recon.optical_calibration.adjustment import free_parameters
from recon.optical_calibration.distortion_selection import MODELS, TRIED
from recon.optical_calibration.observations import PROJECTOR

Array = NDArray[np.float64]
Free = Mapping[str, Sequence[str]]

DEPTHS = 3  # of the working volume


@dataclass(frozen=True)
class Knowledge:
    """Knowledge of the devices' parameters, and what errors of these mean for points."""

    cameras: Mapping[str, Camera]
    free: Free  # device: parameters that are adjusted
    noise: Mapping[str, float]  # px, of a sighting in u and v by device; the projector's that of the fringes alone
    information: Array  # (g, g)
    forms: Array  # (k, g, g) whose traces with the covariance are mean variances of points, mm^2

    @property
    def variances(self) -> Array:
        """Mean variances of points : (k,) mm^2: in the world and within a shape, for each pair of devices."""
        return np.einsum("kgh,hg->k", self.forms, inverse(self.information))

    def after(self, poses: Array, points: Array) -> Array:
        """Mean variances : (p, k) mm^2 after one more pose, for each of poses `world_from_board` : (p, 4, 4)."""
        added = self.information + informations(self.cameras, self.free, self.noise, poses, points)
        scale = 1 / np.sqrt(np.einsum("pgg->pg", added))
        covariance = np.linalg.inv(added * scale[:, :, None] * scale[:, None, :]) * scale[:, :, None] * scale[:, None, :]
        return np.einsum("kgh,phg->pk", self.forms, covariance)

    def gains(self, poses: Array, points: Array) -> Array:
        """Relative reduction : (p,) of the standard deviations of points by one more pose, their geometric mean."""
        return 1 - np.exp(np.log(self.after(poses, points) / self.variances).mean(axis=1) / 2)


def of_rig(
    cameras: Mapping[str, Camera], noise: Mapping[str, float], poses: Array, points: Array, depths: tuple[float, float]
) -> Knowledge:
    """Knowledge before there is a calibration: the rig's description, and the sightings of poses : (p, 4, 4)."""
    free = free_parameters(list(cameras), dict.fromkeys(cameras, MODELS[TRIED[0]]))
    information = np.diag(np.concatenate([_described(camera, free[device]) for device, camera in cameras.items()]) ** -2.0)
    information += informations(cameras, free, noise, poses, points).sum(axis=0)
    return Knowledge(cameras, free, noise, information, _forms(cameras, free, depths))


def of_calibration(known: Calibration, noise: Mapping[str, float], depths: tuple[float, float]) -> Knowledge:
    """Knowledge by a calibration with a covariance."""
    if known.uncertainty is None:
        raise ValueError("expected a calibration with the covariance of its parameters, found one without")
    names = [name.split(".") for name in known.uncertainty.names]
    free = {device: tuple(name for own, name in names if own == device) for device in known.cameras}
    return Knowledge(known.cameras, free, noise, inverse(known.uncertainty.covariance), _forms(known.cameras, free, depths))


def _described(camera: Camera, names: Sequence[str]) -> Array:
    """Standard deviations : (g,) of parameters of which a rig's description is all that is known."""
    focal, centre_px, turn_rad, shift_mm = 0.1, 100.0, 0.1, 50.0  # standard deviations of what a rig's description says
    spread = {"fx": focal * camera.matrix[0, 0], "fy": focal * camera.matrix[1, 1], "cx": centre_px, "cy": centre_px}
    spread |= dict(zip(MOTION, 3 * [turn_rad] + 3 * [shift_mm], strict=True))
    spread |= dict(zip(names, usual_lenses.largest(camera, names).tolist(), strict=True)) | spread
    return np.array([spread[name] for name in names])


def _forms(cameras: Mapping[str, Camera], free: Free, depths: tuple[float, float]) -> Array:
    """Quadratic forms : (k, g, g) of the points' mean variances."""
    names = tuple(f"{device}.{name}" for device in cameras for name in free[device])
    known = Calibration(cameras, Uncertainty(names, np.eye(len(names))))
    try:
        volume = uncertainty.working_volume(known, np.linspace(*depths, DEPTHS).tolist())
    except ValueError:
        near, far = depths
        raise InputError(
            f"rig: expected views of {', '.join(cameras)} that overlap between {near:.0f} and {far:.0f} mm, found hardly any "
            "point that all see: is the rig described as it stands (rig=NAME), or reach.volume_mm another one?"
        ) from None
    first, *others = cameras
    return np.concatenate([uncertainty.mean_squares(known, first, second, volume) for second in others])


def informations(cameras: Mapping[str, Camera], free: Free, noise: Mapping[str, float], poses: Array, points: Array) -> Array:
    """Information : (p, g, g) on the devices' parameters by each of poses `world_from_board` : (p, 4, 4) of points : (n, 3) mm.

    A device sees what lies in its image. The projector's coordinates are read where camera 1 sees the point; that part of their
    error is camera 1's own, so it is taken out, as in the bundle adjustment.
    """
    own = np.cumsum([0, *(len(free[device]) for device in cameras)])
    count, (p, n) = int(own[-1]), (len(poses), len(points))
    arms = points @ poses[:, :3, :3].swapaxes(1, 2)
    world, motion = arms + poses[:, None, :3, 3], rigid.slopes(arms)
    rows = np.zeros((p, n, len(cameras), 2, count + 6))
    weight = np.zeros((p, n, len(cameras)))
    by_point = {}
    for d, (device, camera) in enumerate(cameras.items()):
        lines = linearise(camera, world.reshape(-1, 3), free[device])
        by_point[device] = lines.by_point.reshape(p, n, 2, 3)
        rows[:, :, d, :, own[d] : own[d + 1]] = lines.by_parameter.reshape(p, n, 2, len(free[device]))
        rows[:, :, d, :, count:] = by_point[device] @ motion
        pixels = lines.pixels.reshape(p, n, 2)
        with np.errstate(invalid="ignore"):
            weight[:, :, d] = ((pixels >= 0) & (pixels <= np.array(camera.size) - 1)).all(axis=-1) / noise[device]
    devices = list(cameras)
    if PROJECTOR in devices[1:]:
        d = devices.index(PROJECTOR)
        on_board = [by_point[device] @ poses[:, None, :3, :2] for device in (devices[0], PROJECTOR)]
        rows[:, :, d] -= on_board[1] @ np.linalg.inv(on_board[0]) @ rows[:, :, 0]
        weight[:, :, d] *= weight[:, :, 0] > 0
    rows = np.where(weight[..., None, None] > 0, rows * weight[..., None, None], 0.0).reshape(p, 2 * n * len(cameras), count + 6)
    normal = rows.swapaxes(1, 2) @ rows
    shared, cross, corner = normal[:, :count, :count], normal[:, :count, count:], normal[:, count:, count:]
    return shared - cross @ np.linalg.solve(corner + TINY * np.eye(6), cross.swapaxes(1, 2))
