"""What calibrations written for other programs share; each dialect's own is in `recon.capture.calibration_dialects`.

A device that is more than a dialect can say is refused by the first value that has no place.
"""

from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from recon.capture.camera_dialects import MM
from recon.errors import InputError
from recon.geometry import rigid
from recon.geometry.camera import Array, Camera
from recon.geometry.camera_jacobian import DISTORTION


def coefficients(name: str, camera: Camera, counts: Sequence[int], model: str, ours: str) -> Array:
    """A device's coefficients, cut or filled up to the least number of those that a dialect has.

    Raises InputError if it has more.
    """
    k = np.trim_zeros(camera.distortion, "b")
    count = next((count for count in counts if count >= k.size), None)
    if count is None:
        beyond = next(index for index in range(counts[-1], k.size) if k[index])
        raise InputError(
            f"calibration: {name}.distortion: expected {' '.join(DISTORTION[: counts[-1]])} alone, all that {model} has, "
            f"found {DISTORTION[beyond]} = {k[beyond]:.4g}: calibrate-optics distortion={ours} does without"
        )
    return np.pad(k, (0, count - k.size))


def core(name: str, camera: Camera) -> list[float]:
    """Focal lengths and centre; raises InputError if the axes of the image are skew, for which there is no place."""
    if camera.matrix[0, 1]:
        raise InputError(
            f"calibration: {name}.matrix: expected no skew, for which the layout has no place, found {camera.matrix[0, 1]:g}"
        )
    return [camera.matrix[0, 0], camera.matrix[1, 1], camera.matrix[0, 2], camera.matrix[1, 2]]


def in_metres(pose: Array) -> Array:
    """A pose with its shift in m."""
    return rigid.transform(pose[:3, :3], pose[:3, 3] / MM)


def row(numbers: Iterable[float]) -> str:
    """Numbers with all digits, with a point, by which YAML knows `1e-05` for a number."""
    return f"[{', '.join(_digits(float(number)) for number in numbers)}]"


def _digits(number: float) -> str:
    text = repr(number)
    return text if "." in text or "e" not in text else text.replace("e", ".0e")


def matrix(name: str, values: Array) -> list[str]:
    """Lines of a matrix as ROS has it."""
    return [f"{name}:", f"  rows: {values.shape[0]}", f"  cols: {values.shape[1]}", f"  data: {row(values.ravel())}"]


def write(path: Path, lines: Sequence[str]) -> str:
    """Write a text of lines; returns its name."""
    path.write_text("\n".join(["# written by sonotwin", *lines, ""]), encoding="utf-8")
    return path.name
