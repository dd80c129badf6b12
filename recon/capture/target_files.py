"""Files of the measured target, `target.yaml`: OpenCV FileStorage YAML.

`schema`; the lengths of the target's kind, `c1_mm`, `c2_aside_mm`, `c2_mm` and on, as `recon.model.circle_layout` has them;
`outer_diameter_mm`; `curvature_per_m` (xx, xy, yy); and `parameters`, the names of all these, with their `covariance`.
"""

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from recon.errors import InputError, one_line, short
from recon.files import opencv_storage
from recon.model.rig import Target

Array = NDArray[np.float64]

SCHEMA = "sonotwin-target/1"
CURVATURE = "curvature_per_m"


def lengths_and_diameter(target: Target) -> tuple[str, ...]:
    """Names of the circles' lengths, and of their diameter."""
    return (*target.LENGTHS, "outer_diameter_mm")


def parameters(target: Target) -> tuple[str, ...]:
    """Names of all that is measured."""
    return (*lengths_and_diameter(target), *(f"curvature_{axes}_per_m" for axes in ("xx", "xy", "yy")))


def write(path: Path, target: Target, covariance: Array) -> None:
    """Write a measured target with the covariance : (p, p) of `parameters`, whole or not at all. The suffix should be `.yaml`."""
    storage = cv2.FileStorage(".yaml", cv2.FileStorage_WRITE | cv2.FileStorage_MEMORY)
    storage.write("schema", SCHEMA)
    for name in lengths_and_diameter(target):
        storage.write(name, float(getattr(target, name)))
    storage.write(CURVATURE, np.array(target.curvature_per_m).reshape(1, 3))
    opencv_storage.write_covariance(storage, parameters(target), covariance)
    opencv_storage.save(path, storage)


def read(path: Path, design: Target) -> Target:
    """Read a measured target; the design's board and inner diameter stay.

    Raises
    ------
    InputError
        If the file is missing, damaged, of another kind, or a value is missing or can't be.
    """
    stored = opencv_storage.read_schema(path, "a measured target", SCHEMA)
    values: dict[str, object] = {name: _number(path, name, stored.get(name)) for name in lengths_and_diameter(design)}
    curvature = opencv_storage.matrix(path, CURVATURE, stored.get(CURVATURE))
    if curvature.size != 3 or not np.isfinite(curvature).all():
        raise InputError(f"{path}: {CURVATURE}: expected three numbers, xx, xy and yy, found {short(str(curvature.tolist()))}")
    names = opencv_storage.names(stored)
    expected = parameters(design)
    if names is None or sorted(names) != sorted(expected):
        found = short(" ".join(names or ["none"]))
        raise InputError(f"{path}: parameters: expected {' '.join(expected)}, as of rig.target, found {found}")
    covariance = opencv_storage.covariance(path, stored, len(names))
    of_lengths = [names.index(name) for name in design.LENGTHS]
    values[CURVATURE] = curvature.ravel().tolist()
    values["covariance_mm2"] = covariance[np.ix_(of_lengths, of_lengths)].tolist()
    try:
        return type(design).model_validate(design.model_dump() | values)
    except ValidationError as error:
        raise InputError(f"{path}: {one_line(error)}") from None


def _number(path: Path, name: str, value: object) -> float:
    if not isinstance(value, int | float):
        raise InputError(f"{path}: {name}: expected a length in mm, found {'none' if value is None else 'something else'}")
    return float(value)
