"""Files of a tool's tip, `tip.yaml`: OpenCV FileStorage YAML.

`schema`; `body`, the name of the rig's body, where it has one; `tip_mm` in the target's frame; of a film `dimple_mm` in the
world, `rms_mm` and `frames`; `axis`, the shaft's direction in the target's frame from the handle to the tip, where it is known;
`model`, a mesh's path relative to the file, where there is one; and `parameters`, names of the numbers of `tip_mm`, `dimple_mm`
and `axis`, with their `covariance`.
"""

import os
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from recon.errors import InputError, brief, short
from recon.files import opencv_storage
from recon.files.opencv_storage import Values
from recon.geometry import rigid
from recon.model.tip import Tip

Array = NDArray[np.float64]

SCHEMA = "sonotwin-tip/1"
OFF_LENGTH = 1e-3  # of an axis, from 1


def write(path: Path, tip: Tip, out: Path | None = None) -> None:
    """Write a tip, whole or not at all. The suffix should be `.yaml`.

    out : folder in which the file is going to be, if that isn't where it is written
    """
    storage = cv2.FileStorage(".yaml", cv2.FileStorage_WRITE | cv2.FileStorage_MEMORY)
    storage.write("schema", SCHEMA)
    if tip.body:
        storage.write("body", tip.body)
    storage.write("tip_mm", np.reshape(tip.tip_mm, (1, 3)))
    for name, vector in (("axis", tip.axis), ("dimple_mm", tip.dimple_mm)):
        if vector is not None:
            storage.write(name, np.reshape(vector, (1, 3)))
    if tip.dimple_mm is not None:
        storage.write("rms_mm", float(tip.rms_mm))
        storage.write("frames", int(tip.frames))
    if tip.model is not None:
        storage.write("model", os.path.relpath(tip.model.resolve(), (out or path.parent).resolve()))
    opencv_storage.write_covariance(storage, tip.parameters, tip.covariance)
    opencv_storage.save(path, storage)


def read(path: Path, body: str = "") -> Tip:
    """Read a tip.

    body : that it is expected to be of; a file without a name is taken, as older ones are

    Raises
    ------
    InputError
        If the file is missing, damaged, of another kind or another body, or a value is missing or can't be.
    """
    values = opencv_storage.read_schema(path, "a tool's tip", SCHEMA)
    named = values.get("body", "")
    if not isinstance(named, str):
        raise InputError(f"{path}: body: expected a name of rig.bodies, found {brief(named)}")
    if body and named and named != body:
        way = f"another tool's file? calibrate-tip writes the name that its body= has, body={body}"
        raise InputError(f"{path}: body: expected the tip of {body}, found that of {short(named)}: {way}")
    tip = _vector(path, values, "tip_mm")
    axis, dimple = (_vector(path, values, name) if name in values else None for name in ("axis", "dimple_mm"))
    if axis is not None and abs(np.linalg.norm(axis) - 1) > OFF_LENGTH:
        raise InputError(f"{path}: axis: expected a direction of length 1, found one of {np.linalg.norm(axis):.4g}")
    rms, frames = (_number(path, values, name) if dimple is not None else 0 for name in ("rms_mm", "frames"))
    model = values.get("model")
    if not isinstance(model, str | None):
        raise InputError(f"{path}: model: expected the path of a mesh, found {brief(model)}")
    shape = Tip(tip, np.empty((0, 0)), axis, dimple)
    if (names := opencv_storage.names(values)) != shape.parameters:
        found = short(" ".join(names or ["none"]))
        raise InputError(f"{path}: parameters: expected {' '.join(shape.parameters)}, as of what the file holds, found {found}")
    covariance = opencv_storage.covariance(path, values, len(shape.parameters))
    of_film = (float(rms), int(frames)) if dimple is not None else (np.nan, 0)
    return Tip(tip, covariance, axis, dimple, *of_film, None if model is None else path.parent / model, named)


def _vector(path: Path, values: Values, name: str) -> Array:
    vector = opencv_storage.matrix(path, name, values.get(name))
    if vector.size != 3 or not np.isfinite(vector).all() or np.abs(vector).max() > rigid.FARTHEST_MM:
        raise InputError(f"{path}: {name}: expected three finite numbers, x, y and z, found {short(str(vector.tolist()))}")
    return vector.ravel()


def _number(path: Path, values: Values, name: str) -> float:
    value = values.get(name)
    if not isinstance(value, int | float) or not 0 <= value < np.inf:
        raise InputError(f"{path}: {name}: expected a number from 0 on, found {brief(value) if value is not None else 'none'}")
    return value
