"""Measure the rig's parameters from its own captures, from sensors to scanner and hand, each with its uncertainty and source.

Reads a capture folder with a board of discs, a surface under fringes, or both; and, if given, folders of images with covered
lenses (`dark`), of an even light (`flat`) and of the scene with the projector covered (`room`). Films of the capture, named by
`still` and `hand`, show the tracker's noise and drop-outs, a hand's tremor and the jitter of triggers; calibrations of the
probe before and after a session (`probes`) show how far its bracket gives. Writes into the folder `out`: rig.yaml, for
`rig=FILE` of any verb, which says of each number how well it is known or why it isn't; conditions.yaml, for `conditions=FILE`;
and identified.json. What is there already is replaced. Give `rig`, `conditions` and `ultrasound` of an earlier run, and another
`out`, and the new files keep what isn't measured again. Takes some ten seconds for a surface, and for
a board as `sonotwin calibrate-optics` does, for films as `sonotwin track`.

With B-scans of even tissue (`tissue`), of the probe in air (`air`) and from a probe on a slide (`steps`) it also measures the
scanner, in some seconds, and writes ultrasound.yaml, for `ultrasound=FILE` of any verb. They are sweeps of the capture, by their
names, or folders of images, of one setting. Linear arrays that show raw speckle: no compounding, no smoothing, a linear grey map.

    sonotwin render scene=sphere patterns=gray_surface out=outputs/sphere
    sonotwin identify capture=outputs/sphere/capture out=outputs/ours
    sonotwin film name=held frames=120 path.seconds=12 out=outputs/held
    sonotwin identify capture=outputs/held/capture 'hand=[held]' out=outputs/hand
    sonotwin identify capture=phantom/capture tissue=tissue air=air attenuation_db_per_cm_mhz=0.5 echo_db=0 out=outputs/ours
"""

from pathlib import Path
from typing import Annotated

from recon.registry import Choice
from recon.session import rig_step
from sonotwin.console_watch import ConsoleWatch
from twin.conditions import Conditions
from twin.ultrasound.transducer import Transducer


class Config(rig_step.Settings):
    """Fields of `sonotwin identify`."""

    conditions: Annotated[Conditions, Choice("ideal")]
    """the conditions to begin with, such as an earlier conditions.yaml: what isn't measured stays as they have it"""
    ultrasound: Annotated[Transducer, Choice("linear")]
    """the scanner's description to begin with, of a linear array: what isn't measured stays as it has it"""
    out: Path
    """folder: gets rig.yaml, conditions.yaml, identified.json, and with tissue ultrasound.yaml"""


def run(config: Config) -> None:
    """Read, identify and write; raises InputError as `recon.session.rig_step.run`."""
    rig_step.run(config, config.out, ConsoleWatch())
