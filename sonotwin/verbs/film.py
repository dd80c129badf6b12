"""Render a film of a hand that leads the probe's target before both cameras, with its ground truth.

Reads the rig and the path from conf/; body, surroundings and light are drawn from the seed, out of the ranges of
conf/dataset.yaml. The default path goes slowly, then fast, and partly out of camera 1's view, so that failures are seen too.
Writes OUT/capture/, which `sonotwin track` reads like any hardware's, and OUT/truth/, which only evaluation opens: poses, motion,
projected centres, blur and visibility. Takes about a second a frame on two cores (pixels=full: four), and a minute more when it
first compiles. With `add=true` other parts of a capture in OUT stay; without it they are refused.
With a rig that has further bodies, such as three_bodies, all of them are in view, each with its truth.

    sonotwin film out=outputs/film
    sonotwin film out=outputs/dark frames=120 seed=3 white_dn=20
    sonotwin film out=outputs/bodies rig=three_bodies
"""

from collections.abc import Iterable, Iterator
from pathlib import Path
from time import perf_counter
from typing import Annotated, Literal, Self

import numpy as np
import yaml
from pydantic import Field, model_validator
from rich.progress import Progress

from recon.capture.manifest import CAMERAS, SweepNameOrNone, sweep_part
from recon.model.rig import Rig
from sonotwin.config import folder as conf
from sonotwin.console_watch import LineConsole
from twin.conditions import Conditions, in_use
from twin.session import Session
from twin.shooting import FilmQuality
from twin.tracking import film_session
from twin.tracking.led_bodies import check_names
from twin.tracking.rendered_views import Frames
from twin.tracking.sampling_ranges import DataRanges


class Config(film_session.Filming):
    """Fields of `conf/film.yaml`."""

    rig: Rig
    conditions: Conditions = Conditions()
    out: Path
    add: bool = False
    name: SweepNameOrNone = ""
    pixels: Literal["sketch", "full"] = "sketch"
    quality: FilmQuality = FilmQuality()
    seed: Annotated[int, Field(ge=0, lt=2**32)] = 0

    @model_validator(mode="after")
    def _of_the_rig(self) -> Self:
        check_names(self.bodies, self.rig)
        return self


def run(config: Config) -> None:
    """Render the frames with their truth, and print the largest blur and the time.

    Raises
    ------
    InputError
        If `out` holds anything but what was rendered.
    """
    console = LineConsole()
    session = Session(
        config.out, sweep_part(config.name), config.model_dump(mode="json", exclude={"out", "add"}), config.add, CAMERAS
    )
    session.check()
    rig = in_use(config.rig, config.conditions, config.seed)
    with console.status("setting up the scene"):
        bank = film_session.make_bank(rig, ranges(), config, config.seed)
        made = film_session.takes(bank, rig, ranges(), config, config.seed, config.conditions.motion)
    start = perf_counter()
    blurs: list[float] = []
    with Progress(console=console, transient=True, disable=not console.is_terminal) as progress:
        shot = film_session.shoot(bank, rig, made, config.quality, config.seed, config.pixels)
        frames = progress.track(shot, total=len(made), description="rendering")
        film_session.write_session(session, rig, config.rig, config, made, _noted(frames, blurs))
    seconds = perf_counter() - start
    console.print(f"render      {len(made)} pairs of frames, blurred by up to {max(blurs):.1f} px, {seconds:.1f} s")
    console.print(f"wrote       {config.out}/{{capture,truth}}", markup=False)


def ranges() -> DataRanges:
    """Ranges of body, surroundings and light: those of data sets."""
    return DataRanges.model_validate(yaml.safe_load((conf() / "dataset.yaml").read_text(encoding="utf-8"))["ranges"])


def _noted(frames: Iterable[Frames], blurs: list[float]) -> Iterator[Frames]:
    """The same frames; their largest blur, px, is noted."""
    for one in frames:
        blurs.append(float(np.max([view.blur_px for view in one.truth])))
        yield one
