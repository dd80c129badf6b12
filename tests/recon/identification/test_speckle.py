"""Speckle's closed forms beside drawn fields."""

import numpy as np
import pytest

from recon.identification import speckle


@pytest.mark.parametrize("alike", [0.3, 0.7, 0.95])
def test_logarithms_of_correlated_powers_have_spences_covariance(rng, alike):
    """10^5 pairs of circular Gaussian fields; the correlation's standard error is 0.004, of which 5 pass."""
    first, other = rng.standard_normal((2, 100000, 2)) @ np.array([1, 1j])
    second = alike * first + np.sqrt(1 - alike**2) * other
    greys = np.log(np.abs([first, second]) ** 2)
    assert np.corrcoef(greys)[0, 1] == pytest.approx(float(speckle.grey_correlation(np.array(alike))), abs=0.02)
    assert greys[0].std() * 10 / np.log(10) == pytest.approx(speckle.SPREAD_DB, rel=0.02)


@pytest.mark.parametrize("alike", [0.6, 0.8, 0.97])
def test_black_pixels_make_the_rest_more_alike(rng, alike):
    """3 10^5 pairs, 1 % black: as drawn to 0.003, where the correlation is 0.009 to 0.02 higher than without."""
    first, other = rng.standard_normal((2, 300_000, 2)) @ np.array([1, 1j])
    second = alike * first + np.sqrt(1 - alike**2) * other
    powers = np.abs([first, second]) ** 2 / 2
    greys = np.log(np.maximum(powers, -np.log1p(-0.01)))
    expected, without = (float(speckle.grey_correlation(np.array([[alike]]), black).item()) for black in (np.array([0.01]), 0.0))
    assert np.corrcoef(greys)[0, 1] == pytest.approx(expected, abs=0.003) and expected > without + 0.005
    assert speckle.grey_correlation(np.array([[alike]]), np.array([1e-6])) == pytest.approx(without, abs=3e-4)


def test_grey_correlations_lead_back_to_fields():
    alike = np.linspace(0.05, 0.99, 20)
    assert np.allclose(speckle.field_correlation(speckle.grey_correlation(alike)), alike, atol=1e-3)


def test_b_scans_of_the_same_tissue_are_one_part(rng):
    """Of four B-scans, two of one place with new noise: three places in strips."""
    grains = rng.normal(128, 20, (3, 200, 90))
    images = np.round(np.concatenate([grains[:2], grains[1:2] + rng.normal(0, 3, (1, 200, 90)), grains[2:]])).astype(np.uint8)
    part = speckle.parts(images, (0.1, 0.1))
    assert (part[1] == part[2]).all() and part.max() + 1 == 6


def test_errors_of_places_are_those_of_their_distances(rng):
    """A wrong scale errs by its share, a shift not at all, and one place's error by its part of the pairs."""
    places = np.cumsum(rng.uniform(0.1, 0.3, 12).round(2))
    places -= places[5]
    distances = speckle.lags(places)[0]
    alone = np.zeros(12)
    alone[-1] = 0.02
    found = speckle.lag_errors(places, np.array([0.03 * places, np.full(12, 0.4), alone]))
    assert np.allclose(found[0], 0.03 * distances) and np.allclose(found[1], 0)
    assert np.isclose(found[2][-1], 0.02) and 0 < found[2].mean() < 0.01
    assert speckle.lag_errors(places, np.zeros((0, 12))).shape == (0, len(distances))
