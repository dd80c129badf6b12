import numpy as np
import pytest

from recon.geometry.ellipses import Ellipses, fit_ellipses, from_outline, on_ellipse, signed_distance


def one(centre=(30.0, 20.0), axes=(12.0, 7.0), angle=0.4):
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    return Ellipses(np.array([centre], float), (turn @ np.diag(axes) @ turn.T)[None])


def outline(ellipses, count, start=0.0, end=2 * np.pi):
    angles = np.linspace(start, end, count, endpoint=False)
    return on_ellipse(ellipses, np.broadcast_to(angles, (len(ellipses.centre), count)))


def test_distance_is_that_to_the_nearest_of_very_many_points(rng):
    ellipse = one()
    many = outline(ellipse, 20_000)[0][0]
    points, normals = outline(ellipse, 50)
    away = rng.uniform(-1, 1, 50)
    distance, _ = signed_distance(points[0] + away[:, None] * normals[0], ellipse.centre[0], ellipse.shape[0])
    nearest = np.hypot(*(points[0] + away[:, None] * normals[0] - many[:, None]).T).min(axis=1)
    np.testing.assert_allclose(np.abs(distance), nearest, atol=0.02)  # of the third order: 1 px beside radii down to 4 px
    np.testing.assert_allclose(distance, away, atol=0.02)


@pytest.mark.parametrize("axes", [(12.0, 7.0), (10.0, 10.0), (40.0, 12.0)])
def test_exact_points_give_the_exact_ellipse(axes):
    truth = one(axes=axes)
    points = outline(truth, 40)[0]
    start = Ellipses(truth.centre + 1.0, truth.shape * 1.1)
    fit = fit_ellipses(points, np.full((1, 40), 0.1), start)
    np.testing.assert_allclose(fit.ellipses.centre, truth.centre, atol=1e-8)
    np.testing.assert_allclose(fit.ellipses.semi_axes[0], axes, atol=1e-8)


def test_an_evenly_spread_outline_gives_a_start():
    truth = one()
    np.testing.assert_allclose(from_outline(outline(truth, 40)[0]).shape, truth.shape, atol=1e-9)


@pytest.mark.parametrize("end", [2 * np.pi, 0.75 * np.pi])
def test_predicted_covariance_is_the_scatter(rng, end):
    """400 noisy fits; also of a part of an outline, where errors are large and correlated. Chi-square of 2, within 5 sigma."""
    truth, count, sigma = one(), 400, 0.03
    points, normals = outline(truth, 50, end=end)
    noisy = points + normals * rng.normal(0, sigma, (count, 50, 1))
    start = Ellipses(np.repeat(truth.centre, count, 0), np.repeat(truth.shape, count, 0))
    fit = fit_ellipses(noisy, np.full((count, 50), sigma), start)
    error = fit.ellipses.centre - truth.centre
    chi2 = np.einsum("ni,nij,nj->n", error, np.linalg.inv(fit.covariance[:, :2, :2]), error)
    assert chi2.mean() == pytest.approx(2, abs=5 * 2 / np.sqrt(count))
    assert np.mean(fit.chi2) == pytest.approx(1, abs=0.05)


def test_errors_in_common_are_in_the_covariance(rng):
    """Points that all move to the right together move the centre by as much, whatever their own noise."""
    truth, count, sigma = one(), 400, 0.01
    points, normals = outline(truth, 50)
    shared = np.repeat(0.05 * normals[..., :1], count, axis=0)
    noisy = points + normals * (rng.normal(0, sigma, (count, 50, 1)) + shared * rng.normal(size=(count, 1, 1)))
    start = Ellipses(np.repeat(truth.centre, count, 0), np.repeat(truth.shape, count, 0))
    fit = fit_ellipses(noisy, np.full((count, 50), sigma), start, shared)
    z = (fit.ellipses.centre - truth.centre) / np.sqrt(np.diagonal(fit.covariance[:, :2, :2], axis1=1, axis2=2))
    assert np.sqrt(fit.covariance[:, 0, 0].mean()) > 0.045
    np.testing.assert_allclose(z.std(axis=0), 1, atol=5 / np.sqrt(2 * count))


def test_dirt_on_an_eighth_of_the_rim_and_missing_points_do_no_harm(rng):
    truth = one()
    points, normals = outline(truth, 64)
    points = points + normals * rng.normal(0, 0.02, (1, 64, 1))
    points[0, 10:18] += 2 * normals[0, 10:18]  # dirt on the rim
    points[0, 40:46] = np.nan
    fit = fit_ellipses(points, np.full((1, 64), 0.02), truth)
    assert np.abs(fit.ellipses.centre - truth.centre).max() < 0.02
    assert fit.weights[0, 10:18].max() < 0.1 and fit.weights[0, 40:46].max() == 0
