"""Gray code: is the fringe order right up to the borders of the periods?"""

import numpy as np
import pytest

from recon.model.patterns import Fringes, GrayCode, Patterns
from recon.structured_light.gray_code import fringe_order
from recon.structured_light.phase import Noise, wrapped_phase
from tests.recon.fringe_scenes import NOISE, photograph


def orders(code, fringes, x, rng, **light):
    """Decoded coordinates and where they are trusted, of a camera that sees the projector columns x : (h, w)."""
    patterns = Patterns(projector_size=(1280, 800), unwrap="gray", parts=(fringes, code))
    images = photograph(patterns, {"columns": x}, rng, **light)
    fringe = wrapped_phase(images[: fringes.steps], fringes.shifts, noise=NOISE, saturation=255)
    found, _ = fringe_order(images[fringes.steps :], code, fringes, fringe, 1280, NOISE)
    return fringes.zero(1280) + fringes.pitch * (fringe.phase / (2 * np.pi) + found.order), found.trusted


@pytest.mark.parametrize("start", [None, -140.0, -131.7, -3.0])
@pytest.mark.parametrize("inverted", [False, True])
def test_complementary_bit_is_safe_everywhere(rng, start, inverted):
    """No wrong order at any column, for any relation between the code's start and the fringes' origin, noisy and blurred."""
    x = rng.uniform(1, 1278, (200, 300))
    code = GrayCode(pitch=12, bits=7, start=start, complementary=True, inverted=inverted)
    decoded, trusted = orders(code, Fringes(pitch=12, steps=8), x, rng, light=120, blur=1.0)
    assert np.abs(decoded - x)[trusted].max() < 1
    assert trusted.mean() > 0.97


def test_noise_at_the_borders_is_harmless(rng):
    """Columns right at the borders of periods and half periods, in dim light: bits flip at random, orders don't."""
    code = GrayCode(pitch=12, bits=7, complementary=True)
    x = code.origin(1280) + 6 * rng.integers(25, 220, (200, 300)) + rng.normal(0, 0.05, (200, 300))
    decoded, trusted = orders(code, Fringes(pitch=12, steps=8), x, rng, light=40)
    assert np.abs(decoded - x)[trusted].max() < 2
    assert trusted.mean() > 0.97


def test_without_it_borders_are_left_out(rng):
    """With the phase border on the code's border, the margin of a tenth period on each side isn't trusted, the rest is right."""
    x = rng.uniform(10, 1270, (200, 300))
    code, fringes = GrayCode(pitch=18, bits=7), Fringes(pitch=18, steps=18, first=1)
    decoded, trusted = orders(code, fringes, x, rng)
    assert np.abs(decoded - x)[trusted].max() < 1
    assert trusted.mean() == pytest.approx(0.8, abs=0.03)


def test_two_uncertain_bits_are_refused(rng):
    """A Gray code changes one bit at a time: grey everywhere means no code at all."""
    fringes, code = Fringes(pitch=12, steps=8), GrayCode(pitch=12, bits=7, complementary=True)
    patterns = Patterns(projector_size=(1280, 800), unwrap="gray", parts=(fringes, code))
    images = photograph(patterns, {"columns": rng.uniform(100, 1100, (50, 60))}, rng)
    fringe = wrapped_phase(images[:8], fringes.shifts, noise=NOISE, saturation=255)
    grey = np.broadcast_to(np.rint(fringe.offset).astype(np.uint8), (8, 50, 60))
    assert not fringe_order(grey, code, fringes, fringe, 1280, NOISE)[0].trusted.any()


def test_a_doubtful_bit_is_trusted_only_if_it_does_not_matter(rng):
    """A bit of middling grey, far from its border, can be read either way: trusted where both ways lead to one order."""
    fringes, code = Fringes(pitch=18, steps=18), GrayCode(pitch=18, bits=7)
    patterns = Patterns(projector_size=(1280, 800), unwrap="gray", parts=(fringes, code))
    x = rng.uniform(10, 1270, (100, 120))
    images = photograph(patterns, {"columns": x}, rng, noise=Noise(0.1, 0.0))  # quieter than the decoder believes
    fringe = wrapped_phase(images[:18], fringes.shifts, noise=NOISE, saturation=255)
    for bit in range(7):
        doubtful = images[18:].copy()
        doubtful[bit] = 8 + 90
        found, _ = fringe_order(doubtful, code, fringes, fringe, 1280, NOISE)
        decoded = fringes.zero(1280) + 18 * (fringe.phase / (2 * np.pi) + found.order)
        assert (np.abs(decoded - x)[found.trusted] < 1).all()
        assert found.trusted.mean() < 0.01


def test_a_doubtful_bit_of_a_complementary_code_mostly_does_not_matter(rng):
    """Of the finest bit, which both ways of reading put into neighbouring cells of one order, or of another."""
    fringes, code = Fringes(pitch=18, steps=18), GrayCode(pitch=18, bits=8, complementary=True)
    patterns = Patterns(projector_size=(1280, 800), unwrap="gray", parts=(fringes, code))
    x = rng.uniform(10, 1270, (100, 120))
    images = photograph(patterns, {"columns": x}, rng, noise=Noise(0.1, 0.0))
    fringe = wrapped_phase(images[:18], fringes.shifts, noise=NOISE, saturation=255)
    doubtful = images[18:].copy()
    doubtful[-1] = 8 + 90
    found, _ = fringe_order(doubtful, code, fringes, fringe, 1280, NOISE)
    decoded = fringes.zero(1280) + 18 * (fringe.phase / (2 * np.pi) + found.order)
    assert found.trusted.mean() > 0.3
    assert (np.abs(decoded - x)[found.trusted] < 1).all()


def test_gamma_does_not_move_the_threshold(rng):
    """Grey fringes pass the gamma and are darker in the mean than half of white: the bits' borders must not follow them.

    Blurred over nearly half a period, a border that moved costs trust, and what is trusted is wrong in 6 pixels of 10 000; in
    its place it is wrong where noise beats the 3 sigma of a sure bit.
    """
    x = rng.uniform(30, 1250, (200, 300))
    decoded, trusted = orders(GrayCode(pitch=12, bits=7), Fringes(pitch=12, steps=18), x, rng, blur=5.0, gamma=2.2)
    assert np.mean(np.abs(decoded - x)[trusted] > 2) < 2e-4
    assert trusted.mean() == pytest.approx(0.8, abs=0.02)


@pytest.mark.parametrize(("pitch", "start"), [(12, None), (12, -140.3), (10, 0.0), (9, -3.0)])
def test_residuals_spread_evenly(rng, pitch, start):
    """Cells half a period wide: the phase is at most a quarter period from their middle, as often on either side."""
    fringes, code = Fringes(pitch=pitch, steps=8), GrayCode(pitch=pitch, bits=8, start=start, complementary=True)
    patterns = Patterns(projector_size=(1280, 800), unwrap="gray", parts=(fringes, code))
    images = photograph(patterns, {"columns": rng.uniform(10, 1270, (200, 300))}, rng)
    fringe = wrapped_phase(images[:8], fringes.shifts, noise=NOISE, saturation=255)
    _, residual = fringe_order(images[8:], code, fringes, fringe, 1280, NOISE)
    assert abs(residual.mean()) < 0.005  # five standard errors are 0.003
    assert np.mean(np.abs(residual) > 0.25) < 0.06
    assert np.std(residual) == pytest.approx(0.25 / np.sqrt(3), rel=0.05)
