"""Frames of a device timed by this computer's clock, so that those of several devices lie on one line.

A camera counts from when it got power, a scanner's computer from 1970: the lag between both would be another each day.
"""

from collections import deque
from dataclasses import replace

from recon.devices.device_clocks import follow
from recon.devices.interfaces import Camera, Frame, Scanner

MOST_WAITING = 64  # frames that wait for a clock; a device of which none is found by then is timed by arrivals


class FrameTimes:
    """Times of a device's frames; used by one thread at a time."""

    def __init__(self, device: Camera | Scanner) -> None:
        """Begin without a clock, which takes some frames."""
        self.follower = follow(device)
        self._waiting = deque[Frame]()

    def add(self, frame: Frame) -> list[Frame]:
        """Take the next frame; those, in order, whose `time_ns` is now of this computer's monotonic clock."""
        self.follower.add(frame.time_ns, frame.arrived_ns)
        self._waiting.append(frame)
        clock = self.follower.clock
        if clock is None:
            return [] if len(self._waiting) < MOST_WAITING else [replace(one, time_ns=one.arrived_ns) for one in self._leave()]
        return [replace(one, time_ns=clock.at(one.time_ns)) for one in self._leave()]

    def clear(self) -> None:
        """Forget frames that wait; the clock goes on."""
        self._waiting.clear()

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
        """Wait for the next B-scan : (h, w) uint8; None if none came in time, or its time isn't known yet."""
        if not self._timed and (frame := self._scanner.frame(timeout_s)) is not None:
            self._timed.extend(self._times.add(frame))
        return self._timed.popleft() if self._timed else None

    def close(self) -> None:
        """Give the scanner back."""
        self._scanner.close()
