"""Accuracy of lens models far from the points: calibrations of one camera from few points, crowded ones, or one side's.

Lenses are drawn like real ones: by OpenCV's polynomial, or by the division model, which a polynomial only approaches.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from recon.board_detection.kinds.asymmetric_circles import AsymmetricCircles
from recon.geometry import rigid
from recon.geometry.camera import Camera
from recon.geometry.camera_jacobian import linearise
from recon.geometry.lens_domain import is_one_to_one
from recon.geometry.usual_lenses import corner_radius
from recon.model.calibration import Calibration
from recon.optical_calibration import uncertainty
from recon.optical_calibration.distortion_selection import ModelName
from recon.optical_calibration.joint_calibration import Settings, calibrate
from twin.experiments.board_sets import drawn
from twin.experiments.calibration_errors import REGION
from twin.experiments.experiment_setup import Figures, Setup

Array = NDArray[np.float64]

SEEDS = range(1000, 1200)  # unseen seeds of point sets
BOARD = AsymmetricCircles(columns=4, rows=11, spacing_mm=8, diameter_mm=5)
SIZE, FOCAL_PX = (1280, 1024), (1000.0, 3400.0)
NOISE_PX = 0.02
COUNTS = (4, 6, 10, 20)  # of poses
PLACES = ("whole", "crowded", "one side")
CROWDED = 0.5  # of the image's width and height, within which all points lie
ACROSS = (0.3, 0.5)  # of the image's height that the board fills
TILT_DEG, BORDER_PX = 40.0, 5.0
GRID_PX = 48  # between the pixels that are judged, all over the image
STEPS = 8  # of Gauss and Newton, to the frame's motion


@dataclass(frozen=True)
class Judged:
    """A lens as found, all over its image and at three depths."""

    inside: float  # share of pixels whose error lies in its predicted 95 % region
    one_to_one: bool


def far_from_points(setup: Setup, lenses: str, sets: int) -> Figures:
    """Lens models chosen automatically, or given though they are too rich for the points."""
    judged = [each(seed, lenses) for seed in SEEDS[:sets]]
    return {
        "judged": len(judged),
        "torn": sum(not one.one_to_one for one in judged),
        "inside": np.mean([one.inside for one in judged]),
    }


def each(seed: int, distortion: ModelName | str) -> Judged:
    """Calibrate one camera from one set of points."""
    rng = np.random.default_rng([seed, 11])
    camera = lens(rng)
    poses = views(camera, PLACES[seed % len(PLACES)], COUNTS[seed // len(PLACES) % len(COUNTS)], rng)
    seen = drawn(Calibration({"cam1": camera}), BOARD, poses, {"cam1": NOISE_PX}, rng)
    settings = Settings.model_validate({"distortion": distortion})
    found = calibrate(seen.sightings, BOARD, seen.sizes, settings).adjustment.calibration
    return Judged(inside(found, camera, poses), is_one_to_one(found.cameras["cam1"], margin=0))


def lens(rng: np.random.Generator) -> Camera:
    """A camera with a lens that bends by some per cent in the corners, and has neither pole nor fold."""
    while True:
        focal = rng.uniform(*FOCAL_PX)
        middle = (np.array(SIZE) - 1) / 2 + 20 * rng.standard_normal(2)
        matrix = np.array([[focal, 0, middle[0]], [0, focal * (1 + 0.003 * rng.standard_normal()), middle[1]], [0, 0, 1]])
        radius = corner_radius(Camera(SIZE, matrix, np.zeros(0)))
        bends = np.array([0.08, 0.02, 0.005]) * rng.standard_normal(3) / radius ** np.array([2, 4, 6])
        aside, division = 0.002 * rng.standard_normal(2) / radius, 0.1 * rng.standard_normal() / radius**2
        polynomial = [*bends[:2], *aside, bends[2]]
        camera = Camera(SIZE, matrix, np.array(polynomial if rng.random() < 0.5 else [0, 0, *aside, 0, division, 0, 0]))
        if is_one_to_one(camera):
            return camera


def views(camera: Camera, place: str, count: int, rng: np.random.Generator) -> Array:
    """Poses `world_from_board` : (count, 4, 4) whose points all lie in a part of the image."""
    low, high = np.zeros(2), np.ones(2)
    if place == "crowded":
        low = rng.uniform(0, 1 - CROWDED, 2)
        high = low + CROWDED
    elif place == "one side":
        (low if rng.random() < 0.5 else high)[rng.integers(2)] = 0.5
    points, size, poses = BOARD.points(), np.array(camera.size), []
    long = np.ptp(points, axis=0).max()
    while len(poses) < count:
        way, tilt = rng.uniform(0, 2 * np.pi), np.deg2rad(rng.uniform(0, TILT_DEG))
        turned = Rotation.from_rotvec(tilt * np.array([np.cos(way), np.sin(way), 0]))
        rotation = (turned * Rotation.from_rotvec([0, 0, rng.uniform(0, 2 * np.pi)])).as_matrix()
        depth = camera.matrix[0, 0] * long / (rng.uniform(*ACROSS) * size[1])
        ray = camera.rays((low + (high - low) * rng.random(2))[None] * size)[0]
        pose = rigid.transform(rotation, ray / ray[2] * depth - rotation @ points.mean(axis=0))
        pixels = camera.project(rigid.apply(pose, points))
        if ((pixels > np.maximum(low * size, BORDER_PX)) & (pixels < np.minimum(high * size, size - BORDER_PX))).all():
            poses.append(pose)
    return np.array(poses)


def inside(found: Calibration, truth: Camera, poses: Array) -> float:
    """Share of pixels all over the image, at three depths, whose error lies in its predicted region; the frame's motion apart."""
    camera, board = found.cameras["cam1"], np.concatenate([rigid.apply(pose, BOARD.points()) for pose in poses])
    rays = truth.rays(truth.pixel_grid()[GRID_PX // 3 :: GRID_PX, GRID_PX // 3 :: GRID_PX].reshape(-1, 2))
    world = np.concatenate([rays / rays[:, 2:] * depth for depth in np.quantile(board[:, 2], (0.05, 0.5, 0.95))])
    motion = np.eye(4)
    for _ in range(STEPS):
        moved = rigid.apply(motion, board)
        lines = linearise(camera, moved, ())
        slopes = (lines.by_point @ uncertainty.rigid_modes(moved)).reshape(-1, 6)
        step = np.linalg.lstsq(slopes, (truth.project(board) - lines.pixels).ravel(), rcond=None)[0]
        motion = rigid.from_rotation_vector(step[3:], step[:3]) @ motion
    error = camera.project(rigid.apply(motion, world)) - truth.project(world)
    covariance = uncertainty.projection(found, "cam1", world, board)
    squared = np.einsum("ki,ki->k", error, np.linalg.solve(covariance, error[..., None])[..., 0])
    return float(np.mean(squared < chi2.ppf(REGION, 2)))
