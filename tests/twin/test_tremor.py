"""A hand trembles with the frequencies and the strength that are asked for."""

import numpy as np
import pytest
from scipy.signal import periodogram

from twin import tremor

RATE_HZ, SECONDS = 200.0, 20.0


def record(*key):
    """Turn in deg and shift in mm, each along three axes, over time : (n, 6)."""
    shaken = tremor.draw(0.2, 0.1, *key)
    moves = np.array([shaken.at(t) for t in np.arange(0, SECONDS, 1 / RATE_HZ)])
    return np.concatenate([np.rad2deg(moves[:, :3]), moves[:, 3:]], axis=1)


def test_the_strength_is_as_asked():
    """Of 40 hands, in all axes; a hand's own scatters by 1 / sqrt(64)."""
    spread = np.sqrt(np.mean([record(seed).var(axis=0) for seed in range(40)], axis=0))
    assert spread == pytest.approx([0.2] * 3 + [0.1] * 3, rel=0.08)


def test_all_of_it_is_from_8_to_12_hz():
    hz, power = periodogram(record(1)[:, 4], RATE_HZ, window="hann")
    within = (hz > 7.8) & (hz < 12.2)
    assert power[within].sum() > 0.99 * power.sum()
    assert power[(hz > 8) & (hz < 10)].sum() > 0.1 * power.sum() < 10 * power[(hz > 10) & (hz < 12)].sum()


def test_the_rate_is_the_slope():
    shaken, t, step = tremor.draw(0.2, 0.1, 3), 1.234, 1e-6
    slope = (shaken.at(t + step) - shaken.at(t - step)) / (2 * step)
    np.testing.assert_allclose(shaken.rate(t), slope, rtol=1e-5)


def test_a_hand_is_the_same_for_the_same_key():
    assert (record(1, 2) == record(1, 2)).all() and not np.allclose(record(1, 2), record(1, 3))
