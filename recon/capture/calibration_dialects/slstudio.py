"""SLStudio's calibration: FileStorage XML with Kc, kc, Kp, kp, Rp, Tp, which takes camera to projector, in mm."""

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from recon.capture import camera_dialects, camera_exports
from recon.capture.camera_dialects import Content, Sizes, Stored
from recon.errors import InputError
from recon.files import opencv_storage
from recon.geometry import rigid
from recon.model.calibration import Calibration

TOLD_BY = "Kc and Kp"
SLSTUDIO_SIZES = {"cam1": ("frameWidth", "frameHeight"), "projector": ("screenResX", "screenResY")}


def recognises(content: Content) -> bool:
    """Whether a camera's or a projector's matrix is there."""
    return "Kc" in content.values or "Kp" in content.values


def read(content: Content, sizes: Sizes) -> Calibration:
    """Camera and projector."""
    return camera_dialects.of_mm(content, camera_dialects.of_stored(content.path, _stored(content.path, content.values, sizes)))


def taken(optics: Calibration) -> Sequence[str]:
    """Camera 1 and the projector."""
    return [name for name in optics.cameras if name in ("cam1", "projector")]


def write(folder: Path, optics: Calibration) -> list[str]:
    """Write camera 1 and the projector as `calibration.xml`; returns the file's name."""
    if not {"cam1", "projector"} <= optics.cameras.keys():
        raise InputError(f"layout: expected cam1 and projector for SLStudio, found {', '.join(optics.cameras)}")
    camera, projector = optics.cameras["cam1"], optics.cameras["projector"]
    pose = projector.camera_from_world @ rigid.invert(camera.camera_from_world)
    lenses = {
        name: camera_exports.coefficients(name, optics.cameras[name], (5,), "SLStudio", "brown") for name in ("cam1", "projector")
    }
    storage = cv2.FileStorage(".xml", cv2.FileStorage_WRITE | cv2.FileStorage_MEMORY)
    values = {"Kc": camera.matrix, "kc": lenses["cam1"], "Kp": projector.matrix, "kp": lenses["projector"]}
    for key, value in (values | {"Rp": pose[:3, :3], "Tp": pose[:3, 3]}).items():
        storage.write(key, np.ascontiguousarray(value if value.ndim == 2 else value[:, None]))
    for key in ("cam_error", "proj_error", "stereo_error"):
        storage.write(key, 0.0)  # which nobody knows here
    for device, keys in SLSTUDIO_SIZES.items():
        for key, side in zip(keys, optics.cameras[device].size, strict=True):
            storage.write(key, int(side))
    opencv_storage.save(folder / "calibration.xml", storage)
    return ["calibration.xml"]


def _stored(path: Path, values: opencv_storage.Values, sizes: Sizes) -> dict[str, Stored]:
    """Camera and projector of SLStudio's calibration; sizes, where it has none, are those given.

    Raises
    ------
    InputError
        If a matrix or a size is missing.
    """
    slstudio = ("Kc", "kc", "Kp", "kp", "Rp", "Tp")
    matrices = {key: opencv_storage.matrix(path, key, values.get(key)) for key in slstudio}
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
