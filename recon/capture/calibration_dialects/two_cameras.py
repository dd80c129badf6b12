"""Two cameras of SLMaster and OpenCV's stereo_calib: FileStorage with M1, D1, M2, D2, and Rlr, Tlr or R, T (2 from 1)."""

from pathlib import Path

import numpy as np

from recon.capture import camera_dialects
from recon.capture.camera_dialects import Content, Sizes
from recon.errors import InputError, short
from recon.files.opencv_storage import Values
from recon.model.calibration import Calibration

TOLD_BY = "M1 and M2"


def recognises(content: Content) -> bool:
    """Whether the matrix of a second camera is there, and none of a projector."""
    return "M2" in content.values and "M4" not in content.values


def read(content: Content, sizes: Sizes) -> Calibration:
    """Both cameras."""
    return camera_dialects.of_mm(content, _calibration(content.path, content.values, sizes))


def _calibration(path: Path, stored: Values, sizes: Sizes) -> Calibration:
    pair_motions = (("Rlr", "Tlr"), ("R", "T"))
    motion = next((pair for pair in pair_motions if set(pair) <= stored.keys()), None)
    if motion is None:
        raise InputError(
            f"{path}: expected Rlr and Tlr, or R and T, which take camera 1 to camera 2, found {short(', '.join(stored))}; "
            "OpenCV's stereo_calib leaves R and T in extrinsics.yml: copy them into this file"
        )
    pair_keys = ("M1", "D1", "M2", "D2")
    values = camera_dialects.matrices(path, stored, (*pair_keys, *motion))
    first = camera_dialects.camera(
        path, "cam1", camera_dialects.size_of(path, "cam1", sizes), values["M1"], values["D1"], np.eye(4)
    )
    second = camera_dialects.camera(
        path,
        "cam2",
        camera_dialects.size_of(path, "cam2", sizes),
        values["M2"],
        values["D2"],
        camera_dialects.motion(path, values, *motion),
    )
    return Calibration({"cam1": first, "cam2": second})
