"""The virtual rig: what stands before its devices, what its projector shows, and its time. Its devices are views of it.

The devices offer what `recon.devices.interfaces` asks for. Their frames carry the moments that were rendered, by the rig's own
clock; it stands for this computer's, too, so that the order of a pattern and of exposures is right however long rendering takes.
"""

import threading
from collections import deque
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from recon.devices.interfaces import DeviceError, Frame, Size, Trigger
from recon.model.rig import Rig
from twin.board_session import CAMERAS
from twin.devices.shown_light import Pattern
from twin.devices.virtual_clock import VirtualClock
from twin.optics.surface_session import CameraName
from twin.sensor import Exposure, dropped_bits, expose

TRANSFER_NS = 5_000_000  # from the end of an exposure until the image is in memory; assumed, of a camera at USB 3
REFRESH_NS = 16_666_667  # of the projector's display, until a pattern is on as a whole


class Still(Protocol):
    """What stands before the cameras at rest."""

    def radiance(self, camera: CameraName, shown: Pattern) -> NDArray[np.float32]:
        """What arrives at a camera's pixels while a pattern is shown : (h, w), W/mm^2/sr."""
        ...


@dataclass
class VirtualRig:
    """Instruments before something at rest, which may be exchanged between frames."""

    rig: Rig
    still: Still
    clock: VirtualClock
    bits: int = 8
    seed: int = 0
    shown: Pattern = field(init=False)
    _wired: list["VirtualCamera"] = field(default_factory=list, init=False)  # cameras that the projector's display triggers
    _rendering: threading.Lock = field(default_factory=threading.Lock, init=False)

    def __post_init__(self) -> None:
        self.shown = np.zeros(self.rig.projector.optics.size[::-1], np.uint8)

    def camera(self, name: CameraName) -> "VirtualCamera":
        """A camera of the rig, by its name."""
        return VirtualCamera(name, self)

    def projector(self) -> "VirtualProjector":
        """The rig's projector."""
        return VirtualProjector(self)

    def refresh(self) -> None:
        """Go on to the next image of the projector's display, with which all cameras expose that are wired to it."""
        self.clock.advance_to((self.clock.now_ns // REFRESH_NS + 1) * REFRESH_NS)
        for camera in self._wired:
            camera.expose_now()

    def image(self, camera: CameraName, shown: Pattern, exposure: Exposure, number: int) -> NDArray:
        """Take an image : (h, w), by a number on which its noise depends."""
        device, wavelength = getattr(self.rig, camera), self.rig.projector.wavelength_nm
        key = np.random.SeedSequence([self.seed, CAMERAS.index(camera), number])
        with self._rendering:
            radiance = self.still.radiance(camera, shown)
            return expose(radiance[None], device, wavelength, exposure, int(key.generate_state(1)[0]))[0]


class VirtualCamera:
    """A camera that takes what the rig shows it, as `recon.devices.interfaces.Camera`."""

    def __init__(self, name: CameraName, rig: VirtualRig) -> None:
        self.name: str = name
        self._which: CameraName = name
        self.bits = rig.bits
        self.size: Size = getattr(rig.rig, name).optics.size
        self._rig = rig
        self._exposure = Exposure(0.01, 1.0, rig.bits)  # pyrefly: ignore[bad-argument-type]
        dropped_bits(getattr(rig.rig, name).sensor, self._exposure)  # refuses more than there are before the first frame
        self._trigger: Trigger | None = None
        self._exposed: deque[tuple[int, Pattern, Exposure]] = deque()  # middle of the exposure in ns, what was shown
        self._taken = 0  # frames since the start
        self._images = 0  # images ever, by which noise differs

    def set_exposure(self, exposure_s: float, gain: float) -> None:
        """Set exposure time and linear gain."""
        longest_s, highest_gain = 10.0, 16.0  # that the virtual cameras can be set to
        if not (0 < exposure_s <= longest_s and 0 < gain <= highest_gain):
            limits = f"up to {longest_s:g} s and a gain of {highest_gain:g}"
            raise DeviceError(f"{self.name}: expected an exposure of {limits}, found {exposure_s:g} s and {gain:g}")
        self._exposure = Exposure(exposure_s, gain, self._exposure.bits)

    def start(self, trigger: Trigger) -> None:
        """Begin to take frames, numbered from 0."""
        self.stop()
        self._trigger, self._taken = trigger, 0
        if trigger == "hardware":
            self._rig._wired.append(self)

    def trigger(self) -> None:
        """Expose one frame now; of a camera started with `software`."""
        if self._trigger != "software":
            raise DeviceError(f"{self.name}: expected a camera started with software trigger, found {self._trigger or 'none'}")
        self.expose_now()

    def expose_now(self) -> None:
        """Expose one frame."""
        middle = self._rig.clock.now_ns + round(0.5e9 * self._exposure.time_s)
        self._exposed.append((middle, self._rig.shown, self._exposure))

    def frame(self, timeout_s: float) -> Frame | None:
        """Wait for the next frame; None if none came in time."""
        if self._trigger is None:
            raise DeviceError(f"{self.name}: expected a camera that was started, found one at rest")
        free_ns = 33_333_333  # from frame to frame of a camera that runs free
        if self._trigger == "free" and not self._exposed:
            self._rig.clock.advance_to(self._rig.clock.now_ns + free_ns)
            self.expose_now()
        if self._trigger == "hardware" and not self._exposed:
            self._rig.refresh()
        if not self._exposed:
            return None
        middle, shown, exposure = self._exposed.popleft()
        image = self._rig.image(self._which, shown, exposure, self._images)
        image.setflags(write=False)
        arrived = middle + round(0.5e9 * exposure.time_s) + TRANSFER_NS
        self._rig.clock.advance_to(arrived)
        frame = Frame(image, self._taken, middle, arrived)
        self._taken, self._images = self._taken + 1, self._images + 1
        return frame

    def stop(self) -> None:
        """Take no more frames."""
        self._trigger = None
        self._exposed.clear()
        if self in self._rig._wired:
            self._rig._wired.remove(self)

    def close(self) -> None:
        """Give the camera back."""
        self.stop()


class VirtualProjector:
    """The rig's projector, as `recon.devices.interfaces.Projector`."""

    def __init__(self, rig: VirtualRig) -> None:
        self.size: Size = rig.rig.projector.optics.size
        self._rig = rig

    def show(self, pattern: Pattern) -> int:
        """Show a pattern : (h, w); returns the time in ns of the rig's clock from which on it is on as a whole."""
        if pattern.shape != self.size[::-1] or pattern.dtype != np.uint8:
            expected = f"a pattern of {self.size[0]}x{self.size[1]} uint8"
            raise DeviceError(f"projector: expected {expected}, found {pattern.shape[::-1]} {pattern.dtype}")
        self._rig.shown = pattern
        self._rig.clock.advance_to(self._rig.clock.now_ns + REFRESH_NS)
        return self._rig.clock.now_ns

    def close(self) -> None:
        """Darken the screen."""
        self._rig.shown = np.zeros_like(self._rig.shown)
