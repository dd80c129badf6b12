"""A demonstration: a session is rendered, reconstructed from its images alone, compared with its truth, and reported."""

import shlex
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Annotated

from pydantic import Field, model_validator

from recon.capture import calibration_files
from recon.capture.manifest import MANIFEST, image_name, read_manifest, sweep_part
from recon.errors import InputError
from recon.files import atomic, metrics
from recon.files.metrics import Metrics
from recon.model.probe import Speed
from recon.session import optics_step, plan, scene_step, skin_step
from sonotwin import command_line, pipeline, rendered_session
from sonotwin.config import defaults
from sonotwin.pipeline import Step
from sonotwin.rendered_session import BOTTOM, SCAN, WATER_C, WIRES, Rendering
from sonotwin.verbs import evaluate, film, reconstruct, render, track
from twin import board_session
from twin.evaluation import session_errors, sweep_errors, track_errors
from twin.reports import demo_report, sweep_report, track_report
from twin.session import CAPTURE, TRUTH

RESULT, EVALUATION = "result", "evaluation"  # folders
MESHES = (skin_step.SKIN, skin_step.GLB)
REPORT = "report.html"
Figures = Mapping[str, float | int]

FILES = {  # in the folder: what is in them
    "report.html": "this page",
    "surface.ply": "the surface: triangles, normals and predicted sigma of each vertex, in mm",
    "surface.glb": "the same for viewers and for the web, in metres",
    "metrics.json": "all figures on this page and some more",
    "capture/": "the session's images, their manifest and the true calibration, as devices would have left them",
    "truth/": "what the images were rendered from: points, normals, projector coordinates, poses, labels, true calibration",
    "result/": "what `sonotwin reconstruct` made of the capture, a folder a step",
    "result/surface/points.npz": "the point of every pixel and its predicted sigma",
    "evaluation/error_map.png": "map of the errors",
    "demo.json": "every setting",
}
FROM_BOARD = {"result/optics/calibration.html": "the calibration that all was measured with, and how far it can be trusted"}
FROM_BOTH = {"result/drift/drift.html": "what drifted since the calibration, and what it would have cost"}
FROM_SWEEPS = {
    f"result/scene/{SCAN}/scene.html": "all of it in one view that one can turn, with the probe and its B-scan along the sweep",
    f"result/scene/{SCAN}/scene.glb, slicer/": "the same as layers for any viewer, and a folder for 3D Slicer",
    f"result/masses/{SCAN}/": "what was found inside: a closed surface each, in mm",
    f"result/volume/{SCAN}/volume.nrrd": "the B-scans of the sweep as a volume in the frame of the surface, in mm",
    "result/probe/probe.yaml": "the calibration of the probe, with its covariance",
    "result/latency/lag.json": "the lag of the scanner behind the cameras",
    "result/poses/": "the probe's poses in each sweep's frames with their covariance, why some weren't found, and pictures",
}
FROM_FILM = {
    "film/": "frames of the moving target by both cameras, and their truth",
    "track/": "the target's poses in the film with their covariance, why some weren't found, and pictures of all frames",
}


class Config(rendered_session.Settings):
    """Fields of `conf/demo.yaml`: those of a session."""

    board: Path
    tissue_m_s: Speed = 1450.0
    film_frames: Annotated[int, Field(ge=0, le=10_000)] = 24

    @model_validator(mode="after")
    def _shows_fringes(self) -> "Config":
        if not self.patterns.has_fringes(self.patterns.axes[0]):
            raise ValueError("patterns: expected fringes, whose phase the page shows, found Gray code alone")
        return self

    @property
    def reconstruction(self) -> reconstruct.Config:
        """Settings by which the session is reconstructed."""
        return reconstruct.Config(
            rig=self.rig,
            scale_given=True,
            capture=self.out / CAPTURE,
            out=self.out / RESULT,
            camera=self.cameras[0],
            board_scale=self.conditions.board.stretch,  # a laboratory knows how well its boards are printed
            temperature_c=WATER_C,
            tissue_m_s=self.tissue_m_s,
            overlays=True,
        )

    @property
    def comparison(self) -> evaluate.Config:
        """Settings by which the surface is compared with the truth."""
        surface, truth = self.out / RESULT / "surface", self.out / TRUTH
        return evaluate.Config(surface=surface, truth=truth, out=self.out / EVALUATION, camera=self.cameras[0])

    @property
    def filming(self) -> tuple[film.Config, track.Config] | None:
        """Settings by which a moving target is filmed and tracked, where no sweep shows one."""
        if self.looks_inside or not self.film_frames:
            return None
        own = {"rig": self.rig, "conditions": self.conditions, "seed": self.seed, "frames": self.film_frames}
        filmed = film.Config.model_validate(defaults("film") | own | {"out": self.out / "film"})
        return filmed, track.Config(rig=self.rig, capture=self.out / "film" / CAPTURE, out=self.out / "track")


def check_place(config: Config) -> None:
    """Check, before any work, that no part of a capture would be lost that no demonstration makes; InputError if one would."""
    place = config.out / CAPTURE
    if (place / MANIFEST).is_file():
        made = {"surface", "board", *(sweep_part(name) for name in (WIRES, BOTTOM, SCAN))}
        if others := sorted(read_manifest(place).contents.keys() - made):
            expected = "nothing or the capture of an earlier demonstration"
            raise InputError(f"{place}: expected {expected}, found {others[0]} in it; give another out")


def commands(config: Config) -> list[str]:
    """The command lines that do the same at once, and step by step."""
    lines = [command_line.words("demo", config)]
    lines += [command_line.words(part.verb, part.settings) for part in rendered_session.parts(config, config.out)]
    lines += [command_line.words("reconstruct", config.reconstruction), command_line.words("evaluate", config.comparison)]
    if config.filming is not None:
        lines += [command_line.words(verb, one) for verb, one in zip(("film", "track"), config.filming, strict=True)]
    return [shlex.join(["sonotwin", *line]) for line in lines]


def steps(config: Config) -> list[Step]:
    """All steps, in order."""
    made = []
    for part in rendered_session.parts(config, config.out):
        work = {"render": partial(render_scene, config, part), "board": partial(render_board, config)}.get(part.name, part.run)
        made.append(Step(part.name, part.does, lambda _, work=work: work()))
    made.append(Step("reconstruct", "reconstruct all of it from the images", lambda _: reconstruct_session(config), MESHES))
    made.append(Step("evaluate", "compare it with the truth", lambda _: compare(config)))
    if config.filming is not None:
        filmed, tracking = config.filming
        frames = f"render {config.film_frames} pairs of frames of the moving target"
        made.append(Step("film", frames, lambda _: film.run(filmed)))
        made.append(Step("track", "track the target through them, and compare with the truth", lambda _: track_film(tracking)))
    return [*made, Step("report", "write the report", lambda found: report(config, found), (REPORT,))]


def render_scene(config: Config, part: Rendering) -> None:
    """The scene under fringes; a person sees the first picture before the long steps."""
    part.run()
    print(f"look at     {config.out / CAPTURE / 'surface' / config.cameras[0] / image_name(1)}, the first picture of the scene")


def render_board(config: Config) -> None:
    """The board's images, which all demonstrations of the same rig, conditions and seed share; rendered if they aren't there."""
    kept, here = rendered_session.board(config, config.board, add=False), rendered_session.board(config, config.out)
    render.run(kept)
    board_session.take_over(render.part_of(kept), render.part_of(here))


def reconstruct_session(config: Config) -> None:
    """Everything by the pipeline, which is given the capture and nothing else.

    Raises
    ------
    InputError
        If a step could not be done.
    """
    if reconstruct.run(config.reconstruction):
        raise InputError(f"{config.out / RESULT}: expected all steps, found some that could not be done, as said above")
    for name in MESHES:
        with atomic.listed_file(config.out, name, pipeline.DEMO) as temporary:
            atomic.link_file(config.out / RESULT / "surface" / name, temporary)


def compare(config: Config) -> Metrics:
    """Figures of all that was reconstructed, against the truth."""
    evaluate.run(config.comparison)
    result, truth = config.out / RESULT, config.out / TRUTH
    figures: Metrics = {}
    if config.poses is not None:
        found = calibration_files.read(result / "optics" / optics_step.OPTICS)
        figures |= metrics.read(result / "optics" / metrics.FILE) | session_errors.optics(found, truth)
    if plan.is_corrected(result):
        figures |= _named(result / "drift", "drift")
    figures |= metrics.read(result / "surface" / metrics.FILE)
    # what evaluation predicts, in place of the surface's own, is of points that have a truth, by true normals
    figures |= metrics.read(config.out / EVALUATION / metrics.FILE)
    if config.looks_inside:
        figures |= _named(result / "probe", "probe") | _named(result / "latency", "lag")
        figures |= _named(result / "volume" / SCAN, "volume") | _named(result / "poses" / SCAN, "track")
        errors = session_errors.measure(result, config.out / CAPTURE, truth)
        figures |= {name.removeprefix(f"{SCAN}_"): value for name, value in errors.items() if name.startswith(f"{SCAN}_")}
    return figures


def track_film(settings: track.Config) -> Metrics:
    """The target's poses in the film, against the truth."""
    track.run(settings)
    tracked = track_report.read(settings.capture.with_name(TRUTH), settings.out)
    return _named(settings.out, "track") | track_errors.measure(tracked.errors, tracked.truth)


def report(config: Config, found: Figures) -> None:
    """Write the report of all steps."""
    out, result, truth = config.out, config.out / RESULT, config.out / TRUTH
    optics = plan.optics_used(result)
    estimated = None if optics is None else calibration_files.read(optics)
    story = demo_report.read(out / CAPTURE, truth, result / "surface" / skin_step.POINTS, config.cameras[0], estimated)
    files, inside, tracked, fused = FILES | (FROM_BOARD if config.poses is not None else {}), None, None, None
    files |= FROM_BOTH if plan.is_corrected(result) else {}
    if config.looks_inside:
        files |= FROM_SWEEPS
        expected = sweep_errors.read_truth(truth, SCAN)
        inside = sweep_report.read(result, SCAN, BOTTOM, session_errors.findings(result, expected, SCAN), expected)
        tracked = track_report.read(truth, result / "poses" / SCAN, SCAN)
        fused = scene_step.read(plan.kept_scene(config.reconstruction, result, SCAN, optics))
    elif config.filming is not None:
        files |= FROM_FILM
        tracked = track_report.read(out / "film" / TRUTH, out / "track")
    with atomic.listed_file(out, REPORT, pipeline.DEMO) as page:
        demo_report.write(page, story, dict(found), list(files.items()), commands(config), inside, tracked, fused)


def _named(folder: Path, part: str) -> Metrics:
    """Figures of a step by names that no other has, less its seconds: `frames` of the probe is `probe_frames`."""
    read = metrics.read(folder / metrics.FILE)
    kept = {name.removeprefix(f"{part}_"): value for name, value in read.items() if not name.startswith("seconds_")}
    return {f"{part}_{name}": value for name, value in kept.items()}
