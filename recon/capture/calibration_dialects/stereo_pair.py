"""The stereo pair of the rig's authors: npz, MATLAB file, or FileStorage XML, with K1, dist1, K2, dist2, R, t.

Device 1 is camera 1. Which device 2 is, the content doesn't say: the projector if `proj` is in the file's name, else camera 2.
"""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from recon.capture import camera_dialects
from recon.capture.camera_dialects import Content, Sizes
from recon.files import matlab, npz
from recon.geometry.camera import Array
from recon.model.calibration import Calibration
from recon.model.lengths import UNIT_KEY

TOLD_BY = "K1 and K2"
OLD_KEYS = {"distCoeffs1": "dist1", "distCoeffs2": "dist2"}  # of the authors' first files


def recognises(content: Content) -> bool:
    """Whether a matrix of the pair is there."""
    return "K1" in content.values or "K2" in content.values or content.is_packed


def read(content: Content, sizes: Sizes) -> Calibration:
    """Both devices."""
    keys = ("K1", "dist1", "K2", "dist2", "R", "t")
    if content.is_packed:
        forms = dict.fromkeys(keys, npz.Form("fiu")) | {UNIT_KEY: npz.Form("fiu", optional=True)}
        values = matlab.read(content.path, forms, OLD_KEYS) if content.is_matlab else npz.read(content.path, forms)
        arrays = {name: array.astype(float) for name, array in values.items()}
        return camera_dialects.of_mm(content, _calibration(content.path, arrays, sizes), arrays.get(UNIT_KEY))
    values = camera_dialects.matrices(content.path, content.values, keys)
    return camera_dialects.of_mm(content, _calibration(content.path, values, sizes))


def _calibration(path: Path, values: Mapping[str, Array], sizes: Sizes) -> Calibration:
    second = "projector" if "proj" in path.name.lower() else "cam2"
    second_from_world = camera_dialects.motion(path, values, "R", "t")
    first = camera_dialects.camera(
        path, "cam1", camera_dialects.size_of(path, "cam1", sizes), values["K1"], values["dist1"], np.eye(4)
    )
    other = camera_dialects.camera(
        path, second, camera_dialects.size_of(path, second, sizes), values["K2"], values["dist2"], second_from_world
    )
    return Calibration({"cam1": first, second: other})
