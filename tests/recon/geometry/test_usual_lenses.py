"""Distortion of usual lenses, and what is left of it once points were seen."""

import numpy as np
import pytest

from recon.geometry.camera import Camera
from recon.geometry.usual_lenses import LARGEST, SMALLER, coefficients, corner_radius, estimate, largest

NAMES = ("fx", "k1", "k2", "p1", "tx")


@pytest.fixture
def camera():
    return Camera((1280, 1024), np.array([[1000.0, 0, 639.5], [0, 1000, 511.5], [0, 0, 1]]), np.array([-0.1, 0.2, 0.003, 0]))


def test_a_coefficient_counts_in_the_corner(camera):
    """One of the largest standard deviation moves the corner by its share; what is no distortion is held by nothing."""
    sigmas, corner = largest(camera, NAMES), np.array([[0.64, 0.512, 1.0]])
    assert np.isinf(sigmas[[0, 4]]).all() and coefficients(camera, NAMES).tolist() == [0, -0.1, 0.2, 0.003, 0]
    plain = Camera(camera.size, camera.matrix, np.zeros(0)).project(corner)[0]
    for number, (name, k) in enumerate((("k1", 0), ("k2", 1))):
        bent = np.zeros(4)
        bent[k] = sigmas[1 + number]
        moved = np.linalg.norm(Camera(camera.size, camera.matrix, bent).project(corner)[0] - plain)
        assert moved == pytest.approx(LARGEST[name][0] * corner_radius(camera) * 1000, rel=1e-6)


def shown(values, sigmas):
    """What independent sightings of coefficients say of them: information and pull."""
    return np.diag(sigmas**-2.0), values / sigmas**2


def test_what_points_determine_is_not_held(camera):
    """However exactly: shrunk by a thousandth of its value at most."""
    most = largest(camera, NAMES)[1:4]
    for sigma in (1e-3 * most, 1e-10 * most):
        held = estimate(*shown(0.1 * most, sigma), most, most)
        assert (sigma**2 / held**2 < 1e-3).all() and np.isfinite(held).all()


def test_what_points_show_to_be_small_is_nearly_zero(camera):
    most = largest(camera, NAMES)[1:4]
    sigma = 1e-2 * most
    held = estimate(*shown(0.3 * sigma, sigma), most, most)
    assert (held < 0.7 * sigma).all()


def test_of_what_points_do_not_show_the_scatter_among_lenses_is_left(camera):
    most = largest(camera, NAMES)[1:4]
    held = estimate(*shown(np.zeros(3), 1e4 * most), most, most)
    np.testing.assert_allclose(held, np.sqrt(np.mean(SMALLER**2)) * most, rtol=1e-3)


def test_errors_are_as_large_as_they_seem(rng):
    """Coefficients of 3000 lenses, as likely in each decade, seen with noise of any size, and held by what they show.

    Their errors are a mixture: nine tenths within two standard deviations, and a tail that a Gaussian doesn't have.
    """
    most, inside = np.ones(3), []
    for _ in range(1000):
        true, sigma = rng.choice(SMALLER, 3) * rng.standard_normal(3), 10 ** rng.uniform(-4, 1, 3)
        seen = true + sigma * rng.standard_normal(3)
        held = estimate(*shown(seen, sigma), most, most)
        variance = 1 / (sigma**-2 + held**-2)
        inside.append(np.abs(variance * seen / sigma**2 - true) < 2 * np.sqrt(variance))
    assert 0.88 < np.mean(inside) < 0.97
