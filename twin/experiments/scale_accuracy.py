"""Accuracy of the scale that a calibration takes from its board, over drawn boards, poses, devices and detectors."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from recon.board_detection.kinds.asymmetric_circles import AsymmetricCircles
from recon.board_detection.kinds.chessboard import Chessboard
from recon.board_detection.kinds.symmetric_circles import SymmetricCircles
from recon.errors import InputError
from recon.geometry import rigid
from recon.geometry.camera import Camera
from recon.model.boards import Board
from recon.model.calibration import Calibration
from recon.model.rig import Rig
from recon.optical_calibration import uncertainty
from recon.optical_calibration.figures_of_merit import devices_that_measure
from recon.optical_calibration.joint_calibration import Result, Settings, Shape, calibrate
from twin.experiments.board_accuracy import misshapen
from twin.experiments.board_sets import BoardSet, drawn
from twin.experiments.calibration_errors import DEPTHS, point_errors
from twin.experiments.experiment_setup import Figures, Setup
from twin.optics.surface_session import calibration_of

Array = NDArray[np.float64]

BOARDS = range(2000, 2300)  # seeds
CHOICES = (("cam1",), ("cam1", "cam2"), ("cam1", "projector"), ("cam1", "cam2", "projector"))
SIDE_MM = 140.0  # of the board that the rig is made for; of others the rig is larger or smaller
SPACING_MM, PRINT_MM, BOW = (3.0, 40.0), (0.002, 0.2), (5e-4, 1e-2)  # each size as likely; the bow in parts of the side
STRETCH = 5e-4  # standard deviation of half the difference between the axes' scales, and of the shear
NOISE_PX, CLAIMED = (0.005, 0.05), (0.3, 3.0)  # of detections, and what detection claims of that


@dataclass(frozen=True)
class Scaled:
    """Scale of one calibration."""

    error: float  # ratio, less 1
    sigma: float  # as stated
    designed: float  # error of the scale with the board taken as designed


def drawn_boards(setup: Setup) -> Figures:
    """The scale's errors over what is stated of them, and beside those of boards taken as designed."""
    found = [calibrated(setup.rig, seed) for seed in BOARDS]
    accepted = [one for one in found if one is not None]
    error, sigma, designed = np.array([(one.error, one.sigma, one.designed) for one in accepted]).T
    return {
        "boards": len(found),
        "refused": len(found) - len(accepted),
        "within": np.mean(abs(error) <= 3 * sigma),
        "worse": worse(accepted),
        "error_percent": 100 * abs(error).max(),
        "designed_percent": 100 * abs(designed).max(),
    }


def worse(found: list[Scaled]) -> int:
    """Number of calibrations that are worse than those of the board as designed by more than their stated sigma."""
    return sum(abs(one.error) > abs(one.designed) + one.sigma for one in found)


def calibrated(rig: Rig, seed: int) -> Scaled | None:
    """One board, its poses and their noise, calibrated by default and with the board as designed; None if it is refused."""
    rng = np.random.default_rng([seed, 9])
    board, seen = _drawn(rig, rng)
    try:
        found, designed = (
            calibrate(seen.sightings, board, seen.sizes, Settings(distortion="brown", shape=Shape(released=released)))
            for released in (True, False)
        )
    except InputError:
        return None
    return Scaled(*_scale(found, seen), _scale(designed, seen)[0])


def _drawn(rig: Rig, rng: np.random.Generator) -> tuple[Board, BoardSet]:
    """A board as designed, and sightings of it as it is."""
    spacing, off, bow, noise, claimed = (_log_uniform(rng, *limits) for limits in (SPACING_MM, PRINT_MM, BOW, NOISE_PX, CLAIMED))
    columns, rows = (min(int(rng.integers(6, most)), 2 + int(SIDE_MM / spacing)) for most in (12, 10))
    board: Board = [
        Chessboard(columns=columns, rows=rows, square_mm=spacing),
        SymmetricCircles(columns=columns, rows=rows, spacing_mm=spacing, diameter_mm=0.6 * spacing),
        AsymmetricCircles(columns=(columns + 1) // 2, rows=rows, spacing_mm=spacing, diameter_mm=0.6 * spacing),
    ][rng.integers(3)]
    design = board.points()
    side = float(np.ptp(design, axis=0).max())
    devices = CHOICES[rng.integers(len(CHOICES))]
    whole = calibration_of(rig).cameras
    truth = {name: _larger(whole[name], side / SIDE_MM) for name in devices}
    points = misshapen(design, bow * side, off, rng)
    aspect, shear = STRETCH * rng.standard_normal(2)
    points[:, :2] += (design - design.mean(axis=0))[:, :2] @ np.array([[aspect, shear], [shear, -aspect]])
    poses = _poses(truth, design, side / SIDE_MM, int(rng.integers(5, 35)), rng)
    claims = dict.fromkeys(devices, claimed * noise)
    return board, drawn(Calibration(truth), board, poses, claims, rng, points, times=1 / claimed)


def _log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    """A number between two, each size as likely."""
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def _larger(camera: Camera, times: float) -> Camera:
    """The camera of a rig that is larger."""
    place = camera.camera_from_world.copy()
    place[:3, 3] *= times
    return Camera(camera.size, camera.matrix, camera.distortion, place)


def _poses(cameras: Mapping[str, Camera], design: Array, times: float, count: int, rng: np.random.Generator) -> Array:
    """Poses : (count, 4, 4) world_from_board in which all devices see a whole board; the rig is larger by times."""
    poses: list[Array] = []
    while len(poses) < count:
        way, tilt = rng.uniform(0, 2 * np.pi), np.deg2rad(40) * np.sqrt(rng.uniform())
        axis = np.array([np.cos(way), np.sin(way), 0])
        turn = Rotation.from_rotvec(tilt * axis) * Rotation.from_rotvec([0, 0, rng.uniform(0, 2 * np.pi)])
        middle = times * rng.uniform([-60, -50, 606], [60, 50, 713])
        pose = rigid.transform(turn.as_matrix(), middle - turn.apply(design.mean(axis=0)))
        pixels = {name: camera.project(rigid.apply(pose, design)) for name, camera in cameras.items()}
        if all(((pixels[name] > 0) & (pixels[name] < np.array(camera.size) - 1)).all() for name, camera in cameras.items()):
            poses.append(pose)
    return np.array(poses)


def _scale(result: Result, seen: BoardSet) -> tuple[float, float]:
    """Error of lengths that are measured, and its stated standard deviation; of one camera alone, those of its board."""
    found = result.adjustment.calibration
    if len(found.cameras) == 1:
        design = result.observations.points - result.observations.points.mean(axis=0)
        off = result.adjustment.points - seen.points
        return float((off * design).sum() / (design**2).sum()), result.tolerances.scale_sigma(design)
    pair = devices_that_measure(found)
    size = float(np.ptp(result.observations.points, axis=0).max()) / SIDE_MM
    volume = uncertainty.working_volume(seen.truth, [size * depth for depth in DEPTHS])
    modes = uncertainty.similarity_modes(volume)
    errors = point_errors(found, seen.truth, pair, volume)
    error = np.linalg.lstsq(modes.reshape(-1, 7), errors.ravel(), rcond=None)[0][-1]
    return float(error), uncertainty.scale(found, *pair, volume)
