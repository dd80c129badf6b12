"""The calibration so far: the sightings that were kept, and what they determine, adjusted anew with each one."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import cv2
import numpy as np

from recon.board_guidance.next_pose import NOISE_PX, described
from recon.errors import InputError
from recon.geometry import rigid
from recon.geometry.camera import Array, Camera
from recon.model.boards import Board
from recon.model.calibration import Calibration
from recon.model.rig import Rig
from recon.optical_calibration import initial_estimate
from recon.optical_calibration.adjustment import Adjustment, adjust, free_parameters
from recon.optical_calibration.bundle import Estimate
from recon.optical_calibration.distortion_selection import MODELS, TRIED
from recon.optical_calibration.joint_calibration import circle_offsets
from recon.optical_calibration.observations import Observations, Size
from recon.optical_calibration.optical_checks import FEWEST_POSES
from recon.optical_calibration.sightings import ENOUGH, Sighting, gather

BAD_POSE = 5.0  # times the noise: as in `joint_calibration`


@dataclass(frozen=True)
class SoFar:
    """Sightings that were kept, and the calibration by them."""

    rig: Rig
    board: Board
    sightings: tuple[Sighting, ...] = ()
    calibration: Calibration | None = None  # with its covariance; None until the poses determine all devices
    poses: Array = field(default_factory=lambda: np.zeros((0, 4, 4)))  # (p, 4, 4) world_from_board, by it or by the description
    noise: Mapping[str, float] = field(default_factory=lambda: dict(NOISE_PX))  # px, of a sighting in u and v, of each device
    misfit: Array = field(default_factory=lambda: np.zeros((0, 3)))  # (p, d) median residual of each pose over the noise

    @property
    def cameras(self) -> Mapping[str, Camera]:
        """The devices as far as they are known."""
        return described(self.rig, self.noise) if self.calibration is None else self.calibration.cameras

    @property
    def sizes(self) -> dict[str, Size]:
        """Image sizes of the devices."""
        return {name: camera.size for name, camera in self.cameras.items()}


def with_sighting(so_far: SoFar, sighting: Sighting) -> SoFar:
    """Add a sighting, and adjust all.

    Raises
    ------
    InputError
        If camera 1 sees too little of the board to place it.
    """
    if held(sighting, so_far) is None:
        raise InputError(
            f"{sighting.name}: expected camera 1 to see {ENOUGH} points of the board or more, found fewer; show all of it"
        )
    return _adjust(replace(so_far, sightings=(*so_far.sightings, sighting)))


def held(sighting: Sighting, so_far: SoFar) -> Array | None:
    """Pose `world_from_board` : (4, 4) of a board that camera 1 sees, by its points alone; None if it sees too few."""
    pixels = sighting.pixels.get("cam1")
    if pixels is None:
        return None
    seen, camera = np.isfinite(pixels).all(axis=1), so_far.cameras["cam1"]
    if seen.sum() < ENOUGH:
        return None
    found, turn, shift = cv2.solvePnP(so_far.board.points()[seen], camera.undistort(pixels[seen]), np.eye(3), None)
    return rigid.from_rotation_vector(np.ravel(turn), np.ravel(shift)) if found else None


def _adjust(so_far: SoFar) -> SoFar:
    """Adjust all devices to all sightings, if they determine them; else lay the poses by the rig's description."""
    poses = np.array([held(sighting, so_far) for sighting in so_far.sightings])
    so_far = replace(so_far, poses=poses, misfit=np.zeros((len(poses), len(so_far.sizes))))
    observations = gather(so_far.sightings, so_far.board, so_far.sizes)
    sees = observations.seen.any(axis=1).sum(axis=0)
    if len(observations.devices) < len(so_far.sizes) or sees.min() < FEWEST_POSES:
        return so_far
    try:
        start = _start(so_far, observations)
        offsets = circle_offsets(observations, start, so_far.board)
        free = free_parameters(observations.devices, dict.fromkeys(observations.devices, MODELS[TRIED[0]]))
        found = adjust(observations, start, free, offsets)
    except (ValueError, cv2.error):  # the poses don't determine the devices yet
        return so_far
    if not _is_sure(found.calibration):
        return so_far
    nothing = ~observations.seen.any(axis=1, keepdims=True)  # of a pose that was kept though a device doesn't see it
    misfit = np.nanmedian(np.where(nothing, 0.0, found.normalised), axis=1)
    return replace(so_far, calibration=found.calibration, poses=found.poses, noise=_noise(observations, found), misfit=misfit)


def _start(so_far: SoFar, observations: Observations) -> Estimate:
    """Where the adjustment begins: the calibration before, or each device by itself."""
    if so_far.calibration is None:
        return initial_estimate.estimate(observations)
    return Estimate(so_far.calibration.cameras, so_far.poses, observations.points)


def _is_sure(found: Calibration) -> bool:
    """Whether all focal lengths are known better than from a description."""
    assert found.uncertainty is not None
    focal = [(found.uncertainty.sigma(f"{name}.fx"), camera.matrix[0, 0]) for name, camera in found.cameras.items()]
    # relative standard deviation of focal lengths from which on the poses are trusted more than the description
    sure_focal = 0.02
    return all(sigma < sure_focal * length for sigma, length in focal)


def _noise(observations: Observations, found: Adjustment) -> dict[str, float]:
    """Noise of a sighting in u and v, px, by device: as detection predicts it, scaled to the residuals."""
    levels = {}
    for d, device in enumerate(observations.devices):
        variance = np.trace(observations.covariance[:, :, d][observations.seen[:, :, d]], axis1=1, axis2=2).mean() / 2
        levels[device] = found.noise[device] * float(np.sqrt(variance))
    return levels
