"""Put skin, masses, B-scans, the probe's path and the devices into one picture, in the frame that they share.

Reads a capture's sweep with poses, as `sonotwin track` leaves it, with the probe's calibration and the lag; the skin of
`sonotwin surface`; the masses of `sonotwin segment`, and the volume of `sonotwin freehand`, as far as each is given. The skin is
parted from the table by a mask, or by the plane that it stands on. Writes into `out`: scene.html, a page with all in a view that
one can turn, and a slider along the sweep; scene.glb (metres, y up, as glTF has it) with the layers skin, table, mass0 ...,
scan0000 ... (some B-scans where they were taken), path, probe, circles, cam1, cam2 and projector, for any glTF viewer; slicer/, a
folder for 3D Slicer; and metrics.json. Nothing is registered: all of it is measured in the frame of camera 1. Takes some seconds.

    sonotwin fuse capture=result/poses/scan probe=result/probe/probe.yaml lag_s=0.05 surface=result/surface/surface.ply out=scene
    sonotwin fuse capture=result/poses/scan masses=result/masses/scan volume=result/volume/scan lag_s=0.05 out=scene
"""

from pathlib import Path

from recon.session import scene_step
from sonotwin.console_watch import ConsoleWatch


class Config(scene_step.Settings):
    """Fields of `sonotwin fuse`."""

    out: Path
    """folder; gets scene.html, scene.glb, slicer/, metrics.json"""


def run(config: Config) -> None:
    """Read what is given, and write the page, the layers and the folder; raises InputError as `recon.session.scene_step.run`."""
    scene_step.run(config, config.out, ConsoleWatch())
