"""Correct a calibration for what cameras and projector drifted since, by what a session's own images show.

Reads a capture folder with any of two parts, and the calibration in use, by default the capture's own: a fringe sequence of skin,
or of anything smooth, taken by both cameras; and frames in which both see the probe's target. Further captures, of a certified
ball bar under fringes and a code before camera 1, give the scale. Writes into the folder `out`: optics.yaml, the calibration as
it is now, with its covariance, for all other commands; drift.html, what drifted and what it would have cost; metrics.json.
Refuses what is no drift, such as a camera that was pushed. Takes some seconds.

    sonotwin correct-optics capture=outputs/demo/capture calibration=outputs/demo/result/optics/optics.yaml out=outputs/drift
    sonotwin correct-optics capture=outputs/demo/capture bars=[outputs/bar/capture] bar_mm=[150.0,0.002] out=outputs/drift
    sonotwin surface capture=outputs/demo/capture calibration=outputs/drift/optics.yaml out=outputs/surface
"""

from pathlib import Path

from recon.session import drift_step
from sonotwin.console_watch import ConsoleWatch


class Config(drift_step.Settings):
    """Fields of `sonotwin correct-optics`."""

    out: Path
    """folder; gets optics.yaml, drift.html, metrics.json"""


def run(config: Config) -> None:
    """Match, estimate and write.

    Raises InputError as `recon.session.drift_step.run`.
    """
    drift_step.run(config, config.out, ConsoleWatch())
