"""Several pitches: which can cover the axis, and are the orders right under noise?"""

import numpy as np
import pytest

from recon.errors import InputError
from recon.model.patterns import Fringes
from recon.structured_light.multi_frequency import fringe_order, ladder
from recon.structured_light.phase import Fringe


def measured(fringes, x, sigma, rng):
    """Wrapped phases of one set of fringes at the columns x, with noise."""
    phase = 2 * np.pi * (x - fringes.zero(1280)) / fringes.pitch + rng.normal(0, sigma, x.shape)
    wrapped = np.angle(np.exp(1j * phase)).astype(np.float32)
    level = np.full(x.shape, 90, np.float32)
    return Fringe(wrapped, level, level, np.full(x.shape, sigma, np.float32), np.zeros(x.shape, bool))


def decoded(pitches, x, sigma, rng, origins=None):
    origins = origins or [None] * len(pitches)
    sets = [Fringes(pitch=p, steps=8, origin=o) for p, o in zip(pitches, origins, strict=True)]
    pairs = [(fringes, measured(fringes, x, sigma, rng)) for fringes in sets]
    found = fringe_order(pairs, 1280)[0]
    fringes, fringe = min(pairs, key=lambda pair: pair[0].pitch)
    return fringes.zero(1280) + fringes.pitch * (fringe.phase / (2 * np.pi) + found.order), found.trusted


@pytest.mark.parametrize("pitches", [(12, 126, 1332), (1332, 12, 126), (64, 67), (100, 1350), (14, 15, 16)])
def test_orders_are_right_over_the_axis(rng, pitches):
    """Hierarchies, beats of two, and beats of beats; a little noise, all pixels trusted."""
    x = np.linspace(0, 1279, 60_000).reshape(200, 300)
    coordinate, trusted = decoded(pitches, x, 0.002, rng)
    assert trusted.all()
    assert np.abs(coordinate - x).max() < 0.5


def test_origins_may_differ(rng):
    x = np.linspace(0, 1279, 6000).reshape(20, 300)
    coordinate, trusted = decoded((12, 126, 1332), x, 0.002, rng, [3.0, -17.5, 900.0])
    assert trusted.all()
    assert np.abs(coordinate - x).max() < 0.5


@pytest.mark.parametrize("sigma", [0.02, 0.04, 0.05])
def test_trusted_pixels_are_right_under_noise(rng, sigma):
    """Ten-fold steps: pixels that noise could tip are dropped, none that is kept is wrong."""
    x = rng.uniform(0, 1279, (400, 500))
    coordinate, trusted = decoded((12, 126, 1332), x, sigma, rng)
    assert np.abs(coordinate - x)[trusted].max() < 6
    if sigma == 0.02:
        assert trusted.mean() > 0.999


def test_contradicting_phases_are_refused(rng):
    """Unrelated phases in the three sets end anywhere between two orders; only those near a whole order are kept.

    Each of the two rungs keeps twice 0.1 cycle and five sigmas, 0.105 rad at 0.01 rad of phase noise magnified by 10.5.
    """
    fringes = [Fringes(pitch=pitch, steps=8) for pitch in (12, 126, 1332)]
    sets = [(f, measured(f, rng.uniform(0, 1279, (50, 60)), 0.01, rng)) for f in fringes]
    trusted = fringe_order(sets, 1280)[0].trusted
    assert trusted.mean() == pytest.approx((2 * (0.1 + 5 * 0.105 / (2 * np.pi))) ** 2, abs=0.035)  # 5 standard errors


def test_pitches_that_cannot_cover_the_axis_are_refused():
    with pytest.raises(InputError, match="unambiguous over 72 px, expected 1280"):
        ladder([12, 72], 1280)
    with pytest.raises(InputError, match="sigma"):
        ladder([12, 12.1], 1280)


def test_the_safest_way_is_taken():
    """Three pitches close to each other: from the beat of beats over a plain beat, not in one leap."""
    assert [round(step.pitch) for step in ladder([12, 126, 1332], 1280)] == [1332, 126, 12]
    assert len(ladder([14, 15, 16], 1280)) > 2
