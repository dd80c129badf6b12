"""From the board part of a capture to sightings: the devices that take part, and the poses in which each found the board."""

import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Literal

import numpy as np

from recon.capture.board_part import BoardCapture, Pose
from recon.errors import InputError
from recon.optical_calibration.joint_calibration import Result
from recon.optical_calibration.observations import Size
from recon.optical_calibration.sightings import Failure, Sighting, sight
from recon.threads import mapped

MOST_AT_ONCE = 4  # poses, whose images and maps take some 0.3 GB each
DeviceName = Literal["cam1", "cam2", "projector"]
DEVICES: tuple[DeviceName, ...] = ("cam1", "cam2", "projector")  # in the order in which they are adjusted; the first is the world


def sizes_of(captured: BoardCapture, chosen: Sequence[DeviceName] | None = None) -> dict[str, Size]:
    """Image sizes of the devices that take part, in the order in which they stand in the calibration.

    Parameters
    ----------
    chosen : devices that are to take part; None for all of the capture

    Raises
    ------
    InputError
        If the capture lacks a device that was chosen, or camera 1, whose frame is the world, is not among them.
    """
    sizes = {name: captured.devices[name].size for name in captured.cameras}
    if captured.patterns is not None:
        sizes["projector"] = captured.patterns.projector_size
    if lacking := [name for name in chosen or () if name not in sizes]:
        raise InputError(f"{captured.name}: expected images of {', '.join(lacking)}, as devices, found {', '.join(sizes)}")
    taken = [name for name in DEVICES if name in sizes and (chosen is None or name in chosen)]
    if DEVICES[0] not in taken:
        found = ", ".join(sizes if chosen is None else taken)
        way = f"to calibrate another camera alone, describe its images as those of {DEVICES[0]}"
        raise InputError(f"{captured.name}: expected images of {DEVICES[0]}, the world's frame, found {found}; {way}")
    return {name: sizes[name] for name in taken}


def look_at_all(captured: BoardCapture, devices: Collection[str] = DEVICES) -> Iterator[Sighting]:
    """Read the images of each pose and find the board in them, some poses at once, since much of that is work for one thread.

    Parameters
    ----------
    devices : that are to be calibrated

    Raises
    ------
    InputError
        If an image is damaged, or doesn't fit its device.
    """
    return mapped(lambda number: _look(captured, captured.pose(number), devices), range(len(captured.poses)), most=MOST_AT_ONCE)


def _look(captured: BoardCapture, pose: Pose, devices: Collection[str]) -> Sighting:
    """Find the board in the images of the devices that are calibrated."""
    lit = {camera: image for camera, image in pose.lit.items() if camera in devices}
    bits = {name: device.bits for name, device in captured.devices.items()}
    patterns = captured.patterns if "projector" in devices else None
    return sight(pose.name, captured.board, lit, pose.fringes, patterns, bits)


def found_by(sightings: Sequence[Sighting], devices: Mapping[str, Size]) -> str:
    """Numbers of poses in which each device found the board, in words."""
    counts = (f"{device} {sum(_has_points(sighting, device) for sighting in sightings)}" for device in devices)
    return f"{len(sightings)} poses: {', '.join(counts)}"


def not_found(sightings: Sequence[Sighting]) -> dict[str, Failure]:
    """Failures by pose and device without any point of the board."""
    return {f"{sighting.name} {device}": failure for sighting in sightings for device, failure in sighting.failures.items()}


def refuse_lonely(sightings: Sequence[Sighting], devices: Collection[str], name: str) -> None:
    """Refuse a capture of several devices in which fewer than two found the board, as nothing can be measured with one.

    Raises
    ------
    InputError
        With the commonest reason.
    """
    seeing = {device for sighting in sightings for device in sighting.pixels if _has_points(sighting, device)}
    if len(seeing) >= min(len(devices), 2):
        return
    reasons = [f"{device}: {reason}" for sighting in sightings for device, reason in sighting.failures.items()]
    kinds = [re.sub(r"\d+(\.\d+)?", "#", reason) for reason in reasons]
    why = f" ({reasons[kinds.index(max(kinds, key=kinds.count))]})" if reasons else ""
    expected = "two devices or more that see" if len(devices) > 1 else f"{', '.join(devices)} to see"
    alone = "; devices=[cam1] calibrates it alone" if seeing == {DEVICES[0]} else ""
    raise InputError(f"{name}: expected {expected} the board, found {', '.join(seeing) or 'none'}{why}{alone}")


def with_absent(result: Result, devices: Mapping[str, Size], cameras: Sequence[str]) -> Result:
    """Add a warning for each device of the capture that is not in the result, and for each camera without a place in it."""
    absent = [device for device in devices if device not in result.observations.devices]
    lines = [f"{device}: not calibrated, as it saw the board in no pose" for device in absent]
    lines += [f"{name}: not calibrated, as only {', '.join(DEVICES)} can be" for name in cameras if name not in DEVICES]
    return replace(result, warnings=(*lines, *result.warnings))


def _has_points(sighting: Sighting, device: str) -> bool:
    return device in sighting.pixels and bool(np.isfinite(sighting.pixels[device]).all(axis=-1).any())
