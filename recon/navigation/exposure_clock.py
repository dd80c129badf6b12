"""Device clocks on this computer's monotonic clock, from nothing but the times at which frames arrive."""

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field

from recon.devices.interfaces import Frame

Exposed = Callable[[Frame], int]  # monotonic time : ns of a frame's exposure

WINDOW = 200  # frames, among which the fastest delivery counts: clocks drift apart by less than 0.1 ms meanwhile
JUMP_NS = 250_000_000  # by which no delivery varies: the device's clock was set anew


@dataclass
class ArrivalClock:
    """Exposures by the fastest delivery of late; for devices whose clock nobody has mapped better.

    A frame is never delivered before its exposure, so the least difference of arrival and time stamp is the offset between the
    clocks and the fastest delivery. The latter can't be seen in the differences; it has to be told.
    """

    least_delivery_ns: int = 0  # from the middle of an exposure to the image in memory
    _offsets: deque[int] = field(default_factory=lambda: deque(maxlen=WINDOW))

    def __call__(self, frame: Frame) -> int:
        """Monotonic time : ns of a frame's exposure."""
        offset = frame.arrived_ns - frame.time_ns
        if self._offsets and abs(offset - min(self._offsets)) > JUMP_NS:
            self._offsets.clear()
        self._offsets.append(offset)
        return frame.time_ns + min(self._offsets) - self.least_delivery_ns
