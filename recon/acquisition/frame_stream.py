"""Frames of one source on their way to the disk: one thread reads, one writes, and a bounded queue lies between them."""

import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from queue import SimpleQueue
from time import monotonic
from typing import NamedTuple

from recon.acquisition.pictures import Say
from recon.devices.interfaces import DeviceError, Frame

WAITING = 128  # sets of frames that wait for the disk: 340 MB of pairs of 1280 x 1024
MOST_OFF_NS = 1_000_000_000  # a frame that comes later than that is named; one that is stamped as much ahead shows a jump


class Taken(NamedTuple):
    """A frame of a device."""

    device: str
    frame: Frame
    time_ns: int  # by the clock that its table is to be of


Read = Callable[[float], list[Taken] | None]


class FrameStream:
    """One source that is being recorded. Begins at once; `end` writes what has come."""

    def __init__(self, read: Read, write: Callable[[Taken], None], silent_s: float, say: Say) -> None:
        """Begin.

        Parameters
        ----------
        read : waits so many seconds for the source's next frames
        write : takes one
        silent_s : without a frame, after which the source counts as gone
        """
        self.latest: dict[str, Frame] = {}  # by device
        self._read, self._write, self._silent_s, self._say = read, write, silent_s, say
        self._waiting: SimpleQueue[list[Taken] | None] = SimpleQueue()  # None: no more will come
        self._ending = threading.Event()
        self._stamps: dict[str, _Stamps] = {}  # by device
        self._left_out = 0
        self._span_ns = 0
        self._threads = ThreadPoolExecutor(2, "recording")
        try:
            self._work = [self._threads.submit(work) for work in (self._store, self._fetch)]
        except RuntimeError:  # no further thread: the first one must not wait for ever
            self._waiting.put(None)
            raise

    @property
    def span_s(self) -> float:
        """Time from a device's first frame to its newest one, by their time stamps; of several devices, the longest."""
        return 1e-9 * self._span_ns

    @property
    def alive(self) -> bool:
        """Whether frames are still read and written."""
        return not any(work.done() for work in self._work)

    def end(self) -> None:
        """Read no more, and write what has come."""
        self._ending.set()
        self._threads.shutdown()
        if self._left_out:
            self._say(f"lost {self._left_out} sets of frames, for which the disk was too slow; free it, or lower the rate")
        for device, stamps in self._stamps.items():
            if stamps.late:
                most = f"by up to {1e-9 * stamps.latest_ns:.1f} s"
                self._say(f"frames of {device} that came late: {stamps.late}, {most}; they are recorded by their own time stamps")

    def check(self) -> None:
        """Raise what ended the stream, if anything did, whatever it is."""
        for work in self._work:
            work.result()

    def _fetch(self) -> None:
        came = monotonic()
        slice_s = 0.2  # of waiting for a frame
        try:
            while not self._ending.is_set():
                taken = self._read(slice_s)
                if taken is None:
                    if monotonic() - came >= self._silent_s:
                        expected = f"expected a frame within {self._silent_s:g} s, found none"
                        raise DeviceError(f"{' and '.join(self._stamps) or 'devices'}: {expected}; see cable and power")
                    continue
                came = monotonic()
                for one in taken:
                    self._look(one)
                if self._waiting.qsize() < WAITING:
                    self._waiting.put(taken)
                else:
                    self._left_out += 1
        finally:
            self._waiting.put(None)

    def _look(self, one: Taken) -> None:
        """Check a frame's number and stamp, and say if it came late."""
        stamps = self._stamps.setdefault(one.device, _Stamps())
        if late_ns := stamps.add(one):
            self._say(f"{one.device}: frame {one.frame.number} came {1e-9 * late_ns:.1f} s late: is the computer busy?")
        self._span_ns = max(self._span_ns, stamps.span_ns)
        self.latest[one.device] = one.frame

    def _store(self) -> None:
        try:
            while (taken := self._waiting.get()) is not None:
                for one in taken:
                    self._write(one)
        finally:
            self._ending.set()  # without a writer, the reader ends


class _Stamps:
    """A device's time stamps, beside the moments at which its frames arrive.

    A frame may arrive any time after it was taken, so one that comes late leaves the clock beyond doubt. But stamps rise, and
    no frame arrives before it was taken: a stamp that is ahead of the fastest frame so far shows a clock that was set forward.
    The first frames may all be the late ones of a slow start, so that those after them only seem to be ahead.
    """

    def __init__(self) -> None:
        self.late, self.latest_ns = 0, 0  # frames that came late, and by how long the latest one
        self.span_ns = 0  # from the first frame to the newest
        self._before: Taken | None = None
        self._seen = 0
        self._least_ns = 0  # from a stamp to its arrival, of the fastest frame; both clocks drift apart by some 0.1 s an hour
        self._behind = False  # whether the frame before came late

    def add(self, now: Taken) -> int:
        """Take the next frame; returns its delay in ns if it is the first late one of a row, else 0.

        Raises
        ------
        DeviceError
            If the clock jumped, or the device began to count anew.
        """
        delay_ns = now.frame.arrived_ns - now.time_ns
        if self._before is not None:
            self._check(self._before, now, self._least_ns - delay_ns)
            self.span_ns += now.time_ns - self._before.time_ns
        self._least_ns = delay_ns if self._before is None else min(self._least_ns, delay_ns)
        self._before, self._seen = now, self._seen + 1
        late_ns, followed = delay_ns - self._least_ns, self._behind
        self._behind = late_ns > MOST_OFF_NS
        if not self._behind:
            return 0
        self.late, self.latest_ns = self.late + 1, max(self.latest_ns, late_ns)
        return 0 if followed else late_ns

    def _check(self, before: Taken, now: Taken, ahead_ns: int) -> None:
        back_ns = before.time_ns - now.time_ns
        first = 8  # frames of a device, of which one at least came without delay
        if back_ns >= 0 or (ahead_ns > MOST_OFF_NS and self._seen >= first):
            found = f"it {1e-9 * back_ns:.3f} s back" if back_ns >= 0 else f"it {1e-9 * ahead_ns:.3f} s ahead of arrival"
            expected = "a clock that goes on"
            raise DeviceError(f"{now.device}: expected {expected}, found {found} at frame {now.frame.number}; record anew")
        if now.frame.number <= before.frame.number:
            expected = f"a frame after {before.frame.number}"
            raise DeviceError(f"{now.device}: expected {expected}, found {now.frame.number}: it began anew; record anew")
