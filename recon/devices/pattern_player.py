"""Shows a pattern sequence and takes one image of each camera a pattern, none of them lost, late or of another pattern.

    show -> light (delay measured) -> trigger -> exposure -> image          cameras that are triggered
    show -> light (delay measured) -> images to wait (measured) -> image    cameras that run freely or by the projector's wire

Images that don't arrive, and those that don't change although the pattern does, are taken again.
"""

import logging
import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from recon.devices import pattern_changes
from recon.devices.interfaces import Camera, DeviceError, Frame, Projector, Trigger
from recon.devices.pattern_changes import Light

log = logging.getLogger(__name__)

Pattern = NDArray[np.uint8]
Frames = tuple[Frame, ...]  # one of each camera

TRIES = 3  # of a pattern
DOUBLED = 0.1  # share of the expected change below which an image shows the pattern before; gamma and a part in view leave 0.2
LEAST_LIGHT_DN = 2.0  # root mean square of white less black


class Taking(Protocol):
    """A way to take images of what is lit."""

    @property
    def trigger(self) -> Trigger:
        """Mode that the cameras are started in."""

    def take(self, cameras: Sequence[Camera], lit_ns: int) -> list[Frame | None]:
        """One image of each camera, begun after a time of this computer's monotonic clock; None where none came."""


@dataclass(frozen=True)
class Triggered:
    """Software triggers: all cameras at once, as soon as the light is there."""

    timeout_s: float = 1.0
    trigger: Literal["software"] = "software"

    def take(self, cameras: Sequence[Camera], lit_ns: int) -> list[Frame | None]:
        """Trigger all, then collect."""
        for camera in cameras:
            camera.trigger()
        return [_frame_after(camera, lit_ns, 0, self.timeout_s) for camera in cameras]


@dataclass(frozen=True)
class Streamed:
    """Cameras at their own rate, or at that of a wire from the projector: a measured number of images is left out."""

    wait_frames: int  # of those that arrive with the light or later, by `projector_delay.frames_to_wait`
    trigger: Literal["free", "hardware"] = "free"
    timeout_s: float = 2.0

    def take(self, cameras: Sequence[Camera], lit_ns: int) -> list[Frame | None]:
        """Wait for the image of each camera."""
        return [_frame_after(camera, lit_ns, self.wait_frames, self.timeout_s) for camera in cameras]


@dataclass(frozen=True)
class Shot:
    """All cameras' images of a pattern."""

    number: int  # of the pattern in its sequence
    lit_ns: int  # from which on it was lit, of this computer's monotonic clock
    frames: Frames
    changes: tuple[float, ...]  # a camera, as `pattern_changes.change`

    @property
    def doubled(self) -> bool:
        """Whether a camera still shows the pattern before, after all tries."""
        return any(change < DOUBLED for change in self.changes)


def play(projector: Projector, patterns: Iterable[Pattern], cameras: Sequence[Camera], taking: Taking) -> Iterator[Shot]:
    """Show black, white and then a sequence, and yield all cameras' images of each of its patterns as soon as they are there.

    Parameters
    ----------
    patterns : of (height, width), 0 to 255
    cameras : with exposure and gain set; they are started here, and stopped at the end

    Raises
    ------
    DeviceError
        If a camera doesn't see the projector's light, or gives no image in three tries. A sequence whose images don't change is
        yielded all the same, see `Shot.doubled`.
    """
    with _started(cameras, taking.trigger):
        lights, shown, frames = _measure_light(projector, cameras, taking)
        for number, pattern in enumerate(patterns):
            shot = _shoot(projector, (shown, pattern), cameras, taking, lights, frames, number)
            yield shot
            shown, frames = pattern, shot.frames


def refuse_doubled(shot: Shot, cameras: Sequence[Camera]) -> None:
    """Refuse a shot of which an image didn't change with its pattern.

    Raises
    ------
    DeviceError
        With the camera and the pattern.
    """
    for camera, change in zip(cameras, shot.changes, strict=True):
        if change < DOUBLED:
            raise DeviceError(
                f"{camera.name}: expected another image of pattern {shot.number} than of the one before, found the same in "
                f"{TRIES} tries: is the projector's image frozen, its delay longer than was measured, or this "
                "part of it out of view?"
            )


def _shoot(
    projector: Projector,
    patterns: tuple[Pattern, Pattern],
    cameras: Sequence[Camera],
    taking: Taking,
    lights: Sequence[Light],
    before: Frames,
    number: int,
) -> Shot:
    """Show the second of two patterns until all images differ from those before as the patterns do."""
    for attempt in range(TRIES):
        lit_ns = projector.show(patterns[1])
        frames = _all_frames(cameras, taking, lit_ns, f"pattern {number}")
        changes = tuple(
            pattern_changes.change(light, (old.image, new.image), patterns)
            for light, old, new in zip(lights, before, frames, strict=True)
        )
        shot = Shot(number, lit_ns, frames, changes)
        if not shot.doubled:
            return shot
        log.warning("projector: pattern %d does not show in the images, try %d of %d", number, attempt + 1, TRIES)
    return shot


def _measure_light(projector: Projector, cameras: Sequence[Camera], taking: Taking) -> tuple[list[Light], Pattern, Frames]:
    """The projector's light in each camera, and the pattern and images that it ended with."""
    width, height = projector.size
    black, white = np.zeros((height, width), np.uint8), np.full((height, width), 255, np.uint8)
    dark = _all_frames(cameras, taking, projector.show(black), "black")
    lit = _all_frames(cameras, taking, projector.show(white), "white")
    again = _all_frames(cameras, taking, time.monotonic_ns(), "white")
    lights = [pattern_changes.measure_light(*(frame.image for frame in frames)) for frames in zip(dark, lit, again, strict=True)]
    for camera, light in zip(cameras, lights, strict=True):
        if light.power < max(LEAST_LIGHT_DN**2, light.noise):
            raise DeviceError(
                f"{camera.name}: expected the projector's light, found white {np.sqrt(light.power):.1f} DN brighter than black: "
                "is the lens covered, the exposure too short, the projector off, or its delay longer than was measured?"
            )
    return lights, white, again


def _all_frames(cameras: Sequence[Camera], taking: Taking, lit_ns: int, what: str) -> Frames:
    """An image of each camera, taken again if one is lost.

    A camera that gave none is started anew, so that an image which comes late isn't taken for that of the next pattern.
    """
    lost: list[Camera] = []
    for _ in range(TRIES):
        frames = taking.take(cameras, lit_ns)
        lost = [camera for camera, frame in zip(cameras, frames, strict=True) if frame is None]
        if not lost:
            return tuple(frame for frame in frames if frame is not None)
        for camera in lost:
            log.warning("%s: no image of %s, taken again", camera.name, what)
            camera.stop()
            camera.start(taking.trigger)
    raise DeviceError(
        f"{lost[0].name}: expected an image of {what}, found none in {TRIES} tries: is its cable or trigger loose, another "
        "program using it, or the exposure longer than the time to wait?"
    )


def _frame_after(camera: Camera, lit_ns: int, wait_frames: int, timeout_s: float) -> Frame | None:
    """The image that comes a number of images after the first one that arrived later than a time; None if it doesn't come."""
    first, end = None, time.monotonic() + timeout_s
    while (frame := camera.frame(max(end - time.monotonic(), 0))) is not None:
        if frame.arrived_ns < lit_ns:
            continue
        first = frame.number if first is None else first
        if frame.number - first >= wait_frames:
            return frame
    return None


@contextmanager
def _started(cameras: Sequence[Camera], trigger: Trigger) -> Iterator[None]:
    """Cameras that take images, until the end."""
    try:
        for camera in cameras:
            camera.start(trigger)
        yield
    finally:
        for camera in cameras:
            camera.stop()
