"""Feeds: a thread a device, which hands on its frames, with their exposures, and opens the device again when it was lost."""

import logging
from collections.abc import Callable
from dataclasses import dataclass, field
from threading import Event, Thread
from time import monotonic
from typing import Protocol

from recon.devices.device_clocks import ClockFollower
from recon.devices.interfaces import DeviceError, Frame

log = logging.getLogger(__name__)
AGAIN_S = 1.0  # after a loss, until the device is opened again
WAIT_S = 0.2  # for a frame, before looking whether to end
SILENT_S = 1.0  # without a frame, which is told
Exposed = Callable[[Frame], int]  # monotonic time : ns of a frame's exposure


class Source(Protocol):
    """A device that sends frames, started: what cameras and scanners have in common."""

    def frame(self, timeout_s: float) -> Frame | None:
        """Wait for the next frame; None if none came in time. DeviceError if the device is gone."""

    def close(self) -> None:
        """Give the device back."""


@dataclass(frozen=True)
class Device:
    """A device by its name: how it is opened, and when its frames were exposed."""

    name: str
    open: Callable[[], Source]  # DeviceError if it isn't there
    clock: Callable[[Source], Exposed]  # of the device, each time that it was opened


@dataclass(frozen=True)
class Arrival:
    """A frame, and the monotonic time : ns of its exposure."""

    frame: Frame
    exposed_ns: int


@dataclass
class Feed:
    """Hands a device's frames on, from a thread of its own, until it is stopped."""

    device: Device
    deliver: Callable[[Arrival], None]
    again_s: float = AGAIN_S
    trouble: str | None = "not opened yet"  # None while frames come
    lost: int = 0  # frames that the device has left out
    _stopped: Event = field(default_factory=Event)
    _thread: Thread | None = None

    def start(self) -> None:
        """Begin."""
        self._thread = Thread(target=self._run, name=f"feed of {self.device.name}", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """End, and give the device back."""
        self._stopped.set()
        if self._thread is not None:
            self._thread.join()

    @property
    def alive(self) -> bool:
        """Whether it goes on."""
        return self._thread is not None and self._thread.is_alive()

    def _run(self) -> None:
        while not self._stopped.is_set():
            try:
                source = self.device.open()
                try:
                    self._hand_on(source)
                finally:
                    source.close()
            except DeviceError as error:
                if self.trouble != str(error):
                    log.warning("%s; trying again every %g s", error, self.again_s)
                self.trouble = str(error)
                self._stopped.wait(self.again_s)

    def _hand_on(self, source: Source) -> None:
        exposed, expected, heard = self.device.clock(source), None, monotonic()
        while not self._stopped.is_set():
            frame = source.frame(WAIT_S)
            if frame is None:
                if monotonic() - heard > SILENT_S:
                    self.trouble = f"{self.device.name}: no frame for {monotonic() - heard:.0f} s"
                continue
            self.lost += 0 if expected is None else max(0, frame.number - expected)
            expected, heard, self.trouble = frame.number + 1, monotonic(), None
            self.deliver(Arrival(frame, exposed(frame)))


@dataclass
class FollowedClock:
    """Exposures by a device's clock that is followed; by the arrival as long as too few frames have come."""

    follower: ClockFollower

    def __call__(self, frame: Frame) -> int:
        """Monotonic time : ns of a frame's exposure."""
        self.follower.add(frame.time_ns, frame.arrived_ns)
        clock = self.follower.clock
        return frame.arrived_ns if clock is None else clock.at(frame.time_ns)
