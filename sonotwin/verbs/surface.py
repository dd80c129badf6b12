"""Reconstruct the surface in the common view of a camera and the projector.

Reads a capture folder, whether devices or the twin wrote it, or a bare folder of images with its patterns and calibration.
Writes surface.ply (mm, with the surface's grey), surface.glb (metres, y up), points.npz (the point of every pixel, with its
predicted sigma) and metrics.json into the folder `out`; results that are there already are replaced. Takes three seconds for
nine images of 1280x1024 and some seconds to start; the first run ever also compiles, for about a minute. Patterns are fringes
with what numbers them, or Gray code alone, by which points are known to a projector pixel. If other cameras of the
capture took the sequence as well, the share of the points that they see alike is said.

    sonotwin surface capture=outputs/demo/capture out=outputs/demo/surface
    sonotwin surface capture=shots calibration=calibration/optics.yaml out=outputs/shots
    sonotwin surface images=shots patterns=paper_surface calibration=optics.yaml out=outputs/shots
"""

from pathlib import Path

from recon.session import skin_step
from sonotwin.console_watch import ConsoleWatch


class Config(skin_step.Settings):
    """Fields of `sonotwin surface`: sources, target, and limits of the surface."""

    out: Path
    """folder; gets surface.ply, surface.glb, points.npz, metrics.json"""


def run(config: Config) -> None:
    """Read, decode, triangulate, clean, mesh and write; raises InputError as `recon.session.skin_step.run`."""
    skin_step.run(config, config.out, ConsoleWatch())
