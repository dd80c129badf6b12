"""Recording of a freehand sweep: pairs of camera frames and B-scans, each as it comes, by threads of their own.

Frames wait for the disk in bounded queues. What a device or the disk lost is counted and named; a device that is gone, or a clock
that jumps, ends the recording, and what came before it is kept.
"""

from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from time import monotonic, sleep
from typing import Protocol

from recon.acquisition import frame_checks
from recon.acquisition.frame_checks import Limits
from recon.acquisition.frame_stream import FrameStream, Taken
from recon.acquisition.guidance import PENDING, Operator, Step
from recon.acquisition.pictures import Picture, Say, Show
from recon.acquisition.recording import GrowingSweep, Recording
from recon.acquisition.target_checks import Judge
from recon.capture.manifest import CAMERAS, Device, Purpose
from recon.devices.interfaces import Frame, Scanner, Trigger

POLL_S = 0.05  # of what the operator says, and of streams that ended
WORDS: dict[Purpose | None, str] = {
    "probe": "lead the probe about the crossed wires: from many sides, tilted and turned, the crossing in the image",
    "latency": "move the probe up and down over the tank's flat bottom, quickly, for ten seconds",
    "volume": "lead the probe slowly over what is to be seen, the target's face to both cameras",
    None: "lead the probe, the target's face to both cameras",
}


class PairOfFrames(Protocol):
    """Frames of both cameras of one moment."""

    @property
    def frames(self) -> tuple[Frame, Frame]:
        """Camera 1's and camera 2's."""
        ...

    @property
    def apart_ns(self) -> int:
        """Time of the second after the first."""
        ...

    @property
    def lost(self) -> Sequence[object]:
        """Frames without a partner since the pair before, each in words by `str`."""
        ...


class PairSource(Protocol):
    """Two cameras that take pairs of frames."""

    def start(self, trigger: Trigger, second: Trigger | None = None) -> None:
        """Begin to take frames; the second camera's trigger may be another than the first one's."""

    def pair(self, timeout_s: float) -> PairOfFrames | None:
        """Wait for the next pair; None if none came in time. DeviceError if a camera is gone."""

    def rest(self) -> Sequence[PairOfFrames]:
        """Pairs that still wait, as for their times, where no more will be asked for."""
        ...

    def stop(self) -> Sequence[object]:
        """Take no more frames; those without a partner since the pair before, each in words by `str`."""
        ...


class ScanSource(Scanner, Protocol):
    """A scanner whose B-scans may wait for their times."""

    def rest(self) -> Sequence[Frame]:
        """B-scans that still wait where no more will be asked for."""
        ...


class Reader(Protocol):
    """What reads the frames of one source."""

    def read(self, timeout_s: float) -> list[Taken] | None:
        """Wait for the next ones; None if none came in time."""
        ...

    def rest(self) -> list[Taken]:
        """Those that still wait at the end."""
        ...


@dataclass(frozen=True)
class SweepPlan:
    """What is to be recorded."""

    name: str
    purpose: Purpose | None
    triggers: tuple[Trigger, Trigger]  # of camera 1 and camera 2; free or hardware
    seconds: float | None  # after which it ends by itself, by the time stamps of the frames
    silent_s: float  # without a frame of a device, after which it counts as gone
    limits: Limits


@dataclass
class Shown:
    """When frames were looked at, and what was said of them."""

    show: Show
    say: Say
    judges: Mapping[str, Judge]
    limits: Limits
    devices: Mapping[str, Device]
    _looked: float = 0.0
    _said: dict[str, float] = field(default_factory=dict)

    def look(self, latest: Mapping[str, Frame]) -> None:
        """Look at the latest frames, at most once in a while, and say what is wrong with them."""
        look_s = 1.0  # between two looks at the frames, which cost a tenth of a second each
        if not latest or monotonic() - self._looked < look_s:
            return
        for device, frame in latest.items():
            bits = self.devices[device].bits
            faults: tuple[str, ...] = ()
            text = f"frame {frame.number}"
            if device in self.judges:
                found = frame_checks.look(frame.image, bits)
                target, faults = self.judges[device](frame.image, bits)
                text = f"{text}, {found.text}, {target}"
            self.show(Picture(device, frame.image, bits, text, faults))
            for fault in faults:
                self._say(f"{device} {fault}")
        self._looked = monotonic()

    def _say(self, fault: str) -> None:
        kind = fault.partition(":")[0]
        again_s = 5.0  # before the same fault is said again
        if monotonic() - self._said.get(kind, -again_s) >= again_s:
            self._said[kind] = monotonic()
            self.say(fault)


def record_sweep(
    recording: Recording,
    pairs: PairSource | None,
    scanner: ScanSource | None,
    devices: Mapping[str, Device],
    operator: Operator,
    plan: SweepPlan,
    judges: Mapping[str, Judge],
    say: Say,
    show: Show,
) -> dict[str, int]:
    """Record until the operator ends, the time is over or a device is gone; returns the number of frames of each device.

    Parameters
    ----------
    devices : of those that are recorded
    judges : camera -> what says whether its frame shows the target

    Raises
    ------
    DeviceError
        If a device is gone or its clock jumps; what came before is kept.
    OSError
        If a frame can't be written; likewise.
    """
    counts = dict.fromkeys(devices, 0)
    with recording.sweep(plan.name, plan.purpose, devices) as sweep:
        shown = Shown(show, say, judges, plan.limits, devices)
        operator.ask(Step(WORDS[plan.purpose]))
        if not _rehearsed(pairs, scanner, operator, plan, shown):
            return counts
        operator.ask(Step("recording; end it when you are through"))
        if pairs is not None:
            pairs.start(*plan.triggers)
        sources, write = readers(pairs, scanner, say), _writer(sweep, counts)
        with ExitStack() as stack:
            stack.callback(_say_counts, counts, say)
            stack.callback(stop, pairs, say)
            for reader in sources:
                stack.callback(_write_rest, reader, write)
            streams = [FrameStream(reader.read, write, plan.silent_s, say) for reader in sources]
            for stream in streams:
                stack.callback(stream.end)
            _follow(streams, operator, plan, shown)
        for stream in streams:
            stream.check()
    return counts


def _write_rest(reader: Reader, write: Callable[[Taken], None]) -> None:
    """Write a reader's frames that waited for their times until the end."""
    for taken in reader.rest():
        write(taken)


def stop(pairs: PairSource | None, say: Say) -> None:
    """Stop the cameras, and say which frames are lost."""
    for lost in () if pairs is None else pairs.stop():
        say(f"lost {lost}")


def _say_counts(counts: Mapping[str, int], say: Say) -> None:
    say("recorded " + ", ".join(f"{count} frames of {device}" for device, count in counts.items()))


def _rehearsed(pairs: PairSource | None, scanner: ScanSource | None, operator: Operator, plan: SweepPlan, shown: Shown) -> bool:
    """Show what the devices see until the operator is ready; whether it is to be recorded then."""
    answer = operator.answer()
    if answer not in PENDING:
        return answer != "end"
    if pairs is not None:
        pairs.start(*plan.triggers)
    while answer in PENDING:
        latest = dict[str, Frame]()
        if pairs is not None and (pair := pairs.pair(POLL_S)) is not None:
            latest |= dict(zip(CAMERAS, pair.frames, strict=True))
        if scanner is not None and (frame := scanner.frame(POLL_S)) is not None:
            latest[scanner.name] = frame
        shown.look(latest)
        answer = operator.answer()
    if pairs is not None:
        pairs.stop()
    return answer != "end"


def _follow(streams: Sequence[FrameStream], operator: Operator, plan: SweepPlan, shown: Shown) -> None:
    """Wait for the end of a recording, and show how it goes."""
    while all(stream.alive for stream in streams) and operator.answer() in PENDING:
        if plan.seconds is not None and any(stream.span_s >= plan.seconds for stream in streams):
            break
        shown.look({device: frame for stream in streams for device, frame in stream.latest.items()})
        sleep(POLL_S)


def readers(pairs: PairSource | None, scanner: ScanSource | None, say: Say) -> list[Reader]:
    """What reads the frames of those sources that are there."""
    return [*([] if pairs is None else [_PairReader(pairs, say)]), *([] if scanner is None else [_ScanReader(scanner)])]


@dataclass(frozen=True)
class _PairReader:
    """Reads pairs of frames, and says which are lost."""

    pairs: PairSource
    say: Say

    def read(self, timeout_s: float) -> list[Taken] | None:
        pair = self.pairs.pair(timeout_s)
        return None if pair is None else self._taken(pair)

    def rest(self) -> list[Taken]:
        return [taken for pair in self.pairs.rest() for taken in self._taken(pair)]

    def _taken(self, pair: PairOfFrames) -> list[Taken]:
        for lost in pair.lost:
            self.say(f"lost {lost}")
        first = pair.frames[0]
        times = first.time_ns, first.time_ns + pair.apart_ns
        return [Taken(name, frame, time) for name, frame, time in zip(CAMERAS, pair.frames, times, strict=True)]


@dataclass(frozen=True)
class _ScanReader:
    """Reads B-scans."""

    scanner: ScanSource

    def read(self, timeout_s: float) -> list[Taken] | None:
        frame = self.scanner.frame(timeout_s)
        return None if frame is None else [self._taken(frame)]

    def rest(self) -> list[Taken]:
        return [self._taken(frame) for frame in self.scanner.rest()]

    def _taken(self, frame: Frame) -> Taken:
        return Taken(self.scanner.name, frame, frame.time_ns)


def _writer(sweep: GrowingSweep, counts: dict[str, int]) -> Callable[[Taken], None]:
    def write(taken: Taken) -> None:
        sweep.add(taken.device, taken.frame.number, taken.time_ns, taken.frame.image)
        counts[taken.device] += 1

    return write
