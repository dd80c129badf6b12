"""Camera models of other programs: Kalibr's camchain, ROS's camera_info, mrcal's cameramodel and SLStudio's calibration.

Where they differ from ours, which are pixels, mm, and OpenCV's distortion coefficients in OpenCV's order:

- Kalibr: `cam0`, `cam1`, ... of one YAML file; `T_cn_cnm1` (4x4) takes points of the camera before to this one, in m. Of its
  models `pinhole` with `radtan` (k1 k2 p1 p2) or `none`. The topic of the images names the device where it has one of our words.
- ROS: a YAML file a camera; `plumb_bob` (5 coefficients) or `rational_polynomial` (8). The pose of a pair follows from both
  rectifications: camera i's points turned by its R, and the second's then moved by P[:, 3] over the focal length, in m.
- mrcal: a file a camera, a Python dictionary; `extrinsics` or `rt_cam_ref` are axis times angle and a shift, from any reference,
  in the unit of its board, which is m by its convention. Of its models LENSMODEL_PINHOLE and LENSMODEL_OPENCV4, 5, 8 and 12.
- SLStudio: FileStorage XML; `Kc`, `kc` of the camera, `Kp`, `kp` of the projector, `Rp`, `Tp` take camera to projector, in mm.

Sources: the wikis and sources of Kalibr and SLStudio, ROS's sensor_msgs/CameraInfo, mrcal's documentation of its file formats.
"""

import logging
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from recon.capture.images import natural_key
from recon.errors import InputError, brief
from recon.files import matlab, opencv_storage, regular
from recon.files.opencv_storage import Values
from recon.geometry import rigid
from recon.geometry.camera import ROTATION, Array, Camera
from recon.model import lengths
from recon.model.calibration import WORLD, Calibration
from recon.model.lengths import UNIT_KEY

log = logging.getLogger(__name__)

MM = 1000.0  # in a m
DEVICES = {
    "cam1": "cam1",
    "left": "cam1",
    "cam2": "cam2",
    "right": "cam2",
    "projector": "projector",
}  # by words in files and topics
FROM_0 = {"cam0": "cam1", "cam1": "cam2", "projector": "projector"}  # where one is cam0
NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d{1,4})?"


Sizes = Mapping[str, tuple[int, int]]  # px, of devices' images


class Content:
    """What a file of a calibration holds, or a folder of them, parsed when a dialect first asks for it."""

    def __init__(self, path: Path) -> None:
        self.path, self._texts = path, dict[Path, str | None]()

    def texts(self, *suffixes: str) -> dict[Path, str]:
        """Plain texts: that of the file, or those of a folder's files with these suffixes, in natural order; none of OpenCV's."""
        files = [self.path]
        if self.path.is_dir():
            files = sorted((file for file in self.path.iterdir() if file.suffix.lower() in suffixes), key=natural_key)
        for file in files:
            if file not in self._texts:
                self._texts[file] = _text(file)
        return {file: text for file in files if (text := self._texts[file]) is not None}

    def of_cameras(self, tells: Callable[[str], bool]) -> dict[Path, str]:
        """Texts of one camera each: of the file, or of a folder's, those of which a dialect tells that they are its own."""
        of_files = (".cameramodel", ".yaml", ".yml")  # of one camera each
        return {file: text for file, text in self.texts(*of_files).items() if tells(text)}

    @property
    def is_matlab(self) -> bool:
        """Whether the file is one of MATLAB's."""
        return self.path.is_file() and matlab.is_matlab(self.path)

    @cached_property
    def is_packed(self) -> bool:
        """Whether the file holds arrays: npz, or MATLAB's."""
        if not self.path.is_file():
            return False
        with self.path.open("rb") as file:
            return self.is_matlab or file.read(2) == b"PK"

    @cached_property
    def values(self) -> Values:
        """Values of OpenCV's storage; none of what is none."""
        try:
            return self.checked_values()
        except InputError:
            return {}

    def checked_values(self) -> Values:
        """The same; InputError if the file is missing, damaged, or no storage."""
        return {} if self.is_matlab else opencv_storage.read(self.path, "a calibration file") or {}


def _text(file: Path) -> str | None:
    """A file's text, if it may be of a dialect of plain text."""
    data = regular.read_bytes(file, expected="a calibration file")
    if data.startswith((b"PK", b"%YAML")) or len(data) > opencv_storage.MOST_BYTES:
        return None
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError:
        return None


class Stored(NamedTuple):
    """A device as a file has it; nothing is checked but shapes."""

    size: tuple[int, int]  # px
    matrix: Array  # (3, 3) px
    distortion: Array  # (n,)
    camera_from_world: Array  # (4, 4) mm


def devices(place: Path, words: Sequence[str]) -> list[str]:
    """Our names of devices by the first word that tells in each file's name or topic; the cameras in their order if none does."""
    pieces = [re.findall(r"[^\W_]+", word.lower()) for word in words]
    names = FROM_0 if any("cam0" in each for each in pieces) else DEVICES
    known = [next((names[piece] for piece in each if piece in names), "") for each in pieces]
    if not any(known) and len(words) <= 2:
        return ["cam1", "cam2"][: len(words)]
    if not all(known) or len(set(known)) < len(known):
        expected = f"names with {', '.join(DEVICES)}, each device once, or two cameras with none of these"
        raise InputError(f"{place}: expected {expected}, found {brief(list(words))}; rename them")
    return known


def in_world(found: Mapping[str, Stored]) -> dict[str, Stored]:
    """The same devices, camera 1 first and its frame the world."""
    if WORLD not in found:
        return dict(found)
    from_world = rigid.invert(found[WORLD].camera_from_world)
    ordered = [WORLD, *(name for name in found if name != WORLD)]
    moved = {name: found[name]._replace(camera_from_world=found[name].camera_from_world @ from_world) for name in ordered}
    return moved | {WORLD: moved[WORLD]._replace(camera_from_world=np.eye(4))}


def numbers(path: Path, name: str, value: Any, count: int | None = None) -> Array:
    """A list of numbers : (n,) that are finite, of a length if one is given."""
    listed = value if isinstance(value, list) else [value]
    listed = [float(one) if isinstance(one, str) and re.fullmatch(NUMBER, one) else one for one in listed]  # as of 1e-05 in YAML
    good = isinstance(value, list) and all(isinstance(one, int | float) and not isinstance(one, bool) for one in listed)
    if not good or (count is not None and len(listed) != count):
        raise InputError(f"{path}: {name}: expected {'a list of' if count is None else count} numbers, found {brief(value)}")
    try:
        numbers = np.array(listed, float)
    except OverflowError:
        numbers = np.full(1, np.inf)
    if not np.isfinite(numbers).all():
        raise InputError(f"{path}: {name}: expected numbers that are finite, found {brief(value)}")
    return numbers


def image_size(path: Path, name: str, value: Any) -> tuple[int, int]:
    """Width and height, px, that are a list of two whole numbers."""
    sides = numbers(path, name, value, 2)
    if (sides != np.rint(sides)).any() or sides.min() < 1 or sides.max() > 1e6:
        raise InputError(f"{path}: {name}: expected width and height in px, found {brief(value)}")
    return int(sides[0]), int(sides[1])


def pinhole(fx: float, fy: float, cx: float, cy: float) -> Array:
    """A matrix : (3, 3) px without skew."""
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])


def _warn_of_mistakes(path: Path, read: Calibration) -> None:
    """Warn where names are likely exchanged, or distortion left out."""
    placed = [name for name, camera in read.cameras.items() if not np.allclose(camera.camera_from_world, np.eye(4), atol=1e-9)]
    if WORLD in placed and (first := [name for name in read.cameras if name not in placed]):
        log.warning("%s: expected %s where the world begins, found %s there: are their names exchanged?", path, WORLD, first[0])
    matrices = [camera.matrix for camera in read.cameras.values()]
    rectified = all(np.array_equal(matrix, matrices[0]) for matrix in matrices)  # or one device alone
    estimated = read.uncertainty is None or any(name.endswith(".k1") for name in read.uncertainty.names)
    if estimated and not rectified and not any(camera.distortion.any() for camera in read.cameras.values()):
        log.warning("%s: no lens has any distortion: was it left out, or are the images free of it?", path)


def of_mm(content: Content, read: Calibration, stated: object = None) -> Calibration:
    """The calibration in mm, by the unit that its file states; without one, the usual distances between devices tell another.

    Raises
    ------
    InputError
        If they do, or the unit is none.
    """
    path, stated = content.path, content.values.get(UNIT_KEY) if stated is None else stated
    _warn_of_mistakes(path, read)
    if stated is None:
        for name, camera in read.cameras.items():
            apart = lengths.shift(camera.camera_from_world[:3, 3])
            if fault := lengths.DEVICES_APART.fault(apart):
                raise InputError(f"{path}: {name}: expected {lengths.DEVICES_APART} from {WORLD}, found {fault} {lengths.SAID}")
            if doubt := lengths.DEVICES_APART.doubt(apart):
                log.warning("%s: %s: its distance from %s is %s %s", path, name, WORLD, doubt, lengths.SAID)
        return read
    unit = lengths.unit_of(path, stated)
    if unit == 1:
        return read
    if read.uncertainty is not None:
        raise InputError(f"{path}: {UNIT_KEY}: expected 1 with a covariance, which is in mm, found {unit:g}")
    scaled = {
        name: replace(
            camera, camera_from_world=rigid.transform(camera.camera_from_world[:3, :3], unit * camera.camera_from_world[:3, 3])
        )
        for name, camera in read.cameras.items()
    }
    return Calibration(scaled)


def of_metres(path: Path, stored: Mapping[str, Stored]) -> Calibration:
    """The calibration of a dialect that is in metres; InputError if mm were taken for them."""
    read = of_stored(path, stored)
    most = lengths.DEVICES_APART.most / MM
    for name, camera in read.cameras.items():
        if (apart := lengths.shift(camera.camera_from_world[:3, 3]) / MM) > most:
            expected = f"{path}: {name}: expected it within {most:g} m of {WORLD}"
            raise InputError(f"{expected}, found {apart:.4g} m: are its translations in mm? Divide them by 1000")
    return read


def of_stored(path: Path, stored: Mapping[str, Stored]) -> Calibration:
    """Devices as `Calibration` checks them; InputError names what is wrong."""
    return Calibration({name: camera(path, name, *one) for name, one in stored.items()})


def camera(path: Path, name: str, size: tuple[int, int], matrix: Array, distortion: Array, camera_from_world: Array) -> Camera:
    """A device; InputError if a number is too large, or its pose no rotation and shift."""
    largest = 1e8  # px, of a focal length; and of any coefficient
    for part, values in (("matrix", matrix), ("distortion", distortion)):
        if (np.abs(values) > largest).any():
            raise InputError(f"{path}: {name}.{part}: expected numbers of up to {largest:g}, found {np.abs(values).max():g}")
    few_digits = 1.1e-5  # of a rotation's products, in any of the files: five decimals mostly pass
    if rigid.fault(camera_from_world, ROTATION) and not rigid.fault(camera_from_world, few_digits):
        camera_from_world = rigid.nearest(camera_from_world)
    try:
        return Camera(size, matrix, distortion, camera_from_world)
    except ValueError as error:
        raise InputError(f"{path}: {name}.{error}") from None


def motion(path: Path, values: Mapping[str, Array], rotation: str, translation: str) -> Array:
    """The pose : (4, 4) mm by a rotation and a translation; InputError if their shapes are others."""
    if values[rotation].shape != (3, 3) or values[translation].size != 3:
        found = f"{values[rotation].shape} and {values[translation].shape}"
        raise InputError(f"{path}: {rotation}, {translation}: expected a 3x3 rotation and 3 translations in mm, found {found}")
    return rigid.transform(values[rotation], values[translation])


def size_of(path: Path, name: str, sizes: Mapping[str, tuple[int, int]]) -> tuple[int, int]:
    """The image size given for a device that the file stores none for; InputError if none was given."""
    if name not in sizes:
        raise InputError(f"{path}: expected a file that stores the image size of {name}, found none, and none was given")
    return sizes[name]


def matrices(path: Path, values: Values, keys: tuple[str, ...]) -> dict[str, Array]:
    """Matrices by their keys; InputError if one is missing or damaged."""
    return {key: opencv_storage.matrix(path, key, values.get(key)) for key in keys}
