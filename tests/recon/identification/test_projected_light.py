"""Mirrors behind a blurred lens: their weights against Fourier transforms, and their slopes."""

import numpy as np
import pytest
from scipy.special import j1

from recon.identification.projected_light import Footprint, mirror_weights

FINE = 64  # steps a mirror


def blurred(values, variance, box, disc):
    """A staircase of mirrors : (m,), blurred by its transfer functions, at steps of 1 / FINE px around each."""
    fine = np.repeat(values, FINE)
    frequency = np.fft.rfftfreq(fine.size, 1 / FINE)
    around = np.maximum(np.pi * disc * frequency, 1e-9)
    transfer = np.exp(-2 * np.pi**2 * variance * frequency**2) * np.sinc(frequency * box) * 2 * j1(around) / around
    return np.fft.irfft(np.fft.rfft(fine) * transfer, fine.size)


@pytest.mark.parametrize(
    ("variance", "box", "disc"), [(0.04, 0.6, 0.0), (0.2, 0.02, 1.4), (0.15, 2.3, 6.0), (0.3, 1.0, 11.0), (40.0, 1.4, 45.0)]
)
def test_light_is_that_of_the_transfer_functions(rng, variance, box, disc):
    """Seen at 200 places of a random staircase: the same to 3e-4 of full light, most at the edges of a wide disc."""
    values = rng.uniform(0, 1, 512)
    index = rng.integers(100 * FINE, 400 * FINE, 200)
    place = (index + 0.5) / FINE - 0.5
    all_alike = Footprint(*(np.full(len(place), value) for value in (variance, box, disc)))
    weights = mirror_weights(place, all_alike)
    seen = (weights.value * values[weights.first[:, None] + np.arange(weights.value.shape[1])]).sum(axis=1)
    np.testing.assert_allclose(seen, blurred(values, variance, box, disc)[index], atol=3e-4)


def test_slopes_are_those_of_the_weights(rng):
    """Central differences over 1e-4 px, px^2."""
    place, step = rng.uniform(50, 60, 50), 1e-4
    footprint = Footprint(rng.uniform(0.1, 1, 50), rng.uniform(0.1, 2.5, 50), rng.uniform(0.5, 9, 50))
    found = mirror_weights(place, footprint)

    def change(place_step=0.0, variance_step=0.0, disc_step=0.0):
        ends = []
        for sign in (1, -1):
            moved = footprint._replace(variance=footprint.variance + sign * variance_step, disc=footprint.disc + sign * disc_step)
            ends.append(mirror_weights(place + sign * place_step, moved).value)
        return (ends[0] - ends[1]) / (2 * step)

    np.testing.assert_allclose(found.by_place, change(place_step=step), atol=1e-6)
    np.testing.assert_allclose(found.by_variance, change(variance_step=step), atol=1e-6)
    np.testing.assert_allclose(found.by_disc, change(disc_step=step), atol=1e-6)
