"""The board part of a capture: the calibration board in several poses, lit and under fringes, read one pose at a time.

A pose under 50 patterns is 66 MB, so a set of 34 is never held at once.
"""

from dataclasses import dataclass
from pathlib import Path

from recon.capture import manifest
from recon.capture.images import Images, read_image, read_images
from recon.capture.manifest import MANIFEST, BoardPose, Device
from recon.errors import InputError
from recon.files.regular import check_there
from recon.model.boards import Board
from recon.model.patterns import Patterns


@dataclass(frozen=True)
class Pose:
    """Images of the board in one pose."""

    name: str
    lit: dict[str, Images]  # camera: (h, w) digital numbers, the projector fully on
    fringes: Images | None  # (n, h, w) of camera 1, one image a pattern


@dataclass(frozen=True)
class BoardCapture:
    """The board part of a capture folder; its manifest is checked and every file is there, but no image is read yet."""

    root: Path  # folder that the image paths start from
    name: str
    devices: dict[str, Device]
    board: Board
    patterns: Patterns | None
    records: tuple[BoardPose, ...]  # (p,)

    @property
    def poses(self) -> tuple[str, ...]:
        """Names of the poses : (p,)."""
        return tuple(record.name for record in self.records)

    @property
    def cameras(self) -> tuple[str, ...]:
        """Cameras that saw the board in any pose, in the order of the devices."""
        seen = {camera for record in self.records for camera in record.lit}
        return tuple(name for name in self.devices if name in seen)

    def paths(self, number: int) -> list[Path]:
        """All image files of one pose."""
        record = self.records[number]
        names = [*record.lit.values(), *(path for paths in record.fringes.values() for path in paths)]
        return [self.root / name for name in names]

    def pose(self, number: int) -> Pose:
        """Read the images of one pose.

        Raises
        ------
        InputError
            If one is damaged, or doesn't fit its device.
        """
        record = self.records[number]
        lit = {
            camera: read_image(self.root / path, self.devices[camera].size, self.devices[camera].bits)
            for camera, path in record.lit.items()
        }
        paths = [self.root / path for path in record.fringes.get("cam1", ())]
        camera = self.devices.get("cam1")
        fringes = read_images(paths, camera.size, camera.bits) if camera and paths else None
        return Pose(record.name, lit, fringes)


def read_board(folder: Path) -> BoardCapture:
    """Open the board part of a capture folder.

    Raises
    ------
    InputError
        If the manifest is wrong, has no board, or names a file that is not there.
    """
    folder = Path(folder)
    read = manifest.read_manifest(folder)
    if read.board is None:
        raise InputError(f"{folder / MANIFEST}: expected board, the poses of a calibration board, found none")
    part, name = read.board, read.name or folder.resolve().name
    capture = BoardCapture(folder / read.root, name, read.devices_of("board"), part.board, part.patterns, part.poses)
    check_there(path for number in range(len(part.poses)) for path in capture.paths(number))
    return capture
