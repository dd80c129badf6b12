"""Stand-ins for devices and publishers: frames at will, losses at will, and what was published."""

from time import monotonic, monotonic_ns, sleep

import numpy as np

from recon.devices.interfaces import DeviceError, Frame
from tests.patience import PATIENCE_S


class Ticking:
    """A device whose frames come every some ms, by a clock that all of a `start_ns` share; lost after some frames."""

    def __init__(self, start_ns, period_s=0.02, image=None, lost_after=None):
        self.start_ns, self.period_ns, self.lost_after = start_ns, round(period_s * 1e9), lost_after
        self.image = np.zeros((8, 8), np.uint8) if image is None else image
        self.closed = False
        self._first = self._next = (monotonic_ns() - start_ns) // self.period_ns + 1

    def frame(self, timeout_s):
        number = self._next - self._first
        if self.lost_after is not None and number >= self.lost_after:
            raise DeviceError("ticking: expected a device, found it unplugged")
        time_ns = self.start_ns + self._next * self.period_ns
        wait_s = (time_ns - monotonic_ns()) * 1e-9
        sleep(max(0.0, min(wait_s, timeout_s)))
        if wait_s > timeout_s:
            return None
        self._next += 1
        return Frame(self.image, number, time_ns, monotonic_ns())

    def close(self):
        self.closed = True


class Kept:
    """A publisher that keeps moments, and takes its time."""

    def __init__(self, name="kept", seconds=0.0):
        self.name, self.seconds, self.moments, self.closed = name, seconds, [], False

    def publish(self, moment):
        self.moments.append(moment)
        sleep(self.seconds)

    def close(self):
        self.closed = True


def until(holds, seconds=PATIENCE_S):
    """Wait until something holds; fail if it doesn't."""
    end = monotonic() + seconds
    while not holds():
        assert monotonic() < end, "waited in vain"
        sleep(0.005)
