"""Folders of other groups' captures. Each module is a layout, by the name that `sonotwin import layout=NAME` has.

A module has `read_capture(folder, known)`: reads and checks what is there, and returns a function that
writes it with a `CaptureWriter` and returns lines about it; InputError before anything is written. `known` is a `Known`.
"""

from dataclasses import dataclass

from recon.capture.images import Size
from recon.capture.manifest import Purpose


@dataclass(frozen=True)
class Known:
    """What such folders don't say, from the command line."""

    camera_hz: float  # frames/s, of frames without time stamps
    purpose: Purpose  # of the sweep
    projector_size: Size  # px
    speed_m_s: float | None  # of sound for which the probe's calibration is right; None where none is given
