"""Track the targets of probe and other bodies through the frames of two cameras.

Reads a capture folder with frames of both cameras (sweep/cam1, sweep/cam2) and their calibration; frames are paired by their time
stamps. Writes into the folder `out`: poses.csv, the probe's poses with their covariance in the layout that all verbs read;
frames.csv, the way in which each pose was found, or the reason why not; overlays/, both views side by side with the rims found;
metrics.json; and of further bodies in rig.bodies the same tables, in bodies/NAME. A second body of a design in view is a warning.
With a body `patient` all other poses are told as if the patient stood where it stood when the skin was measured.
Exit status 1 if no pair shows a body besides the patient.
Frames are read one after the other, so a film may be of any length. Results that are there already are replaced. Takes some
seconds, the first time a minute to compile, and 20 to 60 frames a second from then on.

If the capture has B-scans too (sweep/us), `out` becomes a capture itself, those images with these poses, and the verbs that need
poses are given it instead:

    sonotwin film out=outputs/film
    sonotwin track capture=outputs/film/capture out=outputs/track
    sonotwin track capture=recorded calibration=calibration/optics.yaml out=tracked
    sonotwin track capture=recorded target=target/target.yaml out=tracked
    sonotwin track capture=recorded rig=three_bodies measured.needle=needle/target.yaml out=tracked
    sonotwin freehand capture=tracked probe=probe.yaml lag_s=0.05 out=volume
"""

from pathlib import Path

from recon.model.rig import PATIENT
from recon.session import poses_step
from sonotwin.console_watch import ConsoleWatch


class Config(poses_step.Settings):
    """Fields of `sonotwin track`."""

    out: Path
    """folder: gets poses.csv, frames.csv, overlays/, metrics.json; bodies/ of others; manifest.json, if there are B-scans"""


def run(config: Config) -> int:
    """Read, track and write, as `recon.session.poses_step.run`; returns 1 if no pair shows a body besides the patient."""
    steps = poses_step.run(config, config.out, ConsoleWatch())
    return int(not any(step.found for name, own in steps.items() if name != PATIENT for step in own))
