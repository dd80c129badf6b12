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

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from recon.capture.images import natural_key
from recon.errors import InputError, brief
from recon.files import opencv_storage, regular, yaml_text
from recon.geometry import rigid
from recon.geometry.camera import Array
from recon.model.calibration import WORLD

MM = 1000.0  # in a m
OF_FILES = (".cameramodel", ".yaml", ".yml")  # of one camera each
DEVICES = {
    "cam1": "cam1",
    "left": "cam1",
    "cam2": "cam2",
    "right": "cam2",
    "projector": "projector",
}  # by words in files and topics
FROM_0 = {"cam0": "cam1", "cam1": "cam2", "projector": "projector"}  # where one is cam0
MRCAL = {"PINHOLE": 0, "OPENCV4": 4, "OPENCV5": 5, "OPENCV8": 8, "OPENCV12": 12}  # coefficients by the model's name
ROS = {"plumb_bob": (4, 5), "rational_polynomial": (8,)}
NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d{1,4})?"
LISTED = re.compile(rf"\[\s*(?:{NUMBER}\s*(?:,\s*{NUMBER}\s*)*,?\s*)?\]")
SLSTUDIO = ("Kc", "kc", "Kp", "kp", "Rp", "Tp")
SLSTUDIO_SIZES = {"cam1": ("frameWidth", "frameHeight"), "projector": ("screenResX", "screenResY")}


class Stored(NamedTuple):
    """A device as a file has it; nothing is checked but shapes."""

    size: tuple[int, int]  # px
    matrix: Array  # (3, 3) px
    distortion: Array  # (n,)
    camera_from_world: Array  # (4, 4) mm


class Rectified(NamedTuple):
    """A camera of ROS's: its rectification, too."""

    stored: Stored
    rotation: Array  # (3, 3)
    projection: Array  # (3, 4), px and px m


def read(path: Path) -> dict[str, Stored] | None:
    """Devices in a file of one of these dialects, SLStudio's left out, or in a folder of files of one camera each.

    None for what is none of these.

    Raises
    ------
    InputError
        If a value is missing or of another kind, a model is none of ours, or devices can't be told.
    """
    if path.is_dir():
        files = sorted((file for file in path.iterdir() if file.suffix.lower() in OF_FILES), key=natural_key)
        texts = {file: text for file in files if (text := _text(file)) is not None and not _is_kalibr(text)}
        return _several(path, texts) if texts else None
    text = _text(path)
    if text is None:
        return None
    if _is_kalibr(text):
        return _kalibr(path, yaml_text.loaded(path, text))
    return _in_world({WORLD: _mrcal(path, text) if _is_mrcal(text) else _ros(path, text).stored})


def _text(path: Path) -> str | None:
    """A file's text, if it is of one of these dialects by its first words."""
    data = regular.read_bytes(path, expected="a calibration file")
    if data.startswith((b"PK", b"%YAML")) or len(data) > opencv_storage.MOST_BYTES:
        return None
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError:
        return None
    return text if _is_mrcal(text) or _is_kalibr(text) or re.search(r"^camera_matrix\s*:", text, re.MULTILINE) else None


def _is_mrcal(text: str) -> bool:
    return re.search(r"""^\s*\{?\s*['"]lens_?model['"]\s*:""", text, re.MULTILINE) is not None


def _is_kalibr(text: str) -> bool:
    return re.search(r"^cam\d+\s*:", text, re.MULTILINE) is not None


def _several(folder: Path, texts: Mapping[Path, str]) -> dict[str, Stored]:
    """Devices of a folder's files: of mrcal's by their poses, of ROS's by the rectification of a pair."""
    names = _devices(folder, [file.stem for file in texts])
    kinds = {_is_mrcal(text) for text in texts.values()}
    if len(kinds) > 1:
        raise InputError(f"{folder}: expected files of mrcal or of ROS, found both; leave one kind")
    if kinds.pop():
        return _in_world({name: _mrcal(file, text) for name, (file, text) in zip(names, texts.items(), strict=True)})
    cameras = {name: _ros(file, text) for name, (file, text) in zip(names, texts.items(), strict=True)}
    if len(cameras) > 2:
        raise InputError(
            f"{folder}: expected files of ROS of one pair, found {len(cameras)}: {', '.join(file.name for file in texts)}"
        )
    (first, one), *others = cameras.items()
    found = {first: one.stored}
    for name, other in others:
        focal = np.array([other.projection[0, 0], other.projection[1, 1]])
        if not (focal > 0).all():
            raise InputError(f"{folder}: projection_matrix: expected positive focal lengths of {name}, found {focal.tolist()}")
        shift = (other.projection[:2, 3] - one.projection[:2, 3]) / focal
        if not shift.any():
            raise InputError(
                f"{folder}: projection_matrix: expected those of a pair calibrated together, the second's with a shift in its "
                "last column, found none: which of both is where isn't in these files"
            )
        pose = rigid.transform(other.rotation.T @ one.rotation, other.rotation.T @ np.append(shift, 0) * MM)
        found[name] = other.stored._replace(camera_from_world=pose)
    return _in_world(found)


def _devices(place: Path, words: Sequence[str]) -> list[str]:
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


def _in_world(found: Mapping[str, Stored]) -> dict[str, Stored]:
    """The same devices, camera 1 first and its frame the world."""
    if WORLD not in found:
        return dict(found)
    from_world = rigid.invert(found[WORLD].camera_from_world)
    ordered = [WORLD, *(name for name in found if name != WORLD)]
    moved = {name: found[name]._replace(camera_from_world=found[name].camera_from_world @ from_world) for name in ordered}
    return moved | {WORLD: moved[WORLD]._replace(camera_from_world=np.eye(4))}


def _kalibr(path: Path, content: Any) -> dict[str, Stored]:
    entries = {
        key: value for key, value in (content if isinstance(content, dict) else {}).items() if re.fullmatch(r"cam\d+", str(key))
    }
    ordered = sorted(entries, key=lambda key: int(key[3:]))
    if ordered != [f"cam{k}" for k in range(len(ordered))] or not ordered:
        raise InputError(f"{path}: expected cam0, cam1 and so on, found {', '.join(ordered) or 'none'}")
    topics, stored, pose = [], [], np.eye(4)
    for number, key in enumerate(ordered):
        entry = entries[key]
        if not isinstance(entry, dict):
            raise InputError(f"{path}: {key}: expected a camera's fields, found {brief(entry)}")
        model, lens = entry.get("camera_model"), entry.get("distortion_model")
        if model != "pinhole" or lens not in ("radtan", "none"):
            raise InputError(
                f"{path}: {key}: expected camera_model: pinhole with distortion_model: radtan or none, found {brief(model)} with "
                f"{brief(lens)}: calibrate with --models pinhole-radtan"
            )
        fx, fy, cx, cy = _numbers(path, f"{key}.intrinsics", entry.get("intrinsics"), 4)
        k = _numbers(path, f"{key}.distortion_coeffs", entry.get("distortion_coeffs"), 4 if lens == "radtan" else None)
        if number:
            rows = entry.get("T_cn_cnm1")
            motion = [_numbers(path, f"{key}.T_cn_cnm1", row, 4) for row in rows] if isinstance(rows, list) else []
            if len(motion) != 4:
                raise InputError(f"{path}: {key}.T_cn_cnm1: expected 4 rows of 4 numbers, found {brief(rows)}")
            pose = np.array(motion) * np.array([[1, 1, 1, MM]] * 3 + [[1, 1, 1, 1]]) @ pose
        size = _size(path, f"{key}.resolution", entry.get("resolution"))
        topics.append(str(entry.get("rostopic") or ""))
        stored.append(Stored(size, pinhole(fx, fy, cx, cy), k if lens == "radtan" else np.zeros(0), pose))
    return _in_world(dict(zip(_devices(path, topics), stored, strict=True)))


def _ros(path: Path, text: str) -> Rectified:
    content = yaml_text.loaded(path, text)
    if not isinstance(content, dict):
        raise InputError(f"{path}: expected a camera's fields, found {brief(content)}")
    model = content.get("distortion_model")
    counts = ROS.get(model) if isinstance(model, str) else None
    if counts is None:
        raise InputError(f"{path}: distortion_model: expected {' or '.join(ROS)}, found {brief(model)}")
    size = _size(path, "image_width and image_height", [content.get("image_width"), content.get("image_height")])
    k = _entries(path, content, "distortion_coefficients")
    if k.size not in counts:
        raise InputError(f"{path}: distortion_coefficients: expected {counts[-1]} of {model}, found {k.size}")
    matrix = _entries(path, content, "camera_matrix", (3, 3))
    rotation = _entries(path, content, "rectification_matrix", (3, 3)) if "rectification_matrix" in content else np.eye(3)
    if fault := rigid.fault(rigid.transform(rotation, np.zeros(3))):
        raise InputError(f"{path}: rectification_matrix: expected a rotation, found {fault}")
    projection = np.column_stack([matrix, np.zeros(3)])
    if "projection_matrix" in content:
        projection = _entries(path, content, "projection_matrix", (3, 4))
    return Rectified(Stored(size, matrix, k, np.eye(4)), rotation, projection)


def _entries(path: Path, content: Mapping[str, Any], name: str, shape: tuple[int, ...] | None = None) -> Array:
    """A matrix of ROS's, a map of rows, cols and data."""
    value = content.get(name)
    data = value.get("data") if isinstance(value, dict) else None
    numbers = _numbers(path, name, data, None if shape is None else int(np.prod(shape)))
    return numbers if shape is None else numbers.reshape(shape)


def _mrcal(path: Path, text: str) -> Stored:
    """A file's dictionary isn't evaluated: of its values only these are read."""
    plain = re.sub(r"^\s*#.*$", "", text, flags=re.MULTILINE)
    found = re.findall(r"""['"]lens_?model['"]\s*:\s*['"]([^'"]*)['"]""", plain)
    model = found[0].removeprefix("LENSMODEL_") if len(found) == 1 else ""
    if model not in MRCAL:
        expected = ", ".join(f"LENSMODEL_{name}" for name in MRCAL)
        raise InputError(
            f"{path}: lensmodel: expected one of {expected}, found {brief(', '.join(found))}: mrcal-convert-lensmodel makes one"
        )
    fx, fy, cx, cy, *k = _listed(path, plain, "intrinsics", 4 + MRCAL[model])
    width, height = _listed(path, plain, "imagersize", 2)
    motion = _listed(path, plain, "rt_cam_ref|extrinsics", 6)
    pose = rigid.from_rotation_vector(motion[:3], motion[3:] * MM)
    return Stored(_size(path, "imagersize", [width, height]), pinhole(fx, fy, cx, cy), np.array(k, float), pose)


def _listed(path: Path, text: str, key: str, count: int) -> Array:
    """Numbers : (count,) of a list in a Python dictionary."""
    name = key.rpartition("|")[2]
    places = list(re.finditer(rf"""['"](?:{key})['"]\s*:\s*""", text))
    found = LISTED.match(text, places[0].end()) if len(places) == 1 else None
    if found is None:
        raise InputError(f"{path}: {name}: expected a list of numbers once, found {'something else' if places else 'none'}")
    return _numbers(path, name, [float(number) for number in re.findall(NUMBER, found[0])], count)


def _numbers(path: Path, name: str, value: Any, count: int | None = None) -> Array:
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


def _size(path: Path, name: str, value: Any) -> tuple[int, int]:
    numbers = _numbers(path, name, value, 2)
    if (numbers != np.rint(numbers)).any() or numbers.min() < 1 or numbers.max() > 1e6:
        raise InputError(f"{path}: {name}: expected width and height in px, found {brief(value)}")
    return int(numbers[0]), int(numbers[1])


def pinhole(fx: float, fy: float, cx: float, cy: float) -> Array:
    """A matrix : (3, 3) px without skew."""
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])


def slstudio(path: Path, values: opencv_storage.Values, sizes: Mapping[str, tuple[int, int]]) -> dict[str, Stored]:
    """Camera and projector of SLStudio's calibration; sizes, where it has none, are those given.

    Raises
    ------
    InputError
        If a matrix or a size is missing.
    """
    matrices = {key: opencv_storage.matrix(path, key, values.get(key)) for key in SLSTUDIO}
    if matrices["Rp"].shape != (3, 3) or matrices["Tp"].size != 3:
        shapes = f"{matrices['Rp'].shape} and {matrices['Tp'].shape}"
        raise InputError(f"{path}: Rp, Tp: expected a 3x3 rotation and 3 translations in mm, found {shapes}")
    found: dict[str, Stored] = {}
    poses = {"cam1": np.eye(4), "projector": rigid.transform(matrices["Rp"], matrices["Tp"])}
    for (device, keys), (matrix, lens) in zip(SLSTUDIO_SIZES.items(), (("Kc", "kc"), ("Kp", "kp")), strict=True):
        sides = [side for key in keys if isinstance(side := values.get(key), int) and side > 0]
        size = (sides[0], sides[1]) if len(sides) == 2 else sizes.get(device)
        if size is None:
            named = " and ".join(keys)
            raise InputError(f"{path}: {named}: expected the image size of {device}, found none, and none was given")
        found[device] = Stored(size, matrices[matrix], matrices[lens].ravel(), poses[device])
    return found
