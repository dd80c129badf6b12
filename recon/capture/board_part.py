"""The board part of a capture: the calibration board in several poses, lit and under fringes, read one pose at a time.

A pose under 50 patterns is 66 MB, so a set of 34 is never held at once.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from recon.capture import manifest
from recon.capture.images import Images, read_image, read_images
from recon.capture.manifest import MANIFEST, BoardPose, Device
from recon.errors import InputError
from recon.files.regular import check_there
from recon.model.boards import Board
from recon.model.patterns import Patterns

FloatImage = NDArray[np.float32]
FRINGE_CAMERA = "cam1"  # whose fringes give the projector's coordinates


@dataclass(frozen=True)
class Pose:
    """Images of the board in one pose."""

    name: str
    lit: dict[str, Images | FloatImage]  # camera: (h, w) digital numbers, the projector fully on, or the mean of the patterns
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
        seen = {camera for record in self.records for camera in record.cameras}
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
        lit: dict[str, Images | FloatImage] = {
            camera: read_image(self.root / path, self.devices[camera].size, self.devices[camera].bits)
            for camera, path in record.lit.items()
        }
        unlit = record.fringes.keys() - lit.keys()
        used = [camera for camera in record.fringes if camera in unlit or camera == FRINGE_CAMERA]
        fringes = {camera: self._fringes(record, camera) for camera in used}
        lit |= {camera: self._evenly_lit(fringes[camera], camera) for camera in used if camera in unlit}
        return Pose(record.name, lit, fringes.get(FRINGE_CAMERA))

    def _fringes(self, record: BoardPose, camera: str) -> Images:
        device = self.devices[camera]
        return read_images([self.root / path for path in record.fringes[camera]], device.size, device.bits)

    def _evenly_lit(self, fringes: Images, camera: str) -> FloatImage:
        """Mean of those images : (n, h, w) of a sequence that together light all alike; saturated where one of them is."""
        assert self.patterns is not None  # as the manifest has fringes
        full, weights = 2 ** self.devices[camera].bits - 1, self.patterns.even_light
        used = weights > 0
        mean = np.tensordot(weights[used].astype(np.float32), fringes[used].astype(np.float32), axes=1)
        mean[(fringes[used] >= full).any(axis=0)] = full
        return mean


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
    part, name = read.board, read.name_of(folder)
    capture = BoardCapture(folder / read.root, name, read.devices_of("board"), part.board, part.patterns, part.poses)
    check_there(path for number in range(len(part.poses)) for path in capture.paths(number))
    return capture
