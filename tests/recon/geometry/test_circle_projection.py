import cv2
import numpy as np
import pytest

from recon.board_detection.kinds.asymmetric_circles import AsymmetricCircles
from recon.geometry import rigid
from recon.geometry.camera import Camera
from recon.geometry.circle_projection import centre_offsets

MATRIX = np.array([[3320, 0, 618], [0, 3331, 523], [0, 0, 1.0]])
BOARD = AsymmetricCircles(columns=4, rows=11, spacing_mm=15, diameter_mm=9)


def tilted(rotation, translation):
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = cv2.Rodrigues(np.asarray(rotation, float))[0], translation
    return pose


def conic_centre(matrix, pose, point, radius):
    """Centre of the ellipse from the circle's matrix, carried by the homography from the board to the image."""
    board_to_image = matrix @ np.column_stack([pose[:3, :2], rigid.apply(pose, point)])
    back = np.linalg.inv(board_to_image)
    conic = back.T @ np.diag([1, 1, -(radius**2)]) @ back
    return np.linalg.solve(conic[:2, :2], -conic[:2, 2])


def test_a_pinhole_shows_the_conic_that_projective_geometry_predicts(rng):
    camera = Camera((1280, 1024), MATRIX, np.zeros(5))
    for _ in range(5):
        pose = tilted(rng.uniform(-0.6, 0.6, 3), [*rng.uniform(-60, 20, 2), rng.uniform(550, 750)])
        centres = camera.project(rigid.apply(pose, BOARD.points()))
        expected = np.array([conic_centre(MATRIX, pose, p, 4.5) for p in BOARD.points()]) - centres
        np.testing.assert_allclose(centre_offsets(camera, pose, BOARD.points(), 4.5), expected, atol=1e-6)


@pytest.mark.parametrize("radius_mm", [3.0, 9.0])
@pytest.mark.parametrize("tilt_deg", [0.0, 15.0, 30.0, 45.0])
def test_offset_grows_with_the_radius_squared_and_with_the_tilt(radius_mm, tilt_deg):
    """`f r^2 sin(w) cos(w) / Z^2`, on the camera's axis; 0.24 px for the probe's target."""
    camera = Camera((1280, 1024), np.array([[3320, 0, 640], [0, 3320, 512], [0, 0, 1.0]]), np.zeros(0))
    tilt = np.deg2rad(tilt_deg)
    pose = tilted([0, tilt, 0], [0, 0, 690])
    offset = centre_offsets(camera, pose, [[0, 0, 0]], radius_mm)[0]
    expected = 3320 * radius_mm**2 * np.sin(tilt) * np.cos(tilt) / 690**2
    assert np.abs(offset[0]) == pytest.approx(expected, rel=1e-3, abs=1e-9)
    assert offset[1] == pytest.approx(0, abs=1e-9)


def test_the_near_side_counts_more():
    """Turned about y, the board's +x side goes away from the camera (z = x * sin), so the ellipse's centre moves to -x."""
    camera = Camera((1280, 1024), MATRIX, np.zeros(0))
    pose = tilted([0, -0.5, 0], [0, 0, 690])
    assert rigid.apply(pose, [1, 0, 0])[2] > 690
    assert centre_offsets(camera, pose, [[0, 0, 0]], 9.0)[0, 0] < -0.1


def test_a_lens_moves_the_centre_of_a_flat_circle_too():
    """Barrel distortion is stronger outside, so a circle beside the axis, seen squarely, is pulled inwards on its outer half.

    Of `p (1 + k p.p)` at p = (x + r cos a, r sin a), the terms in r^2 move the rim along its normal by `3 k x r^2 cos a`.
    """
    barrel = Camera((1280, 1024), MATRIX, np.array([-0.3, 0, 0, 0, 0]))
    pose = tilted([0, 0, 0], [0, 0, 400])
    offset = centre_offsets(barrel, pose, [[60, 0, 0]], 10.0)[0]
    assert offset[0] == pytest.approx(-0.3 * 3320 * 3 * (60 / 400) * (10 / 400) ** 2, rel=0.02)
    assert abs(offset[1]) < 1e-6


def test_circles_behind_the_camera_are_nowhere():
    camera = Camera((1280, 1024), MATRIX, np.zeros(0))
    assert np.isnan(centre_offsets(camera, tilted([0, 0, 0], [0, 0, -500]), [[0, 0, 0]], 5.0)).all()
