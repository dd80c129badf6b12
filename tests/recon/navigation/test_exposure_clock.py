"""Exposures by arrivals: late frames don't count, and a clock that jumps is followed."""

import numpy as np

from recon.devices.interfaces import Frame
from recon.navigation.exposure_clock import ArrivalClock

IMAGE = np.zeros((1, 1), np.uint8)
OFFSET_NS, LEAST_NS = 7 * 10**15, 8_000_000


def frames(rng, count, offset_ns=OFFSET_NS, first=0):
    """Frames at 50 Hz, delivered late by 8 ms and by a random share of another 30 ms."""
    taken = (first + np.arange(count)) * 20_000_000
    arrived = taken + LEAST_NS + np.int64(30e6 * rng.exponential(0.2, count))
    return [Frame(IMAGE, k, int(t - offset_ns), int(a)) for k, (t, a) in enumerate(zip(taken, arrived, strict=True))], taken


def test_exposures_are_found_whatever_the_delivery(rng):
    """The fastest of 200 exponential delays of 6 ms on average is late by 0.03 ms; five times that is allowed."""
    sent, taken = frames(rng, 300)
    clock = ArrivalClock(LEAST_NS)
    found = np.array([clock(frame) for frame in sent])
    assert np.abs(found - taken)[200:].max() < 150_000


def test_a_clock_that_was_set_anew_is_followed_at_once(rng):
    clock = ArrivalClock(LEAST_NS)
    for frame in frames(rng, 100)[0]:
        clock(frame)
    for step_ns in (3_600_000_000_000, -5_000_000_000):
        sent, taken = frames(rng, 100, OFFSET_NS + step_ns, 100)
        found = np.array([clock(frame) for frame in sent])
        assert np.abs(found - taken).max() < 60_000_000, "not by an hour, nor by five seconds"
