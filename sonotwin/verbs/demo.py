"""Render a phantom, reconstruct its surface, compare it with the truth, and write a report that tells the whole story.

Reads the same choices from conf/ as `sonotwin render`. Writes into the folder `out`: report.html (open it in a browser; it needs
no network), surface.ply (mm), surface.glb (metres, y up), metrics.json, the capture and its truth, and the folders of the steps
between. Takes under a minute on two cores; the first run ever also compiles, for about a minute. A run that was
interrupted is simply started again.

    sonotwin demo
    sonotwin demo scene=sphere patterns=gray_surface out=outputs/sphere
"""

import os
import shlex
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field, PrivateAttr
from rich.console import Console

from recon import atomic, metrics
from recon.metrics import Metrics, shown
from sonotwin.verbs import evaluate, render, surface
from twin import demo, report, session
from twin.demo import Step
from twin.evaluate import things

Figures = Mapping[str, float | int]

MESHES = ("surface.ply", "surface.glb")
OUTPUTS = (
    ("report.html", "this page"),
    ("surface.ply", "the surface: triangles, normals and predicted sigma of each vertex, in mm"),
    ("surface.glb", "the same for viewers and for the web, in metres"),
    ("metrics.json", "all figures on this page and some more"),
    ("capture/", "the images, their manifest and the calibration, as a camera would have left them"),
    ("truth/", "what the images were rendered from: points, normals, projector coordinates, true calibration"),
    ("surface/points.npz", "the point of every pixel and its predicted sigma"),
    ("evaluation/error_map.png", "map of the errors"),
    ("demo.json", "every setting"),
)


class Config(render.Config):
    """Fields of `conf/demo.yaml`: those of `conf/render.yaml`, for one camera."""

    cameras: Annotated[list[session.CameraName], Field(min_length=1, max_length=1)]
    _overrides: Sequence[str] = PrivateAttr(())  # field=value as they were given

    def model_post_init(self, context: Any) -> None:
        """Keep the overrides, for the commands that the report shows."""
        if context:
            self._overrides = context["overrides"]


def run(config: Config) -> None:
    """Play the steps, then say in four lines what came out.

    Raises
    ------
    InputError
        If a setting is wrong or `out` holds something else.
    """
    console = Console(soft_wrap=True, highlight=False)
    steps = surface_steps(config)
    found = demo.play(
        steps, config.out, config.model_dump(mode="json"), lambda text: console.print(text, style="bold cyan", markup=False)
    )
    console.print()
    for line in summary(config, found):
        console.print(line, markup=False)


def surface_steps(config: Config) -> list[Step]:
    """From a scene to the report of its measured surface."""
    camera = config.cameras[0]

    def rendering(folder: Path, _: Figures) -> Figures:
        render.run(render.Config(**dict(config)))
        return {}

    def reconstruction(folder: Path, _: Figures) -> Figures:
        surface.run(surface.Config(capture=folder / "capture", out=folder / "surface", camera=camera))
        for name in MESHES:
            _offer(folder / "surface" / name, folder / name)
        return metrics.read(folder / "surface" / metrics.FILE)

    def comparison(folder: Path, _: Figures) -> Figures:
        places = {"surface": folder / "surface", "truth": folder / "truth", "out": folder / "evaluation"}
        evaluate.run(evaluate.Config(**places, camera=camera))
        return metrics.read(folder / "evaluation" / metrics.FILE)

    def telling(folder: Path, figures: Figures) -> Figures:
        story = report.read(folder / "capture", folder / "truth", folder / "surface" / surface.POINTS, camera)
        report.write(folder / "report.html", story, dict(figures), OUTPUTS, commands(folder, camera, config._overrides))
        return {}

    return [
        Step("render", f"render {config.patterns.count} images of the scene and its truth", rendering, ("capture", "truth")),
        Step("surface", "reconstruct the surface from the images", reconstruction, ("surface", *MESHES)),
        # its prediction is of the points that have a truth, by the true normals
        Step("evaluate", "compare it with the truth", comparison, ("evaluation",), refines=("predicted_rms_mm",)),
        Step("report", "write the report", telling, ("report.html",)),
    ]


def commands(folder: Path, camera: str, overrides: Sequence[str]) -> list[str]:
    """The command lines that do the same at once and step by step, with the settings that `sonotwin demo` was given."""
    given = [override for override in overrides if not override.startswith("out=")]
    lines = (
        ["demo", *given, f"out={folder}"],
        ["render", *given, f"out={folder}"],
        ["surface", f"capture={folder / 'capture'}", f"camera={camera}", f"out={folder / 'surface'}"],
        [
            "evaluate",
            f"surface={folder / 'surface'}",
            f"truth={folder / 'truth'}",
            f"camera={camera}",
            f"out={folder / 'evaluation'}",
        ],
    )
    return [shlex.join(["sonotwin", *line]) for line in lines]


def summary(config: Config, found: Metrics) -> list[str]:
    """What, how well, how much of it, and where to look."""
    out, points = config.out, f"{found['points']:,}".replace(",", " ")
    parts = ", ".join(f"{name} {shown(value, '.3f')}" for name, value in things(found).items())
    return [
        f"measured    {points} points of the scene ({config.scene['kind']}) from {config.patterns.count} images, "
        f"in {found['seconds_demo']:.0f} s",
        f"accuracy    {shown(found['surface_rms_mm'], '.3f', ' mm')} RMS ({parts}); "
        f"the camera's noise alone would leave {shown(found['limit_rms_mm'], '.3f', ' mm')}",
        f"coverage    {100 * found['coverage']:.1f} % of what camera and projector both see; "
        f"{100 * found['gross_error_fraction']:.3f} % of the points are off by more than 1 mm",
        f"look at     {out / 'report.html'}; the surface is in {out / 'surface.ply'} and {out / 'surface.glb'}",
    ]


def _offer(source: Path, path: Path) -> None:
    """Give a file a second place, without a second copy where the file system can do that."""
    with atomic.new_file(path) as temporary:
        try:
            os.link(source, temporary)
        except OSError:
            shutil.copyfile(source, temporary)
