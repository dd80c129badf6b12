"""A pose's error by the scale of the board that the cameras were calibrated with."""

from dataclasses import replace

import numpy as np
import pytest

from recon.tracking import pose
from tests.recon.tracking import drawings
from tests.recon.tracking.test_pose import error, seen
from twin.optics.surface_session import calibration_of

SCALE, BOARDS = 3e-4, 60


@pytest.fixture(scope="module")
def cameras(rig):
    known = calibration_of(rig).cameras
    return known["cam1"], known["cam2"]


def misjudged(camera, ratio):
    """The camera as a board would give it whose print is larger or smaller than its design."""
    moved = camera.camera_from_world.copy()
    moved[:3, 3] *= ratio
    return replace(camera, camera_from_world=moved)


def test_the_scale_of_the_board_moves_poses_as_predicted(cameras, rig, rng):
    """Along the ray from camera 1, by as much as is predicted: the mean square of 60 boards is 1 within 4 standard errors."""
    off, across = [], []
    for _ in range(BOARDS):
        true, ratio = drawings.facing(rng), 1 + SCALE * rng.standard_normal()
        views = seen(cameras, rig.target, true)
        views = [replace(view, camera=misjudged(view.camera, ratio)) for view in views]
        found = pose.estimate(*views, rig.target)
        shift = error(found.world_from_target, true)[3:]
        ray = true[:3, 3] / np.linalg.norm(true[:3, 3])
        added = found.at_scale(SCALE).shared - found.shared
        off.append((ray @ shift) ** 2 / (ray @ added[3:, 3:] @ ray))
        across.append(np.linalg.norm(shift - (ray @ shift) * ray))
        assert np.count_nonzero(np.linalg.eigvalsh(added) > 1e-12) == 1
    assert abs(np.mean(off) - 1) < 4 * np.sqrt(2 / BOARDS)
    assert np.max(across) < 0.02
