"""Sonotwin's own `probe.yaml`: OpenCV FileStorage YAML.

`schema`, `target_from_image` (4x4, mm), `scale` (sx, sy in mm/px), `speed_m_s`, the speed of sound for which sy holds (1540 if it
is missing), `face_row`, the row at which echoes have no delay (0 likewise), and, if known, `parameters`, their names as in
`recon.model.probe`, and `covariance`.
"""

from codecs import BOM_UTF8
from pathlib import Path

import cv2
import numpy as np

from recon.capture.probe_values import checked, states_unit, within_speeds
from recon.errors import InputError, brief
from recon.files import opencv_storage
from recon.files.opencv_storage import Values
from recon.files.regular import read_bytes
from recon.model.calibration import Uncertainty
from recon.model.lengths import UNIT_KEY
from recon.model.probe import SCANNER_SPEED, ProbeCalibration

SCHEMA = "sonotwin-probe/1"
PARAMETERS = ("sx", "sy", "rx", "ry", "rz", "tx", "ty", "tz")


def recognises(path: Path) -> bool:
    """Whether it is OpenCV's storage, of any of its three kinds, and names the schema."""
    text = read_bytes(path, opencv_storage.MOST_BYTES, "a probe's calibration").removeprefix(BOM_UTF8).lstrip()
    storage = text.startswith((b"%YAML", b"{")) or (text.startswith(b"<") and b"opencv_storage" in text)
    return storage and SCHEMA.encode() in text


def read(path: Path, speed_m_s: float | None = None) -> ProbeCalibration:
    """Read it; its own speed of sound counts."""
    values = opencv_storage.read_schema(path, "a probe's calibration", SCHEMA)
    pose = opencv_storage.matrix(path, "target_from_image", values.get("target_from_image"))
    scale = opencv_storage.matrix(path, "scale", values.get("scale")).ravel()
    face_row = values.get("face_row", 0.0)
    face_row = float(face_row) if isinstance(face_row, int | float) else np.nan
    read = ProbeCalibration(pose, scale, _uncertainty(path, values), _speed(path, values), face_row)
    return checked(path, "target_from_image", read, values.get(UNIT_KEY))


def write(path: Path, calibration: ProbeCalibration) -> None:
    """Write sonotwin's own format, whole or not at all. The suffix should be `.yaml`."""
    storage = cv2.FileStorage(".yaml", cv2.FileStorage_WRITE | cv2.FileStorage_MEMORY)
    storage.write("schema", SCHEMA)
    storage.write("target_from_image", calibration.target_from_image)
    storage.write("scale", np.asarray(calibration.scale, float).reshape(1, 2))
    storage.write("speed_m_s", float(calibration.speed_m_s))
    storage.write("face_row", float(calibration.face_row))
    if states_unit(calibration):
        storage.write(UNIT_KEY, 1.0)
    if calibration.uncertainty is not None:
        opencv_storage.write_covariance(storage, calibration.uncertainty.names, calibration.uncertainty.covariance)
    opencv_storage.save(path, storage)


def _speed(path: Path, values: Values) -> float:
    value = values.get("speed_m_s", SCANNER_SPEED)
    if not isinstance(value, int | float):
        raise InputError(f"{path}: speed_m_s: expected a number, of m/s, found {brief(value)}")
    return within_speeds(path, float(value))


def _uncertainty(path: Path, values: Values) -> Uncertainty | None:
    names = opencv_storage.names(values)
    if names is None:
        return None
    if not names or len(set(names)) < len(names) or not set(names) <= set(PARAMETERS):
        raise InputError(f"{path}: parameters: expected some of {' '.join(PARAMETERS)}, each once, found something else")
    return Uncertainty(names, opencv_storage.covariance(path, values, len(names)))
