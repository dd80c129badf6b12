"""Measure the rig's parameters from its own captures: sensors, lenses, projector, optics, each with its uncertainty and source.

Reads a capture folder with a board of discs, a surface under fringes, or both; and, if given, folders of images with covered
lenses (`dark`), of an even light (`flat`) and of the scene with the projector covered (`room`). Writes into the folder `out`:
rig.yaml, for `rig=FILE` of any verb, which says of each number how well it is known or why it isn't; conditions.yaml, for
`conditions=FILE`; and identified.json. What is there already is replaced. Takes some ten seconds for a surface, and for a
board as `sonotwin calibrate-optics` does.

    sonotwin render scene=sphere patterns=gray_surface out=outputs/sphere
    sonotwin identify capture=outputs/sphere/capture out=outputs/ours
"""

from pathlib import Path

from recon.session import rig_step
from sonotwin.console_watch import ConsoleWatch


class Config(rig_step.Settings):
    """Fields of `sonotwin identify`."""

    out: Path
    """folder: gets rig.yaml, conditions.yaml, identified.json"""


def run(config: Config) -> None:
    """Read, identify and write; raises InputError as `recon.session.rig_step.run`."""
    rig_step.run(config, config.out, ConsoleWatch())
