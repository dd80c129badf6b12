"""Calibrate the rendered rig, measure a phantom's surface with it, compare with the truth, and report the whole story.

Reads the same choices from conf/ as `sonotwin render`. Writes into the folder `out`: report.html and calibration/calibration.html
(open them in a browser; they need no network), surface.ply (mm), surface.glb (metres, y up), metrics.json, the captures and
their truth, and the folders of the steps between. Takes under two minutes on two cores; the first run ever also compiles, for
about a minute. The board's images are kept and used
again by all demonstrations of the same rig. A run that was interrupted is simply started again.

    sonotwin demo
    sonotwin demo poses=paper
    sonotwin demo scene=sphere patterns=gray_surface out=outputs/sphere
"""

import os
import shlex
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field, PrivateAttr, model_validator
from rich.console import Console

from recon import atomic, metrics
from recon.capture import read_patterns
from recon.metrics import Metrics, shown
from sonotwin.config import folder as conf
from sonotwin.verbs import calibrate_optics, evaluate, render, surface
from twin import demo, report, session
from twin.demo import Step
from twin.evaluate import things

Figures = Mapping[str, float | int]

MESHES = ("surface.ply", "surface.glb")
CALIBRATION = "calibration"  # folder
BOARD_PATTERNS = "paper_calibration"
BOARD = {"scene": {"kind": "board"}, "cameras": ["cam1", "cam2"]}  # the board as conf/scene/board.yaml has it
OUTPUTS = (
    ("report.html", "this page"),
    ("surface.ply", "the surface: triangles, normals and predicted sigma of each vertex, in mm"),
    ("surface.glb", "the same for viewers and for the web, in metres"),
    ("metrics.json", "all figures on this page and some more"),
    ("calibration/calibration.html", "the calibration that the surface was measured with, and how far it can be trusted"),
    ("capture/", "the images, their manifest and the calibration, as a camera would have left them"),
    ("truth/", "what the images were rendered from: points, normals, projector coordinates, true calibration"),
    ("surface/points.npz", "the point of every pixel and its predicted sigma"),
    ("evaluation/error_map.png", "map of the errors"),
    ("demo.json", "every setting"),
)


class Config(render.Config):
    """Fields of `conf/demo.yaml`: those of `conf/render.yaml`, for one camera; but the poses are of another scene, the board."""

    cameras: Annotated[list[session.CameraName], Field(min_length=1, max_length=1)]
    board: Path
    _overrides: Sequence[str] = PrivateAttr(())  # field=value as they were given

    @model_validator(mode="after")
    def _fits_poses(self) -> "Config":
        return self

    def rendering(self, changes: Mapping[str, object]) -> render.Config:
        """What `sonotwin render` is to do, with some fields changed."""
        fields = {name: getattr(self, name) for name in render.Config.model_fields}
        return render.Config.model_validate(fields | dict(changes))

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
    steps = (calibration_steps(config) if config.poses else []) + surface_steps(config)
    found = demo.play(
        steps, config.out, config.model_dump(mode="json"), lambda text: console.print(text, style="bold cyan", markup=False)
    )
    console.print()
    for line in summary(config, found):
        console.print(line, markup=False)


def calibration_steps(config: Config) -> list[Step]:
    """From a board in some poses to a calibration. The board's images stay where they are if they are the same."""
    assert config.poses is not None

    def rendering(folder: Path, _: Figures) -> Figures:
        patterns = read_patterns(conf() / "patterns" / f"{BOARD_PATTERNS}.yaml")
        shooting = config.shooting.model_copy(update={"exposure_s": None})  # that of the scene is not that of the board
        render.run(config.rendering(BOARD | {"patterns": patterns, "shooting": shooting, "out": config.board}))
        return {}

    def calibration(folder: Path, _: Figures) -> Figures:
        board = config.board
        calibrate_optics.run(calibrate_optics.Config(capture=board / "capture", truth=board / "truth", out=folder / CALIBRATION))
        return metrics.read(folder / CALIBRATION / metrics.FILE)

    return [
        Step("board", f"render the calibration board in {config.poses.count} poses", rendering),
        Step("calibrate", "calibrate cameras and projector", calibration, (CALIBRATION,)),
    ]


def surface_steps(config: Config) -> list[Step]:
    """From a scene to the report of its measured surface."""
    camera = config.cameras[0]

    def rendering(folder: Path, _: Figures) -> Figures:
        render.run(config.rendering({"poses": None}))
        return {}

    def reconstruction(folder: Path, _: Figures) -> Figures:
        optics = folder / CALIBRATION / calibrate_optics.OPTICS if config.poses else None
        surface.run(surface.Config(capture=folder / "capture", calibration=optics, out=folder / "surface", camera=camera))
        for name in MESHES:
            _offer(folder / "surface" / name, folder / name)
        return metrics.read(folder / "surface" / metrics.FILE)

    def comparison(folder: Path, _: Figures) -> Figures:
        places = {"surface": folder / "surface", "truth": folder / "truth", "out": folder / "evaluation"}
        evaluate.run(evaluate.Config(**places, camera=camera))
        return metrics.read(folder / "evaluation" / metrics.FILE)

    def telling(folder: Path, figures: Figures) -> Figures:
        story = report.read(folder / "capture", folder / "truth", folder / "surface" / surface.POINTS, camera)
        outputs = [(name, text) for name, text in OUTPUTS if (folder / name).exists() or name == "report.html"]
        report.write(folder / "report.html", story, dict(figures), outputs, commands(folder, config, config._overrides))
        return {}

    return [
        Step("render", f"render {config.patterns.count} images of the scene and its truth", rendering, ("capture", "truth")),
        Step("surface", "reconstruct the surface from the images", reconstruction, ("surface", *MESHES)),
        # its prediction is of the points that have a truth, by the true normals
        Step("evaluate", "compare it with the truth", comparison, ("evaluation",), refines=("predicted_rms_mm",)),
        Step("report", "write the report", telling, ("report.html",)),
    ]


def commands(folder: Path, config: Config, overrides: Sequence[str]) -> list[str]:
    """The command lines that do the same at once and step by step, with the settings that `sonotwin demo` was given."""
    camera = config.cameras[0]
    given = [override for override in overrides if not override.startswith("out=")]
    of_scene = [override for override in given if not override.startswith("poses")]
    of_board = [override for override in given if override.startswith(("rig", "engine", "seed", "poses"))]
    board, optics = config.board, folder / CALIBRATION / calibrate_optics.OPTICS
    choices = ["scene=board", "poses=demo", f"patterns={BOARD_PATTERNS}", "cameras=[cam1,cam2]"]
    calibrating = [
        ["render", *choices, *of_board, f"out={board}"],
        ["calibrate-optics", f"capture={board / 'capture'}", f"truth={board / 'truth'}", f"out={folder / CALIBRATION}"],
    ]
    calibrated = [f"calibration={optics}"] if config.poses else []
    lines = (
        ["demo", *given, f"out={folder}"],
        *(calibrating if config.poses else []),
        ["render", *of_scene, f"out={folder}"],
        ["surface", f"capture={folder / 'capture'}", *calibrated, f"camera={camera}", f"out={folder / 'surface'}"],
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
        *calibrated(found),
        f"coverage    {100 * found['coverage']:.1f} % of what camera and projector both see; "
        f"{100 * found['gross_error_fraction']:.3f} % of the points are off by more than 1 mm",
        f"look at     {out / 'report.html'}; the surface is in {out / 'surface.ply'} and {out / 'surface.glb'}",
    ]


def calibrated(found: Metrics) -> list[str]:
    """How well the calibration came out, if there was one."""
    if "point_error_rms_mm" not in found:
        return []
    remaining = ", ".join(f"{name} {found[f'reprojection_rms_{name}_px']:.3f}" for name in ("cam1", "cam2", "projector"))
    return [
        f"calibrated  from {found['poses']:.0f} poses: reprojection {remaining} px RMS; "
        f"points off by {found['point_error_rms_mm']:.3f} mm RMS for it, {found['point_sigma_mm']:.3f} mm predicted"
    ]


def _offer(source: Path, path: Path) -> None:
    """Give a file a second place, without a second copy where the file system can do that."""
    with atomic.new_file(path) as temporary:
        try:
            os.link(source, temporary)
        except OSError:
            shutil.copyfile(source, temporary)
