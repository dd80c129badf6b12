"""Frames of a device timed by this computer's clock, so that those of several devices lie on one line.

A camera counts from when it got power, a scanner's computer from 1970: the lag between both would be another each day.
"""

import logging
from collections import deque
from dataclasses import replace

from recon.devices.device_clocks import ClockMap, follow
from recon.devices.interfaces import Camera, DeviceError, Frame, Scanner

LOG = logging.getLogger(__name__)


class FrameTimes:
    """Times of a device's frames; used by one thread at a time."""

    def __init__(self, device: Camera | Scanner) -> None:
        """Begin without a clock, which takes some frames."""
        self._follower = follow(device)
        self._known = False  # whether the device's clock has been
        self._stuck = False  # whether its stamps don't rise
        self._waiting = deque[Frame]()
        self._last_ns = 0

    def add(self, frame: Frame) -> list[Frame]:
        """Take the next frame; those, in order, whose `time_ns` is now of this computer's monotonic clock, and rises.

        Where stamps don't rise, there is no clock to follow: such frames are timed by their arrival.

        Raises
        ------
        DeviceError
            If the device's clock has jumped.
        """
        jump, timed = self._follower.add(frame.time_ns, frame.arrived_ns), list[Frame]()
        if jump is not None:
            if self._known:
                raise DeviceError(f"{jump}; record anew")
            timed = self._by_arrival()
            if not self._stuck:
                LOG.warning("%s: its time stamps don't rise; frames are timed by their arrival", self._follower.device)
            self._stuck = True
        self._waiting.append(frame)
        if (clock := self._follower.clock) is not None:
            self._known = True
            timed += self._by(clock)
        return timed

    def rest(self) -> list[Frame]:
        """Frames that still wait where no more will come: timed as `add` does, as well as so few allow."""
        clock = None if self._stuck else self._follower.clock_of_few()
        return self._by_arrival() if clock is None else self._by(clock)

    def begin_anew(self) -> None:
        """Forget frames that wait, as of a device that is started again; its clock goes on."""
        self._waiting.clear()

    def _by(self, clock: ClockMap) -> list[Frame]:
        return [self._at(one, clock.at(one.time_ns)) for one in self._leave()]

    def _by_arrival(self) -> list[Frame]:
        return [self._at(one, one.arrived_ns) for one in self._leave()]

    def _at(self, frame: Frame, time_ns: int) -> Frame:
        self._last_ns = max(time_ns, self._last_ns + 1)  # each fit moves the clock a little
        return replace(frame, time_ns=self._last_ns)

    def _leave(self) -> list[Frame]:
        gone = list(self._waiting)
        self._waiting.clear()
        return gone


class TimedScanner:
    """A `Scanner` whose B-scans are timed by this computer's clock."""

    def __init__(self, scanner: Scanner) -> None:
        self.name, self.size, self._scanner = scanner.name, scanner.size, scanner
        self._times = FrameTimes(scanner)
        self._timed = deque[Frame]()

    def frame(self, timeout_s: float) -> Frame | None:
        """Wait for the next B-scan : (h, w) uint8; None if none came in time, or its time isn't known yet.

        DeviceError if the scanner is gone, or its clock has jumped.
        """
        if not self._timed and (frame := self._scanner.frame(timeout_s)) is not None:
            self._timed.extend(self._times.add(frame))
        return self._timed.popleft() if self._timed else None

    def rest(self) -> list[Frame]:
        """B-scans that still wait for their time where no more will be asked for, in order."""
        rest = [*self._timed, *self._times.rest()]
        self._timed.clear()
        return rest

    def close(self) -> None:
        """Give the scanner back."""
        self._scanner.close()
