"""The calibration so far is there as soon as the poses determine it, and is as exact as it says."""

from dataclasses import replace

import numpy as np
import pytest

from recon.board_guidance.pose_progress import SoFar, held, with_sighting
from recon.errors import InputError
from recon.geometry import rigid
from tests.recon.board_guidance.held_boards import kept, posed, seen, spread
from tests.recon.board_sets import BOARD, NOISE, devices


def test_a_few_tilted_boards_calibrate_within_the_predicted_errors(rig, rng):
    so_far = kept(rig, spread(rig, 6, rng), rng)
    assert so_far.calibration is not None
    for name, camera in devices(rig).items():
        error = so_far.calibration.cameras[name].matrix[0, 0] - camera.matrix[0, 0]
        assert abs(error) < 5 * so_far.calibration.uncertainty.sigma(f"{name}.fx")


def test_the_noise_is_measured(rig, rng):
    so_far = kept(rig, spread(rig, 6, rng), rng)
    for name, sigma in NOISE.items():  # 500 numbers a device, less the unknowns
        assert so_far.noise[name] == pytest.approx(sigma, rel=0.15)


def test_parallel_boards_make_no_calibration(rig, rng):
    """The poses are known all the same, by the rig's description."""
    poses = [posed((x, y, 660)) for x, y in ((0, 0), (-30, 10), (30, -10), (10, 20))]
    so_far = kept(rig, poses, rng)
    assert so_far.calibration is None
    np.testing.assert_allclose(so_far.poses[:, :3, 3], np.array(poses)[:, :3, 3], atol=0.2)


def test_a_rig_unlike_its_description_is_calibrated_all_the_same(rig, rng):
    """Lenses of 5 % more focal length, and a camera 2 some cm aside."""
    optics = rig.cam2.optics
    moved = optics.device_from_world.model_copy(update={"translation_mm": (-140.0, 5.0, 40.0)})
    wrong = optics.model_copy(update={"focal_px": (3500.0, 3500.0), "device_from_world": moved})
    described = rig.model_copy(update={"cam2": rig.cam2.model_copy(update={"optics": wrong})})
    so_far = SoFar(described, BOARD)
    for sighting in seen(rig, spread(rig, 5, rng), rng):
        so_far = with_sighting(so_far, sighting)
    assert so_far.calibration is not None
    assert so_far.calibration.cameras["cam2"].matrix[0, 0] == pytest.approx(3318, abs=10)


def test_the_held_pose_is_found_by_camera_1_alone(rig, rng):
    pose = posed((20, -10, 640), (15, -20), 80)
    found = held(seen(rig, [pose], rng)[0], SoFar(rig, BOARD))
    step = rigid.difference(pose, found)
    assert np.linalg.norm(step[3:]) < 0.3 and np.rad2deg(np.linalg.norm(step[:3])) < 0.1


def test_a_sighting_without_camera_1_is_refused(rig, rng):
    sighting = seen(rig, [posed((0, 0, 660))], rng)[0]
    blind = replace(sighting, pixels={name: at for name, at in sighting.pixels.items() if name != "cam1"})
    assert held(blind, SoFar(rig, BOARD)) is None
    with pytest.raises(InputError, match="camera 1"):
        with_sighting(SoFar(rig, BOARD), blind)


def test_a_pose_that_one_device_does_not_see_may_be_kept(rig, rng):
    so_far = kept(rig, spread(rig, 5, rng), rng)
    sighting = seen(rig, spread(rig, 1, rng), rng)[0]
    blind = replace(sighting, pixels={name: at for name, at in sighting.pixels.items() if name != "cam2"})
    extended = with_sighting(so_far, blind)
    assert len(extended.poses) == 6 and extended.misfit[-1, 1] == 0
    assert extended.calibration.uncertainty.sigma("cam1.fx") < so_far.calibration.uncertainty.sigma("cam1.fx")
