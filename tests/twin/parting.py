"""How far a calibration parts what light measures from what both cameras do."""

from pathlib import Path

import numpy as np

from recon.capture import calibration_files
from recon.optical_calibration.uncertainty import working_volume
from recon.rig_check import drift


def parted_mm(file: Path, truth: Path) -> float:
    """Mean distance of what light measures from the same by both cameras, at places that all devices see, by a calibration."""
    known, true = calibration_files.read(file).cameras, calibration_files.read(truth / "calibration/optics.yaml")
    places = working_volume(true, [650.0, 680.0])
    return float(np.linalg.norm(drift.parting(known, true.cameras, places, (0, 1)).mean(axis=0)))
