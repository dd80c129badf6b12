"""Pairs of frames that two cameras exposed together, the newest first."""

from collections import deque
from dataclasses import dataclass, field
from threading import Lock

from recon.navigation.feeds import Arrival
from recon.navigation.newest import Newest

TOGETHER_NS = 8_000_000  # between the exposures of a pair: more than unsure clocks differ by, less than half of usual periods
REMEMBERED = 4  # frames of a camera that wait for their partner


@dataclass(frozen=True)
class FramePair:
    """Frames of camera 1 and camera 2 that belong together."""

    left: Arrival
    right: Arrival

    @property
    def exposed_ns(self) -> int:
        """Monotonic time of camera 1's exposure."""
        return self.left.exposed_ns


@dataclass
class Pairing:
    """Puts frames together as they arrive, from one thread a camera, and leaves the newest pair."""

    newest: Newest[FramePair]
    together_ns: int = TOGETHER_NS
    _waiting: tuple[deque[Arrival], deque[Arrival]] = field(
        default_factory=lambda: (deque(maxlen=REMEMBERED), deque(maxlen=REMEMBERED))
    )
    _lock: Lock = field(default_factory=Lock)

    def add(self, camera: int, arrival: Arrival) -> None:
        """Take in a frame of camera 0 or 1."""
        with self._lock:
            others = self._waiting[1 - camera]
            partner = min(others, key=lambda other: _apart(arrival, other), default=None)
            if partner is None or _apart(arrival, partner) > self.together_ns:
                self._waiting[camera].append(arrival)
                return
            while others.popleft() is not partner:  # earlier ones have lost theirs
                pass
            self._waiting[camera].clear()
            self.newest.put(FramePair(arrival, partner) if camera == 0 else FramePair(partner, arrival))


def _apart(one: Arrival, other: Arrival) -> int:
    return abs(one.exposed_ns - other.exposed_ns)
