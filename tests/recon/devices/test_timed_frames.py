"""Frames of devices with clocks of their own, on this computer's clock."""

from dataclasses import replace

import numpy as np
import pytest

from recon.devices.camera_pairs import CameraPair
from recon.devices.device_clocks import ClockReading
from recon.devices.interfaces import DeviceError, Frame
from recon.devices.timed_frames import FrameTimes, TimedScanner

IMAGE = np.zeros((2, 2), np.uint8)
START_NS = 5 * 10**12
UPTIME_NS, UNIX_NS = 3 * 10**9, 1_795_000_000 * 10**9  # what a camera's and a scanner's clock show at the start
TRANSFER_NS = 5_000_000


class Sent:
    """A device that gives frames in turn."""

    size, bits = (2, 2), 8

    def __init__(self, name, frames):
        self.name, self.frames = name, list(frames)

    def frame(self, timeout_s):
        return self.frames.pop(0) if self.frames else None

    def start(self, trigger):
        pass


def taken(rng, shown_ns, rate=1.0, n=400, period_ns=20_000_000):
    """Frames by a clock of the device's own, which arrive late by a transfer and, at random, more."""
    true = START_NS + period_ns * np.arange(n)
    late = TRANSFER_NS + rng.exponential(300e3, n).astype(int)
    own = [shown_ns + round(rate * int(moment - START_NS)) for moment in true]
    return [Frame(IMAGE, k, own[k], int(true[k] + late[k])) for k in range(n)], true


def test_a_camera_that_counts_from_power_on_and_a_scanner_that_counts_from_1970_lie_on_one_line(rng):
    """Fifty-six years apart, 50 ppm fast and slow: to 1 ms the same moments, later by the transfer that no clock shows."""
    films = [taken(rng, UPTIME_NS + k, 1 + 5e-5)[0] for k in range(2)]
    scans, true = taken(rng, UNIX_NS, 1 - 5e-5)
    pair = CameraPair((Sent("cam1", films[0]), Sent("cam2", films[1])))
    pair.start("hardware")
    pairs = [pair.pair(0.01) for _ in range(len(true) + 20)]
    filmed = np.array([one.frames[0].time_ns for one in pairs if one])
    scanner = TimedScanner(Sent("us", scans))
    scanned = np.array([one.time_ns for one in (scanner.frame(0.0) for _ in range(len(true) + 20)) if one])
    assert len(filmed) == len(scanned) == len(true)
    assert np.allclose(filmed, scanned, atol=1e6, rtol=0)
    assert np.allclose(filmed, true + TRANSFER_NS, atol=1e6, rtol=0)
    assert np.all(np.diff(filmed) > 0) and np.all(np.diff(scanned) > 0)


def test_frames_wait_for_a_clock_in_order_and_none_is_lost(rng):
    times = FrameTimes(Sent("us", []))
    frames, _ = taken(rng, UNIX_NS, n=30)
    given = [times.add(one) for one in frames]
    assert not given[0] and [one.number for some in given for one in some] == list(range(30))


def test_a_device_without_a_clock_is_timed_by_arrivals(rng, caplog):
    """Its stamps stand still: each frame begins a new clock, and comes when the next one shows that."""
    frames, _ = taken(rng, 0, 0.0, n=200)
    times = FrameTimes(Sent("us", []))
    found = [one for frame in frames for one in times.add(frame)]
    found += times.rest()  # the last one
    assert [one.time_ns for one in found] == [one.arrived_ns for one in frames]
    assert [record.message for record in caplog.records] == ["us: its time stamps don't rise; frames are timed by their arrival"]


@pytest.mark.parametrize("step_s", [37.0, -37.0])
def test_a_clock_that_jumps_ends_it(rng, step_s):
    """What came before keeps its time; times after it don't belong to those."""
    frames, true = taken(rng, UNIX_NS, n=100)
    frames[60:] = [replace(one, time_ns=one.time_ns + round(1e9 * step_s)) for one in frames[60:]]
    times = FrameTimes(Sent("us", []))
    found = [one for frame in frames[:60] for one in times.add(frame)]
    assert np.allclose([one.time_ns for one in found], true[:60] + TRANSFER_NS, atol=1e6, rtol=0)
    with pytest.raises(DeviceError, match=r"us: its clock jumped by [+-]3[67]\.\d+ s.*record anew"):
        times.add(frames[60])


@pytest.mark.parametrize("n", [1, 2, 7])
def test_few_frames_are_timed_by_the_fastest_of_them(rng, n):
    """Late by 0.3 ms in the mean: the fastest of a few, and its correction, to a millisecond."""
    frames, true = taken(rng, UNIX_NS, n=n)
    times = FrameTimes(Sent("us", []))
    assert not [one for frame in frames for one in times.add(frame)]
    rest = times.rest()
    assert [one.number for one in rest] == list(range(n)) and not times.rest()
    assert np.allclose([one.time_ns for one in rest], true + TRANSFER_NS, atol=1.5e6, rtol=0)
    assert np.all(np.diff([one.time_ns for one in rest]) == 20_000_000)


@pytest.mark.parametrize("gone", [False, True])
def test_a_clock_that_can_be_read_takes_the_transfer_out_of_few_frames(rng, gone):
    """Of a camera that was unplugged before it could be read, the transfer stays in."""
    frames, true = taken(rng, UPTIME_NS, n=5)

    def read_clock():
        if gone:
            raise DeviceError("cam1: unplugged")
        return ClockReading(frames[4].time_ns, int(true[4]) - 10_000, int(true[4]) + 10_000)

    camera = Sent("cam1", [])
    camera.read_clock = read_clock
    times = FrameTimes(camera)
    for frame in frames:
        times.add(frame)
    found = np.array([one.time_ns for one in times.rest()])
    assert np.allclose(found, true + (TRANSFER_NS if gone else 0), atol=1.5e6, rtol=0)


def test_times_rise_though_the_first_frames_come_at_once(rng):
    """Fifteen frames that waited in a buffer arrive together: each fit finds an earlier clock."""
    frames, true = taken(rng, UNIX_NS, n=200)
    frames[:15] = [replace(one, arrived_ns=int(true[15]) + k) for k, one in enumerate(frames[:15])]
    times = FrameTimes(Sent("us", []))
    found = np.array([one.time_ns for frame in frames for one in times.add(frame)])
    assert np.all(np.diff(found) > 0) and len(found) == 200
    assert np.allclose(found[100:], true[100:] + TRANSFER_NS, atol=2e7, rtol=0)  # the early ones count for long


@pytest.mark.parametrize("calls", [1, 3])
def test_frames_taken_at_a_call_wait_for_no_clock(rng, calls):
    film = taken(rng, UPTIME_NS, n=calls)[0]
    cameras = Sent("cam1", film), Sent("cam2", film)
    for camera in cameras:
        camera.trigger = lambda: None
    pair = CameraPair(cameras)
    pair.start("software")
    assert [pair.pair(0.01) is not None for _ in range(calls)] == [True] * calls
