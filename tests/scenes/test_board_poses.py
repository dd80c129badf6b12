"""Random poses against what they are for: every device sees every circle, and the set fills views, depths and directions."""

import numpy as np
import pytest
from pydantic import ValidationError

from recon.errors import InputError
from recon.geometry import rigid
from scenes.board_poses import Config, random_poses
from scenes.kinds import board

DESIGN = board.design(board.Config())


@pytest.fixture(scope="module")
def devices(rig):
    return [device.optics.camera() for device in (rig.cam1, rig.cam2, rig.projector)]


@pytest.fixture(scope="module")
def poses(devices):
    return random_poses(Config(), DESIGN, devices)


def circles(poses) -> np.ndarray:
    """Rims of all circles : (p, n, 32, 3) mm in the world."""
    turn = np.linspace(0, 2 * np.pi, 32, endpoint=False)
    rim = DESIGN.diameter_mm / 2 * np.column_stack([np.cos(turn), np.sin(turn), 0 * turn])
    return np.stack([rigid.apply(pose, DESIGN.points()[:, None] + rim) for pose in poses])


def test_every_device_sees_every_circle_whole(poses, devices):
    """And from the front: the board's z axis, away from the viewer, points away from each device."""
    for device in devices:
        pixels = device.project(circles(poses))
        room = np.minimum(pixels, np.array(device.size) - 1 - pixels)
        assert room.min() > Config().margin_px - 0.01
        away = poses[:, :3, 3] - device.centre
        assert ((away * poses[:, :3, 2]).sum(axis=1) > 0).all()


def test_depths_tilts_and_turns_are_as_asked(poses):
    """Middles spread over the depth range, tilts up to the limit, in all directions, with all turns, half turns too."""
    points = DESIGN.points()
    depths = middles(poses, (points.min(axis=0) + points.max(axis=0)) / 2)[:, 2]
    assert depths.min() >= 606 and depths.max() <= 713
    assert np.histogram(depths, 6, (606, 713))[0].min() >= 3
    tilt = np.rad2deg(np.arccos(poses[:, 2, 2]))
    assert tilt.max() <= 40 and tilt.max() > 35 and np.median(tilt) > 20
    for x, y in ((poses[:, 0, 2], poses[:, 1, 2]), (poses[:, 0, 0], poses[:, 1, 0])):
        quadrants = np.floor(np.arctan2(y, x) / (np.pi / 2))
        assert np.unique(quadrants, return_counts=True)[1].min() >= 4


def middles(poses, middle) -> np.ndarray:
    return np.stack([rigid.apply(pose, middle) for pose in poses])


def test_the_set_fills_both_views(poses, devices):
    """In each of 5 x 4 cells of either camera's image stand circles: distortion is seen in the corners too."""
    centres = circles(poses).mean(axis=2)
    for camera in devices[:2]:
        pixels = camera.project(centres).reshape(-1, 2)
        counts, _, _ = np.histogram2d(*pixels.T, bins=(5, 4), range=[[0, camera.size[0]], [0, camera.size[1]]])
        assert counts.min() >= 8


def test_a_pose_depends_on_its_number_and_the_seed_alone(poses, devices):
    """Fewer poses are the first ones; another seed gives others."""
    np.testing.assert_array_equal(random_poses(Config(count=5), DESIGN, devices), poses[:5])
    assert not np.allclose(random_poses(Config(count=1, seed=2), DESIGN, devices), poses[:1])


def test_a_board_that_is_too_large_is_refused(devices):
    large = board.design(board.Config(spacing_mm=30))
    with pytest.raises(InputError, match=r"poses\.depth_mm: expected room for the board in all views, found none at 6\d\d mm"):
        random_poses(Config(count=1), large, devices)


def test_depths_the_wrong_way_round_are_refused():
    with pytest.raises(ValidationError, match="expected the nearer depth first, found 700, 600"):
        Config(depth_mm=(700, 600))
