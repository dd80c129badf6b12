"""Files of the probe's calibration: sonotwin's own `probe.yaml`, and the rig authors' `US_params.npz`.

- own: OpenCV FileStorage YAML with `schema`, `target_from_image` (4x4, mm), `scale` (sx, sy in mm/px), `speed_m_s`, the speed of
  sound for which sy holds (1540 if it is missing), `face_row`, the row at which echoes have no delay (0 likewise), and, if known,
  `parameters`, their names as in `recon.model.probe`, and `covariance`.
- the authors': npz with sx, sy and T_I_T, which is `target_from_image`. Ours have `speed_m_s`, and `face_row` if it isn't 0,
  beside these, which their programs leave alone; for theirs a caller gives the speed, or 1540 m/s is taken, with a warning. A
  rotation that is off by up to 2 % is taken as the nearest one, and a negative scale as the same map with that axis turned round.
"""

import logging
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from recon.capture import meza2021_sweep
from recon.errors import InputError, short
from recon.files import atomic, npz, opencv_storage
from recon.files.opencv_storage import Values
from recon.geometry import rigid
from recon.model.calibration import Uncertainty
from recon.model.probe import SCANNER_SPEED, SPEEDS, ProbeCalibration

log = logging.getLogger(__name__)

Array = NDArray[np.float64]

SCHEMA = "sonotwin-probe/1"
PARAMETERS = ("sx", "sy", "rx", "ry", "rz", "tx", "ty", "tz")
AUTHORS = "US_params.npz"
MOST_ROWS = 1e5  # of a scanner's image


def read(path: Path, speed_m_s: float | None = None) -> ProbeCalibration:
    """Read a probe's calibration of either kind, recognised by its content.

    speed_m_s : of the sound for which sy holds, m/s, in a file of the authors' that names none

    Raises
    ------
    InputError
        If the file is missing, damaged, of another kind, or a value is missing, not finite, no rotation, scale or speed of sound.
    """
    path = Path(path)
    values = opencv_storage.read(path, "a probe's calibration")
    return _authors(path, speed_m_s) if values is None else _own(path, values)


def write(path: Path, calibration: ProbeCalibration) -> None:
    """Write sonotwin's own format, whole or not at all. The suffix should be `.yaml`."""
    storage = cv2.FileStorage(".yaml", cv2.FileStorage_WRITE | cv2.FileStorage_MEMORY)
    storage.write("schema", SCHEMA)
    storage.write("target_from_image", calibration.target_from_image)
    storage.write("scale", np.asarray(calibration.scale, float).reshape(1, 2))
    storage.write("speed_m_s", float(calibration.speed_m_s))
    storage.write("face_row", float(calibration.face_row))
    if calibration.uncertainty is not None:
        opencv_storage.write_covariance(storage, calibration.uncertainty.names, calibration.uncertainty.covariance)
    opencv_storage.save(path, storage)


def write_authors(path: Path, calibration: ProbeCalibration) -> None:
    """Write the rig authors' `US_params.npz`, whole or not at all, with the speed of sound; it has no room for uncertainty."""
    sx, sy = calibration.scale
    with atomic.new_file(path) as temporary, temporary.open("wb") as file:
        beside = {"face_row": calibration.face_row} if calibration.face_row else {}
        np.savez(file, sx=sx, sy=sy, T_I_T=calibration.target_from_image, speed_m_s=calibration.speed_m_s, **beside)


def _authors(path: Path, speed_m_s: float | None) -> ProbeCalibration:
    number, optional = npz.Form("fiu"), npz.Form("fiu", optional=True)
    forms = {"sx": number, "sy": number, "T_I_T": npz.Form("fiu", (4, 4)), "speed_m_s": optional, "face_row": optional}
    values = npz.read(path, forms)
    for name in values.keys() - {"T_I_T"}:
        if values[name].size != 1:
            raise InputError(f"{path}: {name}: expected one number, found {values[name].size}")
    scale = np.array([values["sx"].item(), values["sy"].item()], float)
    pose = meza2021_sweep.mended(f"{path}: T_I_T", values["T_I_T"].astype(float))
    for axis in np.flatnonzero(scale < 0):
        turned = np.diag([1.0, 1.0, -1.0, 1.0])  # the frame stays right-handed
        turned[axis, axis] = -1.0
        pose, scale[axis] = pose @ turned, -scale[axis]
        log.warning("%s: %s is negative, and is taken as positive with the image's axis turned round", path, ("sx", "sy")[axis])
    if "speed_m_s" in values:
        speed_m_s = _within_speeds(path, float(values["speed_m_s"].item()))
    elif speed_m_s is None:
        speed_m_s = SCANNER_SPEED
        way = "if it was made in water, import it with speed_m_s=..., or add speed_m_s to it"
        log.warning("%s: names no speed of sound, and is taken as right where it makes %g m/s; %s", path, speed_m_s, way)
    face_row = float(values["face_row"].item()) if "face_row" in values else 0.0
    return _checked(path, "T_I_T", ProbeCalibration(pose, scale, None, speed_m_s, face_row))


def _own(path: Path, values: Values) -> ProbeCalibration:
    if values.get("schema") != SCHEMA:
        found = short(values["schema"]) if isinstance(values.get("schema"), str) else "none"
        raise InputError(f"{path}: schema: expected {SCHEMA}, found {found}")
    pose = opencv_storage.matrix(path, "target_from_image", values.get("target_from_image"))
    scale = opencv_storage.matrix(path, "scale", values.get("scale")).ravel()
    face_row = values.get("face_row", 0.0)
    face_row = float(face_row) if isinstance(face_row, int | float) else np.nan
    read = ProbeCalibration(pose, scale, _uncertainty(path, values), _speed(path, values), face_row)
    return _checked(path, "target_from_image", read)


def _checked(path: Path, name: str, read: ProbeCalibration) -> ProbeCalibration:
    scale = read.scale
    if found := rigid.fault(read.target_from_image):
        raise InputError(f"{path}: {name}: expected {rigid.RIGID}, in mm, found {found}")
    if scale.shape != (2,) or not np.isfinite(scale).all() or scale.min() <= 0:
        raise InputError(f"{path}: scale: expected sx and sy above zero in mm/px, found {scale.tolist()}")
    if not abs(read.face_row) < MOST_ROWS:
        raise InputError(f"{path}: face_row: expected a row of an image, found {read.face_row:g}")
    return read


def _speed(path: Path, values: Values) -> float:
    value = values.get("speed_m_s", SCANNER_SPEED)
    return _within_speeds(path, float(value) if isinstance(value, int | float) else None)


def _within_speeds(path: Path, value: float | None) -> float:
    if value is None or not SPEEDS[0] <= value <= SPEEDS[1]:
        found = "something else" if value is None else f"{value:g}"
        raise InputError(f"{path}: speed_m_s: expected a speed of sound of {SPEEDS[0]:g} to {SPEEDS[1]:g} m/s, found {found}")
    return value


def _uncertainty(path: Path, values: Values) -> Uncertainty | None:
    names = opencv_storage.names(values)
    if names is None:
        return None
    if not names or len(set(names)) < len(names) or not set(names) <= set(PARAMETERS):
        raise InputError(f"{path}: parameters: expected some of {' '.join(PARAMETERS)}, each once, found something else")
    return Uncertainty(names, opencv_storage.covariance(path, values, len(names)))
