"""Measure the rig's parameters from its own captures, from sensors to the hand, each with its uncertainty and source.

Reads a capture folder with a board of discs, a surface under fringes, or both; and, if given, folders of images with covered
lenses (`dark`), of an even light (`flat`) and of the scene with the projector covered (`room`). Films of the capture, named by
`still` and `hand`, show the tracker's noise and drop-outs, a hand's tremor and the jitter of triggers; calibrations of the probe
before and after a session (`probes`) show how far its bracket gives. Writes into the folder `out`:
rig.yaml, for `rig=FILE` of any verb, which says of each number how well it is known or why it isn't; conditions.yaml, for
`conditions=FILE`; and identified.json. What is there already is replaced. Takes some ten seconds for a surface, for a
board as `sonotwin calibrate-optics` does, and for films as `sonotwin track`.

    sonotwin render scene=sphere patterns=gray_surface out=outputs/sphere
    sonotwin identify capture=outputs/sphere/capture out=outputs/ours
    sonotwin film name=held frames=120 path.seconds=12 out=outputs/held
    sonotwin identify capture=outputs/held/capture 'hand=[held]' out=outputs/hand
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
