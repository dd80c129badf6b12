"""The time of virtual devices: it goes on with what they do, as fast as life at most."""

import threading
import time
from collections.abc import Sequence


class VirtualClock:
    """Time in ns of the virtual devices and, for them, of the computer. Rendering takes none of it."""

    def __init__(self, paced: bool = False) -> None:
        """Begin at zero; a paced clock waits where rendering is faster than life."""
        self._now, self._paced = 0, paced
        self._real = time.monotonic_ns()
        self._lock = threading.Lock()

    @property
    def now_ns(self) -> int:
        """The present."""
        return self._now

    def advance_to(self, time_ns: int) -> None:
        """Go on to a moment; one that is past already changes nothing."""
        with self._lock:
            step = max(time_ns - self._now, 0)
            ahead = step - (time.monotonic_ns() - self._real)
            if self._paced and ahead > 0:
                time.sleep(ahead * 1e-9)
            self._now, self._real = self._now + step, time.monotonic_ns()


class Turns:
    """Devices that run side by side, each rendered when its moment is the next one of all."""

    def __init__(self, clock: VirtualClock, holds: Sequence[int] = ()) -> None:
        """Before each of the moments of holds, in ns and rising, all wait until they `go_on`."""
        self._clock = clock
        self._holds = list(holds)
        self._next: dict[str, int] = {}  # ns, by device
        self._changed = threading.Condition()

    def set_next(self, device: str, moment_ns: int | None) -> None:
        """Say when a device's next frame is due; None if there will be no more."""
        with self._changed:
            self._next.pop(device, None)
            if moment_ns is not None:
                self._next[device] = moment_ns
            self._changed.notify_all()

    def go_on(self) -> None:
        """Go on until the next hold."""
        with self._changed:
            del self._holds[:1]
            self._changed.notify_all()

    def wait(self, device: str, timeout_s: float) -> bool:
        """Wait until a device's frame is the next one of all; whether it came to that in time."""

        def due() -> bool:
            first = min(self._next, key=lambda name: self._next[name])
            return first == device and not (self._holds and self._next[device] >= self._holds[0])

        with self._changed:
            return self._changed.wait_for(due, timeout_s)

    def advance(self, device: str, arrived_ns: int, next_ns: int | None) -> None:
        """A device's frame has arrived, and its next one is due later."""
        self._clock.advance_to(arrived_ns)
        self.set_next(device, next_ns)
