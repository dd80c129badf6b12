"""What sectors of a rim have of their own: eliminated as a dense solution does it, and how their spread is told."""

import numpy as np
import pytest

from recon.tracking.rim_fit import sector_levels
from recon.tracking.rim_fit.sectors import BRIGHT, COUNT, GROWTH, LEANING, LOCAL, OWN, RIGHT, SECTORS, UNKNOWNS

PIXELS = 30  # of a sector
COMMON = sector_levels.COMMON
TRIANGLE = np.triu_indices(UNKNOWNS)


@pytest.fixture
def equations(rng):
    """Slopes : (SECTORS, PIXELS, UNKNOWNS) and residuals : (SECTORS, PIXELS) of unit noise, and the fit's sums of them."""
    slopes = rng.standard_normal((SECTORS, PIXELS, UNKNOWNS))
    left = rng.standard_normal((SECTORS, PIXELS))
    return slopes, left, summed(slopes, left)


def summed(slopes, left):
    sums = np.zeros((SECTORS, LOCAL))
    sums[:, : len(TRIANGLE[0])] = np.einsum("jim,jin->jmn", slopes, slopes)[:, *TRIANGLE]
    sums[:, RIGHT : RIGHT + UNKNOWNS] = np.einsum("jim,ji->jm", slopes, left)
    sums[:, COUNT] = PIXELS
    return sums


def test_own_levels_are_eliminated_as_a_dense_solution_has_them(equations, rng):
    """Each sector's edge, planes and variance follow four common unknowns directly; its own levels are held by their spread."""
    slopes, left, sums = equations
    own, spread = 0.1 * rng.standard_normal((SECTORS, OWN)), np.array([0.3, 2.0, 0.05])
    reduced, follow = np.zeros((SECTORS, sector_levels.REDUCED)), np.zeros((SECTORS, 3, COMMON + 1))
    sector_levels.eliminate(sums, own, spread, reduced, follow)
    normal, right = np.zeros((COMMON, COMMON)), reduced[:, -COMMON:].sum(axis=0)
    normal[np.triu_indices(COMMON)] = reduced[:, :-COMMON].sum(axis=0)
    step = np.linalg.solve(normal + np.triu(normal, 1).T, right)

    design = np.zeros((SECTORS * PIXELS, COMMON + 3 * SECTORS))
    design[:, :COMMON] = slopes[:, :, :COMMON].reshape(-1, COMMON)
    for j in range(SECTORS):
        design[j * PIXELS : (j + 1) * PIXELS, COMMON + 3 * j : COMMON + 3 * j + 3] = slopes[j][:, sector_levels.HELD]
    held = np.hstack([np.zeros((3 * SECTORS, COMMON)), np.diag(np.tile(1 / spread, SECTORS))])
    whole = np.linalg.lstsq(
        np.vstack([design, held]), np.concatenate([left.ravel(), -(own[:, :3] / spread).ravel()]), rcond=None
    )[0]
    np.testing.assert_allclose(step, whole[:COMMON], atol=1e-9)

    expected = own[:, :3] + whole[COMMON:].reshape(SECTORS, 3)
    sector_levels.move(own, follow, np.tile(step, (SECTORS, 1)), np.ones(SECTORS))
    np.testing.assert_allclose(own[:, :3], expected, atol=1e-9)


def test_light_leans_as_the_neighbours_levels_do():
    own, follow = np.zeros((SECTORS, OWN)), np.zeros((SECTORS, 3, COMMON + 1))
    levels = np.sin(2 * np.pi * np.arange(SECTORS) / SECTORS)
    follow[:, BRIGHT, COMMON] = levels
    weights = np.ones(SECTORS)
    weights[7] = 0
    sector_levels.move(own, follow, np.zeros((SECTORS, COMMON)), weights)
    expected = (np.roll(levels, -1) - np.roll(levels, 1)) / 2
    expected[6:9] = 0  # beside a sector that doesn't count
    np.testing.assert_allclose(own[:, LEANING], expected, atol=1e-12)


@pytest.mark.parametrize("true", [0.0, 0.5, 3.0])
def test_the_spread_of_own_levels_is_told(rng, true):
    """Its mean square within 4 standard errors of the true one less 1.2 times the noise's, which keeps even light even."""
    slopes = np.zeros((SECTORS, PIXELS, UNKNOWNS))
    slopes[:, : PIXELS // 2, 1] = slopes[:, PIXELS // 2 :, 2] = 1
    variance = 2 / PIXELS
    told = []
    for _ in range(100):
        left = rng.standard_normal((SECTORS, PIXELS))
        left += slopes[:, :, 2] * true * rng.standard_normal((SECTORS, 1))
        spread = np.full(3, sector_levels.NONE)
        sector_levels.tell_spread(summed(slopes, left), np.zeros((SECTORS, OWN)), np.ones(SECTORS), 5.0, spread)
        told.append(spread)
    dark, bright, growth = np.array(told).T
    assert (dark < np.sqrt(variance)).all() and (growth == sector_levels.NONE).all()
    assert np.mean(dark <= sector_levels.NONE) > 0.9
    expected = max(true**2 - (1 / sector_levels.MEDIAN - 1) * variance, 0)
    assert abs(np.mean(bright**2) - expected) < max(4 * np.std(bright**2) / 10, 0.1 * variance)


def test_growth_spreads_as_light_leans_along_the_rim(rng):
    """Per pixel, over the sectors that know their neighbours; the others lean by nothing and don't count."""
    own, told = np.zeros((SECTORS, OWN)), []
    for _ in range(100):
        own[:30, LEANING] = 2.0 * rng.standard_normal(30)
        spread = np.zeros(3)
        sector_levels.tell_spread(np.zeros((SECTORS, LOCAL)), own, np.ones(SECTORS), 5.0, spread)
        told.append(spread[GROWTH])
    assert abs(np.mean(np.square(told)) / (2.0 / 5.0) ** 2 - 1) < 0.15
