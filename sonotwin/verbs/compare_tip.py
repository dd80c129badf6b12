"""Compare a needle's tip in B-scans with the tip that tracking predicts there: a check of tracker, tip and probe together.

Reads a capture folder with a sweep of B-scans and the poses of the probe and the needle, as `sonotwin track` hands it on, or a
sequence of the PLUS toolkit; the needle's tip.yaml; and the probe's calibration. Lead the needle's tip in the image's plane, in a
water bath or a phantom, to many places, probe and needle turned about. Prints the distance of both tips in the plane, its
systematic part with sigma, as a shift in the image and of the tool's tip, and whether it is within what poses and calibrations
are known to; if not, the likely cause: a tip that lies elsewhere in the tool's frame, a probe that moved, another speed of sound,
or a lag. How far the tip lies out of the plane isn't seen in a B-scan. Writes into the folder `out`: frames.csv, a row a B-scan;
and metrics.json. What is there already is replaced. Exit status 1 if the tip isn't where tracking has it, or scatters too much to
tell. Takes seconds.

    sonotwin compare-tip capture=outputs/track tip=outputs/tip/tip.yaml tissue_m_s=1488 out=outputs/compared
    sonotwin compare-tip sequence=needle.igs.mha reference=Needle tip=tip.yaml probe=probe.yaml out=outputs/compared
"""

from pathlib import Path

from recon.session import tip_comparison_step
from sonotwin.console_watch import ConsoleWatch


class Config(tip_comparison_step.Settings):
    """Fields of `sonotwin compare-tip`."""

    out: Path
    """folder; gets frames.csv and metrics.json"""


def run(config: Config) -> int:
    """Find the tip in all B-scans, compare, and write; as `recon.session.tip_comparison_step.run`."""
    return tip_comparison_step.run(config, config.out, ConsoleWatch())
