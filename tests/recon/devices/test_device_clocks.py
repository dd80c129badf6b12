"""A device's clock is found from late arrivals, with an uncertainty that holds; a clock that is set anew is named."""

import numpy as np
import pytest

from recon.devices.device_clocks import FEWEST, LATE, ClockFollower, ClockReading, fit_clock, least_transfer

FRAME_NS = 20_000_000
START_NS = 10**18  # of a device's clock that counts from 1970: floats hold it to 128 ns only
COMPUTER_NS = 5 * 10**12
TRANSFER_NS = 8_000_000


def exponential(rng, n):
    return rng.exponential(300e3, n)


def busy(rng, n):
    """A fifth of the frames waits for a core."""
    return np.where(rng.random(n) < 0.2, rng.exponential(10e6, n), rng.exponential(100e3, n))


def half_normal(rng, n):
    return np.abs(rng.normal(0, 300e3, n))


DELAYS = (exponential, busy, half_normal)


def frames(rng, n, rate, delays):
    """Device times, their true times by the computer's clock, and arrivals after the least transfer and a delay."""
    device = START_NS + FRAME_NS * np.arange(n)
    true = COMPUTER_NS + np.round(rate * FRAME_NS * np.arange(n)).astype(np.int64)
    return device, true, true + TRANSFER_NS + np.round(delays(rng, n)).astype(np.int64)


@pytest.mark.parametrize("delays", DELAYS)
@pytest.mark.parametrize("n", [8, 64, 512])
def test_times_and_rate_are_as_certain_as_they_say(rng, delays, n):
    """Errors over 100 draws, in standard deviations: RMS at most 1.3, of the rate 1.3 with 7 % of its own, three times that."""
    errors, rates = [], []
    for _ in range(100):
        rate = 1 + 3e-5 * rng.standard_normal()
        device, true, arrived = frames(rng, n, rate, delays)
        clock = fit_clock(device, arrived)
        end = int(device[-1])
        errors.append((clock.at(end) - true[-1] - TRANSFER_NS) / clock.sigma_at(end))
        rates.append((clock.rate - rate) / clock.rate_sigma)
    assert np.sqrt(np.mean(np.square(errors))) < 1.3
    assert np.sqrt(np.mean(np.square(rates))) < 1.5


@pytest.mark.parametrize("delays", DELAYS)
def test_ten_seconds_show_the_clock_to_some_microseconds(rng, delays):
    """Delays of a tenth of a millisecond to ten of them; the mean arrival would be off by 0.2 to 2 ms."""
    device, true, arrived = frames(rng, 512, 1 + 4e-5, delays)
    clock = fit_clock(device, arrived)
    middle = len(device) // 2
    assert abs(clock.at(int(device[middle])) - true[middle] - TRANSFER_NS) < 30e3
    assert clock.rate - 1 == pytest.approx(4e-5, abs=5e-6)


def test_few_frames_leave_the_rate_to_the_crystal(rng):
    device, _, arrived = frames(rng, FEWEST, 1 + 4e-5, busy)
    clock = fit_clock(device, arrived)
    assert (clock.rate, clock.rate_sigma) == (1, pytest.approx(1e-4))


def test_fewer_frames_show_a_clock_to_their_delays(rng):
    """Of seven, nine of ten errors are within three standard deviations."""
    errors = []
    for _ in range(200):
        device, true, arrived = frames(rng, 7, 1.0, exponential)
        clock = fit_clock(device, arrived)
        errors.append((clock.at(int(device[0])) - true[0] - TRANSFER_NS) / clock.sigma_at(int(device[0])))
    assert np.mean(np.abs(errors) < 3) > 0.9


def test_a_single_frame_leaves_its_delay_open(rng):
    """It is taken to have come at once, late by 0.3 ms in the mean: 5 ms are e^-16 of them."""
    device, true, arrived = frames(rng, 1, 1.0, exponential)
    clock = fit_clock(device, arrived)
    assert 0 <= clock.at(int(device[0])) - true[0] - TRANSFER_NS < 5e6 and np.isinf(clock.sigma_at(int(device[0])))


def test_a_clock_that_stands_still_is_refused():
    with pytest.raises(ValueError, match="stands still"):
        fit_clock(np.full(20, START_NS), COMPUTER_NS + FRAME_NS * np.arange(20))


def test_a_reading_of_the_clock_gives_the_transfer(rng):
    """The fastest of three readings counts; the slow ones were interrupted at one end, and are off by half of it."""
    device, true, arrived = frames(rng, 512, 1 + 4e-5, exponential)
    edge, k = fit_clock(device, arrived), 300
    readings = [
        ClockReading(int(device[k]), int(true[k]) - before, int(true[k]) + after)
        for before, after in ((100_000, 20_000_000), (90_000, 110_000), (5_000_000, 50_000))
    ]
    transfer, sigma = least_transfer(edge, readings)
    assert abs(transfer - TRANSFER_NS) < 3 * sigma < 300_000


def follow(times, reading=None):
    """All jumps that are found in pairs of device time and arrival, and the follower."""
    follower = ClockFollower("cam1", reading)
    return [jump for jump in (follower.add(int(device), int(arrived)) for device, arrived in times) if jump], follower


def test_steady_clocks_never_jump(rng):
    """Two minutes, a third of it under load: 30 ms late frames, and queues of a whole second that empty by and by."""
    device, _, arrived = frames(rng, 6000, 1 - 6e-5, busy)
    arrived[2000:4000] += np.round(rng.exponential(30e6, 2000)).astype(np.int64)
    for first in (2500, 3100, 5000):
        arrived[first : first + 50] = np.maximum(arrived[first : first + 50], arrived[first + 50] + 1000 * np.arange(50))
    arrived = np.maximum.accumulate(arrived)
    jumps, follower = follow(zip(device, arrived, strict=True))
    assert not jumps
    assert follower.clock.rate - 1 == pytest.approx(-6e-5, abs=1e-5)


@pytest.mark.parametrize("step_s", [3600.0, 0.05, 0.012, -0.012, -0.05, -3600.0])
def test_a_jump_is_named_with_its_step(rng, step_s):
    """Forward it shows in the first frame; backward by less than a frame it is taken for lateness at first."""
    device, true, arrived = frames(rng, 1000, 1 + 2e-5, exponential)
    device[500:] += round(1e9 * step_s)
    jumps, follower = follow(zip(device, arrived, strict=True))
    assert len(jumps) == 1
    assert jumps[0].device_ns == device[500]
    assert jumps[0].step_ns == pytest.approx(1e9 * step_s, abs=3e6)  # delays of some frames
    assert str(jumps[0]).startswith("cam1: its clock jumped by")
    assert abs(follower.clock.at(int(device[-1])) - true[-1] - TRANSFER_NS) < 200e3


def test_after_a_jump_no_map_is_given_until_frames_show_it(rng):
    device, _, arrived = frames(rng, 100 + FEWEST - 1, 1, exponential)
    device[100:] += 10**9
    jumps, follower = follow(zip(device, arrived, strict=True))
    assert len(jumps) == 1
    assert follower.clock is None


def test_a_clock_set_back_is_believed_after_some_frames(rng):
    device, _, arrived = frames(rng, 300, 1, exponential)
    device[200:] -= 15_000_000
    times = list(zip(device, arrived, strict=True))
    assert not follow(times[: 200 + LATE - 1])[0]
    assert follow(times[: 200 + LATE])[0]


def test_the_transfer_is_taken_out_and_stays_out(rng):
    """Of a clock that can be read, times are those of the exposures, also after a jump."""
    device, true, arrived = frames(rng, 600, 1, exponential)
    device[300:] += 10**9
    reading = ClockReading(START_NS, COMPUTER_NS - 50_000, COMPUTER_NS + 70_000)
    _, follower = follow(zip(device, arrived, strict=True), lambda: reading)
    assert abs(follower.clock.at(int(device[-1])) - true[-1]) < 100e3  # a third of a delay; and half the time of the reading
    assert follower.clock.sigma_ns < 100e3


def test_a_device_without_a_clock_fills_no_log(caplog):
    jumps, follower = follow([(0, COMPUTER_NS + FRAME_NS * k) for k in range(50)])
    assert len(jumps) == 49
    assert follower.clock is None
    assert not caplog.records
