"""Pictures of what the projector lights: a pattern is shown, and each camera takes one frame that was exposed wholly under it."""

import logging
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from recon.devices.interfaces import Camera, DeviceError, Frame, Projector, Trigger
from recon.model.rig import Part, Positive

log = logging.getLogger(__name__)

Pattern = NDArray[np.uint8]
MOST_WAITING = 1000  # frames of earlier light that are thrown away at most

Seen = Callable[[Mapping[str, Frame]], None]


class Triggering(Part):
    """How pattern and exposure come together."""

    by: Trigger = "software"  # hardware: a wire from the projector, each pattern exposes one frame
    settle_frames: Annotated[int, Field(ge=0, le=100)] = 1  # of free-running cameras, left out after a new pattern
    timeout_s: Positive = 2.0  # after which a frame counts as lost
    tries: Annotated[int, Field(ge=1, le=10)] = 2  # of a sequence, if frames are lost


class LostFrame(DeviceError):
    """A frame that didn't come, or another one in its place."""


@dataclass(frozen=True)
class Stage:
    """A projector and cameras that see its light."""

    projector: Projector
    cameras: Mapping[str, Camera]  # by their names
    triggering: Triggering

    def start(self) -> None:
        """Start all cameras."""
        for camera in self.cameras.values():
            camera.start(self.triggering.by)

    def stop(self) -> None:
        """Stop all cameras."""
        for camera in self.cameras.values():
            camera.stop()

    def white(self) -> Pattern:
        """The pattern with all pixels on : (h, w)."""
        return np.full(self.projector.size[::-1], 255, np.uint8)

    def take(self, pattern: Pattern) -> dict[str, Frame]:
        """Show a pattern, and take a frame of each camera; LostFrame if one doesn't come."""
        if self.triggering.by == "hardware":
            for camera in self.cameras.values():
                _drain(camera)
        shown_ns = self.projector.show(pattern)
        time.sleep(max(0.0, (shown_ns - time.monotonic_ns()) * 1e-9))
        if self.triggering.by == "software":
            for camera in self.cameras.values():
                camera.trigger()
        return {name: self._frame(camera, shown_ns) for name, camera in self.cameras.items()}

    def sequence(self, patterns: Iterable[Pattern], names: Sequence[str], seen: Seen = lambda frames: None) -> dict[str, NDArray]:
        """Take a sequence with some of the cameras : name -> (n, h, w). Once more from its beginning if a frame is lost.

        seen : is given the frames of each pattern as they come
        """
        some = Stage(self.projector, {name: self.cameras[name] for name in names}, self.triggering)
        shown = list(patterns)
        for left in reversed(range(self.triggering.tries)):
            stacks: dict[str, list[NDArray]] = {name: [] for name in names}
            try:
                for pattern in shown:
                    frames = some.take(pattern)
                    seen(frames)
                    for name, frame in frames.items():
                        stacks[name].append(frame.image)
            except LostFrame as error:
                if not left:
                    raise
                log.warning("%s; the sequence is taken again", error)
                continue
            return {name: np.stack(stack) for name, stack in stacks.items()}
        raise AssertionError("unreachable")

    def _frame(self, camera: Camera, shown_ns: int) -> Frame:
        """The camera's frame of what is shown since a moment."""
        if self.triggering.by != "free":
            return _next(camera, self.triggering.timeout_s)
        left_out = 0
        while True:  # what arrives after the pattern may have been exposed before it
            frame = _next(camera, self.triggering.timeout_s)
            if frame.arrived_ns <= shown_ns:
                continue
            if left_out == self.triggering.settle_frames:
                return frame
            left_out += 1


def _next(camera: Camera, timeout_s: float) -> Frame:
    frame = camera.frame(timeout_s)
    if frame is None:
        raise LostFrame(
            f"{camera.name}: expected a frame within {timeout_s:g} s, found none; is its trigger wired? see triggering.by"
        )
    return frame


def _drain(camera: Camera) -> None:
    """Throw away what waits: the frame of a pattern that came late must not stand for the next one."""
    for _ in range(MOST_WAITING):
        if camera.frame(0.0) is None:
            return
    raise DeviceError(f"{camera.name}: expected one frame a pattern, found them without end; does it run free? see triggering.by")
