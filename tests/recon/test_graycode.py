"""Gray code: is the fringe order right up to the borders of the periods?"""

import numpy as np
import pytest

from recon.graycode import fringe_order
from recon.patterns import Fringes, GrayCode, Patterns
from recon.phase import wrapped_phase
from tests.recon.fringe_scenes import NOISE, photograph


def orders(code, fringes, x, rng, **light):
    """Decoded coordinates and where they are trusted, of a camera that sees the projector columns x : (h, w)."""
    patterns = Patterns(projector_size=(1280, 800), unwrap="gray", parts=(fringes, code))
    images = photograph(patterns, {"columns": x}, rng, **light)
    fringe = wrapped_phase(images[: fringes.steps], fringes.shifts, noise=NOISE, saturation=255)
    found = fringe_order(images[fringes.steps :], code, fringes, fringe, 1280, NOISE)
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
    assert not fringe_order(grey, code, fringes, fringe, 1280, NOISE).trusted.any()
