"""The derivatives of the projection against differences, and the meaning of the parameters."""

import cv2
import numpy as np
import pytest

from recon.geometry.camera_jacobian import DISTORTION, MATRIX, MOTION, difference, linearise, moved

NAMES = MATRIX + DISTORTION + MOTION


@pytest.fixture
def bent(rig, rng):
    """Camera 2 with all fourteen coefficients, and points that it sees."""
    camera = rig.cam2.optics.camera()
    tail = [0.1, 0.01, -0.02, 0.03, 1e-3, -1e-3, 2e-3, 1e-3, 0.01, -0.02]
    points = rng.uniform([-100, -80, 600], [100, 80, 710], (30, 3))
    return moved(camera, DISTORTION[4:], np.array(tail)), points


def test_pixels_are_those_of_the_camera_and_of_opencv(bent):
    camera, points = bent
    lines = linearise(camera, points, ())
    assert lines.by_parameter.shape == (30, 2, 0)
    np.testing.assert_array_equal(lines.pixels, camera.project(points))
    turn, shift = cv2.Rodrigues(camera.camera_from_world[:3, :3])[0], camera.camera_from_world[:3, 3]
    peer = cv2.projectPoints(points, turn, shift, camera.matrix, camera.distortion)[0].reshape(-1, 2)
    np.testing.assert_allclose(lines.pixels, peer, atol=1e-8)


@pytest.mark.parametrize("name", NAMES)
def test_derivatives_by_parameters(bent, name):
    camera, points = bent
    step = {"f": 1e-2, "c": 1e-2}.get(name[0], 1e-5)
    ahead, behind = (moved(camera, [name], np.array([sign * step])).project(points) for sign in (1, -1))
    expected = (ahead - behind) / (2 * step)
    np.testing.assert_allclose(
        linearise(camera, points, [name]).by_parameter[..., 0], expected, atol=1e-5 * np.abs(expected).max()
    )


def test_derivatives_by_the_point(bent):
    camera, points = bent
    found = linearise(camera, points, NAMES).by_point
    for axis, unit in enumerate(1e-3 * np.eye(3)):
        expected = (camera.project(points + unit) - camera.project(points - unit)) / 2e-3
        np.testing.assert_allclose(found[..., axis], expected, atol=1e-6)


def test_a_step_is_read_back(bent, rng):
    camera, _ = bent
    step = rng.standard_normal(len(NAMES)) * 1e-3
    np.testing.assert_allclose(difference(camera, moved(camera, NAMES, step), NAMES), step, atol=1e-12)


def test_a_turn_is_made_after_the_calibrated_one(bent):
    """`R = exp([r]) R_calibrated`, and the shift is not turned."""
    camera, _ = bent
    found = moved(camera, MOTION, np.array([0, 0, np.pi / 2, 1, 2, 3])).camera_from_world
    quarter = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]])
    np.testing.assert_allclose(found[:3, :3], quarter @ camera.camera_from_world[:3, :3], atol=1e-12)
    np.testing.assert_allclose(found[:3, 3], camera.camera_from_world[:3, 3] + [1, 2, 3])


def test_a_lens_gets_no_more_coefficients_than_it_needs(rig):
    camera = rig.cam1.optics.camera()
    assert moved(camera, ["fx"], np.ones(1)).distortion.size == 5
    assert moved(camera, ["k4"], np.ones(1)).distortion.size == 8
