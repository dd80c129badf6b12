"""A camera, a projector and a scanner, as the rig's software uses them, whoever makes them.

Drivers, captures that are played back and the twin's stand-ins offer the same, so that the code above them is one for all. Two
clocks stand in each frame: the device's own, and this computer's monotonic one, `time.monotonic_ns()`.
"""

from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from recon.errors import InputError

Image = NDArray[np.uint8] | NDArray[np.uint16]
Size = tuple[int, int]  # width, height, px
Trigger = Literal["free", "software", "hardware"]  # who begins an exposure: the camera by its own rate, a call, or a wire


class DeviceError(InputError):
    """A device that isn't there, was unplugged or refuses a setting: one line with its name, the cause and the way on."""


@dataclass(frozen=True)
class Frame:
    """An image as a device gave it."""

    image: Image  # (h, w), read-only
    number: int  # counted by the device from its start; a gap is a frame that was lost
    time_ns: int  # middle of the exposure, of the device's clock; of this computer's, once `timed_frames` has mapped it
    arrived_ns: int  # of this computer's monotonic clock, as soon as the image was whole in memory


class Camera(Protocol):
    """A grey-level camera. Used by one thread at a time; `close` may be called again."""

    name: str  # as in a capture's manifest: cam1, cam2
    size: Size
    bits: int  # of the digital numbers; beyond 8 right-aligned in uint16

    def set_exposure(self, exposure_s: float, gain: float) -> None:
        """Set exposure time and linear gain (1 is the sensor's base gain); DeviceError beyond the camera's range."""

    def start(self, trigger: Trigger) -> None:
        """Begin to take frames, numbered from 0."""

    def trigger(self) -> None:
        """Expose one frame now; of a camera started with `software`."""

    def frame(self, timeout_s: float) -> Frame | None:
        """Wait for the next frame, in order; None if none came in time. DeviceError if the camera is gone."""

    def stop(self) -> None:
        """Take no more frames."""

    def close(self) -> None:
        """Give the camera back."""


class Projector(Protocol):
    """A projector as a second display."""

    size: Size

    def show(self, pattern: NDArray[np.uint8]) -> int:
        """Show a pattern : (h, w), pixel by pixel.

        Returns
        -------
        int
            Time in ns of this computer's monotonic clock from which on the pattern is on the screen as a whole.
        """

    def close(self) -> None:
        """Darken the screen and give it back."""


class Scanner(Protocol):
    """An ultrasound scanner that sends its B-scans as they come."""

    name: str  # as in a capture's manifest: us
    size: Size  # of what it sends, cropped and turned as it was told

    def frame(self, timeout_s: float) -> Frame | None:
        """Wait for the next B-scan : (h, w) uint8; None if none came in time. DeviceError if the scanner is gone."""

    def close(self) -> None:
        """Give the scanner back."""
