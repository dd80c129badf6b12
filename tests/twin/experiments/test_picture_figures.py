"""Figures of displayed B-scans: of grains, greys and decay that were put in."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from twin.experiments.picture_accuracy import recorded
from twin.experiments.picture_figures import PictureFigures, divergence, measure


def grains(sigma_mm, mm_per_px, shape=(400, 320), mean=100.0, contrast=0.2):
    """White noise, blurred by Gaussians of sigma along the array and in depth: its autocorrelation is one of sqrt(2) sigma."""
    sx, sy = mm_per_px
    noise = gaussian_filter(np.random.default_rng(0).standard_normal(shape), (sigma_mm[1] / sy, sigma_mm[0] / sx))
    return mean * (1 + contrast * noise / noise.std())


@pytest.mark.parametrize("mm_per_px", [(0.12, 0.12), (0.15, 0.077)])
def test_grains_have_the_size_that_was_put_in(mm_per_px):
    """Whatever the pixels' size. The slow part that is taken out takes a tenth off."""
    found = measure(np.clip(grains((0.25, 0.1), mm_per_px), 0, 255).astype(np.uint8), mm_per_px)
    full = 2 * np.sqrt(2 * np.log(2)) * np.sqrt(2)
    assert found.grain_along_mm == pytest.approx(0.25 * full, rel=0.12)
    assert found.grain_deep_mm == pytest.approx(0.1 * full, rel=0.12)
    assert found.contrast == pytest.approx(0.2, rel=0.1) and found.grain_growth == pytest.approx(1, abs=0.1)
    assert found.mean == pytest.approx(100, abs=2) and abs(found.skew) < 0.2


def test_decay_and_unevenness_are_those_of_slow_greys():
    image = np.linspace(150, 50, 400)[:, None].repeat(320, axis=1)
    found = measure(image.astype(np.uint8), (0.12, 0.12))
    assert found.decay == pytest.approx(70 / 130, rel=0.02)
    assert found.uneven == pytest.approx(100 / np.sqrt(12) / 100, rel=0.03)


def test_divergence_is_none_of_the_same_and_one_bit_of_disjoint_greys():
    one, other = np.array([0.5, 0.5, 0, 0]), np.array([0, 0, 0.5, 0.5])
    assert divergence(one, one) == 0 and divergence(one, other) == pytest.approx(1)


@pytest.mark.parametrize("name", recorded())
def test_the_recordings_figures_are_those_that_are_measured(name):
    """Without lengths where the pixels' size isn't known."""
    kept, lengths = recorded()[name], {"grain_along_mm", "grain_deep_mm"}
    assert set(kept["figures"]) | lengths == set(PictureFigures._fields) - {"histogram"}
    assert lengths <= set(kept["figures"]) or "40 mm deep" in kept["about"]
    assert sum(kept["histogram"]) == pytest.approx(1, abs=1e-3) and len(kept["histogram"]) == 32
