"""Noise of a surface by what is left of small patches."""

import numpy as np
import pytest

from twin.evaluation import local_residuals


@pytest.mark.parametrize("told", [1.0, 0.5])
def test_noise_is_told_from_shape(rng, told):
    """On a curved surface with known noise the ratio is that of the noise to what sigma claims (3 %)."""
    v, u = np.mgrid[:300, :400]
    distance = np.float32(650 + 2e-4 * (u - 200) ** 2 + 1e-4 * u * v + rng.normal(0, 0.05, u.shape))
    ratio = local_residuals.smooth_noise_ratio(distance, np.full(u.shape, 0.05 * told, np.float32))
    assert ratio == pytest.approx(1 / told, rel=0.03)


def test_gaps_are_left_out(rng):
    """Patches with a hole don't count, whatever is in the hole's place."""
    distance = np.float32(650 + rng.normal(0, 0.05, (90, 90)))
    distance[10, 10] = np.nan
    ratio = local_residuals.smooth_noise_ratio(distance, np.full(distance.shape, 0.05, np.float32))
    assert ratio == pytest.approx(1, rel=0.1)


def test_residuals_are_the_noise_less_what_a_quadratic_takes(rng):
    """75 of 81 degrees of freedom are left in each patch; without noise nothing of a quadratic is."""
    v, u = np.mgrid[:90, :91]
    shape = 650 + 2e-4 * (u - 200) ** 2 + 1e-4 * u * v
    noisy = local_residuals.residuals(np.float32(shape + rng.normal(0, 0.05, u.shape)))
    assert np.isnan(noisy[:, 90]).all() and np.isfinite(noisy[:, :90]).all()
    assert np.nanstd(noisy) == pytest.approx(0.05 * np.sqrt(75 / 81), rel=0.03)
    assert np.abs(local_residuals.residuals(np.float32(shape))[:, :90]).max() < 1e-3
