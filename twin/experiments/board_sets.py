"""Sets of board sightings whose truth is known: of rendered images, or drawn as points with noise of a known size."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cache, lru_cache, partial
from time import perf_counter

import numpy as np

from recon.geometry import rigid
from recon.geometry.camera import Array, Camera
from recon.geometry.camera_jacobian import linearise
from recon.model.boards import Board, Discs
from recon.model.calibration import Calibration
from recon.model.rig import Rig
from recon.optical_calibration.board_frames import MOST_AT_ONCE
from recon.optical_calibration.bundle import Estimate
from recon.optical_calibration.joint_calibration import Result, Settings, calibrate, circle_offsets
from recon.optical_calibration.observations import PROJECTOR, Observations, Size
from recon.optical_calibration.sightings import Sighting, sight
from recon.threads import mapped
from scenes.board_poses import Config as Poses
from scenes.board_poses import random_poses
from scenes.kinds import board
from twin import board_session
from twin.board_session import CAMERAS, FRINGE_CAMERA
from twin.optics.surface_session import calibration_of
from twin.sensor import Numbers

HELD = 12  # poses whose images are held at once, of 66 MB each
Shot = tuple[dict[str, Numbers], dict[str, Numbers]]  # of a pose: by camera, lit (h, w), and under fringes (n, h, w)


@dataclass(frozen=True)
class BoardSet:
    """Observations of a board, and the truth."""

    sightings: tuple[Sighting, ...]  # (p,)
    board: Board  # as designed
    truth: Calibration
    poses: Array  # (p, 4, 4) world_from_board
    points: Array  # (n, 3) mm, the board as it is
    lit: tuple[dict[str, Numbers], ...] = ()  # (p,) camera: (h, w) DN, of rendered sets
    seconds: float = 0.0  # in which the board was found and its fringes decoded, some poses at once

    @property
    def sizes(self) -> dict[str, Size]:
        """Image sizes of the devices."""
        return {name: camera.size for name, camera in self.truth.cameras.items()}

    def first(self, count: int) -> "BoardSet":
        """The first poses."""
        return replace(self, sightings=self.sightings[:count], poses=self.poses[:count], lit=self.lit[:count])


@lru_cache(maxsize=3)
def rendered(settings: board_session.Settings) -> BoardSet:
    """Render a session pose by pose and find the board in each; of the images only the lit ones are kept."""
    stage = board_session.set_up(settings)
    placed = board_session.place_all(settings)
    exposures = board_session.set_exposures(stage, settings)
    bits: dict[str, int] = {camera: exposure.bits for camera, exposure in exposures.items()}
    design = board.design(settings.board)
    sightings, images, seconds = [], [], 0.0
    for first in range(0, len(placed), HELD):
        shot = {
            number: board_session.shoot_pose(stage, settings, exposures, number, placed[number])
            for number in range(first, min(first + HELD, len(placed)))
        }
        start = perf_counter()
        sightings += mapped(partial(_look, shot, settings, bits), shot, most=MOST_AT_ONCE)
        seconds += perf_counter() - start
        images += [lit for lit, _ in shot.values()]
        shot.clear()  # before the next are rendered
    centres = board.printed_centres(settings.printed)
    return BoardSet(tuple(sightings), design, calibration_of(settings.rig), placed, centres, tuple(images), seconds)


def _look(shot: Mapping[int, Shot], settings: board_session.Settings, bits: Mapping[str, int], number: int) -> Sighting:
    """Find the board in the images of a pose."""
    lit, fringes = shot[number]
    name, design = board_session.pose_name(number), board.design(settings.board)
    return sight(name, design, lit, fringes[FRINGE_CAMERA], settings.patterns, bits)


def drawn(
    truth: Calibration,
    design: Board,
    poses: Array,
    noise: Mapping[str, float],
    rng: np.random.Generator,
    points: Array | None = None,
    times: float = 1.0,
) -> BoardSet:
    """Simulated detections of discs or corners, with noise of known size.

    Parameters
    ----------
    poses : (p, 4, 4)
        world_from_board.
    noise : device -> px
        Standard deviation in u and v; for the projector, if there is one, that of the fringes alone, to which the camera's
        error at the pixel where they are read is added.
    points : (n, 3) or (p, n, 3) mm, optional
        The board as it is, in all poses or in each; as designed if not given.
    times : float
        Of the noise that the detections claim, which is drawn; 0 draws none.
    """
    points = design.points() if points is None else points
    exact = exact_observations(truth.cameras, points, poses, noise)
    errors = times * rng.standard_normal(exact.pixels.shape) * np.array([noise[name] for name in exact.devices])[:, None]
    if PROJECTOR in exact.devices:
        errors[:, :, exact.devices.index(PROJECTOR)] += np.einsum("pnij,pnj->pni", exact.gradient, errors[:, :, 0])
    usual = points if points.ndim == 2 else points.mean(axis=0)
    pixels = exact.pixels + circle_offsets(exact, Estimate(truth.cameras, poses, usual), design) + errors
    sightings = tuple(
        Sighting(
            exact.poses[p],
            {name: pixels[p, :, d] for d, name in enumerate(exact.devices)},
            {name: exact.covariance[p, :, d] for d, name in enumerate(exact.devices)},
            exact.gradient[p],
            {
                name: disc_radii(camera, pose, design)
                for name, camera in truth.cameras.items()
                if name in CAMERAS and isinstance(design, Discs)
            },
        )
        for p, pose in enumerate(poses)
    )
    return BoardSet(sightings, design, truth, poses, usual)


@cache
def recalibrated(rig: Rig, noise: tuple[tuple[str, float], ...], draws: int, count: int) -> tuple[tuple[BoardSet, Result], ...]:
    """Calibrations of independent sets, with new poses and new noise each; five coefficients of distortion a device.

    noise : (device, px) pairs, as in `drawn`.
    """
    truth, design = calibration_of(rig), board.design(board.Config())
    results = []
    for k in range(draws):
        poses = random_poses(Poses(count=count, seed=100 + k), design, list(truth.cameras.values()))
        seen = drawn(truth, design, poses, dict(noise), np.random.default_rng([7, k]))
        results.append((seen, calibrate(seen.sightings, design, seen.sizes, Settings(distortion="brown"))))
    return tuple(results)


def exact_observations(cameras: Mapping[str, Camera], points: Array, poses: Array, noise: Mapping[str, float]) -> Observations:
    """Where the devices see points : (n, 3) or (p, n, 3) mm of the board, without noise, but with its covariance."""
    world = [
        rigid.apply(pose, own) for pose, own in zip(poses, np.broadcast_to(points, (len(poses), *points.shape[-2:])), strict=True)
    ]
    pixels = np.stack([[camera.project(at) for at in world] for camera in cameras.values()], axis=2)
    covariance = np.array([noise[name] ** 2 * np.eye(2) for name in cameras])
    gradient = np.zeros((len(poses), points.shape[-2], 2, 2))
    if PROJECTOR in cameras:
        for k, (pose, at) in enumerate(zip(poses, world, strict=True)):
            by_camera = on_board(cameras[FRINGE_CAMERA], pose, at)
            gradient[k] = on_board(cameras[PROJECTOR], pose, at) @ np.linalg.inv(by_camera)
    return Observations(
        tuple(board_session.pose_name(k) for k in range(len(poses))),
        tuple(cameras),
        tuple(camera.size for camera in cameras.values()),
        points if points.ndim == 2 else points.mean(axis=0),
        pixels,
        np.broadcast_to(covariance, (*pixels.shape, 2)).copy(),
        gradient,
    )


def on_board(camera: Camera, pose: Array, world: Array) -> Array:
    """Derivatives of pixels along the board's plane at points : (n, 3) mm in the world : (n, 2, 2) px/mm."""
    return linearise(camera, world, ()).by_point @ pose[:3, :2]


def disc_radii(camera: Camera, pose: Array, design: Discs) -> Array:
    """Semi-axes of the discs' images, both the radius of a circle of the same area : (n, 2) px."""
    magnified = np.abs(np.linalg.det(on_board(camera, pose, rigid.apply(pose, design.points()))))
    return np.repeat(design.diameter_mm / 2 * np.sqrt(magnified)[:, None], 2, axis=1)


def measured_noise(result: Result) -> tuple[tuple[str, float], ...]:
    """Noise of a sighting in u and v, (device, px): as the detection predicts it, scaled to the residuals."""
    levels = []
    for d, device in enumerate(result.observations.devices):
        seen = result.observations.seen[:, :, d]
        variance = np.trace(result.observations.covariance[:, :, d][seen], axis1=1, axis2=2).mean() / 2
        levels.append((device, result.adjustment.noise[device] * float(np.sqrt(variance))))
    return tuple(levels)
