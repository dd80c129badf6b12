"""Sightings and photographs of a board in poses of the tests' choice."""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from recon.board_guidance.board_room import middle
from recon.board_guidance.pose_progress import SoFar, with_sighting
from recon.geometry import rigid
from tests.recon import board_views
from tests.recon.board_sets import BOARD, devices, random_poses, sightings


def posed(at, tilt_deg=(0.0, 0.0), turn_deg=0.0):
    """world_from_board : (4, 4), its middle at a place, mm; tilted about x and about y, after a turn in its plane."""
    turned = Rotation.from_rotvec(np.deg2rad([*tilt_deg, 0])) * Rotation.from_rotvec(np.deg2rad([0, 0, turn_deg]))
    return rigid.transform(turned.as_matrix(), np.array(at, float) - turned.apply(middle(BOARD)))


def seen(rig, poses, rng):
    """Sightings of poses, named by their numbers."""
    return [replace(one, name=f"{k:02d}") for k, one in enumerate(sightings(devices(rig), np.array(poses), rng))]


def kept(rig, poses, rng):
    """The calibration so far, by sightings of poses."""
    so_far = SoFar(rig, BOARD)
    for sighting in seen(rig, poses, rng):
        so_far = with_sighting(so_far, sighting)
    return so_far


def spread(rig, count, rng):
    """Poses that all devices see."""
    return random_poses(devices(rig), count, rng)


def photograph(camera, board, pose, rng):
    """A sharp view of a board by a camera without distortion, DN, with noise."""
    to_board = np.linalg.inv(camera.matrix @ np.column_stack([pose[:3, :2], pose[:3, 3]]))
    mapped = np.dstack([camera.pixel_grid(), np.ones(camera.size[::-1])]) @ to_board.T
    white = board_views.shares(board, mapped[..., :2] / mapped[..., 2:], footprint=pose[2, 3] / camera.matrix[0, 0])
    return np.float32(30 + 150 * white + 0.5 * rng.standard_normal(white.shape))
