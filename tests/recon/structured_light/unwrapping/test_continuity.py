"""Continuity of a wrapped phase: are jumps seen, is smooth ground left alone, are orders carried only where they follow?"""

import numpy as np
import pytest

from recon.structured_light.unwrapping.continuity import CLEAN, INCOMPLETE, REACH, TORN, VOID, carry, continuity

SIGMA = 0.02  # rad


def wrapped(absolute, rng):
    """Phases : (h, w) in cycles, with noise, and their sigma in rad."""
    noisy = absolute + rng.normal(0, SIGMA / (2 * np.pi), absolute.shape)
    return (noisy - np.floor(noisy + 0.5)).astype(np.float32), np.full(absolute.shape, SIGMA, np.float32)


def test_curved_ground_is_clean(rng):
    """A bowl with a crease, as steep as the rig's flanks: chance alone tears, less than one pixel in a thousand."""
    v, u = np.mgrid[:300, :300].astype(float)
    absolute = 0.1 * u + ((u - 150) ** 2 + (v - 150) ** 2) / 4000 + 0.003 * np.abs(v - 100)
    flags = continuity(*wrapped(absolute, rng), np.ones(u.shape, bool))
    assert np.mean(flags == TORN) < 1e-3
    assert (flags[5:-6, 5:-6] != INCOMPLETE).all()


@pytest.mark.parametrize("jump", [0.08, 0.3, 0.5, 2.7])
@pytest.mark.parametrize("axis", [0, 1])
def test_jumps_are_torn(rng, jump, axis):
    """A step of any size but whole periods is torn all along, also when it is half a period."""
    v, u = np.mgrid[:120, :120].astype(float)
    flags = continuity(*wrapped(0.05 * u + 0.02 * v + jump * ((v, u)[axis] >= 60), rng), np.ones(u.shape, bool))
    across = np.moveaxis(flags, axis, 0)
    assert (across[59:61] == TORN).all()
    assert np.mean(across[20:50] == TORN) < 2e-3


def test_gaps_are_void_and_their_rim_is_incomplete(rng):
    u = np.mgrid[:60, :60][1].astype(float)
    valid = u != 30
    flags = continuity(*wrapped(0.05 * u, rng), valid)
    assert (flags[~valid] == VOID).all()
    assert (flags[:, [26, 29, 31, 34]] == INCOMPLETE).all()
    assert (flags[10:50, [15, 45]] == CLEAN).all()


def test_orders_are_carried_along_the_slope_only(rng):
    """Orders reach as far as asked, wrap on the way, and stop where two sides contradict each other."""
    u = np.mgrid[:40, :60][1].astype(float)
    phase, sigma = wrapped(0.12 * u, rng)
    truth = np.rint(0.12 * u - phase).astype(np.int32)
    flags = np.full(phase.shape, CLEAN, np.uint8)
    known = u < 20
    order, found = carry(truth * known, known, phase, sigma, flags, CLEAN, REACH)
    assert found[:, : 20 + REACH - 1].mean() > 0.99
    assert not found[:, 20 + REACH :].any()
    assert (order == truth)[found].all()
    split = truth + 1 * (u > 23)  # the right side claims another order over a gap that both can reach
    known = (u < 20) | (u > 23)
    _, found = carry(split * known, known, phase, sigma, flags, CLEAN, REACH)
    assert found[:, 20:24].mean() < 0.02


@pytest.mark.parametrize(
    ("wanted", "barrier", "crossed"),
    [
        (CLEAN, INCOMPLETE, False),
        (INCOMPLETE, INCOMPLETE, True),
        (CLEAN, TORN, False),
        (INCOMPLETE, TORN, False),
        (INCOMPLETE, VOID, False),
    ],
)
def test_nothing_is_carried_across_lesser_pixels(rng, wanted, barrier, crossed):
    """A band of 5 px that isn't as good as asked for stops an order, whatever lies beyond."""
    u = np.mgrid[:40, :60][1].astype(float)
    phase, sigma = wrapped(0.05 * u, rng)
    truth = np.rint(0.05 * u - phase).astype(np.int32)
    flags = np.full(phase.shape, CLEAN, np.uint8)
    flags[:, 20:25] = barrier
    known = u < 20
    _, found = carry(truth * known, known, phase, sigma, flags, wanted, REACH)
    assert found[:, 25:27].any() == crossed
