"""Camera and projector of SLMaster: FileStorage with M1, D1 (camera), M4, D4 (projector), Rlp, Tlp (projector from camera), S."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from recon.capture import camera_dialects
from recon.capture.camera_dialects import Content, Sizes
from recon.errors import InputError
from recon.geometry.camera import Array
from recon.model.calibration import Calibration

TOLD_BY = "M1 and M4"


def recognises(content: Content) -> bool:
    """Whether the matrix of the projector is there, or that of the camera without one of a second."""
    return "M4" in content.values or ("M1" in content.values and "M2" not in content.values)


def read(content: Content, sizes: Sizes) -> Calibration:
    """Camera and projector."""
    keys = ("M1", "D1", "M4", "D4", "Rlp", "Tlp", "S")
    path, values = content.path, camera_dialects.matrices(content.path, content.values, keys)
    return camera_dialects.of_mm(content, _calibration(path, values, sizes))


def _calibration(path: Path, values: Mapping[str, Array], sizes: Sizes) -> Calibration:
    if values["S"].size != 2 or not np.isfinite(values["S"]).all() or values["S"].min() < 1:
        raise InputError(f"{path}: S: expected the camera's width and height in px, found {values['S'].ravel().tolist()}")
    width, height = (int(length) for length in values["S"].ravel())
    projector_from_world = camera_dialects.motion(path, values, "Rlp", "Tlp")
    camera = camera_dialects.camera(path, "cam1", (width, height), values["M1"], values["D1"], np.eye(4))
    projector = camera_dialects.camera(
        path, "projector", camera_dialects.size_of(path, "projector", sizes), values["M4"], values["D4"], projector_from_world
    )
    return Calibration({"cam1": camera, "projector": projector})
