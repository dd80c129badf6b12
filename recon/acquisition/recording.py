"""A capture folder that grows while devices record: at every moment all that was recorded before is whole and readable.

An image gets its name when it is whole; its row in a sweep's table follows it, so that a table names whole images alone; and the
manifest, exchanged in one step, names a part as soon as there is something of it. So a process may be ended at any moment, by
`kill -9` too, and the ordinary readers read the folder as it stands. What a killed process has left besides is removed when the
folder is opened for the next recording.
"""

import errno
import logging
import os
import re
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from datetime import UTC, date, datetime
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np
from pydantic import ValidationError

from recon.capture import calibration_files, manifest, probe_files, writer
from recon.capture.images import PNG_ENCODER, Images, Size, write_images
from recon.capture.manifest import BoardPart, Device, Manifest, PartName, Purpose, SurfacePart, SweepPart, image_name
from recon.capture.sweep_tables import STAMPS
from recon.errors import InputError, one_line
from recon.files import atomic, written_files
from recon.model.boards import Board
from recon.model.patterns import Patterns

log = logging.getLogger(__name__)
SURFACE, BOARD = "surface", "board"
RECORD = "record"  # who writes
FRAME_FILE = re.compile(rf"\.?(\d+\.png|{re.escape(manifest.STAMPS)})(\.part)?")  # of a sweep's device


class Recording:
    """A capture folder that is being recorded into, by one process at a time; `open_recording` gives one."""

    def __init__(self, folder: Path, read: Manifest) -> None:
        self.folder = folder
        self._manifest = read

    @property
    def contents(self) -> Manifest:
        """The capture's manifest, as it stands."""
        return self._manifest

    def check_new(self, part: PartName) -> None:
        """Check that the capture has no sweep of that name yet, and room for one; InputError else."""
        path = self.folder / manifest.MANIFEST
        there = [name for name in self._manifest.contents if manifest.is_sweep(name)]
        if part in there:
            raise InputError(
                f"{path}: expected no {manifest.field_of(part)} yet, found one; give another name=NAME or out=FOLDER"
            )
        if there and manifest.SWEEP in (part, *there):
            found = ", ".join(there)
            raise InputError(f"{path}: expected sweeps that all have names, found {found}; give name=NAME, or another out=FOLDER")

    @property
    def surface_day(self) -> str:
        """Day and time of the surface that is there, by its first image."""
        paths = self._manifest.surface.paths() if self._manifest.surface else ()
        first = next((path for path in map(self.folder.joinpath, paths) if path.is_file()), None)
        return "unknown day" if first is None else f"{datetime.fromtimestamp(first.stat().st_mtime):%Y-%m-%d %H:%M}"

    def add_calibration(self, file: Path, sizes: Mapping[str, Size]) -> None:
        """Copy the calibration of cameras and projector, of any dialect; InputError if it isn't one of devices of these sizes."""
        optics = calibration_files.read_for(file, sizes)
        self._copy(manifest.OPTICS, lambda path: calibration_files.write(path, optics))
        self._exchange(writer.changed(self._manifest, calibration=manifest.OPTICS))

    def add_probe(self, file: Path) -> None:
        """Copy the calibration of the ultrasound probe, of any dialect; InputError if it can't be read."""
        probe = probe_files.read(file)
        self._copy(manifest.PROBE, lambda path: probe_files.write(path, probe))
        self._exchange(writer.changed(self._manifest, probe=manifest.PROBE))

    def add_surface(self, images: Mapping[str, Images], patterns: Patterns, devices: Mapping[str, Device]) -> None:
        """Add a fringe sequence, or put it in the place of an earlier one, which stays until the new one is whole.

        images : camera -> (n, h, w), one image a pattern
        """
        takes = [int(name[1]) for entry in _entries(self.folder / SURFACE) if (name := re.fullmatch(r"take(\d+)", entry.name))]
        place = f"{SURFACE}/take{max(takes, default=0) + 1:02d}"
        paths = {camera: tuple(f"{place}/{camera}/{image_name(k)}" for k in range(patterns.count)) for camera in images}
        try:
            with atomic.new_folder(self.folder / place, RECORD) as temporary:
                for camera, stack in images.items():
                    write_images([temporary / Path(path).relative_to(place) for path in paths[camera]], stack)
            self._enter(SURFACE, SurfacePart(patterns=patterns, images=paths), devices)
        finally:
            self._tidy_surface()

    def add_frames(self, name: str, images: Mapping[str, Images]) -> None:
        """Add images of no part, such as of covered lenses, or put them in the place of earlier ones of the same cameras.

        images : folder below one of that name -> (n, h, w)
        """
        for camera in {Path(place).parts[0] for place in images}:
            own = {place: stack for place, stack in images.items() if Path(place).parts[0] == camera}
            with atomic.new_folder(self.folder / name / camera, RECORD) as temporary:
                for place, stack in own.items():
                    folder = temporary / Path(place).relative_to(camera)
                    write_images([folder / image_name(k) for k in range(len(stack))], stack)

    def add_pose(
        self,
        lit: Mapping[str, Images],
        fringes: Mapping[str, Images],
        board: Board,
        patterns: Patterns | None,
        devices: Mapping[str, Device],
    ) -> str:
        """Add a pose of a calibration board to those that are there; returns its name.

        Parameters
        ----------
        lit : camera -> (h, w)
        fringes : camera -> (n, h, w), one image a pattern

        Raises
        ------
        InputError
            If the poses before it show another board or other patterns.
        """
        self.check_board(board, patterns)
        before = self._manifest.board
        poses = before.poses if before else ()
        name = self.next_pose
        written_files.discard(self.folder / BOARD / name, writer.POSE)  # of a pose that was never entered
        pose = writer.write_pose(self.folder, name, lit, fringes)
        self._enter(BOARD, BoardPart(board=board, patterns=patterns, poses=(*poses, pose)), devices)
        return name

    @property
    def next_pose(self) -> str:
        """Name of the next pose of a board."""
        poses = self._manifest.board.poses if self._manifest.board else ()
        number = max((int(pose.name) for pose in poses if pose.name.isdecimal()), default=-1) + 1
        while written_files.foreign(self.folder / BOARD / f"{number:02d}"):
            number += 1
        return f"{number:02d}"

    def check_board(self, board: Board, patterns: Patterns | None) -> None:
        """Check that the poses so far show this board under these patterns; InputError else."""
        before = self._manifest.board
        for field, there, given in (
            ("board", before and before.board, board),
            ("patterns", before and before.patterns, patterns),
        ):
            if before is not None and there != given:
                path = self.folder / manifest.MANIFEST
                raise InputError(f"{path}: board.{field}: expected the same as given, found another; give another out=FOLDER")

    @contextmanager
    def sweep(self, name: str, purpose: Purpose | None, devices: Mapping[str, Device]) -> Iterator["GrowingSweep"]:
        """Give a sweep to add frames to, from any thread; InputError as of `check_new`."""
        place = manifest.sweep_part(name)
        self.check_new(place)
        for device in devices:
            self._clear_unentered(self.folder / place / device)
        growing = GrowingSweep(self, place, purpose, devices)
        try:
            yield growing
        finally:
            growing.close()

    def _copy(self, file: str, write: Callable[[Path], None]) -> None:
        """Write a calibration, unless the same is there; InputError if another one is that this command didn't write."""
        place = self.folder / file
        place.parent.mkdir(exist_ok=True)
        with TemporaryDirectory() as name:
            write(made := Path(name) / place.name)
            content = made.read_bytes()
        if not (place.is_file() and place.read_bytes() == content):
            with atomic.listed_file(self.folder, file, RECORD) as temporary:
                temporary.write_bytes(content)

    def _clear_unentered(self, folder: Path) -> None:
        """Make room for a sweep's device: remove what a killed process recorded and didn't enter; InputError if there is more."""
        if written_files.LIST in (written_files.read_list(folder) or {}):
            for name in written_files.entries(folder):
                if FRAME_FILE.fullmatch(name):
                    (folder / name).unlink()
        if there := written_files.entries(folder):
            found = f"found {min(there)}, which sonotwin didn't record; move it away, or give another name=NAME"
            raise InputError(f"{folder}: expected nothing where a sweep is recorded, {found}")

    def _enter(self, name: PartName, part: manifest.Part, devices: Mapping[str, Device]) -> None:
        """Enter a part of today into the manifest; InputError if its devices are others than those of other parts."""
        today = part.model_copy(update={"day": _today()})
        try:
            self._exchange(writer.with_part(self._manifest, name, today, devices))
        except ValidationError as error:
            raise InputError(
                f"{self.folder / manifest.MANIFEST}: {one_line(error)}; another rig? give another out=FOLDER"
            ) from None

    def _exchange(self, new: Manifest) -> None:
        """Exchange the manifest in one step."""
        _write_whole(self.folder / manifest.MANIFEST, manifest.manifest_text(new).encode())
        self._manifest = new

    def _remove(self) -> None:
        """Remove a new capture into which nothing was recorded."""
        with suppress(InputError):  # of one that was changed since
            atomic.remove_listed(self.folder, (manifest.OPTICS, manifest.PROBE), RECORD)
        (self.folder / manifest.MANIFEST).unlink()
        if not written_files.entries(self.folder) - {str(Path(manifest.OPTICS).parent)}:
            written_files.discard(self.folder, RECORD)
        for empty in (self.folder / Path(manifest.OPTICS).parent, self.folder):
            with suppress(OSError):  # of a sweep of which a frame was written, but not entered
                empty.rmdir()

    def _tidy_surface(self) -> None:
        """Remove takes of the surface that the manifest doesn't name."""
        named = {path for paths in (self._manifest.surface.images.values() if self._manifest.surface else ()) for path in paths}
        for entry in _entries(self.folder / SURFACE):
            if re.fullmatch(r"take\d+", entry.name) and not any(path.startswith(f"{SURFACE}/{entry.name}/") for path in named):
                written_files.discard(entry, RECORD)

    def _tidy(self) -> None:
        """Mend what a process that was killed has left."""
        self._tidy_surface()
        for file in (manifest.OPTICS, manifest.PROBE):
            atomic.remove_leftovers(self.folder / file)
        for leftover in self.folder.glob(".*.part"):
            leftover.unlink()
        for part in filter(manifest.is_sweep, self._manifest.contents):
            for folder in self._manifest.part(part).paths():
                for leftover in (self.folder / folder).glob(".*.part"):
                    leftover.unlink()
                table = self.folder / folder / manifest.STAMPS
                if table.is_file() and (torn := _mend_table(table)):
                    log.warning("%s: mended: the last row, of which %d bytes had been written, is left out", table, torn)


class GrowingSweep:
    """A sweep that is being recorded. Each device's frames are added by one thread at a time, different devices' by any."""

    def __init__(self, recording: Recording, place: PartName, purpose: Purpose | None, devices: Mapping[str, Device]) -> None:
        self.place, self._recording, self._purpose, self._devices = place, recording, purpose, devices
        self._tables: dict[str, GrowingTable] = {}
        self._before = recording.contents
        self._entering = threading.Lock()

    def add(self, device: str, number: int, time_ns: int, image: Images) -> None:
        """Add a frame, by its number and time of the device's clock, both larger than those before.

        Raises
        ------
        OSError
            If it can't be written, as on a full disk; all frames before it stay as they are.
        """
        folder = self._recording.folder / self.place / device
        if device not in self._tables:
            atomic.begin_filled(folder, RECORD)
        encoded, data = cv2.imencode(".png", image, PNG_ENCODER)
        if not encoded:
            raise OSError(f"{folder}: the PNG encoder failed")
        _write_whole(folder / image_name(number), data)
        if device in self._tables:
            self._tables[device].append(number, time_ns)
            return
        self._tables[device] = GrowingTable(folder / manifest.STAMPS)
        self._tables[device].append(number, time_ns)
        self._enter()
        (folder / written_files.LIST).unlink(missing_ok=True)  # from now on the manifest names what is here

    def drop(self, counts: Mapping[str, int]) -> None:
        """Delete the last frames of devices : device -> their number; with the only ones of all, the sweep too.

        A frame leaves its table before its image goes, so that the folder is readable at every moment.
        """
        if all(len(table) == counts.get(device, 0) for device, table in self._tables.items()):
            self._leave()
            return
        for device, count in counts.items():
            for _ in range(count):
                number = self._tables[device].drop()
                (self._recording.folder / self.place / device / image_name(number)).unlink()

    def _leave(self) -> None:
        """Take the sweep out of the manifest, and delete its files; those that a killed process leaves, the next one deletes."""
        place = self._recording.folder / self.place
        for device in self._tables:
            atomic.begin_filled(place / device, RECORD)
        self._recording._exchange(self._before)
        self.close()
        for device in self._tables:
            self._recording._clear_unentered(place / device)
            (place / device / written_files.LIST).unlink()
        self._tables.clear()
        for empty in (*(place / device for device in self._devices), place, place.parent):
            if empty != self._recording.folder:
                with suppress(OSError):  # of others' files, or of other sweeps
                    empty.rmdir()

    def close(self) -> None:
        """End the tables."""
        for table in self._tables.values():
            table.close()

    def _enter(self) -> None:
        """Name those devices in the manifest that have a frame."""
        with self._entering:
            seen = [device for device in self._devices if device in self._tables]
            part = SweepPart(purpose=self._purpose, images={device: f"{self.place}/{device}" for device in seen})
            self._recording._enter(self.place, part, {device: self._devices[device] for device in seen})


@contextmanager
def open_recording(folder: Path, name: str = "") -> Iterator[Recording]:
    """Open a capture folder to record into, a new one or one that grows on; waits for another process that records into it.

    Raises
    ------
    InputError
        If the place is taken by something that is not a capture, can't be written to, or its capture's files lie elsewhere.
    """
    folder = Path(os.path.realpath(folder))
    _check_capture(folder)
    atomic.check_folder(folder, RECORD, adds=written_files.Addition((manifest.MANIFEST,)))
    folder.mkdir(parents=True, exist_ok=True)
    with atomic.alone(folder):
        path = folder / manifest.MANIFEST
        new = not path.is_file()
        read = Manifest(schema=manifest.SCHEMA, name=name, devices={}) if new else manifest.read_manifest(folder)
        writer.check_kept(folder, read, None)
        recording = Recording(folder, read)
        if new:
            recording._exchange(read)
        try:
            recording._tidy()
            yield recording
        finally:
            if new and not recording.contents.contents:
                recording._remove()


def _check_capture(folder: Path) -> None:
    """Check that a folder with files is a capture; InputError else."""
    within = folder / "capture"
    if folder.is_dir() and any(folder.iterdir()) and not (folder / manifest.MANIFEST).is_file():
        expected = f"expected a new folder or a capture folder, which has {manifest.MANIFEST}"
        way = f"is {within} meant?" if (within / manifest.MANIFEST).is_file() else "give another out=FOLDER"
        raise InputError(f"{folder}: {expected}, found other files; {way}")


def _today() -> date:
    return datetime.now(UTC).date()


def _write_whole(path: Path, data: bytes | np.ndarray) -> None:
    """Write a file that appears whole or not at all; it needs no lock of its own, as one process alone writes the folder."""
    temporary = path.with_name(f".{path.name}.part")
    with atomic.named_in_errors(path):
        try:
            temporary.write_bytes(data)
            os.replace(temporary, path)
        except OSError:
            with suppress(OSError):
                temporary.unlink()
            raise


def _entries(folder: Path) -> list[Path]:
    return sorted(folder.iterdir()) if folder.is_dir() else []


class GrowingTable:
    """`timestamps.csv` of one device, as `recon.capture.sweep_tables.read_stamps` reads it, a row at a time."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._file = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_APPEND, 0o666)
        self._head = ",".join(STAMPS) + "\n"
        self._rows: list[tuple[int, int]] = []  # frame, and size of the file before it

    def __len__(self) -> int:
        return len(self._rows)

    def append(self, frame: int, time_ns: int) -> None:
        """Add a row, in one call of the system; OSError if it doesn't fit on the disk, and the table stays as it was."""
        row = f"{self._head}{frame},{time_ns}\n".encode("ascii")
        before = os.fstat(self._file).st_size
        try:
            if os.write(self._file, row) < len(row):
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(self._path))
        except OSError as error:
            os.ftruncate(self._file, before)
            error.filename = str(self._path)
            raise
        self._head = ""
        self._rows.append((frame, before))

    def drop(self) -> int:
        """Remove the last row, in one call of the system; returns its frame."""
        frame, before = self._rows.pop()
        os.ftruncate(self._file, before)
        return frame

    def close(self) -> None:
        """Close the file; may be called again."""
        if self._file >= 0:
            os.close(self._file)
        self._file = -1


def _mend_table(path: Path) -> int:
    """Cut a table after its last whole row; returns the number of bytes that went."""
    with path.open("r+b") as stream:
        content = stream.read()
        whole = content.rfind(b"\n") + 1
        if whole < len(content):
            stream.truncate(whole)
    return len(content) - whole
