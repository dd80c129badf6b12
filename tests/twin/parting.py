"""How far a calibration parts what light measures from what both cameras do."""

from pathlib import Path

import numpy as np

from recon.capture import calibration_files
from recon.optical_calibration.uncertainty import working_volume
from recon.rig_check.optics_equations import points_by_light
from recon.tracking.pose_fit import meet


def parted_mm(file: Path, truth: Path) -> float:
    """Mean distance of what light measures from the same by both cameras, at places that all devices see, by a calibration."""
    known, true = calibration_files.read(file).cameras, calibration_files.read(truth / "calibration/optics.yaml")
    places = working_volume(true, [650.0, 680.0])
    seen = {name: camera.project(places) for name, camera in true.cameras.items()}
    by_light = points_by_light(seen["cam1"], seen["projector"], (0, 1), known)
    by_both = meet([known[name] for name in ("cam1", "cam2")], [seen[name] for name in ("cam1", "cam2")])[0]
    return float(np.linalg.norm((by_light - by_both).mean(axis=0)))
