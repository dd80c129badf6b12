"""Render a real capture again with an identified rig, and say what the twin of that rig doesn't explain.

Reads a capture folder with a surface under patterns, and the rig and conditions that `sonotwin identify` wrote; no ground truth.
Reconstructs the surface, takes its reflectance and the room's light from the images, renders the same patterns at the same
exposure and bits, with light from one place of the surface to another, and decodes the result the same way. Writes into the
folder `out`: report.html, with real and twin side by side (pictures, grey levels, noise, modulation, harmonics, edges of light,
residuals), and metrics.json. Says each statistic that is beyond its bar, the farthest first. Takes a minute or two on two cores
for a megapixel; with tracing.bounces=1, light from the projector alone, half a minute.

The rig and conditions of `sonotwin identify` are given as rig=ours/rig.yaml conditions=ours/conditions.yaml; a number of the rig
can be tried by its name, such as rig.projector.gamma=2.2.

    sonotwin render scene=sphere patterns=gray_surface out=outputs/sphere
    sonotwin compare-twin capture=outputs/sphere/capture out=outputs/again
    sonotwin compare-twin capture=outputs/sphere/capture rig.projector.gamma=2.0 out=outputs/another_gamma
"""

import shlex
from pathlib import Path
from typing import Annotated

from pydantic import Field

from recon.capture.manifest import read_manifest
from recon.files import atomic, metrics
from recon.model.part import Part
from recon.model.rig import Rig
from recon.registry import Choice
from sonotwin.console_watch import ConsoleWatch
from twin.conditions import Conditions
from twin.experiments import rerendering
from twin.optics.light_transport import Tracing
from twin.optics.surface_session import CameraName
from twin.reports import likeness_report

BY = "compare-twin"  # who writes
REPORT = "report.html"


class Config(Part):
    """Fields of `sonotwin compare-twin`."""

    capture: Path
    """a capture folder with a surface under patterns"""
    rig: Annotated[Rig, Choice("meza2021")]
    """as identified: rig.yaml of `sonotwin identify`. Its optics take the place of the capture's calibration"""
    conditions: Annotated[Conditions, Choice("ideal")]
    """conditions.yaml of the same: errors of frames, which are drawn anew"""
    identified_from: Path | None = None
    """the capture that the rig was identified from, if it is another one: the page then says that this one is new to the rig"""
    camera: CameraName = "cam1"
    """whose images"""
    tracing: Annotated[Tracing, Choice("between")]
    """of the renders; the room's light is taken from the images"""
    seed: Annotated[int, Field(ge=0)] = 1
    """of noise, of frames' errors and of rays"""
    out: Path
    """folder: gets report.html, metrics.json"""


def run(config: Config) -> None:
    """Render, compare, write, and say what is beyond its bar; raises InputError as `rerendering.rerender`."""
    watch = ConsoleWatch()
    inputs = (config.capture, config.identified_from)
    atomic.check_folder(config.out, BY, inputs=inputs)
    found = rerendering.rerender(config.capture, config.rig, config.conditions, config.camera, config.tracing, config.seed, watch)
    name = read_manifest(config.capture).name_of(config.capture)
    with watch.busy("writing the page"), atomic.new_folder(config.out, BY) as new:
        source = f"{source_of(config, name)} The surface’s {found.seen.reflectance_in_words}."
        likeness_report.write(new / REPORT, found.real, found.twin, found.likeness, name, source, [command_of(config)])
        figures = likeness_report.metrics_of(found.likeness)
        figures |= {"room_lux": found.seen.room_lux, "reflectance": found.seen.reflectance}
        metrics.write(new / metrics.FILE, figures)
    for line in likeness_report.unexplained(found.real, found.likeness):
        watch.say(f"unexplained {line}")
    watch.say(f"wrote       {config.out}/{{{REPORT},{metrics.FILE}}}")


def source_of(config: Config, name: str) -> str:
    """A sentence on the data that the rig is from; name: of the capture."""
    measured = len(config.rig.measured)
    if not measured:
        return "None of the rig’s numbers was measured: this compares a description with a capture."
    other = None if config.rig.identified is None else config.rig.identified.capture
    if config.identified_from is not None:
        other = name if config.identified_from.resolve() == config.capture.resolve() else str(config.identified_from)
    if other not in (None, name):
        known = f"The rig’s {measured} measured numbers are from another capture"
        return f"{known}, {other}: this one is new to the rig, and agreement is a prediction that came true."
    known = f"{measured} of the rig’s numbers were measured, by all of this capture as far as is known here"
    return f"{known}: agreement says that the rig’s model fits, not that it predicts. identified_from names another capture."


def command_of(config: Config) -> str:
    """The command; files of the rig and conditions, and fields of the tracing, aren't known any more."""
    names = ("capture", "identified_from", "camera", "seed", "out")
    given = [f"{name}={value}" for name in names if (value := getattr(config, name)) is not None]
    return f"sonotwin compare-twin rig=rig.yaml conditions=conditions.yaml {shlex.join(given)}"
