"""Measure the lag of the scanner's images behind the poses of the tracker.

Reads the sweep part of a capture folder, or a tracked sequence of the PLUS toolkit: the probe moved up and down over a flat
bottom in water, by 10 mm or more, three times or more, at an uneven pace. Writes into the folder `out`: lag.json, with lag_s for
the other commands; depths.csv, the bottom's depth in each B-scan; and metrics.json. Results that are there already are replaced.
Takes seconds.

    sonotwin measure-lag capture=outputs/bottom/capture out=outputs/lag
    sonotwin measure-lag sequence=bottom.igs.mha reference=Tracker clip=[120,80,400,500] out=outputs/lag
    sonotwin freehand capture=outputs/sweep/capture lag_s=0.0503 out=outputs/volume
"""

from pathlib import Path

from recon.session import latency_step
from sonotwin.console_watch import ConsoleWatch


class Config(latency_step.Settings):
    """Fields of `sonotwin measure-lag`."""

    out: Path
    """folder; gets lag.json, depths.csv, metrics.json"""


def run(config: Config) -> None:
    """Find the bottom in all B-scans, compare its depth with the probe's height, and write.

    Raises InputError as `recon.session.latency_step.run`.
    """
    latency_step.run(config, config.out, ConsoleWatch())
