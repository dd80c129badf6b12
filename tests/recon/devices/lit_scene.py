"""A projector and cameras that see its light on a wall, with the faults that real ones have."""

import time
from collections import deque

import numpy as np

from recon.devices.interfaces import DeviceError, Frame

GAIN, AMBIENT = 0.8, 10.0  # DN a level, DN
LATE_NS = 110_000_000


class Wall:
    """A projector's light over time, on a wall."""

    def __init__(self, size=(96, 64), delay_s=0.0, gamma=1.0, frozen=()):
        """`frozen` : numbers of calls of `show` that have no effect."""
        self.size = size
        self.delay_s = delay_s
        self.gamma = gamma
        self.frozen = set(frozen)
        self.calls = 0
        self.history = deque([(0, np.zeros(size[::-1], np.uint8))], maxlen=8)
        self.closed = False

    def show(self, pattern):
        now = time.monotonic_ns()
        if self.calls not in self.frozen:
            self.history.append((now + round(1e9 * self.delay_s), pattern))
        self.calls += 1
        return now

    def close(self):
        self.closed = True

    def light(self, begin_ns, end_ns):
        """Mean light (h, w), 0 to 255, from a time to a later one."""
        changes = [at for at, _ in self.history]
        times = np.clip([*changes, np.inf], begin_ns, end_ns)
        shares = np.diff(times) / (end_ns - begin_ns)
        return sum(share * 255 * (pattern / 255) ** self.gamma for share, (_, pattern) in zip(shares, self.history, strict=True))


class WallCamera:
    """A camera that sees a wall, pixel by pixel."""

    bits = 8

    def __init__(self, wall, rng, name="cam1", exposure_s=0.002, period_s=0.004, lost=(), late=(), noise=1.0, gain=GAIN):
        """`lost` : numbers of exposures that never arrive; `late` : of those that arrive among those of the next patterns."""
        self.wall, self.rng, self.name, self.size = wall, rng, name, wall.size
        self.exposure_s, self.period_s, self.noise, self.gain = exposure_s, period_s, noise, gain
        self.lost, self.late = set(lost), set(late)
        self.exposures = 0
        self.starts = 0
        self.unplugged = False

    def set_exposure(self, exposure_s, gain):
        self.exposure_s = exposure_s

    def start(self, trigger):
        self.mode, self.began_ns, self.number, self.queue = trigger, time.monotonic_ns(), 0, deque()
        self.starts += 1

    def trigger(self):
        assert self.mode == "software"
        self._expose(time.monotonic_ns())

    def frame(self, timeout_s):
        if self.unplugged:
            raise DeviceError(f"{self.name}: expected a camera, found none")
        end = time.monotonic() + timeout_s
        while True:
            if self.mode != "software":
                self._catch_up()
            if self.queue and min(self.queue)[0] <= time.monotonic_ns():
                first = min(self.queue)
                self.queue.remove(first)
                return self._image(*first)
            if time.monotonic() >= end:
                return None
            time.sleep(0.0005)

    def stop(self):
        self.queue = deque()

    def close(self):
        pass

    def _catch_up(self):
        """Expose all images that a free camera has begun and ended by now."""
        period, exposure = round(1e9 * self.period_s), round(1e9 * self.exposure_s)
        while self.began_ns + self.number * period + exposure <= time.monotonic_ns():
            self._expose(self.began_ns + self.number * period)

    def _expose(self, begin_ns):
        end_ns = begin_ns + round(1e9 * self.exposure_s)
        number, self.number = self.number, self.number + 1
        exposure, self.exposures = self.exposures, self.exposures + 1
        if exposure in self.lost:
            return
        arrives = end_ns + (LATE_NS if exposure in self.late else 500_000)
        self.queue.append((arrives, number, begin_ns, end_ns))

    def _image(self, arrives, number, begin_ns, end_ns):
        level = AMBIENT + self.gain * self.wall.light(begin_ns, end_ns) + self.noise * self.rng.standard_normal(self.size[::-1])
        return Frame(np.uint8(np.clip(np.rint(level), 0, 255)), number, (begin_ns + end_ns) // 2, arrives)
