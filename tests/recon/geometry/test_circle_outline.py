"""Images of circles, against the plain fit and projection."""

import numpy as np
import pytest

from recon.geometry import rigid
from recon.geometry.circle_outline import ellipses_of, slopes_at
from recon.geometry.ellipses import fit_ellipses, from_outline
from recon.model import circle_layout
from tests.recon.tracking import drawings


@pytest.mark.parametrize("raised_mm", [0.0, 3.0])
def test_ellipses_are_those_of_the_plain_fit(rig, rng, raised_mm):
    """Centre and shape, from 200 projected points of each outline; a circle may lie above the target's plane."""
    camera, model, radius = rig.cam1.optics.camera(), circle_layout.circle_centres(rig.target), rig.target.outer_diameter_mm / 2
    model = model + np.array([0, 0, raised_mm])
    angles = np.linspace(0, 2 * np.pi, 201)[:-1]
    circle = radius * np.stack([np.cos(angles), np.sin(angles), 0 * angles], axis=1)
    for _ in range(5):
        place = drawings.facing(rng)
        outlines = camera.project(rigid.apply(place, model[:, None] + circle))
        expected = fit_ellipses(outlines, np.ones(outlines.shape[:2]), from_outline(outlines)).ellipses
        centres, shapes = ellipses_of(camera, place, model, radius)
        assert np.abs(centres - expected.centre).max() < 1e-5
        assert np.abs(shapes - expected.shape).max() < 1e-4


def test_circles_behind_the_camera_have_no_ellipse(rig):
    behind = np.diag([1.0, 1.0, 1.0, 1.0])
    behind[2, 3] = -500
    centres, shapes = ellipses_of(rig.cam1.optics.camera(), behind, circle_layout.circle_centres(rig.target), 9.0)
    assert np.isnan(centres).all() and np.isnan(shapes).all()


def test_slopes_are_differences_of_projections(rig, rng):
    camera = rig.cam2.optics.camera()
    points = rng.uniform([-50, -45, 610], [50, 45, 705], (20, 3))
    found = slopes_at(camera, points)
    for axis in range(3):
        step = 1e-3 * np.eye(3)[axis]
        expected = (camera.project(points + step) - camera.project(points - step)) / 2e-3
        np.testing.assert_allclose(found[:, :, axis], expected, atol=1e-5)
