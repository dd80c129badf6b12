"""Frames of two cameras put together: by their numbers where one trigger exposes both, by their times where each has its own.

A frame that was lost, or that has no partner, is named with the next pair.
"""

import logging
from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass, replace
from time import monotonic
from typing import Literal

from recon.devices.interfaces import Camera, Frame, Trigger
from recon.devices.timed_frames import FrameTimes

LOG = logging.getLogger(__name__)
HELD = 64  # frames of a camera that wait for the other's

Cause = Literal["lost", "alone"]


@dataclass(frozen=True)
class Lost:
    """Frames of a camera, one after the other, that are in no pair."""

    camera: str
    first: int
    last: int
    cause: Cause  # never came, or came without its partner

    def __str__(self) -> str:
        frames = f"frame {self.first}" if self.first == self.last else f"frames {self.first} to {self.last}"
        return f"{self.camera}: {frames} {'never came' if self.cause == 'lost' else 'without a partner'}"


@dataclass(frozen=True)
class Pair:
    """Frames of both cameras of one moment."""

    frames: tuple[Frame, Frame]  # timed by this computer's clock, unless each waited for a call
    number: int  # of pairs, from 0
    apart_ns: int  # second frame after the first, by this computer's clock; 0 where pairs are made by number
    lost: tuple[Lost, ...]  # since the pair before


class PairQueue:
    """Frames of two cameras that wait for their partners: arithmetic only, no waiting.

    Keys rise within a camera: numbers, or times in ns of one clock. Frames whose keys differ by not more than `within` are
    partners; if not, the earlier one's partner can't come any more.
    """

    def __init__(self, cameras: tuple[str, str], within: int, held: int = HELD) -> None:
        self._cameras = cameras
        self._within = within
        self._held = held
        self._waiting = (deque[tuple[int, Frame]](), deque[tuple[int, Frame]]())
        self._next = [0, 0]  # number of each camera's next frame
        self._lost: list[Lost] = []
        self._pairs = 0

    def add(self, which: Literal[0, 1], key: int, frame: Frame) -> None:
        """Take a camera's next frame; one too many waits no longer for its partner."""
        if frame.number > self._next[which]:
            self._lose(which, self._next[which], frame.number - 1, "lost")
        self._next[which] = frame.number + 1
        waiting = self._waiting[which]
        waiting.append((key, frame))
        if len(waiting) > self._held:
            self._leave_alone(which)

    def pair(self) -> Pair | None:
        """Next pair, if both its frames are there."""
        first, second = self._waiting
        while first and second:
            apart = second[0][0] - first[0][0]
            if abs(apart) > self._within:
                self._leave_alone(0 if apart > 0 else 1)
            else:
                self._pairs += 1
                return Pair((first.popleft()[1], second.popleft()[1]), self._pairs - 1, apart, self.lost())
        return None

    def end(self) -> tuple[Lost, ...]:
        """Let those that wait go, as no partner will come; names all lost since the last pair."""
        for which, waiting in ((0, self._waiting[0]), (1, self._waiting[1])):
            while waiting:
                self._leave_alone(which)
        return self.lost()

    def lost(self) -> tuple[Lost, ...]:
        """Frames lost since the last pair; they are named once."""
        lost, self._lost = tuple(self._lost), []
        return lost

    def behind(self) -> Literal[0, 1]:
        """The camera of which fewer frames wait."""
        return 0 if len(self._waiting[0]) <= len(self._waiting[1]) else 1

    def _leave_alone(self, which: Literal[0, 1]) -> None:
        number = self._waiting[which].popleft()[1].number
        self._lose(which, number, number, "alone")

    def _lose(self, which: int, first: int, last: int, cause: Cause) -> None:
        """Note lost frames, as a continuation where they are one: what is remembered stays small however long pairs fail."""
        for place, known in enumerate(self._lost):
            if (known.camera, known.cause, known.last + 1) == (self._cameras[which], cause, first):
                self._lost[place] = replace(known, last=last)
                return
        self._lost.append(Lost(self._cameras[which], first, last, cause))


class CameraPair:
    """Two cameras that take pairs of frames; used by one thread at a time."""

    def __init__(self, cameras: tuple[Camera, Camera], within_s: float | None = None, held: int = HELD) -> None:
        """Put two open cameras together.

        Parameters
        ----------
        cameras : two Camera
        within_s : float, optional
            Pairs are frames taken within that time, at most half the time between two frames; without, frames of the same
            number, for cameras that are triggered together.
        held : int
            Frames that wait for a partner.
        """
        self.cameras = cameras
        self._within_s = within_s
        self._held = held
        self._called: list[Camera] = []  # cameras that wait for a call
        self.times = tuple(FrameTimes(camera) for camera in cameras)
        self._begin()

    def start(self, trigger: Trigger, second: Trigger | None = None) -> None:
        """Begin to take frames with both.

        Parameters
        ----------
        trigger : Trigger
            Of both cameras, or of the first only.
        second : Trigger, optional
            Of the second: `hardware` if the first one's exposures trigger it by wire. It is started first, so as to miss none.
        """
        self._begin()
        triggers = trigger, second or trigger
        self._called = [camera for camera, how in zip(self.cameras, triggers, strict=True) if how == "software"]
        for camera, how in reversed(list(zip(self.cameras, triggers, strict=True))):
            camera.start(how)

    def trigger(self) -> None:
        """Expose a pair now, one camera right after the other: some tenths of a millisecond, no matter for what stands still."""
        for camera in self._called:
            camera.trigger()

    def pair(self, timeout_s: float) -> Pair | None:
        """Wait for the next pair, in order; None if none came in time. DeviceError if a camera is gone or its clock jumped."""
        until = monotonic() + timeout_s
        slice_s = 0.05  # of waiting for one camera, after which the other's frames are fetched
        while (pair := self._queue.pair()) is None:
            behind = self._queue.behind()
            self._fetch(behind, min(slice_s, max(0.0, until - monotonic())))
            self._fetch(1 if behind == 0 else 0, 0.0)
            if monotonic() >= until:
                return self._queue.pair()
        return pair

    def rest(self) -> list[Pair]:
        """Pairs that still wait where no more will be asked for, in order; their times are as certain as few frames allow."""
        self._add(0, self.times[0].rest())
        self._add(1, self.times[1].rest())
        return list(iter(self._queue.pair, None))

    def stop(self) -> tuple[Lost, ...]:
        """Take no more frames; names those in no pair since the last one."""
        for camera in self.cameras:
            camera.stop()
        return self._queue.end()

    def close(self) -> None:
        """Give both cameras back."""
        for camera in self.cameras:
            camera.close()

    def _begin(self) -> None:
        first, second = self.cameras
        within_ns = 0 if self._within_s is None else round(1e9 * self._within_s)
        self._queue = PairQueue((first.name, second.name), within_ns, self._held)
        for times in self.times:
            times.begin_anew()

    def _fetch(self, which: Literal[0, 1], timeout_s: float) -> None:
        frame = self.cameras[which].frame(timeout_s)
        if frame is None:
            return
        untimed = self._within_s is None and self._called  # a call, and perhaps no other for long
        self._add(which, [frame] if untimed else self.times[which].add(frame))

    def _add(self, which: Literal[0, 1], frames: Iterable[Frame]) -> None:
        for one in frames:
            self._queue.add(which, one.number if self._within_s is None else one.time_ns, one)
