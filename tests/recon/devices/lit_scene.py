"""A projector and cameras that see its light on a wall, with the faults that real ones have, in a time of their own."""

from collections import deque

import numpy as np

from recon.devices import pattern_player, projector_delay
from recon.devices.interfaces import DeviceError, Frame

GAIN, AMBIENT = 0.8, 10.0  # DN a level, DN
CALL_NS, TRANSFER_NS, LATE_NS = 1_000, 500_000, 110_000_000


class Clock:
    """Stands for the module `time`: it goes on by calls and waits alone, however busy the machine is."""

    def __init__(self, monkeypatch):
        self.now_ns = 10**9
        for module in (pattern_player, projector_delay):
            monkeypatch.setattr(module, "time", self)

    def monotonic_ns(self):
        self.now_ns += CALL_NS
        return self.now_ns

    def monotonic(self):
        return self.monotonic_ns() / 1e9

    def sleep(self, seconds):
        self.now_ns += round(1e9 * seconds)


class Wall:
    """A projector's light over time, on a wall."""

    def __init__(self, clock, size=(96, 64), delay_s=0.0, gamma=1.0, frozen=()):
        """`frozen` : numbers of calls of `show` that have no effect."""
        self.clock, self.size, self.delay_s, self.gamma, self.frozen = clock, size, delay_s, gamma, set(frozen)
        self.calls = 0
        self.history = deque([(0, np.zeros(size[::-1], np.uint8))], maxlen=8)

    def show(self, pattern):
        now = self.clock.monotonic_ns()
        if self.calls not in self.frozen:
            self.history.append((now + round(1e9 * self.delay_s), pattern))
        self.calls += 1
        return now

    def close(self):
        pass

    def light(self, begin_ns, end_ns):
        """Mean light (h, w), 0 to 255, from a time to a later one."""
        times = np.clip([*(at for at, _ in self.history), np.inf], begin_ns, end_ns)
        shares = np.diff(times) / (end_ns - begin_ns)
        return sum(share * 255 * (pattern / 255) ** self.gamma for share, (_, pattern) in zip(shares, self.history, strict=True))


class WallCamera:
    """A camera that sees a wall, pixel by pixel."""

    bits = 8

    def __init__(self, wall, rng, name="cam1", exposure_s=0.002, period_s=0.004, lost=(), late=(), noise=1.0, gain=GAIN):
        """`lost` : numbers of exposures that never arrive; `late` : of those that arrive among those of the next patterns."""
        self.wall, self.rng, self.name, self.size = wall, rng, name, wall.size
        self.exposure_ns, self.period_ns, self.noise, self.gain = round(1e9 * exposure_s), round(1e9 * period_s), noise, gain
        self.lost, self.late = set(lost), set(late)
        self.exposures = 0
        self.unplugged = False

    def set_exposure(self, exposure_s, gain):
        self.exposure_ns = round(1e9 * exposure_s)

    def start(self, trigger):
        self.mode, self.began_ns, self.number, self.queue = trigger, self.wall.clock.monotonic_ns(), 0, []

    def trigger(self):
        assert self.mode == "software"
        self._expose(self.wall.clock.monotonic_ns())

    def frame(self, timeout_s):
        if self.unplugged:
            raise DeviceError(f"{self.name}: expected a camera, found none")
        clock = self.wall.clock
        end = clock.monotonic_ns() + round(1e9 * timeout_s)
        while self.mode != "software" and self.began_ns + self.number * self.period_ns <= end:
            self._expose(self.began_ns + self.number * self.period_ns)
        first = min(self.queue, default=None)
        if first is None or first[0] > end:
            clock.now_ns = end
            return None
        self.queue.remove(first)
        arrives, number, begin = first
        clock.now_ns = max(clock.now_ns, arrives)
        light = self.wall.light(begin, begin + self.exposure_ns)
        level = AMBIENT + self.gain * light + self.noise * self.rng.standard_normal(self.size[::-1])
        image = np.uint8(np.clip(np.rint(level), 0, 255))
        return Frame(image, number, begin + self.exposure_ns // 2, arrives)

    def stop(self):
        self.queue = []

    def close(self):
        pass

    def _expose(self, begin_ns):
        number, self.number = self.number, self.number + 1
        exposure, self.exposures = self.exposures, self.exposures + 1
        if exposure not in self.lost:
            delay = LATE_NS if exposure in self.late else TRANSFER_NS
            self.queue.append((begin_ns + self.exposure_ns + delay, number, begin_ns))
