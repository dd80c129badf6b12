"""Measure the probe's target as it was printed: places and diameter of its circles, and the bow of its board.

Reads a capture folder with frames of both cameras (sweep/cam1, sweep/cam2) and their calibration, as `sonotwin track` does: any
film in which both cameras see the target whole, slowly moved, tilted to all sides, nearer and farther. Writes into the folder
`out`: target.yaml (with the covariance) and metrics.json. What is there already is replaced. Takes half a second a pose, besides
tracking the film.

    sonotwin film out=outputs/turned path.turn_deg=20 white_dn=120
    sonotwin calibrate-target capture=outputs/turned/capture out=outputs/target
    sonotwin film out=outputs/film
    sonotwin track capture=outputs/film/capture target=outputs/target/target.yaml out=outputs/track

Both films are of one seed, so of one print. A film of another seed shows another print, which is tracked worse by this one's
measures than by the design: `track` warns of it.
"""

from pathlib import Path

from recon.session import target_step
from sonotwin.console_watch import ConsoleWatch


class Config(target_step.Settings):
    """Fields of `sonotwin calibrate-target`."""

    out: Path
    """folder: gets target.yaml and metrics.json"""


def run(config: Config) -> None:
    """Track the film, adjust the target, and write; raises InputError as `recon.session.target_step.run`."""
    target_step.run(config, config.out, ConsoleWatch())
