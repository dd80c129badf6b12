"""Informations of poses are those of the bundle adjustment, and say what a calibration with them would be worth."""

import numpy as np
import pytest

from recon.board_guidance.pose_information import informations, of_calibration, of_rig
from recon.errors import InputError
from recon.model.calibration import Calibration
from recon.optical_calibration import uncertainty
from recon.optical_calibration.adjustment import adjust, free_parameters
from recon.optical_calibration.bundle import Estimate, Problem, linear_system
from recon.optical_calibration.distortion_selection import MODELS
from tests.recon.board_guidance.held_boards import posed, spread
from tests.recon.board_sets import BOARD, DEVICES, NOISE, devices, observe

DEPTHS = (606.0, 713.0)
BROWN = dict.fromkeys(DEVICES, MODELS["brown"])
NONE = np.zeros((0, 4, 4))


def test_the_sum_of_informations_is_the_bundle_adjustment_s(rig, rng):
    """Slow and plain: the normal equations of the adjustment itself, its poses eliminated."""
    cameras, poses, free = devices(rig), spread(rig, 4, rng), free_parameters(DEVICES, BROWN)
    exact = observe(cameras, poses, rng, noise=dict.fromkeys(DEVICES, 0.0))
    problem = Problem(exact, np.zeros_like(exact.pixels), free)
    expected, _ = linear_system(problem, Estimate(cameras, poses, BOARD.points()), np.ones(3)).equations.reduced()
    found = informations(cameras, free, NOISE, poses, BOARD.points()).sum(axis=0)
    scale = np.sqrt(np.diag(expected))
    np.testing.assert_allclose(found / np.outer(scale, scale), expected / np.outer(scale, scale), atol=1e-3)  # of FLOOR_PX


def test_points_outside_an_image_tell_nothing(rig, rng):
    """Of a board half beside camera 2's image and wholly beside the projector's."""
    cameras, free = devices(rig), free_parameters(DEVICES, BROWN)
    both = informations(cameras, free, NOISE, np.array([posed((0, 0, 660)), posed((400, 0, 660))]), BOARD.points())
    names = [device for device in DEVICES for _ in free[device]]
    assert np.abs(both[0]).max() > 0
    assert np.abs(both[1][names.index("projector") :, names.index("projector") :]).max() == 0


def test_variances_are_those_that_an_adjustment_predicts(rig, rng):
    cameras, poses = devices(rig), spread(rig, 8, rng)
    seen = observe(cameras, poses, rng)
    found = adjust(seen, Estimate(cameras, poses, seen.points), free_parameters(DEVICES, BROWN)).calibration
    known = of_calibration(found, NOISE, DEPTHS)
    volume = uncertainty.working_volume(found, [606, 659.5, 713])
    expected = []
    for second in ("cam2", "projector"):
        pair = "cam1", second
        expected.append(np.trace(uncertainty.triangulation(found, *pair, volume), axis1=1, axis2=2).mean())
        expected.append(np.trace(uncertainty.shape(found, *pair, volume, volume), axis1=1, axis2=2).mean())
    np.testing.assert_allclose(known.variances, expected, rtol=1e-6)


def test_the_predicted_gain_is_the_gain(rig, rng):
    """What a ninth pose is said to add is what the adjustment of nine poses predicts, within what noise changes."""
    cameras, poses = devices(rig), spread(rig, 9, rng)
    seen, free = observe(cameras, poses, rng), free_parameters(DEVICES, BROWN)
    eight, nine = (
        adjust(seen.of_poses(range(count)), Estimate(cameras, poses[:count], seen.points), free).calibration for count in (8, 9)
    )
    before, after = (of_calibration(found, NOISE, DEPTHS).variances for found in (eight, nine))
    predicted = of_calibration(eight, NOISE, DEPTHS).after(poses[8:], BOARD.points())[0]
    np.testing.assert_allclose(predicted, after, rtol=0.15)  # the noise is measured on 2000 numbers, the lens's prior moves too
    assert (after < before).all()


def test_before_a_calibration_any_pose_helps_and_tilted_ones_more(rig):
    cameras = devices(rig)
    known = of_rig(cameras, NOISE, np.array([posed((0, 0, 660))]), BOARD.points(), DEPTHS)
    straight, tilted = known.gains(np.array([posed((0, 0, 640)), posed((0, 0, 660), (25, 25))]), BOARD.points())
    assert 0 < straight < tilted < 1


def test_a_calibration_without_covariance_is_refused(rig):
    with pytest.raises(ValueError, match="covariance"):
        of_calibration(Calibration(devices(rig)), NOISE, DEPTHS)


def test_views_that_do_not_overlap_are_refused_with_the_way_on(rig):
    with pytest.raises(InputError, match=r"overlap between 50 and 60 mm.*volume_mm"):
        of_rig(devices(rig), NOISE, NONE, BOARD.points(), (50.0, 60.0))
