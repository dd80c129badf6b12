"""Measures the time from a projector's picture to its light: flashes, watched by a camera.

A driver's queue, the cable, the projector's electronics and its lamp take some images of the display, and not always the same. So
the largest of several flashes counts, at moments spread over a camera's period.
"""

import time
from collections.abc import Iterator
from typing import Literal, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from recon.devices.interfaces import Camera, DeviceError, Frame, Projector

FLASHES = 16  # black and white in turn
LONGEST_S = 0.5  # that a projector may take, and a third more is watched


class _Watched(NamedTuple):
    """Images after a flash."""

    seconds: NDArray[np.float64]  # (n,) begin of each exposure, or arrival of each image, after the flash was drawn
    numbers: NDArray[np.int64]  # (n,) counted from the first
    levels: NDArray[np.float64]  # (n,) DN, mean of each image


def seconds_to_wait(projector: Projector, camera: Camera, flashes: int = FLASHES) -> float:
    """Time from `show` to an exposure that sees nothing of the picture before, for cameras that are triggered.

    Parameters
    ----------
    projector : without a delay of its own
    camera : with exposure and gain set; it is triggered by software, as fast as it can

    Returns
    -------
    float
        In s, the largest of all flashes; too large by up to a period of the camera.

    Raises
    ------
    DeviceError
        If the camera doesn't see the flashes, or they take longer than 0.5 s.
    """
    camera.start("software")
    try:
        series = [_trigger(projector, camera, k, flashes) for k in range(flashes)]
    finally:
        camera.stop()
    return max(float(watched.seconds[first]) for watched, first in _settled(camera, series))


def frames_to_wait(
    projector: Projector, camera: Camera, trigger: Literal["free", "hardware"] = "free", flashes: int = FLASHES
) -> int:
    """Number of images to leave out, of those that arrive after `show`, for cameras that run freely or by a wire.

    Parameters and errors as of `seconds_to_wait`. The largest number of all flashes and one more, since a moment of
    the camera's period that is a little worse may not have been among them.
    """
    camera.start(trigger)
    try:
        series = [_watch(projector, camera, k, flashes) for k in range(flashes)]
    finally:
        camera.stop()
    return max(int(watched.numbers[first]) for watched, first in _settled(camera, series)) + 1


def _settled(camera: Camera, series: list[_Watched]) -> Iterator[tuple[_Watched, int]]:
    """Each flash but the first, and the index of its first image from which on all show it."""
    ends = [float(np.median(watched.levels[-max(len(watched.levels) // 4, 1) :])) for watched in series]
    settled = 0.02  # share of a step up to which a level is the new one
    least_dn = 1.0  # step of the image's mean; smaller ones are left to the lamp's flicker
    for before, end, watched in zip(ends, ends[1:], series[1:], strict=False):
        step = abs(end - before)
        if step < least_dn:
            raise DeviceError(
                f"{camera.name}: expected flashes of the projector, found black and white {step:.1f} DN apart: is the lens "
                "covered, the exposure too short, or the projector off?"
            )
        first = int(np.flatnonzero(np.append(True, np.abs(watched.levels - end) > settled * step))[-1])
        if first == len(watched.levels) or watched.seconds[first] > LONGEST_S:
            raise DeviceError(
                f"{camera.name}: expected a flash to settle within {LONGEST_S} s, found levels that still change: does the "
                "room's or the projector's light flicker, or is an auto exposure on?"
            )
        yield watched, first


def _trigger(projector: Projector, camera: Camera, k: int, flashes: int) -> _Watched:
    """Flash k, watched by triggers as fast as the camera takes them."""
    frames, begins, begin = [], [], _flash(projector, k)
    while time.monotonic_ns() - begin < 1e9 * LONGEST_S * 4 / 3:
        begins.append(time.monotonic_ns())
        camera.trigger()
        if (frame := camera.frame(LONGEST_S)) is None:
            begins.pop()
            continue
        frames.append(frame)
        if len(frames) == 1:  # another moment of the period for each flash
            time.sleep((time.monotonic_ns() - begins[0]) / 1e9 * k / flashes)
    return _watched(camera, frames, begins, begin)


def _watch(projector: Projector, camera: Camera, k: int, flashes: int) -> _Watched:
    """Flash k, watched by a camera that runs."""
    frames: list[Frame] = []
    begin = _flash(projector, k)
    while time.monotonic_ns() - begin < 1e9 * LONGEST_S * 4 / 3:
        frame = camera.frame(LONGEST_S)
        if frame is not None and frame.arrived_ns >= begin:
            frames.append(frame)
    if len(frames) > 1:
        period_s = (frames[-1].arrived_ns - frames[0].arrived_ns) / 1e9 / (len(frames) - 1)
        time.sleep(period_s * k / flashes)
    return _watched(camera, frames, [frame.arrived_ns for frame in frames], begin)


def _flash(projector: Projector, k: int) -> int:
    """Show white, then black, in turn; the time in ns."""
    width, height = projector.size
    return projector.show(np.full((height, width), 0 if k % 2 else 255, np.uint8))


def _watched(camera: Camera, frames: list[Frame], begins: list[int], begin: int) -> _Watched:
    """Levels of frames; DeviceError without any."""
    if not frames:
        raise DeviceError(f"{camera.name}: expected images during a flash, found none: is it triggered, and its cable tight?")
    numbers = np.array([frame.number for frame in frames])
    levels = np.array([cv2.mean(frame.image)[0] for frame in frames])
    return _Watched((np.array(begins) - begin) / 1e9, numbers - numbers[0], levels)
