"""Writing a capture folder: parts are added one by one, the manifest comes last, and the folder appears whole or not at all.

The same input gives the same bytes.
"""

import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from recon import arguments
from recon.capture import calibration_files, manifest, probe_files, sweep_tables
from recon.capture.images import Images, write_images
from recon.capture.manifest import (
    BoardPart,
    BoardPose,
    Device,
    Manifest,
    Part,
    PartName,
    Purpose,
    SurfacePart,
    SweepPart,
    image_name,
)
from recon.errors import InputError
from recon.files import atomic
from recon.files.written_files import Addition
from recon.model.calibration import Calibration
from recon.model.patterns import Patterns
from recon.model.probe import ProbeCalibration
from recon.model.tracks import Track

POSE = "write_pose"  # who writes the poses of a board, one by one
SHARED = (manifest.MANIFEST, manifest.OPTICS)  # where a part is added: what they hold stays in them


class CaptureWriter:
    """A capture folder that is being filled; `new_capture` gives one."""

    def __init__(self, folder: Path, name: str = "") -> None:
        self.folder = folder
        self._manifest = Manifest(schema=manifest.SCHEMA, name=name, devices={})

    def keep(self, source: Path, replaced: PartName) -> tuple[PartName, ...]:
        """Take over all of a capture but one part, as links to its files. Nothing is taken if it has no other part.

        Returns
        -------
        tuple of str
            The parts that were taken over.

        Raises
        ------
        InputError
            As of `check_kept`.
        """
        read = manifest.read_manifest(source)
        kept = {part: used for part, used in read.contents.items() if part != replaced}
        if not kept:
            return ()
        check_kept(source, read, replaced)
        atomic.link_tree(source, self.folder, leave_out={manifest.MANIFEST, replaced})
        self._change(name=read.name, calibration=read.calibration, probe=read.probe)
        if replaced == manifest.SWEEP:
            (self.folder / manifest.PROBE).unlink(missing_ok=True)
            self._change(probe=None)
        in_use = {name for used in read.contents.values() for name in used}
        self._change(devices={name: device for name, device in read.devices.items() if name not in in_use})
        for part, used in kept.items():
            devices = read.devices_of(part)
            here = {name: devices[name] for name in (*used, "projector") if name in devices}
            self._add(part, read.part(part).model_copy(update={"devices": None}), here)
        return tuple(kept)

    def add_calibration(self, optics: Calibration) -> None:
        """Write the calibration of cameras and projector; other devices of a capture that is kept stay in it."""
        calibration_files.extend(self.folder / manifest.OPTICS, optics)
        self._change(calibration=manifest.OPTICS)

    def complete_calibration(self, optics: Calibration) -> None:
        """Write the calibration of cameras and projector that have none yet; that of a capture that is kept stays as it is."""
        calibration_files.complete(self.folder / manifest.OPTICS, optics)
        self._change(calibration=manifest.OPTICS)

    def add_probe(self, probe: ProbeCalibration) -> None:
        """Write the calibration of the ultrasound probe."""
        (self.folder / manifest.PROBE).parent.mkdir(exist_ok=True)
        probe_files.write(self.folder / manifest.PROBE, probe)
        self._change(probe=manifest.PROBE)

    def add_surface(self, images: Mapping[str, Images], patterns: Patterns, devices: Mapping[str, Device]) -> None:
        """Write a fringe sequence.

        Parameters
        ----------
        images : camera -> (n, h, w) uint8 or uint16
            One image a pattern; 16-bit where the device has more than 8 bits.
        devices : of the cameras and the projector

        Raises
        ------
        ValueError
            If images, patterns and devices don't fit together.
        """
        numbers = range(patterns.count)
        paths = {camera: tuple(f"surface/{camera}/{image_name(k)}" for k in numbers) for camera in images}
        self._add("surface", SurfacePart(patterns=patterns, images=paths), devices)
        for camera, stack in images.items():
            if len(stack) != patterns.count:
                raise ValueError(f"images of {camera}: expected {patterns.count}, one a pattern, found {len(stack)}")
            _check_images(f"images of {camera}", stack, devices[camera])
        for camera, stack in images.items():
            write_images([self.folder / path for path in paths[camera]], stack)

    def add_board(self, part: BoardPart, devices: Mapping[str, Device]) -> None:
        """Describe the poses of a calibration board, whose images `write_pose` has written into `folder`."""
        self._add("board", part, devices)

    def add_sweep(
        self,
        times: Mapping[str, NDArray[np.int64]],
        images: Iterable[tuple[str, Images]],
        devices: Mapping[str, Device],
        track: Track | None = None,
        name: str = "",
        purpose: Purpose | None = None,
        bodies: Mapping[str, Track] | None = None,
    ) -> None:
        """Write B-scans, frames of the tracking cameras, or both, each device's with its own time stamps.

        Parameters
        ----------
        times : device -> (n,) ns
            Of its own clock, strictly increasing.
        images : of (device, (h, w) uint8 or uint16)
            Taken one by one; those of a device in the order of its times, the devices in any order.
        track : poses of the probe's target; None where they are still to be found in the cameras' frames
        name : of one of several sweeps; of the only one none is needed
        bodies : poses of further bodies by their names, by the clock of the track

        Raises
        ------
        ValueError
            If an image is of another size or depth than its device, their number is not that of the times, or times don't
            increase.
        """
        for moments in (*times.values(), *([track.times] if track is not None else [])):
            if (np.diff(moments) <= 0).any():
                raise ValueError("times: expected them strictly increasing")
        place = manifest.sweep_part(name)
        poses = None if track is None else f"{place}/{manifest.TRACK}"
        bodies = bodies or {}
        others = {body: manifest.body_track(place, body) for body in bodies}
        folders = {device: f"{place}/{device}" for device in times}
        part = SweepPart(purpose=purpose, images=folders, track=poses, bodies=others or None)
        self._add(place, part, devices)
        counts = dict.fromkeys(times, 0)
        for device, image in images:
            _check_images(f"image {counts[device]} of {device}", image[None], devices[device])
            write_images([self.folder / part.images[device] / image_name(counts[device])], image[None])
            counts[device] += 1
        for device, moments in times.items():
            if counts[device] != len(moments):
                raise ValueError(f"images of {device}: expected {len(moments)}, one a time, found {counts[device]}")
            sweep_tables.write_stamps(self.folder / part.images[device] / manifest.STAMPS, moments)
        if track is not None:
            sweep_tables.write_track(self.folder / place / manifest.TRACK, track)
        for body, path in others.items():
            (self.folder / path).parent.mkdir(parents=True)
            sweep_tables.write_track(self.folder / path, bodies[body])

    def finish(self) -> None:
        """Write the manifest."""
        manifest.write_manifest(self.folder, self._manifest)

    def _add(self, name: PartName, part: Part, devices: Mapping[str, Device]) -> None:
        self._manifest = with_part(self._manifest, name, part, devices)

    def _change(self, **fields: object) -> None:
        self._manifest = changed(self._manifest, **fields)


def with_part(before: Manifest, name: PartName, part: Part, devices: Mapping[str, Device]) -> Manifest:
    """A manifest with one more part; devices that were set otherwise for the parts before it are entered with it alone.

    Raises
    ------
    pydantic.ValidationError
        If they don't fit together.
    """
    there = before.devices
    own = {device: setting for device, setting in devices.items() if there.get(device, setting) != setting}
    part = part.model_copy(update={"devices": own}) if own else part
    folder, _, named = name.partition("/")
    entry = {"sweeps": before.sweeps | {named: part}} if named else {folder: part}
    return changed(before, **entry, devices={**there, **devices, **there})


def changed(before: Manifest, **fields: object) -> Manifest:
    """A manifest with other values of some fields; pydantic.ValidationError if they don't fit together."""
    unchanged = {name: value for name, value in before if name != "version"}
    return Manifest.model_validate({"schema": manifest.SCHEMA, **unchanged, **fields})


@contextmanager
def new_capture(folder: Path, name: str = "", add: PartName | None = None, by: str = "new_capture") -> Iterator[CaptureWriter]:
    """Give the writer of a capture folder, which appears whole or not at all.

    Waits, before anything is written, for another process that writes the same folder, so that no part of either is lost.

    Parameters
    ----------
    add : the one part that is written; all others of a capture that is there stay. None replaces the whole capture.
    by : verb or function that writes; only files that it wrote itself are replaced

    Raises
    ------
    InputError
        If the place is taken by something that `by` didn't write, or that isn't as it was written; or can't be written to.
    """
    with atomic.new_folder(folder, by, None if add is None else Addition(SHARED, add)) as temporary:
        capture = CaptureWriter(temporary, name)
        if add is not None and Path(folder, manifest.MANIFEST).is_file():
            capture.keep(Path(folder), add)
        yield capture
        capture.finish()


def write_surface(
    folder: Path,
    images: Mapping[str, Images],
    patterns: Patterns,
    optics: Calibration,
    devices: Mapping[str, Device],
    name: str = "",
) -> None:
    """Write a capture folder with a surface part alone, whole or not at all, the same bytes for the same input.

    Parameters
    ----------
    images : camera name -> (n, h, w) uint8 or uint16
        One image a pattern; 16-bit where the device has more than 8 bits.

    Raises
    ------
    InputError
        If the place is taken by something else than an earlier such capture, as it was written, or can't be written to.
    ValueError
        If images, patterns and devices don't fit together.
    """
    for field, value in (("images", images), ("devices", devices)):
        arguments.of_kind(f"write_surface: {field}", value, Mapping, way="one entry a device: {'cam1': ...}")
    arguments.of_kind("write_surface: patterns", patterns, Patterns, way="sonotwin.read_patterns reads them by name or file")
    arguments.of_kind("write_surface: optics", optics, Calibration)
    for device, value in devices.items():
        arguments.of_kind(f"write_surface: devices: {device}", value, Device)
    for camera, stack in images.items():
        arguments.numbers(f"write_surface: images: {camera}", stack, (patterns.count, "h", "w"))
    if lacking := [device for device in (*images, "projector") if device not in devices]:
        raise InputError(f"write_surface: devices: expected {', '.join(lacking)}, found {', '.join(devices) or 'none'}")
    with new_capture(folder, name, by="write_surface") as capture:
        capture.add_calibration(optics)
        capture.add_surface(images, patterns, devices)


def describe_pose(name: str, cameras: Sequence[str], counts: Mapping[str, int]) -> BoardPose:
    """Where the images of a pose lie in a capture folder: `cameras` saw it lit, and took `counts` fringe images each."""
    lit = {camera: f"board/{name}/{camera}/lit.png" for camera in cameras}
    fringes = {camera: tuple(f"board/{name}/{camera}/{image_name(k)}" for k in range(count)) for camera, count in counts.items()}
    return BoardPose(name=name, lit=lit, fringes=fringes)


def write_pose(folder: Path, name: str, lit: Mapping[str, Images], fringes: Mapping[str, Images]) -> BoardPose:
    """Write the images of one pose of a board into a capture folder, whole or not at all, where `describe_pose` says.

    Parameters
    ----------
    lit : camera name -> (h, w) uint8 or uint16
        May be empty if there are fringes.
    fringes : camera name -> (n, h, w) uint8 or uint16
        One image a pattern; may be empty.
    """
    record = describe_pose(name, list(lit), {camera: len(stack) for camera, stack in fringes.items()})
    place = Path("board", name)
    with atomic.new_folder(folder / place, POSE) as temporary:
        for camera, stack in fringes.items():
            write_images([temporary / Path(path).relative_to(place) for path in record.fringes[camera]], stack)
        for camera, image in lit.items():
            write_images([temporary / Path(record.lit[camera]).relative_to(place)], image[None])
    return record


def check_kept(source: Path, read: Manifest, replaced: PartName | None) -> None:
    """Check that the other parts of a capture can stay when one is written anew, or none; its manifest may be written by hand.

    Raises
    ------
    InputError
        If files of the capture lie elsewhere, or those of a part in the folder of the one that is written anew.
    """
    path = source / manifest.MANIFEST
    for field, there, here in (
        ("root", read.root, "."),
        ("calibration", read.calibration, manifest.OPTICS),
        ("probe", read.probe, manifest.PROBE),
    ):
        if there is not None and os.path.normpath(there) != os.path.normpath(here):
            raise InputError(f"{path}: {field}: expected {here}, as in a capture that holds all its files, found {there}")
    for part in sorted(read.contents.keys() - {replaced or ""}):
        for name in read.part(part).paths():
            inside = Path(os.path.normpath(name))
            if inside.is_absolute() or inside.parts[:1] == ("..",):
                raise InputError(f"{path}: {manifest.field_of(part)}: expected a capture that holds all its files, found {name}")
            if replaced is not None and inside.is_relative_to(replaced):
                expected = f"none of its files in {replaced}/, which is written anew"
                raise InputError(f"{path}: {manifest.field_of(part)}: expected {expected}, found {name}")


def _check_images(what: str, images: Images, device: Device) -> None:
    """Check that images : (n, h, w) are as their device takes them."""
    kind = np.uint8 if device.bits == 8 else np.uint16
    if images.shape[1:] != device.size[::-1] or images.dtype != kind:
        size = "x".join(map(str, device.size))
        raise ValueError(f"{what}: expected {size} {kind.__name__}, found {images.shape[1:]} {images.dtype}")
