"""Sets of board sightings by geometry alone: what perfect detection would report, and noise of a known size."""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from recon.board_detection.kinds.asymmetric_circles import AsymmetricCircles
from recon.geometry import rigid
from recon.geometry.camera_jacobian import linearise
from recon.optical_calibration.bundle import Estimate
from recon.optical_calibration.joint_calibration import circle_offsets
from recon.optical_calibration.observations import Observations
from recon.optical_calibration.sightings import Sighting

BOARD = AsymmetricCircles(columns=4, rows=11, spacing_mm=15, diameter_mm=9)
DEVICES = ("cam1", "cam2", "projector")
NOISE = {"cam1": 0.01, "cam2": 0.01, "projector": 0.005}  # px


def devices(rig):
    """The rig's true cameras by name."""
    return {name: getattr(rig, name).optics.camera() for name in DEVICES}


def random_poses(cameras, count, rng, tilt_deg=40.0, points=None):
    """Poses (count, 4, 4) world_from_board in which all devices see the whole board."""
    points = BOARD.points() if points is None else points
    poses = []
    while len(poses) < count:
        direction, tilt = rng.uniform(0, 2 * np.pi), np.deg2rad(rng.uniform(0, tilt_deg))
        axis = [np.cos(direction), np.sin(direction), 0]
        turn = Rotation.from_rotvec(tilt * np.array(axis)) * Rotation.from_rotvec([0, 0, rng.uniform(0, 2 * np.pi)])
        middle = np.array([rng.uniform(-60, 60), rng.uniform(-50, 50), rng.uniform(606, 713)])
        pose = rigid.transform(turn.as_matrix(), middle - turn.apply(points.mean(axis=0)))
        pixels = {name: camera.project(rigid.apply(pose, points)) for name, camera in cameras.items()}
        if all(((pixels[name] > 20) & (pixels[name] < np.array(cameras[name].size) - 20)).all() for name in cameras):
            poses.append(pose)
    return np.array(poses)


def observe(cameras, poses, rng, points=None, noise=NOISE, claimed=NOISE):
    """Observations of a board whose true points are `points`, with true and claimed noise in px by device."""
    design = BOARD.points()
    points = design if points is None else points
    world = [rigid.apply(pose, points) for pose in poses]
    gradient = np.array([projector_by_camera(cameras, pose, at) for pose, at in zip(poses, world, strict=True)])
    pixels = np.stack([[camera.project(at) for at in world] for camera in cameras.values()], axis=2)
    errors = rng.standard_normal(pixels.shape) * np.array([noise[name] for name in cameras])[:, None]
    if "projector" in cameras:
        number = list(cameras).index("projector")
        errors[:, :, number] += np.einsum("pnij,pnj->pni", gradient, errors[:, :, 0])
    covariance = np.array([claimed[name] ** 2 * np.eye(2) for name in cameras])
    return Observations(
        tuple(f"{k:02d}" for k in range(len(poses))),
        tuple(cameras),
        tuple(camera.size for camera in cameras.values()),
        design,
        pixels + errors,
        np.broadcast_to(covariance, (*pixels.shape, 2)).copy(),
        gradient,
    )


def projector_by_camera(cameras, pose, world):
    """Derivative (n, 2, 2) of the projector's pixel by camera 1's, along the board's plane; zero without a projector."""
    if "projector" not in cameras:
        return np.zeros((len(world), 2, 2))
    camera, projector = (linearise(cameras[name], world, ()).by_point @ pose[:3, :2] for name in ("cam1", "projector"))
    return projector @ np.linalg.inv(camera)


def sightings(cameras, poses, rng, **how):
    """The same as a detector of discs would report it: centres of ellipses, and their sizes."""
    seen = observe(cameras, poses, rng, **how)
    offsets = circle_offsets(seen, Estimate(cameras, poses, seen.points), BOARD)
    seen = replace(seen, pixels=seen.pixels + offsets)
    result = []
    for p, pose in enumerate(poses):
        radii = {}
        for name in [name for name in cameras if name != "projector"]:
            by_board = linearise(cameras[name], rigid.apply(pose, seen.points), ()).by_point @ pose[:3, :2]
            radii[name] = np.repeat(BOARD.diameter_mm / 2 * np.sqrt(np.abs(np.linalg.det(by_board)))[:, None], 2, axis=1)
        pixels = {name: seen.pixels[p, :, d] for d, name in enumerate(cameras)}
        covariance = {name: seen.covariance[p, :, d] for d, name in enumerate(cameras)}
        result.append(Sighting(seen.poses[p], pixels, covariance, seen.gradient[p], radii))
    return result


def corners(cameras, poses, board, rng, share=1.0):
    """The same as a detector of corners would report it; each camera sees a share of them, on one side of a line."""
    result = []
    for number, pose in enumerate(poses):
        world = rigid.apply(pose, board.points())
        gradient = projector_by_camera(cameras, pose, world)
        errors = {name: NOISE[name] * rng.standard_normal((len(world), 2)) for name in cameras}
        pixels = {name: camera.project(world) + errors[name] for name, camera in cameras.items()}
        for name in [name for name in cameras if name != "projector"]:
            across = board.points()[:, :2] @ rng.standard_normal(2)
            pixels[name][across > np.quantile(across, share)] = np.nan
        if "projector" in cameras:
            pixels["projector"] += np.einsum("nij,nj->ni", gradient, errors["cam1"])
            pixels["projector"][np.isnan(pixels["cam1"])] = np.nan
        covariance = {
            name: np.where(np.isfinite(at)[..., None], NOISE[name] ** 2 * np.eye(2), np.nan) for name, at in pixels.items()
        }
        result.append(Sighting(f"{number:02d}", pixels, covariance, gradient))
    return result
