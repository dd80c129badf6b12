"""Checks of the probe's calibration, whatever file it is from: a rigid transform, lengths that a probe has, speed of sound."""

import logging
from dataclasses import replace
from pathlib import Path

import numpy as np

from recon.errors import InputError
from recon.geometry import rigid
from recon.geometry.rigid import Array
from recon.model import lengths
from recon.model.lengths import UNIT_KEY
from recon.model.probe import SCANNER_SPEED, ProbeCalibration, speed_fault

log = logging.getLogger(__name__)

AUTHORS = "US_params.npz"
AS_NPZ = f"give it as {AUTHORS} with sx, sy, T_I_T and"  # a plain matrix, for what there is no place in it
MOST_ROWS = 1e5  # of a scanner's image
RIGID_SCALE = 1e-6  # by which the axes of a rigid transform are off a length of 1
MOST_OFF_DEG = 0.1  # of an image's axes, before it is said


def of_matrix(path: Path, name: str, matrix: Array, speed_m_s: float | None) -> ProbeCalibration:
    """The calibration by a matrix from pixels to mm."""
    scale = np.linalg.norm(matrix[:3, :2], axis=0)
    if not np.isfinite(matrix).all() or np.abs(matrix[3] - [0, 0, 0, 1]).max() > rigid.EXACT or scale.min() == 0:
        raise InputError(
            f"{path}: {name}: expected 4x4 finite numbers with a last row of 0 0 0 1, from pixels to mm, found others"
        )
    if np.abs(scale - 1).max() < RIGID_SCALE:
        expected = "first columns as long as the mm of a pixel"
        raise InputError(f"{path}: {name}: expected {expected}, found a rigid transform: multiply them by sx and sy in mm/px")
    if found := lengths.axes_fault(matrix):
        raise InputError(f"{path}: {name}: expected an image with square axes, found {found}")
    across, down = (matrix[:3, :2] / scale).T
    pose = rigid.nearest(rigid.transform(np.column_stack([across, down, np.cross(across, down)]), matrix[:3, 3]))
    if (off := np.degrees(abs(np.arcsin(across @ down)))) > MOST_OFF_DEG:
        log.warning(
            "%s: %s: axes are %.1f degrees off a right angle, and are taken as square; `config` keeps them", path, name, off
        )
    if speed_m_s is None:
        speed_m_s = scanners_speed(path, f"{AS_NPZ} speed_m_s")
    way = f"multiply its first three rows by the mm of its unit or, if it is right, {AS_NPZ} {UNIT_KEY}=1"
    return checked(path, name, ProbeCalibration(pose, scale, None, speed_m_s, 0.0), None, way)


def scanners_speed(path: Path, way: str) -> float:
    """The speed of sound, m/s, that scanners assume, for a file that names none; with a warning."""
    text = "%s: names no speed of sound, and is taken as right where it makes %g m/s; if it was made in water, %s"
    log.warning(text, path, SCANNER_SPEED, way)
    return SCANNER_SPEED


def checked(path: Path, name: str, read: ProbeCalibration, stated: object, way: str = lengths.SAID) -> ProbeCalibration:
    """A calibration as it was read, in mm; InputError by its first value that no probe has.

    stated : the unit of its lengths, as the file states it; None where it does not
    way : past a refusal
    """
    scale = read.scale
    if found := rigid.fault(read.target_from_image):
        raise InputError(f"{path}: {name}: expected {rigid.RIGID}, in mm, found {found}")
    if scale.shape != (2,) or not np.isfinite(scale).all() or scale.min() <= 0:
        raise InputError(f"{path}: scale: expected sx and sy above zero in mm/px, found {scale.tolist()}")
    if not abs(read.face_row) < MOST_ROWS:
        raise InputError(f"{path}: face_row: expected a row of an image, found {read.face_row:g}")
    if stated is not None:
        return _in_mm(path, read, lengths.unit_of(path, stated))
    if found := _unusual(read, name):
        raise InputError(f"{path}: {found} {way}")
    if doubt := lengths.BRACKET.doubt(lengths.shift(read.target_from_image[:3, 3])):
        log.warning("%s: %s: the image's corner lies from the target by %s %s", path, name, doubt, way)
    return read


def states_unit(probe: ProbeCalibration) -> bool:
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


def within_speeds(path: Path, value: float) -> float:
    """A speed of sound; InputError if no tissue or water has it."""
    if fault := speed_fault(value):
        raise InputError(f"{path}: speed_m_s: {fault}")
    return value
