"""Frames of one source on their way to the disk: one thread reads, one writes, and a bounded queue lies between them."""

import queue
import threading
from collections.abc import Callable
from typing import NamedTuple

from recon.acquisition.pictures import Say
from recon.devices.interfaces import DeviceError, Frame
from recon.errors import InputError

WAITING = 128  # sets of frames that wait for the disk: 340 MB of pairs of 1280 x 1024
SLICE_S = 0.2  # of waiting for a frame
MOST_JUMP_NS = 1_000_000_000  # by which a device's clock may go on otherwise than this computer's between two frames


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
        self._waiting: queue.Queue[list[Taken] | None] = queue.Queue(WAITING)
        self._ending = threading.Event()
        self._failure: InputError | OSError | None = None
        self._left_out = 0
        self._threads = [threading.Thread(target=work, daemon=True) for work in (self._fetch, self._store)]
        for thread in self._threads:
            thread.start()

    @property
    def alive(self) -> bool:
        """Whether frames are still read and written."""
        return all(thread.is_alive() for thread in self._threads)

    def end(self) -> None:
        """Read no more, and write what has come."""
        self._ending.set()
        for thread in self._threads:
            thread.join()
        if self._left_out:
            self._say(f"lost {self._left_out} sets of frames, for which the disk was too slow; free it, or lower the rate")

    def check(self) -> None:
        """Raise what ended the stream, if anything did."""
        if self._failure is not None:
            raise self._failure

    def _fetch(self) -> None:
        silent, before = 0.0, dict[str, Taken]()
        try:
            while not self._ending.is_set() and self._failure is None:
                taken = self._read(SLICE_S)
                if taken is None:
                    silent += SLICE_S
                    if silent >= self._silent_s:
                        expected = f"expected a frame within {self._silent_s:g} s, found none"
                        raise DeviceError(f"{' and '.join(before) or 'devices'}: {expected}; see cable and power")
                    continue
                silent = 0.0
                for one in taken:
                    _check_clock(before.get(one.device), one)
                    before[one.device], self.latest[one.device] = one, one.frame
                try:
                    self._waiting.put_nowait(taken)
                except queue.Full:
                    self._left_out += 1
        except DeviceError as error:
            self._failure = self._failure or error
        finally:
            self._waiting.put(None)

    def _store(self) -> None:
        try:
            while (taken := self._waiting.get()) is not None:
                for one in taken:
                    self._write(one)
        except (InputError, OSError) as error:
            self._failure = error
            while self._waiting.get() is not None:  # so that the reader can end
                pass


def _check_clock(before: Taken | None, now: Taken) -> None:
    """Check that a device counts and times on; DeviceError if its clock jumped, or it began anew."""
    if before is None:
        return
    step, passed = now.time_ns - before.time_ns, now.frame.arrived_ns - before.frame.arrived_ns
    if step <= 0 or abs(step - passed) > MOST_JUMP_NS:
        found = f"{1e-9 * step:+.3f} s after {1e-9 * passed:.3f} s"
        raise DeviceError(f"{now.device}: expected a clock that goes on, found {found} at frame {now.frame.number}; record anew")
    if now.frame.number <= before.frame.number:
        expected = f"a frame after {before.frame.number}"
        raise DeviceError(f"{now.device}: expected {expected}, found {now.frame.number}: it began anew; record anew")
