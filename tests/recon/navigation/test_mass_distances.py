"""Distances of planes from a ball, whose answers are known, and the circle in which a plane cuts it."""

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from recon.geometry import rigid
from recon.navigation.mass_distances import bodies_of, distances
from recon.navigation.placed_scans import PlacedScan

RADIUS = 8.0
CENTRE = np.array([12.0, -5.0, 690.0])
TURN = Rotation.from_euler("xyz", [20, -35, 50], degrees=True).as_matrix()
MM_PER_PX = 0.25
SHAPE = (160, 120)  # 40 mm deep, 30 mm wide
COARSE = 0.05  # mm, of a ball of 10 000 triangles against a true one


@pytest.fixture(scope="module")
def bodies():
    return bodies_of({"ball": trimesh.creation.icosphere(4, RADIUS).apply_translation(CENTRE)})


def scan_at(ahead_mm, aside_mm=0.0):
    """A B-scan whose middle lies beside the ball's centre, so far along its normal and its rows."""
    middle = CENTRE - ahead_mm * TURN[:, 2] - aside_mm * TURN[:, 0]
    corner = middle - TURN[:, :2] @ (MM_PER_PX * (np.array(SHAPE[::-1]) - 1) / 2)
    world_from_pixel = rigid.transform(TURN, corner) @ np.diag([MM_PER_PX, MM_PER_PX, MM_PER_PX, 1])
    return PlacedScan(np.zeros(SHAPE, np.uint8), 0, 0, world_from_pixel)


@pytest.mark.parametrize("ahead", [-20.0, -8.5, 8.5, 20.0])
def test_a_plane_beside_the_ball(bodies, ahead):
    (found,) = distances(bodies, scan_at(ahead))
    assert found.distance_mm == pytest.approx(abs(ahead) - RADIUS, abs=COARSE)
    assert found.middle_mm == pytest.approx(ahead, abs=COARSE)
    assert not found.cut and not found.in_image and found.outline.shape == (0, 2, 3)


@pytest.mark.parametrize("ahead", [-6.0, 0.0, 3.0])
def test_a_plane_through_the_ball_cuts_a_circle(bodies, ahead):
    (found,) = distances(bodies, scan_at(ahead))
    assert found.distance_mm == pytest.approx(abs(ahead) - RADIUS, abs=COARSE)
    assert found.cut and found.in_image
    off = found.outline - CENTRE
    np.testing.assert_allclose(off @ TURN[:, 2], -ahead, atol=1e-9)
    radii = np.linalg.norm(off + ahead * TURN[:, 2], axis=-1)
    np.testing.assert_allclose(radii, np.sqrt(RADIUS**2 - ahead**2), atol=2 * COARSE)
    around = np.linalg.norm(np.diff(found.outline, axis=1), axis=-1).sum()
    assert around == pytest.approx(2 * np.pi * np.sqrt(RADIUS**2 - ahead**2), rel=0.01)


def test_a_cut_beside_the_image_is_told_apart(bodies):
    """The image ends 15 mm from its middle, the ball 8 mm from its centre."""
    assert distances(bodies, scan_at(0.0, 20.0))[0].in_image
    beside = distances(bodies, scan_at(0.0, 30.0))[0]
    assert beside.cut and not beside.in_image
