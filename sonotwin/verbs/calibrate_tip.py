"""Find the tip of a tracked tool, such as a needle or a stylus, in the frame of its target, from a film of it in a dimple.

Reads a capture folder with frames of both cameras, as `sonotwin track` does, or a table of poses, or a tracked sequence of the
PLUS toolkit. Put the tip into a dimple that is at rest, tilt the tool by 30 degrees and more to all sides and back upright, and
turn it, without force, which bends the shaft: 7 seconds or more, the target in view of both cameras. A film that shows too little
motion, a tip that slips, a shaft that bends or a target that is loose is refused. The shaft's direction needs a second film
(spin=), or a drawing. Writes into the folder `out`: tip.yaml, with the covariance; frames.csv, the residuals; and metrics.json.
What is there already is replaced. Takes seconds, besides tracking the film.

    sonotwin film path=pivot frames=200 out=outputs/pivot
    sonotwin calibrate-tip capture=outputs/pivot/capture out=outputs/tip
    sonotwin calibrate-tip tip_mm=[0,-2.5,-150] axis=[0,0,-1] model=needle.stl out=outputs/drawn
"""

from pathlib import Path

from recon.session import tip_step
from sonotwin.console_watch import ConsoleWatch


class Config(tip_step.Settings):
    """Fields of `sonotwin calibrate-tip`."""

    out: Path
    """folder: gets tip.yaml, frames.csv and metrics.json"""


def run(config: Config) -> None:
    """Track the film, find the tip, and write; raises InputError as `recon.session.tip_step.run`."""
    tip_step.run(config, config.out, ConsoleWatch())
