"""Calibration files: sonotwin's own `optics.yaml` and the dialects of others, recognised by their content.

- own: OpenCV FileStorage YAML; for every device a map of `size`, `matrix`, `distortion` and `camera_from_world`; and, if known,
  `parameters`, their names, and `covariance`.
- camera and projector of SLMaster: FileStorage with M1, D1 (camera), M4, D4 (projector), Rlp, Tlp (projector from camera), S.
- two cameras of SLMaster and OpenCV's stereo_calib: FileStorage with M1, D1, M2, D2, and Rlr, Tlr or R, T (camera 2 from 1).
- stereo pair of the rig's authors: npz, MATLAB file, or FileStorage XML, with K1, dist1, K2, dist2, R, t. Device 1 is camera 1;
  which device 2 is, the content doesn't say: the projector if the file's name has `proj` in it, else camera 2.
- camera and projector of SLStudio: FileStorage XML with Kc, kc, Kp, kp, Rp, Tp (projector from camera).
- Kalibr's camchain YAML, ROS's camera_info YAML and mrcal's cameramodel: see `recon.capture.camera_dialects`.

Those in OpenCV's storage, npz and MATLAB's files may state the unit of their translations by a number `mm_per_unit`: 1000 for
metres. Without it they are in mm, and devices that would stand apart as none do are refused.
"""

import logging
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from recon.capture import camera_dialects
from recon.capture.camera_dialects import Stored
from recon.capture.manifest import SCANNER, read_manifest
from recon.errors import InputError, short
from recon.files import matlab, npz, opencv_storage
from recon.files.opencv_storage import Values
from recon.geometry import rigid
from recon.geometry.camera import ROTATION, Array, Camera
from recon.geometry.camera_jacobian import DISTORTION, MATRIX, MOTION
from recon.model import lengths
from recon.model.calibration import WORLD, Calibration, Uncertainty
from recon.model.lengths import UNIT_KEY

log = logging.getLogger(__name__)

SCHEMA = "sonotwin-optics/1"
SLMASTER_KEYS = ("M1", "D1", "M4", "D4", "Rlp", "Tlp", "S")
PAIR_KEYS = ("M1", "D1", "M2", "D2")
PAIR_MOTIONS = (("Rlr", "Tlr"), ("R", "T"))
STEREO_KEYS = ("K1", "dist1", "K2", "dist2", "R", "t")
OLD_KEYS = {"distCoeffs1": "dist1", "distCoeffs2": "dist2"}  # of the authors' first files
FEW_DIGITS = 1.1e-5  # of a rotation's products, in any of the files: five decimals mostly pass
LARGEST = 1e8  # px, of a focal length; and of any coefficient
DIALECTS = "schema, or M1 and M4, or M1 and M2, or K1 and K2, or Kc and Kp, or a file of Kalibr, ROS or mrcal"
OWN_KEYS = ("schema", "parameters", "covariance", UNIT_KEY)  # any other is a device


def read(path: Path, sizes: Mapping[str, tuple[int, int]] | None = None) -> Calibration:
    """Read a calibration file of any of the dialects.

    Parameters
    ----------
    sizes : device -> (width, height) px
        Image sizes of devices for which the file stores none; its own are kept where it has them.

    Raises
    ------
    InputError
        If the file is missing, damaged, of no known dialect, or a value is missing, not finite, or no rotation.
    """
    path = Path(path)
    forms = dict.fromkeys(STEREO_KEYS, npz.Form("fiu")) | {UNIT_KEY: npz.Form("fiu", optional=True)}
    if path.is_file() and matlab.is_matlab(path):
        arrays = _decimal(matlab.read(path, forms, OLD_KEYS))
        return _in_mm(path, _stereo_pair(path, arrays, sizes or {}), arrays.get(UNIT_KEY))
    if (stored := camera_dialects.read(path)) is not None:
        return _of_metres(path, _of_stored(path, stored))
    values = opencv_storage.read(path, "a calibration file")
    if values is None:
        arrays = _decimal(npz.read(path, forms))
        return _in_mm(path, _stereo_pair(path, arrays, sizes or {}), arrays.get(UNIT_KEY))
    return _in_mm(path, _of_storage(path, values, sizes), values.get(UNIT_KEY))


def _of_storage(path: Path, values: Values, sizes: Mapping[str, tuple[int, int]] | None) -> Calibration:
    if "schema" in values:
        return _own(path, values)
    if "K1" in values or "K2" in values:
        return _stereo_pair(path, _matrices(path, values, STEREO_KEYS), sizes or {})
    if "Kc" in values or "Kp" in values:
        return _of_stored(path, camera_dialects.slstudio(path, values, sizes or {}))
    if "M2" in values and "M4" not in values:
        return _two_cameras(path, values, sizes or {})
    if "M1" in values or "M4" in values:
        return _slmaster(path, _matrices(path, values, SLMASTER_KEYS), sizes or {})
    found = short(", ".join(values)) or "no keys"
    raise InputError(f"{path}: expected {DIALECTS}, found {found}")


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


def _in_mm(path: Path, read: Calibration, stated: object) -> Calibration:
    """The calibration in mm, by the unit that its file states; without one, the usual distances between devices tell another.

    Raises
    ------
    InputError
        If they do, or the unit is none.
    """
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


def _of_metres(path: Path, read: Calibration) -> Calibration:
    """The calibration of a dialect that is in metres; InputError if mm were taken for them."""
    most = lengths.DEVICES_APART.most / camera_dialects.MM
    for name, camera in read.cameras.items():
        if (apart := lengths.shift(camera.camera_from_world[:3, 3]) / camera_dialects.MM) > most:
            expected = f"{path}: {name}: expected it within {most:g} m of {WORLD}"
            raise InputError(f"{expected}, found {apart:.4g} m: are its translations in mm? Divide them by 1000")
    return read


def of_capture(folder: Path, given: Path | None = None) -> Calibration | None:
    """The calibration in a file, if one is given, or else a capture's own; None where there is neither.

    Raises
    ------
    InputError
        As `read`; or if the capture's manifest is wrong.
    """
    held = read_manifest(folder)
    path = given or (None if held.calibration is None else folder / held.calibration)
    return None if path is None else read(path, {name: device.size for name, device in held.devices.items() if name != SCANNER})


def read_for(path: Path, sizes: Mapping[str, tuple[int, int]]) -> Calibration:
    """Read a calibration that is to be that of devices, each with images of a size; as `read` otherwise.

    Raises
    ------
    InputError
        Also if a device isn't there or was calibrated with images of another size.
    """
    found = read(path, sizes)
    for name, (width, height) in sizes.items():
        if name not in found.cameras:
            raise InputError(f"{path}: expected {name}, found {', '.join(found.cameras) or 'none'}")
        if found.cameras[name].size != (width, height):
            other = "x".join(map(str, found.cameras[name].size))
            raise InputError(f"{path}: expected {name} of {width}x{height} px, found {other}")
    return found


def write(path: Path, calibration: Calibration) -> None:
    """Write sonotwin's own format, whole or not at all. The suffix should be `.yaml`."""
    storage = cv2.FileStorage(".yaml", cv2.FileStorage_WRITE | cv2.FileStorage_MEMORY)
    storage.write("schema", SCHEMA)
    apart = [lengths.shift(camera.camera_from_world[:3, 3]) for camera in calibration.cameras.values()]
    if any(map(lengths.DEVICES_APART.is_unusual, apart)):
        storage.write(UNIT_KEY, 1.0)
    for name, camera in calibration.cameras.items():
        storage.startWriteStruct(name, cv2.FileNode_MAP)
        storage.startWriteStruct("size", cv2.FileNode_SEQ | cv2.FileNode_FLOW)
        for length in camera.size:
            storage.write("", int(length))
        storage.endWriteStruct()
        storage.write("matrix", camera.matrix)
        storage.write("distortion", camera.distortion.reshape(1, -1) if camera.distortion.size else np.zeros((1, 4)))
        storage.write("camera_from_world", camera.camera_from_world)
        storage.endWriteStruct()
    if calibration.uncertainty is not None:
        opencv_storage.write_covariance(storage, calibration.uncertainty.names, calibration.uncertainty.covariance)
    opencv_storage.save(path, storage)


def extend(path: Path, calibration: Calibration) -> None:
    """Write a calibration, making the folder; other devices that the file has already stay in it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    before = read(path).cameras if path.is_file() else {}
    write(path, Calibration({**before, **calibration.cameras}, calibration.uncertainty))


def complete(path: Path, calibration: Calibration) -> None:
    """Write a calibration of those devices that the file hasn't yet, making it and the folder; what it has stays as it is."""
    before = read(path) if path.is_file() else Calibration({}, calibration.uncertainty)
    missing = {name: camera for name, camera in calibration.cameras.items() if name not in before.cameras}
    if missing:
        path.parent.mkdir(parents=True, exist_ok=True)
        write(path, Calibration({**before.cameras, **missing}, before.uncertainty))


def _of_stored(path: Path, stored: Mapping[str, Stored]) -> Calibration:
    return Calibration({name: _camera(path, name, *one) for name, one in stored.items()})


def _own(path: Path, values: Values) -> Calibration:
    if values["schema"] != SCHEMA:
        found = short(values["schema"]) if isinstance(values["schema"], str) else "a value that is no text"
        raise InputError(f"{path}: schema: expected {SCHEMA}, found {found}")
    cameras = {}
    for name in [name for name in values if name not in OWN_KEYS]:
        device = values[name]
        if not isinstance(device, dict):
            raise InputError(f"{path}: {name}: expected size, matrix, distortion and camera_from_world, found something else")
        matrix, distortion, pose = (
            opencv_storage.matrix(path, f"{name}.{key}", device.get(key)) for key in ("matrix", "distortion", "camera_from_world")
        )
        size = device.get("size")
        if not isinstance(size, list) or len(size) != 2 or not all(isinstance(side, int) and side > 0 for side in size):
            raise InputError(f"{path}: {name}.size: expected width and height in px, found something else")
        cameras[name] = _camera(path, name, (size[0], size[1]), matrix, distortion, pose)
    if not cameras:
        raise InputError(f"{path}: expected at least one device, found none")
    return Calibration(cameras, _uncertainty(path, values, cameras))


def _uncertainty(path: Path, values: Values, cameras: Mapping[str, Camera]) -> Uncertainty | None:
    names = opencv_storage.names(values)
    if names is None:
        return None
    if not names:
        raise InputError(f"{path}: parameters: expected names of the covariance's parameters, found something else")
    known = {f"{device}.{name}" for device in cameras for name in MATRIX + DISTORTION + (MOTION if device != WORLD else ())}
    wrong = next((name for k, name in enumerate(names) if name not in known or name in names[:k]), None)
    if wrong is not None:
        raise InputError(f"{path}: parameters: expected a device's parameter like projector.fx, each once, found {short(wrong)}")
    return Uncertainty(names, opencv_storage.covariance(path, values, len(names)))


def _slmaster(path: Path, values: Mapping[str, Array], sizes: Mapping[str, tuple[int, int]]) -> Calibration:
    if values["S"].size != 2 or not np.isfinite(values["S"]).all() or values["S"].min() < 1:
        raise InputError(f"{path}: S: expected the camera's width and height in px, found {values['S'].ravel().tolist()}")
    width, height = (int(length) for length in values["S"].ravel())
    projector_from_world = _rigid(path, values, "Rlp", "Tlp")
    camera = _camera(path, "cam1", (width, height), values["M1"], values["D1"], np.eye(4))
    projector = _camera(path, "projector", _size(path, "projector", sizes), values["M4"], values["D4"], projector_from_world)
    return Calibration({"cam1": camera, "projector": projector})


def _two_cameras(path: Path, stored: Values, sizes: Mapping[str, tuple[int, int]]) -> Calibration:
    motion = next((pair for pair in PAIR_MOTIONS if set(pair) <= stored.keys()), None)
    if motion is None:
        raise InputError(
            f"{path}: expected Rlr and Tlr, or R and T, which take camera 1 to camera 2, found {short(', '.join(stored))}; "
            "OpenCV's stereo_calib leaves R and T in extrinsics.yml: copy them into this file"
        )
    values = _matrices(path, stored, (*PAIR_KEYS, *motion))
    first = _camera(path, "cam1", _size(path, "cam1", sizes), values["M1"], values["D1"], np.eye(4))
    second = _camera(path, "cam2", _size(path, "cam2", sizes), values["M2"], values["D2"], _rigid(path, values, *motion))
    return Calibration({"cam1": first, "cam2": second})


def _stereo_pair(path: Path, values: Mapping[str, Array], sizes: Mapping[str, tuple[int, int]]) -> Calibration:
    second = "projector" if "proj" in path.name.lower() else "cam2"
    second_from_world = _rigid(path, values, "R", "t")
    first = _camera(path, "cam1", _size(path, "cam1", sizes), values["K1"], values["dist1"], np.eye(4))
    other = _camera(path, second, _size(path, second, sizes), values["K2"], values["dist2"], second_from_world)
    return Calibration({"cam1": first, second: other})


def _decimal(matrices: Mapping[str, NDArray]) -> dict[str, Array]:
    return {name: matrix.astype(float) for name, matrix in matrices.items()}


def _camera(path: Path, name: str, size: tuple[int, int], matrix: Array, distortion: Array, camera_from_world: Array) -> Camera:
    for part, values in (("matrix", matrix), ("distortion", distortion)):
        if (np.abs(values) > LARGEST).any():
            raise InputError(f"{path}: {name}.{part}: expected numbers of up to {LARGEST:g}, found {np.abs(values).max():g}")
    if rigid.fault(camera_from_world, ROTATION) and not rigid.fault(camera_from_world, FEW_DIGITS):
        camera_from_world = rigid.nearest(camera_from_world)
    try:
        return Camera(size, matrix, distortion, camera_from_world)
    except ValueError as error:
        raise InputError(f"{path}: {name}.{error}") from None


def _rigid(path: Path, values: Mapping[str, Array], rotation: str, translation: str) -> Array:
    if values[rotation].shape != (3, 3) or values[translation].size != 3:
        found = f"{values[rotation].shape} and {values[translation].shape}"
        raise InputError(f"{path}: {rotation}, {translation}: expected a 3x3 rotation and 3 translations in mm, found {found}")
    return rigid.transform(values[rotation], values[translation])


def _size(path: Path, name: str, sizes: Mapping[str, tuple[int, int]]) -> tuple[int, int]:
    if name not in sizes:
        raise InputError(f"{path}: expected a file that stores the image size of {name}, found none, and none was given")
    return sizes[name]


def _matrices(path: Path, values: Values, keys: tuple[str, ...]) -> dict[str, Array]:
    return {key: opencv_storage.matrix(path, key, values.get(key)) for key in keys}
