"""Exposures by a clock that is followed, and by arrivals as long as it isn't known."""

import numpy as np

from recon.devices.device_clocks import ClockFollower
from recon.devices.interfaces import Frame
from recon.navigation.feeds import FollowedClock

OFFSET_NS, LEAST_NS = 7 * 10**15, 8_000_000


def test_exposures_follow_the_fastest_deliveries(rng):
    """At 50 Hz, delivered late by 8 ms, which nobody sees, and by 6 ms on average, of which 0.5 ms may be left."""
    taken = np.arange(300) * 20_000_000
    arrived = taken + LEAST_NS + np.int64(30e6 * rng.exponential(0.2, 300))
    clock, image = FollowedClock(ClockFollower("cam1")), np.zeros((1, 1), np.uint8)
    frames = [Frame(image, k, int(t - OFFSET_NS), int(a)) for k, (t, a) in enumerate(zip(taken, arrived, strict=True))]
    found = np.array([clock(frame) for frame in frames])
    assert found[0] == arrived[0]
    assert np.abs(found - taken - LEAST_NS)[200:].max() < 500_000
