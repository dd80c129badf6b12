"""The rig authors' `US_params.npz`, with sx, sy and T_I_T, which is `target_from_image`.

Ours have `speed_m_s`, and `face_row` if it isn't 0, beside these, which their programs leave alone; for theirs a caller gives the
speed, or 1540 m/s is taken, with a warning. A rotation that is off by up to 2 % is taken as the nearest one, and a negative scale
as the same map with that axis turned round.
"""

import logging
from pathlib import Path

import numpy as np

from recon.capture import meza2021_sweep
from recon.capture.probe_values import checked, scanners_speed, states_unit, within_speeds
from recon.errors import InputError
from recon.files import atomic, npz
from recon.files.regular import read_bytes
from recon.model.lengths import UNIT_KEY
from recon.model.probe import ProbeCalibration

log = logging.getLogger(__name__)


def recognises(path: Path) -> bool:
    """Whether it is an npz file, a zip file."""
    return read_bytes(path, expected="a probe's calibration").startswith(b"PK")


def read(path: Path, speed_m_s: float | None = None) -> ProbeCalibration:
    """Read it, with a speed of sound for a file that names none."""
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
        speed_m_s = within_speeds(path, float(values["speed_m_s"].item()))
    elif speed_m_s is None:
        speed_m_s = scanners_speed(path, "import it with speed_m_s=..., or add speed_m_s to it")
    face_row = float(values["face_row"].item()) if "face_row" in values else 0.0
    read = ProbeCalibration(pose, scale, None, speed_m_s, face_row)
    return checked(path, "T_I_T", read, values.get(UNIT_KEY))


def write(path: Path, calibration: ProbeCalibration) -> None:
    """Write the rig authors' `US_params.npz`, whole or not at all, with the speed of sound; it has no room for uncertainty."""
    sx, sy = calibration.scale
    with atomic.new_file(path) as temporary, temporary.open("wb") as file:
        beside = {"face_row": calibration.face_row} if calibration.face_row else {}
        beside |= {UNIT_KEY: 1.0} if states_unit(calibration) else {}
        np.savez(file, sx=sx, sy=sy, T_I_T=calibration.target_from_image, speed_m_s=calibration.speed_m_s, **beside)
