"""Fits find the shape that noisy points were made of, and know how well."""

import numpy as np
import pytest

from recon.geometry import primitives, rigid

NOISE = 0.05  # mm
POSE = rigid.from_rotation_vector([0.4, -0.7, 0.2], [12.0, -30.0, 660.0])
AXIS = rigid.rotate(POSE, [0, 0, 1])


def cap(rng, n=600):
    """A piece of a sphere of radius 20, as a camera sees it."""
    directions = rng.normal(size=(n, 3)) * (0.4, 0.4, 0) - (0, 0, 1)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return POSE[:3, 3] + (20 + rng.normal(0, NOISE, (n, 1))) * directions


def half_tube(rng, n=600):
    """A third of a cylinder of radius 30, 80 long."""
    angle, z = rng.uniform(-1, 1, n), rng.uniform(-40, 40, n)
    radius = 30 + rng.normal(0, NOISE, n)
    return rigid.apply(POSE, np.column_stack([radius * np.cos(angle), radius * np.sin(angle), z]))


def plate(rng, n=600):
    return rigid.apply(POSE, np.column_stack([rng.uniform(-50, 50, n), rng.uniform(-20, 20, n), rng.normal(0, NOISE, n)]))


def test_sphere():
    fit = primitives.fit_sphere(cap(np.random.default_rng(0)))
    deviation = np.sqrt(np.diag(fit.covariance))
    assert (np.abs([*(fit.shape.centre - POSE[:3, 3]), fit.shape.radius - 20]) < 5 * deviation).all()
    assert abs(fit.rms / NOISE - 1) < 5 / np.sqrt(2 * 600)


def test_cylinder():
    fit = primitives.fit_cylinder(half_tube(np.random.default_rng(1)))
    deviation = np.sqrt(np.diag(fit.covariance))
    tilt = np.linalg.norm(np.cross(fit.shape.axis, AXIS))
    off_axis = np.linalg.norm(np.cross(fit.shape.point - POSE[:3, 3], AXIS))
    assert abs(fit.shape.radius - 30) < 5 * deviation[4]
    assert tilt < 5 * np.hypot(*deviation[2:4]) and off_axis < 5 * np.hypot(*deviation[:2])
    assert abs(fit.rms / NOISE - 1) < 5 / np.sqrt(2 * 600)


def test_plane():
    fit = primitives.fit_plane(plate(np.random.default_rng(2)))
    assert np.linalg.norm(np.cross(fit.shape.normal, AXIS)) < 5 * np.sqrt(fit.covariance[0, 0] + fit.covariance[1, 1])
    assert abs(fit.shape.distance(POSE[:3, 3])) < 0.03
    assert fit.shape.normal @ fit.shape.point < 0, "the normal points to the origin"
    assert abs(fit.rms / NOISE - 1) < 5 / np.sqrt(2 * 600)


@pytest.mark.parametrize(
    ("points", "fit_shape", "parameter", "truth", "index"),
    [
        (cap, primitives.fit_sphere, lambda shape: shape.radius, 20, 3),
        (cap, primitives.fit_sphere, lambda shape: shape.centre[2], POSE[2, 3], 2),
        (half_tube, primitives.fit_cylinder, lambda shape: shape.radius, 30, 4),
    ],
)
def test_predicted_covariance_is_the_scatter(points, fit_shape, parameter, truth, index):
    """150 fits: the z-scores' standard deviation is 1 within four of its standard errors (0.23)."""
    rng, z = np.random.default_rng(3), []
    for _ in range(150):
        fit = fit_shape(points(rng, 150))
        z.append((parameter(fit.shape) - truth) / np.sqrt(fit.covariance[index, index]))
    assert abs(np.std(z) - 1) < 4 / np.sqrt(2 * len(z)) and abs(np.mean(z)) < 4 / np.sqrt(len(z))


@pytest.mark.parametrize(
    ("points", "fit_shape"), [(plate, primitives.fit_plane), (cap, primitives.fit_sphere), (half_tube, primitives.fit_cylinder)]
)
def test_residuals_are_distances_from_the_fitted_shape(points, fit_shape):
    measured = points(np.random.default_rng(7))
    fit = fit_shape(measured)
    assert np.abs(fit.residuals - fit.shape.distance(measured)).max() < 1e-9


def test_the_axis_is_found_whichever_way_it_points():
    """Short pieces, where the longest extent is not the axis, in ten directions."""
    rng = np.random.default_rng(4)
    for _ in range(10):
        pose = rigid.from_rotation_vector(rng.normal(size=3), rng.normal(0, 100, 3))
        angle, z = rng.uniform(-1.5, 1.5, 400), rng.uniform(-8, 8, 400)
        tube = np.column_stack([30 * np.cos(angle), 30 * np.sin(angle), z]) + rng.normal(0, 0.02, (400, 3))
        fit = primitives.fit_cylinder(rigid.apply(pose, tube))
        assert abs(fit.shape.radius - 30) < 0.1 and fit.rms < 0.03


@pytest.mark.parametrize("fit_shape", [primitives.fit_plane, primitives.fit_sphere, primitives.fit_cylinder])
@pytest.mark.parametrize("points", [np.zeros((3, 3)), np.zeros((10, 2)), np.full((10, 3), np.nan)])
def test_too_little_is_refused(fit_shape, points):
    with pytest.raises(ValueError, match="expected at least"):
        fit_shape(points)


@pytest.mark.parametrize("noise", [0, 1e-6, 0.05, 1.0])
def test_a_plane_is_no_sphere(noise):
    """Nor are noisy points of one: they would give a sphere of a chance radius. Each of 50 would pass once in a million."""
    rng = np.random.default_rng(5)
    for _ in range(50):
        flat = np.column_stack([rng.uniform(-20, 20, (100, 2)), rng.normal(0, noise, 100)])
        with pytest.raises(ValueError, match="in a plane"):
            primitives.fit_sphere(rigid.apply(POSE, flat))


def test_a_slight_curvature_is_a_sphere():
    """A cap 40 wide and 0.2 high, above a noise of 0.02: its radius of 1000 is known to a few per cent."""
    rng = np.random.default_rng(6)
    x, y = rng.uniform(-20, 20, (2, 400))
    fit = primitives.fit_sphere(np.column_stack([x, y, np.sqrt(1000**2 - x**2 - y**2) + rng.normal(0, 0.02, 400)]))
    assert abs(fit.shape.radius - 1000) < 5 * np.sqrt(fit.covariance[3, 3]) < 200
