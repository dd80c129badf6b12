"""Exposures of frames by this computer's monotonic clock."""

from collections.abc import Callable
from dataclasses import dataclass

from recon.devices.device_clocks import ClockFollower
from recon.devices.interfaces import Frame

Exposed = Callable[[Frame], int]  # monotonic time : ns of a frame's exposure


@dataclass
class FollowedClock:
    """Exposures by a device's clock that is followed; by the arrival as long as too few frames have come."""

    follower: ClockFollower

    def __call__(self, frame: Frame) -> int:
        """Monotonic time : ns of a frame's exposure."""
        self.follower.add(frame.time_ns, frame.arrived_ns)
        clock = self.follower.clock
        return frame.arrived_ns if clock is None else clock.at(frame.time_ns)
