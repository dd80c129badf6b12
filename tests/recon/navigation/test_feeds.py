"""A device that is lost is opened again, and meanwhile its trouble is told."""

from time import monotonic_ns

import numpy as np
import pytest

from recon.devices.interfaces import DeviceError
from recon.navigation import feeds
from recon.navigation.feeds import Device, Feed
from tests.recon.navigation.live_stand_ins import Ticking, until

AGAIN_S = 0.05


@pytest.fixture
def feed():
    """A feed of devices made by a function, stopped in the end."""
    made = []

    def start(opener):
        came = []
        made.append(Feed(Device("cam1", opener, lambda source: lambda frame: frame.time_ns), came.append, AGAIN_S))
        made[-1].start()
        return made[-1], came

    yield start
    for each in made:
        each.stop()


def test_frames_are_handed_on_in_order(feed):
    devices = []

    def opened():
        devices.append(Ticking(monotonic_ns(), 0.005))
        return devices[-1]

    running, came = feed(opened)
    until(lambda: len(came) >= 5)
    assert running.trouble is None
    running.stop()
    assert [arrival.frame.number for arrival in came] == list(range(len(came)))
    assert len(devices) == 1 and devices[0].closed


def test_a_lost_device_is_closed_and_opened_again_until_it_is_back(feed):
    """Unplugged after 3 frames, then absent twice, then back."""
    start, tries = monotonic_ns(), []

    def opened():
        tries.append(monotonic_ns())
        if len(tries) in (2, 3):
            raise DeviceError("cam1: expected a camera, found none; plug it in")
        devices.append(Ticking(start, 0.005, lost_after=3 if len(tries) == 1 else None))
        return devices[-1]

    devices = []
    running, came = feed(opened)
    until(lambda: running.trouble is not None and "plug it in" in running.trouble)
    assert len(came) == 3 and devices[0].closed
    until(lambda: len(came) >= 6)
    assert running.trouble is None and running.lost == 0
    assert len(tries) == 4
    assert np.diff(tries).min() >= AGAIN_S * 1e9


def test_frames_that_the_device_left_out_are_counted(feed):
    class Gaps(Ticking):
        def frame(self, timeout_s):
            self._next += 2
            return super().frame(timeout_s)

    running, came = feed(lambda: Gaps(monotonic_ns(), 0.002))
    until(lambda: len(came) >= 4)
    running.stop()
    assert running.lost == 2 * (len(came) - 1)


def test_a_device_that_falls_silent_is_told(feed, monkeypatch):
    monkeypatch.setattr(feeds, "SILENT_S", 0.05)
    monkeypatch.setattr(feeds, "WAIT_S", 0.02)
    running, _ = feed(lambda: Ticking(monotonic_ns(), 3600.0))
    until(lambda: "no frame for" in (running.trouble or ""))
