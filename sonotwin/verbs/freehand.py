"""Put the B-scans of a freehand sweep into a volume.

Reads the sweep part of a capture folder, with the probe's calibration and the lag between scanner and tracker; or a tracked
sequence of the PLUS toolkit, reconstructed by the fields below and, where they aren't given, by its own configuration. Writes
into the folder `out`: volume.nrrd (in the world's frame, mm); of a capture also sigma.nrrd, the standard deviation of the place,
mm, of what each voxel shows, and sequence.igs.mha, the B-scans with their poses for PLUS and 3D Slicer; and metrics.json. Depths
are as of the speed of sound that the probe's calibration holds for, unless tissue_m_s is given. Results that are there already
are replaced. Takes a second for a hundred B-scans, and some seconds more when it first compiles.

    sonotwin freehand capture=outputs/sweep/capture probe=outputs/probe/probe.yaml lag_s=0.0503 out=outputs/volume
    sonotwin freehand capture=outputs/sweep/capture tissue_m_s=1450 spacing_mm=0.3 compounding=maximum out=outputs/volume
    sonotwin freehand sequence=sweep.igs.mha config=config.xml arithmetic=floating out=outputs/volume
    sonotwin freehand sequence=sweep.igs.mha probe=outputs/probe/probe.yaml reference=Tracker lag_s=0.0503 out=outputs/volume
    sonotwin freehand sequence=abdomen.igs.mha fan=find out=outputs/volume
"""

from pathlib import Path

from recon.session import volume_step
from sonotwin.console_watch import ConsoleWatch


class Config(volume_step.Settings):
    """Fields of `sonotwin freehand`: sources, target, and settings of the volume."""

    out: Path
    """folder; gets volume.nrrd, sigma.nrrd and sequence.igs.mha (of a capture), metrics.json"""


def run(config: Config) -> None:
    """Read, paste, fill and write; raises InputError as `recon.session.volume_step.run`."""
    volume_step.run(config, config.out, ConsoleWatch())
