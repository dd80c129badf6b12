"""Single shots of a probe at rest: at a key one B-scan with a pair of frames before and after it, at another the last is deleted.

Shots are the frames of a sweep. The pairs' poses are near enough in time for the B-scan's to lie between them, though its time
stamp may be late. In both, the target's circles must be at the same places: then the probe was at rest.
"""

import threading
from bisect import bisect_left, bisect_right
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from time import monotonic, sleep
from typing import NamedTuple

import numpy as np

from recon.acquisition.frame_stream import FrameStream, Taken
from recon.acquisition.guidance import Operator, Step, sentence
from recon.acquisition.pictures import Say, Show
from recon.acquisition.recording import GrowingSweep, Recording
from recon.acquisition.sweep_recording import POLL_S, PairSource, ScanSource, Shown, SweepPlan, readers, stop
from recon.acquisition.target_checks import Judge, Places
from recon.capture.manifest import CAMERAS, SCANNER, Device, Purpose
from recon.model.tracks import MAX_GAP_S

LEAD_S = 0.1  # by which a B-scan's time stamp may be late
WORDS: dict[Purpose | None, str] = {
    "probe": "bring the crossed wires into the image, near another corner and tilted otherwise each time, and hold still",
    "latency": "hold the probe still over the tank's bottom",
    "volume": "hold the probe still over what is to be seen, the target's face to both cameras",
    None: "hold the probe still, the target's face to both cameras",
}
KEYS = "Enter takes a shot, k whatever is wrong with it; d deletes the last one"


class Shot(NamedTuple):
    """Frames of one moment of rest."""

    before: tuple[Taken, Taken]  # of camera 1 and camera 2
    scan: Taken
    after: tuple[Taken, Taken]


class _Newest:
    """Frames that came since one was asked for, from any thread; none are kept meanwhile."""

    def __init__(self) -> None:
        self._lock, self._asked = threading.Lock(), False
        self._frames: dict[str, list[Taken]] = {name: [] for name in (*CAMERAS, SCANNER)}

    def ask(self, asked: bool) -> None:
        """Begin anew, or keep no more."""
        with self._lock:
            self._asked = asked
            for frames in self._frames.values():
                frames.clear()

    def add(self, taken: Taken) -> None:
        """Add a frame; a pair's first one comes before its second."""
        first, second = (self._frames[name] for name in CAMERAS)
        with self._lock:
            if self._asked and not (taken.device == CAMERAS[1] and len(second) == len(first)):
                self._frames[taken.device].append(taken)

    def shot(self) -> Shot | None:
        """The first B-scan that has a pair of frames before and after it."""
        with self._lock:
            first, second, scans = (list(self._frames[name]) for name in (*CAMERAS, SCANNER))
        pairs = list(zip(first, second, strict=False))
        times = [one.time_ns for one, _ in pairs]
        for scan in scans:
            before = bisect_right(times, scan.time_ns - round(1e9 * LEAD_S)) - 1
            after = bisect_left(times, scan.time_ns)
            if before >= 0 and after < len(pairs):
                return Shot(pairs[before], scan, pairs[after])
        return None


def record_shots(
    recording: Recording,
    pairs: PairSource,
    scanner: ScanSource,
    devices: Mapping[str, Device],
    operator: Operator,
    plan: SweepPlan,
    most_moved_px: float,
    judges: Mapping[str, Judge],
    places: Places,
    say: Say,
    show: Show,
) -> int:
    """Record until the operator ends or a device is gone; returns the number of shots. Each is on the disk before the next.

    Parameters
    ----------
    most_moved_px : of the target's circles, from the frames before the B-scan to those after it
    judges : as of `record_sweep`
    places : finds the target's circles in a frame

    Raises
    ------
    DeviceError
        If a device is gone or its clock jumps; what came before is kept.
    OSError
        If a frame can't be written; likewise.
    """
    kept = refused = 0
    with recording.sweep(plan.name, plan.purpose, devices) as sweep:
        shown, newest = Shown(show, say, judges, plan.limits, devices), _Newest()
        pairs.start(*plan.triggers)
        with ExitStack() as stack:
            stack.callback(lambda: say(f"recorded {kept} shots" + (f", {refused} not kept" if refused else "")))
            stack.callback(stop, pairs, say)
            streams = [FrameStream(one.read, newest.add, plan.silent_s, say) for one in readers(pairs, scanner, say)]
            for stream in streams:
                stack.callback(stream.end)
            operator.ask(Step(f"{WORDS[plan.purpose]}; {KEYS}"))
            while all(stream.alive for stream in streams) and (answer := operator.answer()) != "end":
                if answer == "wait":
                    shown.look({device: frame for stream in streams for device, frame in stream.latest.items()})
                    sleep(POLL_S)
                elif answer == "drop":
                    kept = _drop(sweep, kept)
                    operator.ask(Step(f"deleted the last shot, {kept} are left" if kept else "no shot is there"))
                elif (shot := _take(newest, streams, operator, plan, say)) is None:
                    refused += 1
                    operator.ask(Step("nothing kept; take it again"))
                elif faults := [] if answer == "keep" else _faults(shot, devices, most_moved_px, places):
                    refused += 1
                    say(f"not kept: {sentence(faults)}")
                    operator.ask(Step("hold still and take it again"))
                else:
                    kept = _keep(sweep, shot, kept)
                    operator.ask(Step(f"kept {kept}"))
        for stream in streams:
            stream.check()
    return kept


def _take(newest: _Newest, streams: Sequence[FrameStream], operator: Operator, plan: SweepPlan, say: Say) -> Shot | None:
    """Wait for the frames of a shot; None if the operator ends, a device is gone or its times don't meet the other's."""
    until = monotonic() + plan.silent_s
    newest.ask(True)
    try:
        while (shot := newest.shot()) is None and all(stream.alive for stream in streams) and operator.answer() != "end":
            if monotonic() > until:
                say(f"no B-scan between frames within {plan.silent_s:g} s: are cameras and scanner on one clock?")
                break
            sleep(POLL_S)
        return shot
    finally:
        newest.ask(False)


def _faults(shot: Shot, devices: Mapping[str, Device], most_px: float, places: Places) -> list[str]:
    """What is wrong with a shot, each with the way to mend it."""
    faults = []
    for before, after in zip(shot.before, shot.after, strict=True):
        name, apart_s = before.device, 1e-9 * (after.time_ns - before.time_ns)
        if apart_s > MAX_GAP_S:
            faults.append(
                f"{name} frames {apart_s:.2f} s apart, beyond {MAX_GAP_S:g} s no pose lies between them; raise the rate"
            )
        first, second = (places(one.frame.image, devices[name].bits) for one in (before, after))
        moved = np.linalg.norm(second - first, axis=1)
        if not np.isfinite(moved).any():
            faults.append(f"{name} target not found; turn its face to both cameras")
        elif (most := float(np.nanmax(moved))) > most_px:
            faults.append(f"{name} target moved by {most:.1f} px in {apart_s:.2f} s")
    return faults


def _keep(sweep: GrowingSweep, shot: Shot, kept: int) -> int:
    """Write a shot, the B-scan last; returns the number that is there."""
    for taken in (*shot.before, *shot.after, shot.scan):
        sweep.add(taken.device, taken.frame.number, taken.time_ns, taken.frame.image)
    return kept + 1


def _drop(sweep: GrowingSweep, kept: int) -> int:
    """Delete the last shot, the B-scan first; returns the number that is left."""
    if kept == 0:
        return 0
    sweep.drop({SCANNER: 1, **dict.fromkeys(CAMERAS, 2)})
    return kept - 1
