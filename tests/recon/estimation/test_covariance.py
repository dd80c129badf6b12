"""Covariances, against definitions and draws."""

import numpy as np
import pytest

from recon.estimation.covariance import inverse, marginal, propagate, root, whitening

UNITS = np.array([1e-5, 1.0, 1e3, 1e-2])  # rad, px, mm, and what a lens has


@pytest.fixture
def some(rng):
    """A covariance of four parameters of any units."""
    factor = UNITS[:, None] * rng.standard_normal((4, 6))
    return factor @ factor.T


def correlated(matrix, by):
    scale = np.sqrt(np.diag(by))
    return matrix / np.outer(scale, scale)


def test_a_covariance_is_carried_on_by_slopes(rng, some):
    """Draws of parameters, put through a linear function: each entry to five standard deviations of 40000 draws."""
    slopes = rng.standard_normal((3, 2, 4)) / UNITS
    drawn = root(some) @ rng.standard_normal((4, 40000))
    for found, by in zip(propagate(slopes, some), slopes, strict=True):
        assert correlated(np.cov(by @ drawn), found) == pytest.approx(correlated(found, found), abs=5 * np.sqrt(2 / 40000))


def test_a_root_gives_a_covariance_of_any_units_and_rank(rng):
    factor = rng.standard_normal((4, 2)) * np.array([[1e-5], [1.0], [100.0], [0.0]])
    found = root(factor @ factor.T, 1e-12)
    assert found.shape == (4, 2) and found @ found.T == pytest.approx(factor @ factor.T, rel=1e-6)


def test_whitened_residuals_are_independent(some):
    both = np.stack([some, 4 * some])
    np.testing.assert_allclose(propagate(whitening(both), both), np.tile(np.eye(4), (2, 1, 1)), atol=1e-9)


def test_an_inverse_is_one_whatever_the_units_and_stays_finite_where_nothing_is_known(some):
    np.testing.assert_allclose(correlated(inverse(inverse(some)), some), correlated(some, some), atol=1e-9)
    slopes = np.array([[1.0, 1.0]])  # a sum alone
    found = inverse(slopes.T @ slopes)
    assert np.isfinite(found).all() and found[0, 0] > 1e12


def test_marginal_equations_have_the_solution_and_the_covariance_of_all(rng):
    rows, left, kept = rng.standard_normal((20, 5)), rng.standard_normal(20), np.array([3, 1])
    information, right = marginal(rows.T @ rows, rows.T @ left, kept)
    np.testing.assert_allclose(np.linalg.solve(information, right), np.linalg.lstsq(rows, left)[0][kept], rtol=1e-9)
    np.testing.assert_allclose(np.linalg.inv(information), np.linalg.inv(rows.T @ rows)[np.ix_(kept, kept)], rtol=1e-9)
