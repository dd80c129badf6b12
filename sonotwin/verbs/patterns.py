"""Write a pattern sequence as images for a projector, with a timing sheet and the commands that read what cameras see of them.

Reads the sequence from conf/patterns, which the twin projects and the decoder expects, and the rig, for the projector's size.
Writes into the folder `out`: 0000.png, 0001.png ..., 8-bit grey, to be shown in this order; timing_sheet.csv, what each shows,
the time that it must stand, and the names of the cameras' images; patterns.yaml, the sequence, for `describe` and `surface`; and
README.txt, with the commands that make a capture of the images shot. A sequence along both axes serves for calibration boards,
too, and gets lit.png, white, for their even light. An earlier folder of this kind is replaced. Takes seconds.

    sonotwin patterns patterns=paper_surface out=projected
    sonotwin patterns patterns=paper_calibration refresh_hz=120 exposure_s=0.0167 out=projected
    sonotwin patterns patterns=twelve_step_gray rig.projector.optics.size=[1920,1080] out=projected
"""

import csv
import math
from collections.abc import Iterator
from pathlib import Path
from shlex import quote
from typing import Annotated

import numpy as np
import yaml
from pydantic import BaseModel, ConfigDict, Field, model_validator

from recon.artwork import projected_images
from recon.capture.images import write_images
from recon.capture.manifest import axes_not_encoded
from recon.files import atomic
from recon.model.patterns import Patterns
from recon.model.rig import Rig
from recon.registry import Choice

SHEET = "timing_sheet.csv"
SEQUENCE = "patterns.yaml"
LIT = "lit.png"
CAMERA = "cam1"
PERIODS = 0.01  # of a period, by which an exposure may miss a whole number of them
COLUMNS = (
    *("order", "file", "kind", "what", "axis", "pitch_px", "shift_deg", "bit", "binary"),
    *("exposure_ms", "least_ms", "surface_image", "board_image"),
)
BOARD = "{kind: asymmetric_circles, columns: 4, rows: 11, spacing_mm: 15, diameter_mm: 9}"


class Config(BaseModel):
    """Fields of `sonotwin patterns`."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    rig: Annotated[Rig, Choice("meza2021")]
    """of it, the projector's size and gamma"""
    patterns: Annotated[Patterns, Choice("paper_surface")]
    """the sequence to write"""
    out: Path
    """folder to write: images, timing_sheet.csv, patterns.yaml, README.txt"""
    linearise_gamma: Annotated[float, Field(ge=0.2, le=5)] | None = None
    """of the projector, light = value^gamma: grey levels are written as value^(1/gamma), so that three or four steps aren't
    bent, at a cost in dark levels of 8 bits; null: none, as the twin projects. Five steps or more cancel gamma, and
    black-and-white patterns have none"""
    refresh_hz: Annotated[float, Field(gt=0, le=100_000)] = 60.0
    """of the projector's input; within a period it makes grey of flashes"""
    delay_frames: Annotated[int, Field(ge=0, le=100)] = 1
    """periods until an image that is sent is on the wall; displays take one or two"""
    exposure_s: Annotated[float, Field(gt=0, le=100)] | None = None
    """of the cameras, s; null: a period of the projector. Whole periods see all flashes"""

    @model_validator(mode="after")
    def _fits(self) -> "Config":
        raster, size = self.rig.projector.optics.size, self.patterns.projector_size
        if size != raster:
            ways = f"patterns.projector_size={_listed(raster)} or rig.projector.optics.size={_listed(size)}"
            raise ValueError(f"patterns.projector_size: expected the rig's {list(raster)}, found {list(size)}; give {ways}")
        return self

    @property
    def exposure(self) -> float:
        """Of the cameras, s; a period of the projector if none is given."""
        return self.exposure_s or 1 / self.refresh_hz

    @property
    def least_s(self) -> float:
        """Time that each pattern must stand: the exposure and the display's delay, in whole periods."""
        periods = math.ceil(self.exposure * self.refresh_hz - PERIODS) + self.delay_frames
        return periods / self.refresh_hz

    @property
    def for_boards(self) -> bool:
        """Whether the sequence encodes both axes, as the projector's calibration needs."""
        return not axes_not_encoded(self.patterns)


def run(config: Config) -> None:
    """Write images, sheet, sequence and commands."""
    atomic.check_folder(config.out, "patterns")
    images = projected_images.images(config.patterns, config.linearise_gamma or 1.0)
    names = [f"{k:04}.png" for k in range(len(images))]
    with atomic.new_folder(config.out, "patterns") as folder:
        write_images([folder / name for name in names], images)
        if config.for_boards:
            write_images([folder / LIT], np.full_like(images[:1], projected_images.FULL))
        with open(folder / SHEET, "w", encoding="utf-8", newline="") as file:
            writer = csv.writer(file, lineterminator="\n")
            writer.writerow(COLUMNS)
            writer.writerows(sheet_rows(config, names))
        (folder / SEQUENCE).write_text(sequence_text(config.patterns), encoding="utf-8")
        text = "\n".join(readme(config)) + "\n"
        (folder / "README.txt").write_text(text, encoding="utf-8", errors="backslashreplace")  # names may be no text
    for line in lines(config):
        print(line)


def sheet_rows(config: Config, names: list[str]) -> Iterator[tuple[object, ...]]:
    """Rows of the timing sheet; empty where a column has no meaning."""
    times = (f"{1e3 * config.exposure:.3f}", f"{1e3 * config.least_s:.3f}")
    for order, (name, shown) in enumerate(zip(names, projected_images.shown(config.patterns), strict=True)):
        board = f"board/00/{CAMERA}/{name}" if config.for_boards else ""
        numbers = ["" if value is None else f"{value:g}" for value in (shown.pitch_px, shown.shift_deg, shown.bit)]
        what = (shown.kind, shown.what, shown.axis, *numbers, "yes" if shown.binary else "no")
        yield (order, name, *what, *times, f"surface/{CAMERA}/{name}", board)
    if config.for_boards:
        what = ("uniform", "white, the board's lit image; not of the sequence", "", "", "", "", "yes")
        yield (len(names), LIT, *what, *times, "", f"board/00/{CAMERA}/{LIT}")


def sequence_text(patterns: Patterns) -> str:
    """The sequence as a file like those of conf/patterns."""
    fields = patterns.model_dump(mode="json", exclude_none=True)
    return f"# the sequence of these {patterns.count} images, as sonotwin projects and decodes it\n" + yaml.safe_dump(
        fields, sort_keys=False
    )


def commands(config: Config) -> dict[str, str]:
    """Commands that make captures of the images shot, by what they are of."""
    sequence = quote(f"patterns={config.out / SEQUENCE}")
    found = {"surface": f"sonotwin describe folder=surface {sequence} calibration=optics.yaml out=surface_capture"}
    if config.for_boards:
        found["board"] = f"sonotwin describe folder=board {sequence} board='{BOARD}' out=board_capture"
    return found


def readme(config: Config) -> Iterator[str]:
    """Lines of README.txt."""
    width, height = config.patterns.projector_size
    yield f"{config.patterns.count} patterns for a projector of {width}x{height} px, made by sonotwin."
    yield ""
    yield "Show them pixel by pixel: full screen at the projector's own resolution; no scaling, no keystone or colour correction,"
    yield "no sharpening. Fix the cameras' exposure, gain and focus, without gamma."
    yield f"Show each for {1e3 * config.least_s:.1f} ms or longer, in the order of {SHEET}, and expose {exposure_text(config)}."
    yield from gamma_lines(config)
    yield ""
    yield f"A surface: save what cameras 1 and 2 see of 0000.png as surface/{CAMERA}/0000.png and surface/cam2/0000.png; then, in"
    yield "the folder where the patterns were made:"
    yield f"  {commands(config)['surface']}"
    if config.for_boards:
        yield ""
        yield f"A calibration board, in 20 to 40 poses: save what camera 1 sees in pose 7 as board/07/{CAMERA}/0000.png ...,"
        yield f"and both under {LIT} as board/07/{CAMERA}/{LIT} and board/07/cam2/{LIT}; then, with its lengths as printed:"
        yield f"  {commands(config)['board']}"


def exposure_text(config: Config) -> str:
    """The cameras' exposure in words, with the next better one if it isn't whole periods of the projector."""
    periods = config.exposure * config.refresh_hz
    text = f"{1e3 * config.exposure:.2f} ms"
    if round(periods) and abs(periods - round(periods)) < PERIODS * round(periods):
        return f"{text}, {round(periods)} of the projector's periods"
    whole = 1e3 * math.ceil(periods) / config.refresh_hz
    return f"{text}, which is {periods:.2f} of its periods, within which it makes grey of flashes; better {whole:.2f} ms"


def gamma_lines(config: Config) -> Iterator[str]:
    """The projector's gamma, if grey levels are written for one or suffer from it."""
    steps, gamma = projected_images.bent_by_gamma(config.patterns), config.rig.projector.gamma
    if config.linearise_gamma is not None:
        yield f"Grey levels are made for a projector of gamma {config.linearise_gamma:g}, so that its light is linear."
    elif steps and gamma != 1:
        yield f"Fringes of {steps} steps are bent by the projector's gamma, {gamma:g} in the rig; give linearise_gamma={gamma:g}."


def lines(config: Config) -> Iterator[str]:
    """What was written, and how to go on."""
    width, height = config.patterns.projector_size
    lit = f", and {LIT} for boards" if config.for_boards else ""
    yield f"patterns    {config.patterns.count} images of {width}x{height} px{lit}"
    yield f"exposure    {exposure_text(config)}"
    yield f"timing      show each {1e3 * config.least_s:.1f} ms or longer, {config.patterns.count * config.least_s:.2f} s in all"
    yield from (f"gamma       {line}" for line in gamma_lines(config))
    yield f"wrote       {config.out}"
    yield from (f"next        {command}" for command in commands(config).values())


def _listed(size: tuple[int, int]) -> str:
    return f"[{size[0]},{size[1]}]"
