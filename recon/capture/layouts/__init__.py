"""Folders of other groups' captures. Each module is a layout, by the name that `sonotwin import layout=NAME` has.

A module has `TAKES`, names of the fields that it takes of `Known`, beyond which none may be given; and `read_capture(folder,
known)`: reads and checks what is there, and returns a function that writes it with a `CaptureWriter` and returns lines about it;
InputError before anything is written. `known` is a `Known`.
"""

from dataclasses import dataclass

from recon.capture.images import Size
from recon.capture.manifest import Purpose

STILLS_HZ = 1.0  # frames/s; taken for stills, each by a press of a key, so that nothing is interpolated between them


@dataclass(frozen=True)
class Known:
    """What such folders don't say, from the command line."""

    camera_hz: float | None  # frames/s, of frames without time stamps; None where none is given
    purpose: Purpose | None  # of the sweep; None where none is given
    projector_size: Size  # px
    speed_m_s: float | None  # of sound for which the probe's calibration is right; None where none is given
