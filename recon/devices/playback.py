"""A recorded sweep played back in real time, as cameras and a scanner: what is above them can't tell it from the rig.

All devices of a recording share one timeline. Each frame comes 10 ms after the middle of its exposure, as of a camera that
reads out and transfers; of frames that nobody fetches the oldest are lost, as in a driver's buffer. From the end it goes on at
the beginning, with time stamps that go on.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from math import ceil
from operator import itemgetter
from pathlib import Path
from threading import Event, Lock
from time import monotonic_ns

import numpy as np
from numpy.typing import NDArray

from recon.capture import manifest, sweep_tables
from recon.capture.images import frame_file, read_image
from recon.capture.manifest import CAMERAS, SCANNER, STAMPS, image_name
from recon.devices.interfaces import DeviceError, Frame, Image, Size, Trigger
from recon.errors import InputError
from recon.files.regular import check_there

DELIVERY_NS = 10_000_000  # from the middle of an exposure to the image in memory: half of 10 ms, and 1.3 MB over USB 3
CLOCKS = "clocks of their own? record them by one, as sonotwin record does"
BUFFERED = 4  # frames that wait to be fetched


@dataclass(frozen=True)
class Recorded:
    """One device's frames of a sweep: its tables are checked and every image is there, but none is read yet."""

    name: str
    size: Size
    bits: int
    paths: tuple[Path, ...]  # (n,)
    times: NDArray[np.int64]  # (n,) ns, of the device's clock


@dataclass
class Timeline:
    """Recorded moments on this computer's monotonic clock, round after round. Begins when it is first asked for a time."""

    first: int  # ns, of the recording
    length: int  # ns, of a round
    speed: float = 1.0
    _start: int | None = None
    _lock: Lock = field(default_factory=Lock)

    def clock_of(self, moment: int) -> int:
        """Monotonic time : ns of a moment : ns of the recording, or of a later round."""
        return self._begun() + round((moment - self.first) / self.speed)

    def moment_at(self, clock: int) -> int:
        """Moment : ns at a monotonic time : ns."""
        return self.first + round((clock - self._begun()) * self.speed)

    def _begun(self) -> int:
        with self._lock:
            if self._start is None:
                self._start = monotonic_ns()
            return self._start


def read_recording(folder: Path, sweep: str = "", names: tuple[str, ...] = (*CAMERAS, SCANNER)) -> dict[str, Recorded]:
    """Open the named devices' frames of a capture's sweep.

    Parameters
    ----------
    sweep : name of one of several.

    Raises
    ------
    InputError
        If the manifest or a table is wrong, or frames of a device are missing.
    """
    folder = Path(folder)
    images = manifest.read_manifest(folder).images_of(folder, names, sweep, "volume")
    found = {name: _read(each.folder, name, each.device) for name, each in images.items()}
    check_there(path for each in found.values() for path in each.paths)
    return found


def timeline_of(recorded: Mapping[str, Recorded], speed: float = 1.0, apart_s: float | None = None) -> Timeline:
    """The timeline that devices share: a round ends one period after the last frame of the one that goes on longest.

    Parameters
    ----------
    apart_s : by which devices may begin or end after others; None for a tenth of the longest recording, and 1 s

    Raises
    ------
    InputError
        If there is no time at which all of them were recorded, or one began or ended long after another: clocks of their own.
    """
    begun, ended = max(int(each.times[0]) for each in recorded.values()), min(int(each.times[-1]) for each in recorded.values())
    if begun > ended:
        found = f"found times {(begun - ended) / 1e9:.6g} s apart"
        raise InputError(f"{_table(recorded)}: expected one clock of {', '.join(recorded)}, {found}; {CLOCKS}")
    _check_ends(recorded, apart_s)
    first = min(int(each.times[0]) for each in recorded.values())
    ends = [int(each.times[-1] + _period(each.times)) for each in recorded.values()]
    return Timeline(first, max(ends) - first, speed)


@dataclass
class _Played:
    """Frames of a recording as they come, from the moment at which the first is asked for."""

    recorded: Recorded
    timeline: Timeline
    name: str = field(init=False)
    size: Size = field(init=False)
    bits: int = field(init=False)
    _begun: int | None = None  # number, over all rounds, of the first frame that was given
    _next: int = 0  # and of the one that is to be given
    _kept: dict[int, Image] = field(default_factory=dict)
    _closed: Event = field(default_factory=Event)

    def __post_init__(self) -> None:
        self.name, self.size, self.bits = self.recorded.name, self.recorded.size, self.recorded.bits

    def frame(self, timeout_s: float) -> Frame | None:
        """Wait for the next frame, in order; None if none came in time. DeviceError if its image is damaged, or after `close`."""
        if self._closed.is_set():
            raise DeviceError(f"{self.name}: expected an open device, found one that was closed; open it again")
        until = monotonic_ns() + round(timeout_s * 1e9)
        came = self._came()
        if self._begun is None:
            self._begun = self._next = came
        self._next = max(self._next, came - BUFFERED)
        image, due = self._image(self._next % len(self.recorded.times)), self._due(self._next)
        if self._closed.wait(max(0, min(due, until) - monotonic_ns()) * 1e-9) or monotonic_ns() < due:
            return None
        taken = Frame(image, self._next - self._begun, self._moment(self._next), monotonic_ns())
        self._next += 1
        return taken

    def close(self) -> None:
        """End."""
        self._closed.set()
        self._kept.clear()

    def _moment(self, number: int) -> int:
        """Time : ns of a frame by the device's clock."""
        rounds, k = divmod(number, len(self.recorded.times))
        return int(self.recorded.times[k]) + rounds * self.timeline.length

    def _due(self, number: int) -> int:
        """Monotonic time : ns at which a frame is whole in memory."""
        return self.timeline.clock_of(self._moment(number)) + DELIVERY_NS

    def _came(self) -> int:
        """Number of frames, over all rounds, that have come until now."""
        moment = self.timeline.moment_at(monotonic_ns() - DELIVERY_NS)
        rounds, into = divmod(moment - self.timeline.first, self.timeline.length)
        within = int(np.searchsorted(self.recorded.times, self.timeline.first + into, "right"))
        return max(0, rounds * len(self.recorded.times) + within)

    def _image(self, number: int) -> Image:
        if (kept := self._kept.get(number)) is not None:
            return kept
        try:
            image = read_image(self.recorded.paths[number], self.size, self.recorded.bits)
        except InputError as error:
            raise DeviceError(f"{self.name}: {error}") from None
        image.flags.writeable = False
        most_kept = 1 << 28  # bytes of a device's images that are kept in memory, so that later rounds read none
        if (len(self._kept) + 1) * image.nbytes <= most_kept:
            self._kept[number] = image
        return image


class PlayedCamera(_Played):
    """A `Camera` that plays a recording; exposure, gain and trigger are those it was recorded with."""

    def set_exposure(self, exposure_s: float, gain: float) -> None:
        """Refuse: the exposure was set when this was recorded."""
        raise DeviceError(f"{self.name}: expected no other exposure of a recording, found {exposure_s:g} s, gain {gain:g}")

    def start(self, trigger: Trigger) -> None:
        """Begin; any trigger but `software` is as good."""
        if trigger == "software":
            raise DeviceError(f"{self.name}: expected trigger free or hardware of a recording, found software")

    def trigger(self) -> None:
        """Refuse: what was recorded comes by itself."""
        raise DeviceError(f"{self.name}: expected no call for a frame of a recording; start it with trigger free")

    def stop(self) -> None:
        """Change nothing: a recording goes on."""


class PlayedScanner(_Played):
    """A `Scanner` that plays a recording."""


def _check_ends(recorded: Mapping[str, Recorded], apart_s: float | None) -> None:
    """Check that devices begin and end together; InputError as of `timeline_of`."""
    spans = {name: (int(each.times[0]), int(each.times[-1])) for name, each in recorded.items()}
    longest_s = max(last - first for first, last in spans.values()) / 1e9
    most_apart, most_apart_s = 0.1, 1.0  # of the longest recording, and s beside it, that a device may begin or end after another
    most_s = most_apart * longest_s + most_apart_s if apart_s is None else apart_s
    found_s, word, late, early = max((_furthest(spans, end) for end in (0, 1)), key=itemgetter(0))
    if found_s > most_s:
        found = f"found {late} to {word} {found_s:.3g} s after {early}"
        way = f"if one was recorded longer, allow apart_s={ceil(found_s)}"
        raise InputError(f"{_table(recorded)}: expected devices that {word} within {most_s:.3g} s, {found}; {CLOCKS}; {way}")


def _furthest(spans: Mapping[str, tuple[int, int]], end: int) -> tuple[float, str, str, str]:
    """The largest time, s, between beginnings (0) or ends (1) of devices, which it is, and the later and the earlier device."""
    early, late = min(spans, key=lambda name: spans[name][end]), max(spans, key=lambda name: spans[name][end])
    return (spans[late][end] - spans[early][end]) / 1e9, ("begin", "end")[end], late, early


def _table(recorded: Mapping[str, Recorded]) -> Path:
    return next(iter(recorded.values())).paths[0].with_name(STAMPS)


def _read(folder: Path, name: str, device: manifest.Device) -> Recorded:
    frames, times = sweep_tables.read_stamps(folder / STAMPS)
    paths = tuple(frame_file(folder, image_name(frame)) for frame in frames.tolist())
    return Recorded(name, device.size, device.bits, paths, times)


def _period(times: NDArray[np.int64]) -> int:
    return int(np.median(np.diff(times))) if len(times) > 1 else 33_000_000
