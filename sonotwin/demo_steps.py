"""The steps of a demonstration: each a verb with its overrides, so that running it and printing its command line are one."""

import os
import shlex
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from importlib import import_module
from pathlib import Path

import numpy as np
import trimesh
from pydantic import BaseModel

from recon.capture import probe_files, sweep_part
from recon.files import atomic, metrics
from recon.files.metrics import Metrics
from recon.freehand import scans as freehand_scans
from recon.freehand.scans import Unsure
from recon.probe_calibration.repeatability import five_points
from sonotwin import latency_fields
from sonotwin.config import load
from sonotwin.demo_config import BOARD_PATTERNS, CALIBRATION, WATER_C, Config
from sonotwin.latency_fields import Latency
from sonotwin.pipeline import DEMO, Step
from sonotwin.verbs import calibrate_optics, calibrate_probe, film, render, sweep, track
from twin.evaluation import session_errors, sweep_errors, track_errors
from twin.reports import track_report

Figures = Mapping[str, float | int]

MESHES = ("surface.ply", "surface.glb")
RESTING = ("filmed=true", "clocks.camera_hz=5")  # the probe is held still for each B-scan of the wires
LAG, LAG_SIGMA = "lag_s=MEASURED", "lag_sigma_s=MEASURED"  # stand for what an earlier step measured


@dataclass(frozen=True)
class VerbStep:
    """A step that a verb does."""

    name: str  # in one word
    does: str  # what a person reads while it runs
    verb: str
    fields: Sequence[str]  # overrides
    figures: Callable[[Path], Figures] = field(default=lambda folder: {})  # of the demonstration's folder, after the verb
    makes: Sequence[str] = ()  # files and folders at the top of the folder
    refines: Sequence[str] = ()  # figures of earlier steps that it measures better

    def words(self, lag: Latency | None) -> list[str]:
        """The command line after `sonotwin`."""
        told = {} if lag is None else dict(zip((LAG, LAG_SIGMA), lag.fields, strict=True))
        return [self.verb, *(told.get(each, each) for each in self.fields)]

    def step(self) -> Step:
        """The step for `pipeline.play`."""
        return Step(self.name, self.does, self._work, self.makes, self.refines)

    def _work(self, folder: Path, _: Figures) -> Figures:
        verb, *fields = self.words(latency_fields.measured(folder / "lag") if LAG in self.fields else None)
        module = import_module(f"sonotwin.verbs.{verb.replace('-', '_')}")
        module.run(load(verb, fields, module.Config))
        return self.figures(folder)


def commands(folder: Path, config: Config, overrides: Sequence[str], lag: Latency | None) -> list[str]:
    """The command lines that do the same at once and step by step, with the settings that `sonotwin demo` was given."""
    at_once = ["demo", *_given(overrides), f"out={folder}"]
    lines = [at_once, *(step.words(lag) for step in verb_steps(folder, config, overrides) if isinstance(step, VerbStep))]
    return [shlex.join(["sonotwin", *line]) for line in lines]


def verb_steps(folder: Path, config: Config, overrides: Sequence[str]) -> list[VerbStep | Step]:
    """All steps but the report, in order."""
    given = [*_unless_given(overrides, "conditions", "lifelike"), *_given(overrides)]
    steps: list[VerbStep | Step] = [*(calibration_steps(folder, config, given) if config.poses else [])]
    steps += surface_steps(folder, config, given)
    if config.looks_inside:
        return steps + sweep_steps(folder, config, given)
    return steps + (film_steps(folder, config, given) if config.film_frames else [])


def calibration_steps(folder: Path, config: Config, given: Sequence[str]) -> list[VerbStep]:
    """From a board in some poses to a calibration. The board's images stay where they are if they are the same."""
    assert config.poses is not None
    board = config.board
    poses = _unless_given(given, "poses", "demo")
    own = [each for each in _of(given, render.Config, without=("scene", "patterns", "cameras")) if not _sets_exposure(each)]
    rendering = ["scene=board", *poses, f"patterns={BOARD_PATTERNS}", "cameras=[cam1,cam2]", *own, f"out={board}"]
    calibrating = [f"capture={board / 'capture'}", f"truth={board / 'truth'}", f"out={folder / CALIBRATION}"]
    return [
        VerbStep("board", f"render the calibration board in {config.poses.count} poses", "render", rendering),
        VerbStep(
            "calibrate", "calibrate cameras and projector", "calibrate-optics", calibrating, _figures(CALIBRATION), (CALIBRATION,)
        ),
    ]


def surface_steps(folder: Path, config: Config, given: Sequence[str]) -> list[VerbStep]:
    """From a scene to the errors of its measured surface."""
    camera = f"camera={config.cameras[0]}"
    rendering = [*_of(given, render.Config, without=("poses",)), f"out={folder}"]
    measuring = [f"capture={folder / 'capture'}", *_optics(folder, config), camera, f"out={folder / 'surface'}"]
    comparing = [f"surface={folder / 'surface'}", f"truth={folder / 'truth'}", camera, f"out={folder / 'evaluation'}"]
    images = f"render {config.patterns.count} images of the scene and its truth"
    return [
        VerbStep("render", images, "render", rendering, makes=("capture", "truth")),
        VerbStep("surface", "reconstruct the surface from the images", "surface", measuring, _with_meshes, ("surface", *MESHES)),
        # its prediction is of the points that have a truth, by the true normals
        VerbStep(
            "evaluate",
            "compare it with the truth",
            "evaluate",
            comparing,
            _figures("evaluation"),
            ("evaluation",),
            refines=("predicted_rms_mm",),
        ),
    ]


def sweep_steps(folder: Path, config: Config, given: Sequence[str]) -> list[VerbStep | Step]:
    """From frames and B-scans of crossed wires to the tumours under the surface, and how far they are from the truth."""
    scanner = config.ultrasound  # one in the tank and on the breast, set otherwise
    size, scale = (str(list(pair)).replace(" ", "") for pair in (scanner.image_size, scanner.scale_mm_per_px))
    filmed = ["filmed=true", *_unless_given(given, "clocks.camera_hz", f"{config.clocks.camera_hz:.15g}")]
    tank = [
        "ultrasound=water",
        f"ultrasound.image_size={size}",
        f"ultrasound.scale_mm_per_px={scale}",
        *_of(given, sweep.Config, without=("scene", "path", "ultrasound")),
    ]
    rig = [override for override in given if override.startswith("rig")]
    path = _unless_given(given, "path", "raster")
    probe = f"probe={folder / 'probe' / calibrate_probe.PROBE}"
    placed = [f"capture={poses_of(folder, 'sweep')}", probe, LAG, f"tissue_m_s={config.tissue_m_s:.15g}"]
    wires = ["scene=crosswire", "path=wire", f"path.count={config.wires}", *tank, *RESTING, f"out={folder / 'wires'}"]
    calibrating = [*rig, f"capture={poses_of(folder, 'wires')}", f"temperature_c={WATER_C:.15g}", f"out={folder / 'probe'}"]
    bottom = ["scene=tank", "path=bob", f"path.seconds={config.bottom_s:.15g}", *tank, *filmed, f"out={folder / 'bottom'}"]
    timing = [f"capture={poses_of(folder, 'bottom')}", f"out={folder / 'lag'}"]
    sweeping = [*path, *_of(given, sweep.Config), *filmed, f"out={folder / 'sweep'}"]
    filling = [*placed, LAG_SIGMA, f"out={folder / 'volume'}"]
    skin = f"surface={folder / 'surface' / 'surface.ply'}"
    fusing = [*rig, *placed, skin, *_optics(folder, config), f"masses={folder / 'tumours'}", f"volume={folder / 'volume'}"]
    return [
        VerbStep("wires", f"render {config.wires} B-scans of crossed wires, and frames of both cameras", "sweep", wires),
        _tracking(folder, config, rig, "wires", "find the probe in these frames"),
        VerbStep("probe", "calibrate the ultrasound probe", "calibrate-probe", calibrating, _named("probe"), ("probe",)),
        VerbStep("bottom", "render a flat bottom, up and down", "sweep", bottom),
        _tracking(folder, config, rig, "bottom", "find the probe in these frames"),
        VerbStep("lag", "measure the scanner's lag behind the cameras", "measure-lag", timing, _named("lag"), ("lag",)),
        VerbStep("sweep", "render a sweep over the scene: B-scans, frames, and their truth", "sweep", sweeping),
        _tracking(folder, config, rig, "sweep", "track the probe through the sweep, and compare with the truth"),
        VerbStep("volume", "put its B-scans into a volume", "freehand", filling, _named("volume")),
        VerbStep("tumours", "find tumours in its B-scans", "segment", [*placed, LAG_SIGMA, skin, f"out={folder / 'tumours'}"]),
        VerbStep("scene", "put all of it into one picture", "fuse", [*fusing, f"out={folder / 'scene'}"]),
        Step("compare", "compare it with the truth", lambda folder, _: tumour_errors(folder)),
    ]


def fusing_fields(folder: Path, config: Config, overrides: Sequence[str]) -> list[str]:
    """Fields of the step that puts all into one picture, with the lag that was measured."""
    (step,) = (step for step in verb_steps(folder, config, overrides) if isinstance(step, VerbStep) and step.name == "scene")
    return step.words(latency_fields.measured(folder / "lag"))[1:]


def poses_of(folder: Path, name: str) -> Path:
    """The capture in which a filmed sweep has its poses."""
    return folder / "poses" / name


def _tracking(folder: Path, config: Config, rig: Sequence[str], name: str, does: str) -> VerbStep:
    """The step that tracks the probe through a filmed sweep, by the estimated calibration of the cameras."""
    fields = [*rig, f"capture={folder / name / 'capture'}", *_optics(folder, config)]
    if name == "sweep":
        figures: Callable[[Path], Figures] = partial(_pose_errors, swept=True)
    else:
        fields, figures = [*fields, "overlays=false"], lambda folder: {}
    return VerbStep(f"track_{name}", does, "track", [*fields, f"out={poses_of(folder, name)}"], figures)


def _optics(folder: Path, config: Config) -> list[str]:
    """The calibration by the board, as a field; of a demonstration without one the capture's own is used."""
    return [f"calibration={folder / CALIBRATION / calibrate_optics.OPTICS}"] if config.poses else []


def film_steps(folder: Path, config: Config, given: Sequence[str]) -> list[VerbStep]:
    """From a film of the moving target to its poses, and how far they are from the truth."""
    filming = [*_of(given, film.Config, without=("path", "quality")), f"frames={config.film_frames}", f"out={folder / 'film'}"]
    rig = [override for override in _of(given, track.Config) if override.startswith("rig")]
    tracking = [*rig, f"capture={folder / 'film' / 'capture'}", f"out={folder / 'track'}"]
    frames = f"render {config.film_frames} pairs of frames of the moving target"
    return [
        VerbStep("film", frames, "film", filming, makes=("film",)),
        VerbStep(
            "track",
            "track the target through them, and compare with the truth",
            "track",
            tracking,
            partial(_pose_errors, swept=False),
            ("track",),
        ),
    ]


def tumour_errors(folder: Path) -> Metrics:
    """Figures of the tumours found against the true ones, and of where the sweep's pixels are put."""
    findings, truth = compared(folder)
    captured, lag = sweep_part.read_sweep(poses_of(folder, "sweep")), latency_fields.measured(folder / "lag")
    calibration = probe_files.read(folder / "probe" / calibrate_probe.PROBE)
    scans = freehand_scans.of_sweep(captured, calibration, lag.lag_s, truth.transducer.assumed_speed, Unsure(lag.sigma_s))
    apart, sigmas = sweep_errors.placement(scans.world_from_pixel, truth), session_errors.place_sigmas(scans)
    error, sigma = sweep_errors.probe_errors(calibration, truth, five_points(truth.transducer.image_size))
    figures = sweep_errors.measure(findings, truth, metrics.read(folder / "tumours" / metrics.FILE))
    return figures | {
        "sweep_placement_rms_mm": float(np.sqrt(np.nanmean(apart**2))),
        "sweep_placement_sigma_mm": float(np.sqrt(np.nanmean(sigmas**2))),
        "probe_worst_mm": float(error.max()),
        "probe_worst_sigma_mm": float(sigma[error.argmax()]),
        "lag_true_ms": 1e3 * truth.lag_s,
    }


def compared(folder: Path) -> tuple[list[sweep_errors.Finding], sweep_errors.SweepTruth]:
    """The true tumours, each with its match, and the truth."""
    truth = sweep_errors.read_truth(folder / "sweep" / "truth")
    count = int(metrics.read(folder / "tumours" / metrics.FILE)["masses"])
    found = [trimesh.load_mesh(folder / "tumours" / f"mass{number}.ply", process=False) for number in range(count)]
    return sweep_errors.compare(found, truth.hidden), truth


def _figures(part: str) -> Callable[[Path], Metrics]:
    return lambda folder: metrics.read(folder / part / metrics.FILE)


def _named(part: str) -> Callable[[Path], Metrics]:
    """Figures of a step by names that no other has, less its seconds: `frames` of the probe is `probe_frames`."""

    def figures(folder: Path) -> Metrics:
        read = metrics.read(folder / part / metrics.FILE)
        kept = {name.removeprefix(f"{part}_"): value for name, value in read.items() if not name.startswith("seconds_")}
        return {f"{part}_{name}": value for name, value in kept.items()}

    return figures


def _with_meshes(folder: Path) -> Metrics:
    for name in MESHES:
        _offer(folder / "surface" / name, folder, name)
    return _figures("surface")(folder)


def _pose_errors(folder: Path, swept: bool) -> Metrics:
    tracked = tracked_film(folder, swept)
    read = metrics.read(tracked.folder / metrics.FILE)
    figures = {f"track_{name}": value for name, value in read.items() if not name.startswith("seconds_")}
    return figures | track_errors.measure(tracked.errors, tracked.truth)


def tracked_film(folder: Path, swept: bool) -> track_report.Tracked:
    """The tracked frames of the sweep, or of the film where there is none, with their truth."""
    if swept:
        return track_report.read(folder / "sweep", poses_of(folder, "sweep"))
    return track_report.read(folder / "film", folder / "track")


def _offer(source: Path, folder: Path, name: str) -> None:
    """Give a file a second place, without a second copy where the file system can do that."""
    with atomic.listed_file(folder, name, DEMO) as temporary:
        try:
            os.link(source, temporary)
        except OSError:
            shutil.copyfile(source, temporary)


def _given(overrides: Sequence[str]) -> list[str]:
    return [override for override in overrides if not override.startswith("out=")]


def _unless_given(given: Sequence[str], group: str, choice: str) -> list[str]:
    """The demonstration's own choice of a group, where another verb has another, unless one was given."""
    return [] if any(override.startswith(f"{group}=") for override in given) else [f"{group}={choice}"]


def _sets_exposure(override: str) -> bool:
    """Whether an override sets the exposure of the scene, which is not that of the board."""
    return override.lstrip("+~").startswith("shooting.exposure_s")


def _of(overrides: Sequence[str], model: type[BaseModel], without: Sequence[str] = ()) -> list[str]:
    """Those of the overrides that are of a model's fields."""
    wanted = set(model.model_fields) - set(without)
    return [override for override in overrides if override.lstrip("+~").partition("=")[0].partition(".")[0] in wanted]
