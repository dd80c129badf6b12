"""The sectors' own levels: eliminated as a dense solution does it, and their spread."""

import numpy as np
import pytest

from recon.tracking.rim_fit import sector_levels
from recon.tracking.rim_fit.sector_levels import COMMON, NONE, OWN, REDUCED, Spread
from recon.tracking.rim_fit.sectors import LEVELS, SECTORS, SUMS, UNKNOWNS

PIXELS = 30  # of a sector
NOTHING = Spread(NONE, NONE, NONE)


@pytest.fixture
def equations(rng):
    """Slopes : (SECTORS, PIXELS, UNKNOWNS) and residuals : (SECTORS, PIXELS) of unit noise, and the fit's sums of them."""
    slopes = rng.standard_normal((SECTORS, PIXELS, UNKNOWNS))
    left = rng.standard_normal((SECTORS, PIXELS))
    return slopes, left, summed(slopes, left)


def summed(slopes, left):
    sums = np.zeros(SECTORS, SUMS)
    sums["normal"] = np.einsum("jim,jin->jmn", slopes, slopes)
    sums["right"] = np.einsum("jim,ji->jm", slopes, left)
    sums["count"] = PIXELS
    return sums


def test_own_levels_are_eliminated_as_a_dense_solution_has_them(equations, rng):
    """Each sector's edge, planes and variance follow four common unknowns directly; its own levels are held by their spread."""
    slopes, left, sums = equations
    spread = Spread(0.3, 2.0, 0.05)
    before = 0.1 * rng.standard_normal((SECTORS, 3))
    own, reduced = np.zeros(SECTORS, LEVELS), np.zeros(SECTORS, REDUCED)
    own["dark"], own["bright"], own["growth"] = before.T
    sector_levels.eliminate(sums, own, spread, reduced)
    normal, right = np.triu(reduced["normal"].sum(axis=0)), reduced["right"].sum(axis=0)
    step = np.linalg.solve(normal + np.triu(normal, 1).T, right)

    design = np.zeros((SECTORS * PIXELS, COMMON + 3 * SECTORS))
    design[:, :COMMON] = slopes[:, :, :COMMON].reshape(-1, COMMON)
    for j in range(SECTORS):
        design[j * PIXELS : (j + 1) * PIXELS, COMMON + 3 * j : COMMON + 3 * j + 3] = slopes[j][:, OWN]
    held = np.hstack([np.zeros((3 * SECTORS, COMMON)), np.diag(np.tile(1 / np.array(spread), SECTORS))])
    whole = np.linalg.lstsq(
        np.vstack([design, held]), np.concatenate([left.ravel(), -(before / np.array(spread)).ravel()]), rcond=None
    )[0]
    np.testing.assert_allclose(step, whole[:COMMON], atol=1e-9)

    expected = before + whole[COMMON:].reshape(SECTORS, 3)
    sector_levels.update(own, reduced, np.tile(step, (SECTORS, 1)), np.ones(SECTORS))
    np.testing.assert_allclose(np.stack([own["dark"], own["bright"], own["growth"]], axis=1), expected, atol=1e-9)


def test_light_leans_as_the_neighbours_levels_do():
    own, reduced = np.zeros(SECTORS, LEVELS), np.zeros(SECTORS, REDUCED)
    levels = np.sin(2 * np.pi * np.arange(SECTORS) / SECTORS)
    reduced["response"][:, 1, COMMON] = levels
    weights = np.ones(SECTORS)
    weights[7] = 0
    sector_levels.update(own, reduced, np.zeros((SECTORS, COMMON)), weights)
    np.testing.assert_allclose(own["bright"], levels)
    expected = (np.roll(levels, -1) - np.roll(levels, 1)) / 2
    expected[6:9] = 0  # beside a sector that doesn't count
    np.testing.assert_allclose(own["leaning"], expected, atol=1e-12)


@pytest.mark.parametrize("true", [0.0, 0.5, 3.0])
def test_the_spread_of_own_levels_is_estimated(rng, true):
    """Its mean square within 4 standard errors of the true one less 1.2 times the noise's, which keeps even light even."""
    slopes = np.zeros((SECTORS, PIXELS, UNKNOWNS))
    slopes[:, : PIXELS // 2, 1] = slopes[:, PIXELS // 2 :, 2] = 1
    variance = 2 / PIXELS
    found = []
    for _ in range(100):
        left = rng.standard_normal((SECTORS, PIXELS))
        left += slopes[:, :, 2] * true * rng.standard_normal((SECTORS, 1))
        sums, own = summed(slopes, left), np.zeros(SECTORS, LEVELS)
        found.append(sector_levels.estimate_spread(sums, own, np.ones(SECTORS), 5.0, NOTHING))
    dark, bright, growth = np.array(found).T
    assert (dark < np.sqrt(variance)).all() and (growth == NONE).all()
    assert np.mean(dark <= NONE) > 0.9
    expected = max(true**2 - (1 / sector_levels.MEDIAN - 1) * variance, 0)
    assert abs(np.mean(bright**2) - expected) < max(4 * np.std(bright**2) / 10, 0.1 * variance)


def test_growth_spreads_as_light_leans_along_the_rim(rng):
    """Per pixel, over the sectors with neighbours that count; the others lean by nothing and don't count."""
    own, sums, found = np.zeros(SECTORS, LEVELS), np.zeros(SECTORS, SUMS), []
    for _ in range(100):
        own["leaning"][:30] = 2.0 * rng.standard_normal(30)
        found.append(sector_levels.estimate_spread(sums, own, np.ones(SECTORS), 5.0, Spread(0.0, 0.0, 0.0)).growth)
    assert abs(np.mean(np.square(found)) / (2.0 / 5.0) ** 2 - 1) < 0.15
