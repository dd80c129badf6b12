"""Shows a pattern sequence and takes one image of each camera a pattern, none of them lost, late or of another pattern.

    show -> light (delay measured) -> trigger -> exposure -> image          cameras that are triggered
    show -> light (delay measured) -> images to wait (measured) -> image    cameras that run freely or by the projector's wire

A pattern whose image doesn't arrive, or doesn't change although the pattern does, is shown and taken again. Times are those of
projector and frames alone, so that devices with a time of their own are played, too.
"""

import logging
import time
from collections.abc import Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from recon.devices import pattern_changes
from recon.devices.interfaces import Camera, DeviceError, Frame, Projector, Trigger
from recon.devices.pattern_changes import Light

log = logging.getLogger(__name__)

Pattern = NDArray[np.uint8]

TRIES = 3  # of a pattern
DOUBLED = 0.1  # share of the expected change below which an image shows the pattern before; gamma and a part in view leave 0.2


class Taking(Protocol):
    """A way to take images of what is lit."""

    @property
    def trigger(self) -> Trigger:
        """Mode that the cameras are started in."""

    def take(self, cameras: Sequence[Camera], lit_ns: int) -> list[Frame | None]:
        """One image of each camera, begun after a time of the projector's clock; None where none came."""


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
class Stage:
    """A projector, cameras that see its light, and the way to take their images."""

    projector: Projector
    cameras: Mapping[str, Camera]  # by their names, with exposure and gain set
    taking: Taking

    @property
    def black(self) -> Pattern:
        """The pattern with all pixels off : (h, w)."""
        return np.zeros(self.projector.size[::-1], np.uint8)

    @property
    def white(self) -> Pattern:
        """The pattern with all pixels on : (h, w)."""
        return np.full(self.projector.size[::-1], 255, np.uint8)

    def of(self, names: Iterable[str]) -> "Stage":
        """The same with some of the cameras."""
        return replace(self, cameras={name: self.cameras[name] for name in names})


@dataclass(frozen=True)
class Shot:
    """All cameras' images of a pattern."""

    number: int  # of the pattern in its sequence
    lit_ns: int  # from which on it was lit, of the projector's clock
    frames: dict[str, Frame]  # by camera
    changes: dict[str, float]  # by camera, as `pattern_changes.change`
    faults: tuple[str, ...]  # a line each: a camera that doesn't see the projector, or shows the pattern before after all tries


def take(stage: Stage, pattern: Pattern) -> dict[str, Frame]:
    """Show one pattern : (height, width), and take an image of each camera; DeviceError if one gives none in three tries."""
    with _started(stage):
        return _take(stage, pattern, "what is lit").frames


def play(stage: Stage, patterns: Iterable[Pattern]) -> Generator[Shot, None, None]:
    """Show black, white and then a sequence, and yield all cameras' images of each of its patterns as soon as they are there.

    Cameras are started here, and stopped at the end. A sequence is yielded whatever its images show; its faults are said.

    Parameters
    ----------
    patterns : of (height, width), 0 to 255

    Raises
    ------
    DeviceError
        If a camera gives no image in three tries.
    """
    with _started(stage):
        dark, lit = _take(stage, stage.black, "black"), _take(stage, stage.white, "white")
        before = _take(stage, stage.white, "white")
        images = {name: tuple(taken.frames[name].image for taken in (dark, lit, before)) for name in stage.cameras}
        lights = {name: pattern_changes.measure_light(*three) for name, three in images.items()}
        unlit = [fault for name, light in lights.items() if (fault := _light_fault(name, light))]
        for number, pattern in enumerate(patterns):
            before, changes = _take_changed(stage, lights, before, pattern, number)
            frozen = [_frozen_fault(name, number) for name, change in changes.items() if change < DOUBLED]
            yield Shot(number, before.lit_ns, before.frames, changes, (*unlit, *frozen))


def refuse_faults(shot: Shot) -> None:
    """Refuse a shot of a camera without light, or with the image of the pattern before.

    Raises
    ------
    DeviceError
        With the camera, and with the pattern.
    """
    if shot.faults:
        raise DeviceError(shot.faults[0])


class _Taken(NamedTuple):
    """A pattern and its images."""

    pattern: Pattern
    lit_ns: int
    frames: dict[str, Frame]


def _take_changed(
    stage: Stage, lights: Mapping[str, Light], before: _Taken, pattern: Pattern, number: int
) -> tuple[_Taken, dict[str, float]]:
    """Show a pattern until all images differ from those before as the patterns do.

    Two patterns may be alike in the part that a camera sees. So white, then black is shown between tries: in any part, one of
    them differs from the pattern. Each camera's image is that of its own first try without fault.
    """
    frames, changes = dict[str, Frame](), dict[str, float]()
    for number_of_try, between in enumerate(("", "white", "black"), 1):
        if between:
            before = _take(stage, stage.white if between == "white" else stage.black, between)
        taken = _take(stage, pattern, f"pattern {number}")
        for name in [name for name in lights if changes.get(name, 0.0) < DOUBLED]:
            frames[name], images = taken.frames[name], (before.frames[name].image, taken.frames[name].image)
            changes[name] = pattern_changes.change(lights[name], images, (before.pattern, pattern))
        if not any(change < DOUBLED for change in changes.values()):
            break
        log.info("projector: pattern %d does not show in the images, try %d of %d", number, number_of_try, TRIES)
    return _Taken(pattern, taken.lit_ns, frames), changes


def _light_fault(name: str, light: Light) -> str:
    """What is wrong with a camera's view of the projector's light; nothing if it is seen."""
    least_light_dn = 2.0  # root mean square of white less black
    if light.power >= max(least_light_dn**2, light.noise):
        return ""
    return (
        f"{name}: expected the projector's light, found white {np.sqrt(light.power):.1f} DN brighter than black: "
        "is the lens covered, the exposure too short, the projector off, or its delay longer than was measured?"
    )


def _frozen_fault(name: str, number: int) -> str:
    return (
        f"{name}: expected another image of pattern {number} than of the one before, found the same in {TRIES} tries: is the "
        "projector's image frozen, or its delay longer than was measured?"
    )


def _take(stage: Stage, pattern: Pattern, what: str) -> _Taken:
    """Show a pattern and take an image of each camera, again if one is lost.

    A camera that gave none is started anew, so that an image which comes late isn't taken for that of the next pattern.
    """
    lost: list[str] = []
    for _ in range(TRIES):
        lit_ns = stage.projector.show(pattern)
        frames = dict(zip(stage.cameras, stage.taking.take(list(stage.cameras.values()), lit_ns), strict=True))
        lost = [name for name, frame in frames.items() if frame is None]
        if not lost:
            return _Taken(pattern, lit_ns, {name: frame for name, frame in frames.items() if frame is not None})
        for name in lost:
            log.warning("%s: no image of %s, taken again", name, what)
            stage.cameras[name].stop()
            stage.cameras[name].start(stage.taking.trigger)
    raise DeviceError(
        f"{lost[0]}: expected an image of {what}, found none in {TRIES} tries: is its cable or trigger loose, another "
        "program using it, or the exposure longer than the time to wait?"
    )


def _frame_after(camera: Camera, lit_ns: int, wait_frames: int, timeout_s: float) -> Frame | None:
    """The image that comes a number of images after the first one that arrived later than a time; None if it doesn't come."""
    first, end = None, time.monotonic() + timeout_s
    most_waiting = 1000  # images of earlier light that are left out at most
    for _ in range(most_waiting):  # by number, not by time: of virtual cameras an image may take longer than life
        frame = camera.frame(max(end - time.monotonic(), 0))
        if frame is None:
            return None
        if frame.arrived_ns < lit_ns:
            continue
        first = frame.number if first is None else first
        if frame.number - first >= wait_frames:
            return frame
    return None


@contextmanager
def _started(stage: Stage) -> Iterator[None]:
    """Cameras that take images, until the end."""
    try:
        for camera in stage.cameras.values():
            camera.start(stage.taking.trigger)
        yield
    finally:
        for camera in stage.cameras.values():
            camera.stop()
