"""Files of the probe's calibration: sonotwin's own `probe.yaml`, the rig authors' `US_params.npz`, and plain matrices.

- own: OpenCV FileStorage YAML with `schema`, `target_from_image` (4x4, mm), `scale` (sx, sy in mm/px), `speed_m_s`, the speed of
  sound for which sy holds (1540 if it is missing), `face_row`, the row at which echoes have no delay (0 likewise), and, if known,
  `parameters`, their names as in `recon.model.probe`, and `covariance`.
- the authors': npz with sx, sy and T_I_T, which is `target_from_image`. Ours have `speed_m_s`, and `face_row` if it isn't 0,
  beside these, which their programs leave alone; for theirs a caller gives the speed, or 1540 m/s is taken, with a warning. A
  rotation that is off by up to 2 % is taken as the nearest one, and a negative scale as the same map with that axis turned round.
- a matrix of 4 x 4 numbers from pixels to mm, as text, or as `ImageToProbe` in a configuration of the PLUS toolkit: its first two
  columns are as long as mm/px; for its speed of sound holds the same. Axes that aren't square, by up to some degrees, are taken
  as such, with a warning.

Any but the last may state the unit of its lengths by a number `mm_per_unit`; without it lengths that no bracket has are refused.
"""

import logging
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from recon.capture import meza2021_sweep
from recon.errors import InputError, brief, short
from recon.files import atomic, npz, opencv_storage, xml_text
from recon.files.opencv_storage import Values
from recon.files.regular import read_bytes
from recon.geometry import rigid
from recon.model import lengths
from recon.model.calibration import Uncertainty
from recon.model.lengths import UNIT_KEY
from recon.model.probe import SCANNER_SPEED, ProbeCalibration, speed_fault

log = logging.getLogger(__name__)

Array = NDArray[np.float64]

SCHEMA = "sonotwin-probe/1"
PARAMETERS = ("sx", "sy", "rx", "ry", "rz", "tx", "ty", "tz")
AUTHORS = "US_params.npz"
AS_NPZ = f"give it as {AUTHORS} with sx, sy, T_I_T and"  # a plain matrix, for what there is no place in it
SEPARATORS = bytes.maketrans(b",;[]()", b"      ")


def read(path: Path, speed_m_s: float | None = None) -> ProbeCalibration:
    """Read a probe's calibration of either kind, recognised by its content.

    speed_m_s : of the sound for which sy holds, m/s, in a file of the authors' that names none

    Raises
    ------
    InputError
        If the file is missing, damaged, of another kind, or a value is missing, not finite, no rotation, scale or speed of sound.
    """
    path = Path(path)
    matrix = _plain_matrix(path)
    if matrix is not None:
        return _of_matrix(path, *matrix, speed_m_s)
    values = opencv_storage.read(path, "a probe's calibration")
    return _authors(path, speed_m_s) if values is None else _own(path, values)


def _plain_matrix(path: Path) -> tuple[str, Array] | None:
    """A matrix (4, 4) with its name, of a text of 16 numbers or a configuration of PLUS; None of any other file."""
    text = read_bytes(path, opencv_storage.MOST_BYTES, "a probe's calibration").lstrip()
    plus_ends = ("Image", "Probe")
    if text.startswith(b"<") and b"opencv_storage" not in text:
        found = [each for each in xml_text.read(path).iter("Transform") if (each.get("From"), each.get("To")) == plus_ends]
        if len(found) != 1:
            raise InputError(
                f"{path}: expected one Transform from {' to '.join(plus_ends)}, the probe's calibration, found {len(found)}"
            )
        text, name = (found[0].get("Matrix") or "").encode(), "To".join(plus_ends)
    else:
        name = "matrix"
    words = text.translate(SEPARATORS).split()
    try:
        values = np.array([float(word) for word in words]) if len(words) == 16 or name != "matrix" else np.empty(0)
    except ValueError:
        values = np.empty(0)
    if values.size != 16:
        if name != "matrix":
            raise InputError(f"{path}: {name}: expected 16 numbers, found {brief(text.decode(errors='replace'))}")
        return None
    return name, values.reshape(4, 4)


def _of_matrix(path: Path, name: str, matrix: Array, speed_m_s: float | None) -> ProbeCalibration:
    """The calibration by a matrix from pixels to mm."""
    scale = np.linalg.norm(matrix[:3, :2], axis=0)
    if not np.isfinite(matrix).all() or np.abs(matrix[3] - [0, 0, 0, 1]).max() > rigid.EXACT or scale.min() == 0:
        raise InputError(
            f"{path}: {name}: expected 4x4 finite numbers with a last row of 0 0 0 1, from pixels to mm, found others"
        )
    rigid_scale = 1e-6  # by which the axes of a rigid transform are off a length of 1
    if np.abs(scale - 1).max() < rigid_scale:
        expected = "first columns as long as the mm of a pixel"
        raise InputError(f"{path}: {name}: expected {expected}, found a rigid transform: multiply them by sx and sy in mm/px")
    if found := lengths.axes_fault(matrix):
        raise InputError(f"{path}: {name}: expected an image with square axes, found {found}")
    across, down = (matrix[:3, :2] / scale).T
    pose = rigid.nearest(rigid.transform(np.column_stack([across, down, np.cross(across, down)]), matrix[:3, 3]))
    most_off_deg = 0.1  # of an image's axes, before it is said
    if (off := np.degrees(abs(np.arcsin(across @ down)))) > most_off_deg:
        log.warning(
            "%s: %s: axes are %.1f degrees off a right angle, and are taken as square; `config` keeps them", path, name, off
        )
    if speed_m_s is None:
        speed_m_s = _scanners_speed(path, f"{AS_NPZ} speed_m_s")
    way = f"multiply its first three rows by the mm of its unit or, if it is right, {AS_NPZ} {UNIT_KEY}=1"
    return _checked(path, name, ProbeCalibration(pose, scale, None, speed_m_s, 0.0), None, way)


def write(path: Path, calibration: ProbeCalibration) -> None:
    """Write sonotwin's own format, whole or not at all. The suffix should be `.yaml`."""
    storage = cv2.FileStorage(".yaml", cv2.FileStorage_WRITE | cv2.FileStorage_MEMORY)
    storage.write("schema", SCHEMA)
    storage.write("target_from_image", calibration.target_from_image)
    storage.write("scale", np.asarray(calibration.scale, float).reshape(1, 2))
    storage.write("speed_m_s", float(calibration.speed_m_s))
    storage.write("face_row", float(calibration.face_row))
    if _states_unit(calibration):
        storage.write(UNIT_KEY, 1.0)
    if calibration.uncertainty is not None:
        opencv_storage.write_covariance(storage, calibration.uncertainty.names, calibration.uncertainty.covariance)
    opencv_storage.save(path, storage)


def write_authors(path: Path, calibration: ProbeCalibration) -> None:
    """Write the rig authors' `US_params.npz`, whole or not at all, with the speed of sound; it has no room for uncertainty."""
    sx, sy = calibration.scale
    with atomic.new_file(path) as temporary, temporary.open("wb") as file:
        beside = {"face_row": calibration.face_row} if calibration.face_row else {}
        beside |= {UNIT_KEY: 1.0} if _states_unit(calibration) else {}
        np.savez(file, sx=sx, sy=sy, T_I_T=calibration.target_from_image, speed_m_s=calibration.speed_m_s, **beside)


def _authors(path: Path, speed_m_s: float | None) -> ProbeCalibration:
    number, optional = npz.Form("fiu"), npz.Form("fiu", optional=True)
    forms = {
        "sx": number,
        "sy": number,
        "T_I_T": npz.Form("fiu", (4, 4)),
        "speed_m_s": optional,
        "face_row": optional,
        UNIT_KEY: optional,
    }
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
        speed_m_s = _scanners_speed(path, "import it with speed_m_s=..., or add speed_m_s to it")
    face_row = float(values["face_row"].item()) if "face_row" in values else 0.0
    read = ProbeCalibration(pose, scale, None, speed_m_s, face_row)
    return _checked(path, "T_I_T", read, values.get(UNIT_KEY))


def _scanners_speed(path: Path, way: str) -> float:
    """The speed of sound, m/s, that scanners assume, for a file that names none; with a warning."""
    text = "%s: names no speed of sound, and is taken as right where it makes %g m/s; if it was made in water, %s"
    log.warning(text, path, SCANNER_SPEED, way)
    return SCANNER_SPEED


def _own(path: Path, values: Values) -> ProbeCalibration:
    if values.get("schema") != SCHEMA:
        found = short(values["schema"]) if isinstance(values.get("schema"), str) else "none"
        raise InputError(f"{path}: schema: expected {SCHEMA}, found {found}")
    pose = opencv_storage.matrix(path, "target_from_image", values.get("target_from_image"))
    scale = opencv_storage.matrix(path, "scale", values.get("scale")).ravel()
    face_row = values.get("face_row", 0.0)
    face_row = float(face_row) if isinstance(face_row, int | float) else np.nan
    read = ProbeCalibration(pose, scale, _uncertainty(path, values), _speed(path, values), face_row)
    return _checked(path, "target_from_image", read, values.get(UNIT_KEY))


def _checked(path: Path, name: str, read: ProbeCalibration, stated: object, way: str = lengths.SAID) -> ProbeCalibration:
    scale = read.scale
    if found := rigid.fault(read.target_from_image):
        raise InputError(f"{path}: {name}: expected {rigid.RIGID}, in mm, found {found}")
    if scale.shape != (2,) or not np.isfinite(scale).all() or scale.min() <= 0:
        raise InputError(f"{path}: scale: expected sx and sy above zero in mm/px, found {scale.tolist()}")
    most_rows = 1e5  # of a scanner's image
    if not abs(read.face_row) < most_rows:
        raise InputError(f"{path}: face_row: expected a row of an image, found {read.face_row:g}")
    if stated is not None:
        return _in_mm(path, read, lengths.unit_of(path, stated))
    if found := _unusual(read, name):
        raise InputError(f"{path}: {found} {way}")
    if doubt := lengths.BRACKET.doubt(lengths.shift(read.target_from_image[:3, 3])):
        log.warning("%s: %s: the image's corner lies from the target by %s %s", path, name, doubt, way)
    return read


def _states_unit(probe: ProbeCalibration) -> bool:
    """Whether a file had better state its unit."""
    return _unusual(probe) is not None or lengths.BRACKET.is_unusual(lengths.shift(probe.target_from_image[:3, 3]))


def _unusual(probe: ProbeCalibration, name: str = "target_from_image") -> str | None:
    """The fault of lengths that no probe has; None as a rule."""
    for axis, size in zip(("sx", "sy"), np.ravel(probe.scale).tolist(), strict=True):
        if found := lengths.PIXEL.fault(size):
            return f"{axis}: expected {lengths.PIXEL} a pixel, found {found}"
    found = lengths.BRACKET.fault(lengths.shift(probe.target_from_image[:3, 3]))
    return found and f"{name}: expected {lengths.BRACKET} from the target to the image's corner, found {found}"


def _in_mm(path: Path, read: ProbeCalibration, unit: float) -> ProbeCalibration:
    if unit != 1 and read.uncertainty is not None:
        raise InputError(f"{path}: {UNIT_KEY}: expected 1 with a covariance, which is in mm, found {unit:g}")
    pose = rigid.transform(read.target_from_image[:3, :3], unit * read.target_from_image[:3, 3])
    return replace(read, target_from_image=pose, scale=unit * read.scale)


def _speed(path: Path, values: Values) -> float:
    value = values.get("speed_m_s", SCANNER_SPEED)
    if not isinstance(value, int | float):
        raise InputError(f"{path}: speed_m_s: expected a number, of m/s, found {brief(value)}")
    return _within_speeds(path, float(value))


def _within_speeds(path: Path, value: float) -> float:
    if fault := speed_fault(value):
        raise InputError(f"{path}: speed_m_s: {fault}")
    return value


def _uncertainty(path: Path, values: Values) -> Uncertainty | None:
    names = opencv_storage.names(values)
    if names is None:
        return None
    if not names or len(set(names)) < len(names) or not set(names) <= set(PARAMETERS):
        raise InputError(f"{path}: parameters: expected some of {' '.join(PARAMETERS)}, each once, found something else")
    return Uncertainty(names, opencv_storage.covariance(path, values, len(names)))
