"""An ultrasound scanner whose screen a video grabber takes, by OpenCV; also a video file or a network stream in its place.

A thread reads all the time, so that the driver drops nothing while others compute. A grabber that is lost is opened again as soon
as it is back; a file ends.
"""

import logging
import queue
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from recon.devices.interfaces import DeviceError, Frame, Size

log = logging.getLogger(__name__)

Image = NDArray[np.uint8]

WAITING = 64  # images that wait to be taken; of a full queue the newest are lost, and missing in the numbers
AGAIN_S = 1.0  # between tries to open a lost grabber


class View(Protocol):
    """The B-scan within what is sent, such as `scan_view.ScanView`."""

    def size(self, sent: Size) -> Size:
        """Width and height of the B-scan in images of a size; DeviceError if it lies outside."""

    def of(self, image: Image) -> Image:
        """The B-scan : (h, w) in an image."""


class VideoGrabber:
    """A `Scanner`. While the grabber is lost `frame` raises DeviceError, and gives images again afterwards.

    The time of a frame is the driver's time stamp where it has one (of V4L2 the moment of the capture), else that of its arrival.
    """

    def __init__(self, name: str, source: int | str, view: View | None = None, sent: Size | None = None) -> None:
        """Open the grabber, and wait for images.

        source : the grabber's number, the path of a video, which plays at its own rate, or an address such as rtsp://...
        view : of the B-scan in what is sent; None takes all
        sent : (width, height) px to be set in the grabber; None leaves its own choice, often 640x480

        Raises
        ------
        DeviceError
            If it isn't there, gives no images, or images of another size.
        """
        self.name, self._source, self._view, self._wanted = name, source, view, sent
        self._live = isinstance(source, int) or "://" in source
        self._frames: queue.Queue[Frame] = queue.Queue(WAITING)
        self._number = 0
        self._fault = ""  # why there are no images
        self._losing = False  # whether the last one found no room
        self._closing = threading.Event()
        opened = self._open()
        if opened is None:
            raise self._lost()
        capture, first = opened
        self._sent = (first.shape[1], first.shape[0])
        try:
            if sent is not None and sent != self._sent:
                found = f"found {_px(self._sent)}: set the scanner's output"
                raise DeviceError(f"{self._device}: expected images of {_px(sent)}, {found}")
            self.size = self._sent if view is None else view.size(self._sent)
        except DeviceError:
            capture.release()
            raise
        self._thread = threading.Thread(target=self._read, args=(capture, first), name=f"video grabber {name}", daemon=True)
        self._thread.start()

    def frame(self, timeout_s: float) -> Frame | None:
        """Wait for the next B-scan : (h, w) uint8; None if none came in time.

        Raises
        ------
        DeviceError
            If the grabber is lost, its images have changed their size, or the file has ended.
        """
        end = time.monotonic() + timeout_s
        slice_s = 0.05  # between looks whether it is lost
        while True:
            fault = self._fault  # what was read before is given before it
            try:
                return self._frames.get(timeout=max(min(end - time.monotonic(), slice_s), 0))
            except queue.Empty:
                if fault:
                    raise self._lost() from None
                if time.monotonic() >= end:
                    return None

    def close(self) -> None:
        """Give the grabber back."""
        self._closing.set()
        closing_s = 2.0  # a driver without a signal may keep the thread for ten
        self._thread.join(closing_s)

    @property
    def _device(self) -> str:
        return f"scanner {self.name} at video {self._source}"

    def _lost(self) -> DeviceError:
        return DeviceError(f"{self._device}: expected images, found {self._fault}")

    def _open(self) -> tuple[cv2.VideoCapture, Image] | None:
        """The grabber and its first image; None, and the fault, if there is none."""
        with _quiet():
            capture = cv2.VideoCapture(self._source)
        if not capture.isOpened():
            self._fault = "none there: is it plugged in, its number or path right, and no other program using it?"
            return None
        if self._wanted is not None:
            capture.set(cv2.CAP_PROP_FRAME_WIDTH, self._wanted[0])
            capture.set(cv2.CAP_PROP_FRAME_HEIGHT, self._wanted[1])
        good, first = capture.read()
        if not good:
            capture.release()
            self._fault = "one without images: is a signal connected, and no other program using it?"
            return None
        return capture, np.asarray(first, np.uint8)

    def _read(self, capture: cv2.VideoCapture, image: Image) -> None:
        """Read until the end; of a grabber also after it was lost."""
        self._read_until_lost(capture, image)
        while self._live and not self._closing.wait(AGAIN_S):
            if (opened := self._open()) is not None:
                self._read_until_lost(*opened)

    def _read_until_lost(self, capture: cv2.VideoCapture, image: Image) -> None:
        """Queue images, the first of which is read already; those of a file at their times."""
        begin, rate, stamped = time.monotonic(), capture.get(cv2.CAP_PROP_FPS) or 25.0, _stamp_s(capture) > 0
        good, number = True, 0
        while good and not self._closing.is_set():
            stamp_s = _stamp_s(capture)
            if not self._live:
                stamp_s = stamp_s or number / rate
                self._closing.wait(max(begin + stamp_s - time.monotonic(), 0))
            arrived_ns = time.monotonic_ns()
            if self._is_of_size(image):
                self._queue(image, round(1e9 * stamp_s) if stamped or not self._live else arrived_ns, arrived_ns)
            good, image = capture.read()
            number += 1
        capture.release()
        if not good:
            self._fault = "none any more: was it unplugged?" if self._live else "the end of the file"
            log.warning("%s: %s", self._device, self._fault)

    def _is_of_size(self, image: Image) -> bool:
        found = (image.shape[1], image.shape[0])
        if found != self._sent:
            self._fault = f"{_px(found)} where it sent {_px(self._sent)} before: set the scanner's output, or open it again"
            return False
        self._fault = ""
        return True

    def _queue(self, image: Image, time_ns: int, arrived_ns: int) -> None:
        """Keep an image for `frame`, if there is room."""
        grey = image if image.ndim == 2 else np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), np.uint8)
        scan = grey if self._view is None else self._view.of(grey)
        scan.flags.writeable = False
        frame = Frame(scan, self._number, time_ns, arrived_ns)
        self._number += 1
        try:
            self._frames.put_nowait(frame)
            self._losing = False
        except queue.Full:
            if not self._losing:
                log.warning("%s: images lost from %d on, since %d wait to be taken", self._device, frame.number, WAITING)
            self._losing = True


def _stamp_s(capture: cv2.VideoCapture) -> float:
    """Time stamp of the image that was read last; 0 where the driver has none."""
    return max(float(capture.get(cv2.CAP_PROP_POS_MSEC)) / 1e3, 0.0)


@contextmanager
def _quiet() -> Iterator[None]:
    """Keep OpenCV from writing to the console what is said here in one line."""
    before = cv2.utils.logging.getLogLevel()
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:
        yield
    finally:
        cv2.utils.logging.setLogLevel(before)


def _px(size: Size) -> str:
    return f"{size[0]}x{size[1]} px"
