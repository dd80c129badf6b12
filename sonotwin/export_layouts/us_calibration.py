"""Sets for US-Calibration, the rig authors' program for the probe: a capture's sweep over crossed wires each."""

from pathlib import Path

import numpy as np

from recon.capture import calibration_files
from recon.capture.images import Size
from recon.capture.layouts import meza2021, us_calibration
from recon.errors import InputError
from recon.model.calibration import Calibration
from recon.session import probe_step
from sonotwin import exported_scans
from sonotwin.export_layouts import Settings

TAKES = ("capture", "calibration", "sweep", "implausible", "lag_s", "frames", "apart_s")
ABOUT = "of crossed wires alone"


def write(folder: Path, settings: Settings) -> list[str]:
    """Write a set of each capture, with the crossings that are found, and the cameras' file for all of them.

    Raises
    ------
    InputError
        If no capture is given, a set has no B-scan with a pose, or sizes or cameras differ between captures.
    """
    if not settings.capture:
        raise InputError("export: capture: needs a value; give capture=...")
    optics, lines = _cameras(settings), []
    sizes: list[Size] = []
    for number, capture in enumerate(settings.capture, 1):
        selected, about = exported_scans.read(settings, capture, "probe")
        sweep = selected.sweep
        sizes.append(sweep.size)
        if sweep.size != sizes[0]:
            expected, found = ("x".join(map(str, each)) for each in (sizes[0], sweep.size))
            raise InputError(f"{capture}: expected B-scans of {expected} px, as of {settings.capture[0]}, found {found}")
        frames = probe_step.look(sweep, lag_s=settings.lag_s)
        crossed = np.isin(selected.scans, frames.usable)
        crossings, said = None, "none with a crossing: PointSegment.py sets it"
        if crossed.any():
            selected, said = selected.chosen(crossed), f"{crossed.sum()} with a crossing, which alone count"
            crossings = np.array([frames.seen[k].pixel for k in selected.scans.tolist()])
        name = us_calibration.write_set(folder, number, selected.images(), selected.poses, crossings)
        lines += [f"{name:11} {about[0]}; {said}", *about[1:]]
    return [*lines, f"beside      {', '.join(us_calibration.write_settings(folder, sizes[0], optics))}"]


def _cameras(settings: Settings) -> Calibration | None:
    """The calibration of all captures, whose one file goes with all sets; InputError if they have different ones."""
    first, *others = settings.capture
    optics = calibration_files.of_capture(first, settings.calibration)
    for capture in others if settings.calibration is None else ():
        other = calibration_files.of_capture(capture)
        if (optics is None) != (other is None) or (optics and other and not _alike(optics, other)):
            raise InputError(
                f"{capture}: expected the cameras' calibration of {first}, as one file goes with all sets, found another; "
                "export them apart, or give the one that holds for all: calibration=FILE"
            )
    return optics


def _alike(one: Calibration, other: Calibration) -> bool:
    """Whether cameras have the same parameters, but for the rounding of files."""
    if not {"cam1", "cam2"} <= one.cameras.keys() & other.cameras.keys():
        return "cam2" not in one.cameras and "cam2" not in other.cameras
    first, second = (meza2021.parameters(each, "cam2") for each in (one, other))
    sizes = [[each.cameras[name].size for name in ("cam1", "cam2")] for each in (one, other)]
    same = [first[name].shape == second[name].shape and np.allclose(first[name], second[name]) for name in first]
    return sizes[0] == sizes[1] and all(same)
