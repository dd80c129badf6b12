"""Find masses, or a tube, in the B-scans of a freehand sweep, as closed surfaces in the world.

Reads the sweep part of a capture folder, with the probe's calibration and the lag between scanner and tracker, or a tracked
sequence of the PLUS toolkit; and the skin as of `sonotwin surface`, a PLY, to check that masses lie inside, or to fit the round
body about a tube, with the wall between both. Writes into the folder `out`: mass0.ply, mass1.ply ... from the largest on, or
tube.ply and cover.ply, in the world's frame, mm; the same as .glb; some B-scans with the outline, overlay0.png ...;
left_out.json, which lists what isn't measured, with place, size and reason; seen.nrrd, the probability that a mass would have
been found there, with seen.json and unseen.ply; and metrics.json. Results that are there already are replaced. Takes a quarter of
a minute for 150 B-scans, a tube some seconds.

    sonotwin segment capture=outputs/sweep/capture lag_s=0.05 tissue_m_s=1450 out=outputs/masses
    sonotwin segment capture=outputs/sweep/capture lag_s=0.05 surface=outputs/surface/surface.ply out=outputs/masses
    sonotwin segment sequence=sweep.igs.mha config=config.xml clip=[120,80,400,500] slice_mm=null out=outputs/masses
    sonotwin segment kind=tube capture=outputs/tank/capture probe=outputs/probe/probe.yaml lag_s=0.05 out=outputs/tube
"""

from pathlib import Path

from recon.session import masses_step
from sonotwin.console_watch import ConsoleWatch


class Config(masses_step.Settings):
    """Fields of `sonotwin segment`."""

    out: Path
    """folder; gets mass0.ply ... or tube.ply and cover.ply, the same as .glb, overlays of some B-scans, metrics.json"""


def run(config: Config) -> None:
    """Read, segment and write; raises InputError as `recon.session.masses_step.run`."""
    masses_step.run(config, config.out, ConsoleWatch())
