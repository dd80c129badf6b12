"""Phase of N-step fringes: is it right, and is the predicted noise the noise?"""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from recon.structured_light.phase import QUANTISATION, Noise, estimate_noise, phase_weights, pseudo_inverse, wrapped_phase

NOISE = Noise(0.5, 0.033)


def fringes(phase, shifts, a=100.0, b=80.0):
    """Noiseless images : (n, h, w)."""
    return a + b * np.cos(phase + shifts[:, None, None])


def noisy(images, rng, noise=NOISE):
    """The camera's 8-bit images; `noise` includes rounding."""
    sigma = np.sqrt(np.maximum(noise.read_variance - 1 / 12 + noise.gain * images, 0))
    return np.clip(np.rint(images + sigma * rng.normal(size=images.shape)), 0, 255).astype(np.uint8)


def difference(a, b):
    return np.angle(np.exp(1j * (np.asarray(a, float) - b)))


@settings(max_examples=40, deadline=None)
@given(n=st.integers(3, 20), seed=st.integers(0, 2**31), even=st.booleans())
def test_any_shifts_give_the_phase(n, seed, even):
    """Exact images give phase, modulation and offset for any count and spacing; float32 leaves some 1e-5 rad."""
    rng = np.random.default_rng(seed)
    shifts = 2 * np.pi * (np.arange(n) + (0 if even else rng.uniform(-0.3, 0.3, n))) / n
    truth = rng.uniform(-np.pi, np.pi, (6, 50))
    found = wrapped_phase(fringes(truth, shifts).astype(np.float32), shifts, noise=NOISE, saturation=255)
    assert np.abs(difference(found.phase, truth)).max() < 5e-5
    assert found.modulation == pytest.approx(80, abs=2e-3)
    assert found.offset == pytest.approx(100, abs=2e-3)


@pytest.mark.parametrize("n", [3, 4, 8, 18])
@pytest.mark.parametrize("uneven", [False, True])
def test_predicted_noise_is_the_noise(rng, n, uneven):
    """Phase errors, divided by the predicted sigma, have a standard deviation of 1, in bright and in dark places."""
    shifts = 2 * np.pi * np.arange(n) / n + (rng.uniform(-0.4, 0.4, n) if uneven else 0)
    truth = rng.uniform(-np.pi, np.pi, (200, 300))
    for level in (0.3, 1.0):
        images = noisy(fringes(truth, shifts, 110 * level, 90 * level), rng)
        found = wrapped_phase(images, shifts, noise=NOISE, saturation=255)
        z = difference(found.phase, truth) / found.sigma
        # 5 standard errors, and 1 % for the variance being read off noisy intensities.
        assert abs(z.std() - 1) < 5 / np.sqrt(2 * z.size) + 0.01


def test_sigma_of_even_shifts_is_the_textbook_formula():
    """For equal noise in all images, sigma = sqrt(2 / N) * sigma_I / B."""
    shifts = 2 * np.pi * np.arange(8) / 8
    images = fringes(np.full((1, 9), 0.7), shifts).astype(np.float32)
    found = wrapped_phase(images, shifts, noise=Noise(2.25, 0.0), saturation=255)
    assert found.sigma == pytest.approx(np.sqrt(2 / 8) * 1.5 / 80, rel=1e-4)


def test_agrees_with_a_plain_solution(rng):
    """The compiled fit and numpy's least squares agree on integers of both widths."""
    shifts = np.array([0.1, 1.4, 2.2, 4.0, 5.5])
    images = rng.integers(0, 1024, (5, 20, 30)).astype(np.uint16)
    design = np.stack([np.ones(5), np.cos(shifts), -np.sin(shifts)], axis=1)
    a, c, s = np.linalg.lstsq(design, images.reshape(5, -1).astype(float), rcond=None)[0]
    found = wrapped_phase(images, shifts, noise=NOISE, saturation=1023)
    assert np.abs(difference(found.phase.ravel(), np.arctan2(s, c))).max() < 1e-4
    assert found.modulation.ravel() == pytest.approx(np.hypot(c, s), rel=1e-4, abs=1e-2)
    assert found.offset.ravel() == pytest.approx(a, rel=1e-4, abs=1e-2)
    assert (found.saturated == (images >= 1023).any(axis=0)).all()


def test_shifts_that_say_nothing_are_refused():
    with pytest.raises(ValueError, match="undetermined"):
        wrapped_phase(np.zeros((3, 4, 4), np.uint8), [0.0, np.pi, 0.0], noise=NOISE, saturation=255)
    with pytest.raises(ValueError, match="n >= 3"):
        wrapped_phase(np.zeros((2, 4, 4), np.uint8), [0.0, 1.0], noise=NOISE, saturation=255)


@pytest.mark.parametrize("n", [8, 12, 18])
@pytest.mark.parametrize("truth", [Noise(0.5, 0.033), Noise(2.0, 0.01), Noise(0.3, 0.1)])
def test_noise_is_measured_through_gamma(rng, n, truth):
    """Fringes bent by a gamma of 2.2, lit unevenly, with black and saturated corners: the variance is right to 5 %."""
    shifts = 2 * np.pi * np.arange(1, n + 1) / n
    v, u = np.mgrid[:512, :640]
    light = 10 + 260 * (u / 640)[None]
    images = light * ((1 + np.cos(0.3 * u + 0.05 * v + shifts[:, None, None])) / 2) ** 2.2 + 3
    images[:, :60, :60] = 0
    found = estimate_noise(noisy(images, rng, truth), shifts)
    assert found is not None
    for level in (20.0, 50.0, 90.0):
        assert found.read_variance + found.gain * level == pytest.approx(truth.read_variance + truth.gain * level, rel=0.05)


def test_noise_is_measured_through_flicker(rng):
    """A lamp whose flicker beats with the sequence fills one high harmonic in every pixel: that is not the camera's noise."""
    n, truth = 12, Noise(0.5, 0.033)
    shifts = 2 * np.pi * np.arange(n) / n
    flicker = 1 + 0.03 * np.cos(5 * shifts + 0.4)
    images = flicker[:, None, None] * (100 + 60 * np.cos(0.3 * np.arange(640) + shifts[:, None, None])) * np.ones((512, 1))
    found = estimate_noise(noisy(images, rng, truth), shifts)
    assert found is not None
    assert found.read_variance + found.gain * 100 == pytest.approx(truth.read_variance + truth.gain * 100, rel=0.05)


@pytest.mark.parametrize("darkest", [1.5, 2.5])
def test_noise_is_measured_in_the_dark(rng, darkest):
    """Rounded to whole digital numbers, more than half of the residuals are zero; the variance is right to 10 % all the same."""
    shifts, truth = np.pi * np.arange(8) / 4, Noise(0.02 + QUANTISATION, 0.03)
    v, u = np.mgrid[:512, :640]
    level = darkest + 2 * u / 640
    found = estimate_noise(noisy(level * (1 + 0.4 * np.cos(0.3 * v + 0.05 * u + shifts[:, None, None])), rng, truth), shifts)
    assert found is not None
    for dark in (darkest + 0.5, darkest + 1.5):
        expected = truth.read_variance + truth.gain * dark
        assert found.read_variance + found.gain * dark == pytest.approx(expected, rel=0.1)


def test_too_few_steps_measure_no_noise(rng):
    """Below eight steps each temporal harmonic holds the projector's non-linearity too."""
    for n in (3, 4, 6):
        assert estimate_noise(np.full((n, 64, 64), 90, np.uint8), 2 * np.pi * np.arange(n) / n) is None


@pytest.mark.parametrize("n", [3, 4, 8, 12])
def test_gamma_stays_out_of_shifts_that_are_a_little_off(rng, n):
    """With seven steps or more harmonics 2 and 3 don't reach the phase, at no cost; even shifts have the usual weights."""
    even = 2 * np.pi * np.arange(n) / n
    np.testing.assert_allclose(phase_weights(even), pseudo_inverse(even), atol=1e-12)
    shifts = even + 0.02 * rng.normal(size=n)
    found, usual = phase_weights(shifts), pseudo_inverse(shifts)
    assert (found[1:] ** 2).sum() < 1.02 * (usual[1:] ** 2).sum()
    np.testing.assert_allclose(found @ np.stack([np.ones(n), np.cos(shifts), -np.sin(shifts)], axis=1), np.eye(3), atol=1e-12)
    leaked, before = (np.abs(weights[1:] @ np.exp(2j * shifts)).max() for weights in (found, usual))
    assert leaked < 1e-12 if n >= 7 else leaked == before


def test_random_shifts_keep_the_least_noise(rng):
    """Shifts so uneven that harmonics can't be told apart are fitted without them."""
    shifts = np.sort(rng.uniform(0, 2.2, 8))
    np.testing.assert_array_equal(phase_weights(shifts), pseudo_inverse(shifts))
