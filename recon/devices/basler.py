"""Basler cameras by pylon: settings, triggers, frames with the camera's own number and time.

A thread of each camera takes frames over as they come, so that the time of arrival is the true one whatever the program does.
Frames that came damaged, that the computer had no buffer for, or that nobody fetched in time leave gaps in the numbers.
"""

import atexit
import logging
import threading
from collections import deque
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field
from functools import partial
from math import log10
from time import monotonic, monotonic_ns, sleep
from typing import Any, Literal

from recon.devices.device_clocks import ClockReading
from recon.devices.genicam_features import Features, Value, said_by, words
from recon.devices.interfaces import DeviceError, Frame, Size, Trigger

LOG = logging.getLogger(__name__)
SLICE_MS = 100  # of waiting, after which an end or an unplugged cable is noticed
FORMATS = {8: "Mono8", 10: "Mono10", 12: "Mono12"}
EDGES = {"rising": "RisingEdge", "falling": "FallingEdge"}
NS_PER_S = 10**9
EXPOSURE = ("ExposureTime", "ExposureTimeAbs")


@dataclass(frozen=True)
class BaslerSettings:
    """What stays as it is while a camera is open."""

    size: Size = (1280, 1024)  # px, from the sensor's upper left corner
    bits: Literal[8, 10, 12] = 8
    rate_hz: float | None = None  # of a free-running camera; None: as fast as it can
    trigger_line: str = "Line1"  # at which a hardware trigger comes in
    trigger_edge: Literal["rising", "falling"] = "rising"
    exposure_line: str | None = None  # output that is high during exposures, wired to another camera's trigger or a projector
    held: int = 64  # frames that are kept until they are fetched; of more, the oldest are let go
    features: Mapping[str, Value] = field(default_factory=dict)  # further ones by their GenICam names, set in this order


class BaslerCamera:
    """A Basler camera, as `recon.devices.interfaces.Camera`.

    Cameras without a time stamp, pylon's emulator among them, get arrival less half the exposure as their time.
    """

    def __init__(self, name: str, connect: Callable[[], Any], settings: BaslerSettings) -> None:
        """Open a camera.

        Parameters
        ----------
        name : str
            As in a capture's manifest: cam1.
        connect : () -> pypylon.pylon.InstantCamera
            Finds the camera anew each time; raises DeviceError if it isn't there.
        settings : BaslerSettings
            The same after `reopen`.

        Raises
        ------
        DeviceError
            If the camera isn't there, is used by another program, or refuses a setting.
        """
        self.name = name
        self.size = settings.size
        self.bits: int = settings.bits
        self._settings = settings
        self._connect = connect
        self._exposure: tuple[float, float] | None = None  # seconds, gain
        self._frames = deque[Frame]()
        self._unfetched = 0  # since the last that was
        self._changed = threading.Condition()
        self._failure: DeviceError | None = None
        self._thread: threading.Thread | None = None
        self._ending = threading.Event()
        self._open()

    def set_exposure(self, exposure_s: float, gain: float) -> None:
        """Set exposure time and linear gain, 1 at 0 dB; DeviceError beyond the camera's range."""
        if not gain > 0:
            raise DeviceError(f"{self.name}: gain: expected a factor above 0, found {gain}")
        self._features.put(1e6 * exposure_s, *EXPOSURE)
        self._features.put(20 * log10(gain), "Gain")
        self._exposure = exposure_s, gain
        self._exposure_ns = self._exposure_now()

    def start(self, trigger: Trigger) -> None:
        """Begin to take frames, numbered from 0."""
        from pypylon import pylon

        self.stop()
        self._set_trigger(trigger)
        self._frames.clear()
        self._failure = None
        self._ending.clear()
        with said_by(self.name):
            self._device.StartGrabbing(pylon.GrabStrategy_OneByOne)
        self._thread = threading.Thread(target=self._take_over, name=f"{self.name} frames", daemon=True)
        self._thread.start()
        atexit.register(self.stop)  # a thread that waits in pylon's code while Python ends would abort the process

    def trigger(self) -> None:
        """Expose one frame now; waits until the camera has read out the one before, since it would miss the trigger.

        Raises
        ------
        DeviceError
            If the camera is gone, or isn't ready after some seconds.
        """
        from pypylon import pylon

        self._raise_failure()
        ready_ms = 5000  # for which a camera may be busy before a software trigger is given up; exposures last up to some seconds
        with said_by(self.name):
            waits = self._device.CanWaitForFrameTriggerReady()
            if waits and not self._device.WaitForFrameTriggerReady(ready_ms, pylon.TimeoutHandling_Return):
                raise DeviceError(f"{self.name}: not ready for a trigger after {ready_ms / 1000:g} s; started with `software`?")
            self._device.ExecuteSoftwareTrigger()

    def frame(self, timeout_s: float) -> Frame | None:
        """Wait for the next frame, in order; None if none came in time. DeviceError if the camera is gone or wasn't started."""
        with self._changed:
            self._changed.wait_for(lambda: self._frames or self._failure or self._thread is None, timeout_s)
            if self._frames:
                self._unfetched = 0
                return self._frames.popleft()
        self._raise_failure()
        if self._thread is None:
            raise DeviceError(f"{self.name}: expected a camera that was started, found one that takes no frames")
        return None

    def read_clock(self) -> ClockReading | None:
        """Read the camera's clock between two readings of this computer's; None of a camera that can't."""
        latch = self._features.available("TimestampLatch", "GevTimestampControlLatch")
        if latch is None:
            return None
        before = monotonic_ns()
        self._features.execute(latch)
        after = monotonic_ns()
        ticks = self._features.get("TimestampLatchValue", "GevTimestampValue")
        return ClockReading(ticks * NS_PER_S // self._ticks_per_s, before, after)

    def stop(self) -> None:
        """Take no more frames; those that have arrived can still be fetched."""
        if self._thread is None:
            return
        atexit.unregister(self.stop)
        self._ending.set()
        self._thread.join()
        with self._changed:
            self._thread = None
            self._changed.notify_all()
        self._quietly(self._device.StopGrabbing)

    def close(self) -> None:
        """Give the camera back."""
        self.stop()
        self._quietly(self._device.Close)
        self._quietly(self._device.DestroyDevice)

    def reopen(self, timeout_s: float) -> None:
        """Open a camera again that was unplugged, as soon as it is back, with the same settings; `start` comes next.

        Raises
        ------
        DeviceError
            If it isn't back in time.
        """
        self.close()
        until = monotonic() + timeout_s
        while True:
            try:
                return self._open()
            except DeviceError:
                if monotonic() > until:
                    raise
                sleep(SLICE_MS / 1000)

    def _open(self) -> None:
        self._device = self._connect()
        self._features = Features(self.name, self._device)
        buffers = 32  # of pylon's, filled by the driver while this thread waits for a core
        with ExitStack() as stack:
            stack.callback(self._quietly, self._device.Close)
            with said_by(self.name):
                self._device.Open()
                self._device.MaxNumBuffer.SetValue(buffers)
            self._set_up()
            stack.pop_all()  # it is open, and `close` gives it back

    def _set_up(self) -> None:
        settings, features = self._settings, self._features
        if features.available("UserSetSelector"):  # whatever another program left behind
            features.put("Default", "UserSetSelector")
            features.execute("UserSetLoad")
        for automatic in ("ExposureAuto", "GainAuto"):
            if features.available(automatic):
                features.put("Off", automatic)
        features.put(FORMATS[settings.bits], "PixelFormat")
        for name, value in zip(("OffsetX", "OffsetY", "Width", "Height"), (0, 0, *settings.size), strict=True):
            features.put(value, name)
        if settings.exposure_line:
            self._show_exposures(settings.exposure_line)
        self._send_along()
        for name, value in settings.features.items():
            features.put(value, name)
        ticks = features.available("GevTimestampTickFrequency")  # others count nanoseconds
        self._ticks_per_s = features.get(ticks) if ticks else NS_PER_S
        self._first_number = 1 if self._device.IsGigE() else 0
        if self._exposure:
            self.set_exposure(*self._exposure)
        self._exposure_ns = self._exposure_now()

    def _show_exposures(self, line: str) -> None:
        """Let an output be high during exposures."""
        self._features.put(line, "LineSelector")
        if self._features.get("LineMode") != "Output":  # of lines that are always outputs it can't be set
            self._features.put("Output", "LineMode")
        self._features.put("ExposureActive", "LineSource")

    def _send_along(self) -> None:
        """Let the camera send exposure and checksum with each image, if it can; chunks are chosen once they are switched on."""
        if self._features.available("ChunkModeActive") is None:
            return
        self._features.put(True, "ChunkModeActive")
        offered = self._features.choices("ChunkSelector")
        chunks = ("ExposureTime", "PayloadCRC16")  # sent along with images by cameras that can
        for chunk in [name for name in chunks if name in offered]:
            self._features.put(chunk, "ChunkSelector")
            self._features.put(True, "ChunkEnable")
        self._features.put(bool(offered), "ChunkModeActive")

    def _set_trigger(self, trigger: Trigger) -> None:
        settings, put = self._settings, self._features.put
        for selector in self._features.choices("TriggerSelector"):
            put(selector, "TriggerSelector")
            put("Off", "TriggerMode")
        put("FrameStart", "TriggerSelector")
        if trigger != "free":
            put("On", "TriggerMode")
            put("Software" if trigger == "software" else settings.trigger_line, "TriggerSource")
        if trigger == "hardware":
            put(EDGES[settings.trigger_edge], "TriggerActivation")
        rate_hz = settings.rate_hz if trigger == "free" else None
        if rate_hz is not None or self._features.available("AcquisitionFrameRateEnable"):
            put(rate_hz is not None, "AcquisitionFrameRateEnable")
        if rate_hz is not None:
            put(rate_hz, "AcquisitionFrameRate", "AcquisitionFrameRateAbs")

    def _exposure_now(self) -> int:
        return round(1000 * self._features.get(*EXPOSURE))

    def _take_over(self) -> None:
        """Take frames over until the end, or until the camera is gone; runs in a thread of its own."""
        from pypylon import genicam, pylon

        number, failure = self._first_number - 1, "stopped taking frames"
        unplugged = "unplugged; check cable and power, then open it again"
        try:
            while not self._ending.is_set() and not self._device.IsCameraDeviceRemoved():
                result = self._device.RetrieveResult(SLICE_MS, pylon.TimeoutHandling_Return)
                if result.IsValid():
                    with result:
                        number = unwrapped(result.BlockID, number, self._first_number)
                        self._keep(result, number - self._first_number)
        except genicam.GenericException as error:
            failure = words(error)
        finally:
            if not self._ending.is_set():
                self._fail(unplugged if self._device.IsCameraDeviceRemoved() else failure)

    def _keep(self, result: Any, number: int) -> None:
        """Take a result into the queue, or say why its frame is lost."""
        arrived = monotonic_ns()
        if not result.GrabSucceeded():
            return LOG.warning("%s: frame %d lost: %s", self.name, number, result.ErrorDescription)
        if result.HasCRC() and not result.CheckCRC():
            return LOG.warning("%s: frame %d lost: wrong checksum; a bad cable?", self.name, number)
        if (result.Width, result.Height) != self.size:
            found = result.Width, result.Height
            return LOG.warning("%s: frame %d lost: expected %dx%d, found %dx%d", self.name, number, *self.size, *found)
        exposure = self._exposure_of(result)
        begun = result.TimeStamp * NS_PER_S // self._ticks_per_s if result.TimeStamp else arrived - exposure
        image = result.Array
        image.setflags(write=False)
        with self._changed:
            if len(self._frames) >= self._settings.held:
                self._let_go(self._frames.popleft().number)
            self._frames.append(Frame(image, number, begun + exposure // 2, arrived))
            self._changed.notify_all()

    def _let_go(self, number: int) -> None:
        """Note a frame that nobody fetched in time; the first of them is logged, since a program that pauses leaves thousands."""
        if self._unfetched == 0:
            LOG.warning("%s: frame %d lost: not fetched in time, %d newer ones wait", self.name, number, len(self._frames))
        self._unfetched += 1

    def _exposure_of(self, result: Any) -> int:
        """Exposure of a result in ns: its own if the camera sends it along, else what is set now."""
        if not result.IsChunkDataAvailable():
            return self._exposure_ns
        chunk = result.ChunkExposureTime
        return round(1000 * chunk.GetValue()) if chunk.IsReadable() else self._exposure_ns

    def _fail(self, cause: str) -> None:
        with self._changed:
            self._failure = DeviceError(f"{self.name}: {cause}")
            self._changed.notify_all()

    def _raise_failure(self) -> None:
        if self._failure:
            raise DeviceError(str(self._failure))

    def _quietly(self, end: Callable[[], object]) -> None:
        """End something of a camera that may be gone already."""
        from pypylon import genicam

        try:
            end()
        except genicam.GenericException as error:
            LOG.debug("%s: %s", self.name, words(error))


def unwrapped(block: int, last: int, first: int) -> int:
    """A frame's number from pylon's, which wraps around at cameras of Gigabit Ethernet, where `first` is 1.

    A camera that doesn't number its frames gets them counted.
    """
    no_number = 2**64 - 1
    if block == no_number:
        return last + 1
    wrap = 65535  # numbers 1 to 65535 of cameras of Gigabit Ethernet; they never use 0
    if first == 0 or block > wrap:
        return block
    return last + (block - last - 1) % wrap + 1


def open_camera(name: str, serial: str, settings: BaslerSettings | None = None) -> BaslerCamera:
    """Open the camera of a serial number.

    Raises
    ------
    DeviceError
        If it isn't there, is used by another program, or refuses a setting.
    """
    return BaslerCamera(name, partial(_connect, name, serial), settings or BaslerSettings())


def _connect(name: str, serial: str) -> Any:
    from pypylon import pylon

    factory = pylon.TlFactory.GetInstance()
    with said_by(name):
        present = {info.GetSerialNumber(): info for info in factory.EnumerateDevices()}
        if serial not in present:
            found = ", ".join(present) or "no Basler camera at all"
            raise DeviceError(f"{name}: expected a Basler camera of serial number {serial}, found {found}; cable, power?")
        return pylon.InstantCamera(factory.CreateDevice(present[serial]))
