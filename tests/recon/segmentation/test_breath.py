"""Breath in the course of a distance, beside a hand that is unsteady or presses more and more."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d

from recon.segmentation import breath

TIMES = np.arange(180) / 20  # s
STEADY = np.full(len(TIMES), 0.9)  # cosines of the skin's normal with the chest's


def unsteady(rng, times=TIMES):
    """A hand's unsteadiness of 0.15 mm over 0.15 s, and noise of 0.08 mm."""
    wander = gaussian_filter1d(rng.standard_normal(len(times) + 60), 3)[30:-30]
    return 0.15 * wander / wander.std() + 0.08 * rng.standard_normal(len(times))


@pytest.mark.parametrize(("rise_mm", "period_s"), [(2.0, 4.0), (5.0, 5.5)])
def test_a_breath_is_found_beside_pressure(rng, rise_mm, period_s):
    """A quick inspiration, a slower expiration and a pause, by a hand that presses by 1 to 2 mm: to 0.35 mm, as predicted."""
    share = (TIMES / period_s + 0.3) % 1
    true = rise_mm * np.where(share < 0.35, np.sin(np.pi * share / 0.7), np.clip(1 - (share - 0.35) / 0.4, 0, 1)) ** 2
    pressed = np.linspace(1.0, 2.0, len(TIMES))
    found = breath.part(TIMES, STEADY * true - pressed + unsteady(rng), STEADY)
    assert found.period_s == pytest.approx(period_s, rel=0.1)
    errors = found.breath - true
    assert np.sqrt(np.mean(errors**2)) < 0.35 and np.mean(np.abs(errors) < 2 * found.sigma) > 0.7
    assert np.sqrt(np.mean((found.rest + pressed) ** 2)) < 0.35


@pytest.mark.parametrize("seed", range(5))
def test_an_unsteady_hand_breathes_not(seed):
    """Nor does one that presses more and more, by 1.5 mm."""
    rng = np.random.default_rng(seed)
    pressed = np.linspace(0.5, 2.0, len(TIMES))
    found = breath.part(TIMES, unsteady(rng) - pressed, STEADY)
    assert found.period_s is None and not found.breath.any()
    assert np.sqrt(np.mean((found.rest + pressed) ** 2)) < 0.2


def test_less_than_a_breath_and_a_quarter_is_none():
    """Of a half, or of one that a shorter one would resemble, nothing is said: all of it is left to the rest."""
    for count in (40, 70):
        rise = 4 * np.sin(np.pi * TIMES[:count] / 4) ** 2
        found = breath.part(TIMES[:count], rise, STEADY[:count])
        assert found.period_s is None and np.abs(found.rest - rise).max() < 0.3


def test_outliers_and_gaps_count_for_nothing(rng):
    """A face that lies far off in some B-scans, such as over a nipple, and some without a distance."""
    distances = 3 * np.sin(np.pi * TIMES / 4) ** 4 + unsteady(rng)
    harmed = distances.copy()
    harmed[[20, 50, 51, 100]] += 4
    harmed[130:140] = np.nan
    whole, parted = (breath.part(TIMES, values, STEADY) for values in (distances, harmed))
    assert parted.period_s == pytest.approx(4.0, rel=0.1) and np.abs(parted.breath - whole.breath).max() < 0.5


def test_distances_that_jump_hold_no_breath():
    """Eight that have nothing to do with each other."""
    distances = np.array([0.09, 3.30, 1.59, 9.87, 2.06, 8.35, 9.58, 5.54])
    parts = breath.part(0.05 * np.arange(8), distances, np.ones(8))
    assert parts.period_s is None and not parts.breath.any()
