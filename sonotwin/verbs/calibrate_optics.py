"""Calibrate cameras and projector, all at once, from images of a board in many poses.

Reads the board part of a capture folder: in each pose the lit board and, for the projector, a fringe sequence along both axes,
whose mean serves where there is no lit image. One camera alone, with or without a projector, is calibrated as well.
Writes into the folder `out`: optics.yaml (with the covariance); the same in the rig authors' layout, cam1_proj_params.npz,
cam1_cam2_params.npz and StereoParams.xml; metrics.json; and calibration.html (open it in a browser; it needs no network). A
calibration that is there already is replaced. Takes some seconds a pose, and about a minute for the adjustment. Before
fringes are refused, other patterns are tried on three poses.

    sonotwin calibrate-optics capture=outputs/board/capture out=outputs/board/calibration
    sonotwin calibrate-optics capture=outputs/board/capture truth=outputs/board/truth out=outputs/board/calibration
    sonotwin calibrate-optics capture=board/capture devices=[cam1,projector] out=board/calibration
    sonotwin calibrate-optics capture=board/capture devices=[cam1] out=board/camera
"""

import shlex
from pathlib import Path

from recon.session import optics_step
from sonotwin import command_line
from sonotwin.console_watch import ConsoleWatch


class Config(optics_step.Settings):
    """Fields of `sonotwin calibrate-optics`: sources, target, and settings of the calibration."""

    out: Path
    """folder; gets optics.yaml, the rig authors' files, metrics.json, calibration.html"""


def run(config: Config) -> None:
    """Find the board in all poses, adjust, judge and write; raises InputError as `recon.session.optics_step.run`."""
    optics_step.run(config, config.out, command(config), ConsoleWatch())


def command(config: Config) -> str:
    """The command line that gives these settings."""
    return shlex.join(["sonotwin", *command_line.words("calibrate-optics", config)])
