"""Calibration files: sonotwin's own `optics.yaml` and the dialects of others, recognised by their content; a module of
`calibration_dialects` each.

Those in OpenCV's storage, npz and MATLAB's files may state the unit of their translations by a number `mm_per_unit`: 1000 for
metres. Without it they are in mm, and devices that would stand apart as none do are refused.
"""

import logging
from collections.abc import Mapping
from pathlib import Path

import cv2
import numpy as np

from recon import registry
from recon.capture.calibration_dialects import own
from recon.capture.camera_dialects import Content
from recon.capture.manifest import SCANNER, read_manifest
from recon.errors import InputError, short
from recon.files import opencv_storage
from recon.geometry.lens_domain import is_one_to_one
from recon.model import lengths
from recon.model.calibration import Calibration
from recon.model.lengths import UNIT_KEY

log = logging.getLogger(__name__)

DIALECTS = "recon.capture.calibration_dialects"  # a module each


def read(path: Path, sizes: Mapping[str, tuple[int, int]] | None = None) -> Calibration:
    """Read a calibration file of any of the dialects; warns of a lens that folds within its image.

    Parameters
    ----------
    sizes : device -> (width, height) px
        Image sizes of devices for which the file stores none; its own are kept where it has them.

    Raises
    ------
    InputError
        If the file is missing, damaged, of no known dialect, or a value is missing, not finite, or no rotation.
    """
    content = Content(Path(path))
    known = {name: dialect for name, dialect in registry.kinds(DIALECTS).items() if dialect.recognises(content)}
    if len(known) > 1:
        raise InputError(f"{path}: expected files of {' or of '.join(known)}, found both; leave one kind")
    for dialect in known.values():
        found = dialect.read(content, sizes or {})
        for name, camera in found.cameras.items():
            if camera.distortion.any() and not is_one_to_one(camera, margin=0):
                cause = "coefficients of another model or in another order, or of points that left out the corners"
                log.warning("%s: %s: the lens folds within the image, where pixels have no ray: %s?", path, name, cause)
        return found
    found = short(", ".join(content.checked_values())) or "no keys"
    told = [getattr(dialect, "TOLD_BY", f"a file of {name}") for name, dialect in registry.kinds(DIALECTS).items()]
    raise InputError(f"{path}: expected {', or '.join(told)}, found {found}")


def written() -> list[str]:
    """Names of the dialects that can be written for other programs."""
    return [name for name, dialect in registry.kinds(DIALECTS).items() if hasattr(dialect, "write")]


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
    storage.write("schema", own.SCHEMA)
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
        if calibration.uncertainty.has_scale:
            storage.write(own.HAS_SCALE, 1)
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
