"""Calibrate the rendered rig, measure a phantom outside and inside with it, compare with the truth, and report the whole story.

Reads the same choices from conf/ as `sonotwin render`, `sonotwin sweep` and `sonotwin film`. Writes into the folder `out`:
report.html and calibration/calibration.html (open them in a browser; they need no network), surface.ply (mm), surface.glb
(metres, y up), metrics.json; of scenes with tumours volume/volume.nrrd and tumours/; track/, the tracker's poses in a film; the
captures and their truth, and the folders of the steps between. Takes five to seven minutes on two cores, half of that without
ultrasound (path=none), and less than a minute less without the film (film_frames=0); the first run ever also compiles, for some
minutes. The board's images are kept and used again by all demonstrations of the same rig. A run that was interrupted is simply
started again.

    sonotwin demo
    sonotwin demo poses=paper path=none
    sonotwin demo scene=sphere patterns=gray_surface out=outputs/sphere
"""

import json
import os
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from rich.console import Console

from recon.capture import probe_files, sweep_part
from recon.capture.surface_part import read_patterns
from recon.files import atomic, metrics
from recon.files.metrics import Metrics, shown
from recon.freehand import sequences
from recon.probe_calibration import sound_in_water
from recon.tracking import networks
from sonotwin import pipeline
from sonotwin.config import folder as conf
from sonotwin.demo_commands import commands
from sonotwin.demo_config import BOARD, BOARD_PATTERNS, CALIBRATION, WATER_C, Config
from sonotwin.pipeline import Step
from sonotwin.verbs import (
    calibrate_optics,
    calibrate_probe,
    evaluate,
    film,
    freehand,
    measure_lag,
    render,
    segment,
    surface,
    sweep,
    track,
)
from twin.evaluation import sweep_errors, track_errors
from twin.evaluation.surface_errors import things
from twin.reports import demo_report, sweep_report, track_report
from twin.ultrasound.probe_path import Bob, WirePath

Figures = Mapping[str, float | int]

MESHES = ("surface.ply", "surface.glb")
OUTPUTS = (
    ("report.html", "this page"),
    ("surface.ply", "the surface: triangles, normals and predicted sigma of each vertex, in mm"),
    ("surface.glb", "the same for viewers and for the web, in metres"),
    ("metrics.json", "all figures on this page and some more"),
    ("calibration/calibration.html", "the calibration that the surface was measured with, and how far it can be trusted"),
    ("volume/volume.nrrd", "the B-scans of the sweep as a volume in the frame of the surface, in mm"),
    ("tumours/", "what was found inside: a closed surface each, in mm"),
    ("probe/probe.yaml", "the calibration of the probe, with its covariance"),
    ("lag/lag.json", "by how much the scanner lags behind the cameras"),
    ("track/", "the target's poses in the film with their covariance, why some weren't found, and pictures of all frames"),
    ("capture/", "the images, their manifest and the calibration, as a camera would have left them"),
    ("truth/", "what the images were rendered from: points, normals, projector coordinates, true calibration"),
    ("sweep/, wires/, bottom/", "the B-scans and poses of the sweep, of crossed wires and of a flat bottom, and their truth"),
    ("film/", "frames of the moving target by both cameras, and their truth"),
    ("surface/points.npz", "the point of every pixel and its predicted sigma"),
    ("evaluation/error_map.png", "map of the errors"),
    ("demo.json", "every setting"),
)


def run(config: Config) -> None:
    """Play the steps, then say in some lines what came out.

    Raises
    ------
    InputError
        If a setting is wrong, the tracker's networks are missing, or `out` holds something else.
    """
    console = Console(soft_wrap=True, highlight=False)
    if config.film_frames:
        networks.load()  # before minutes of work
    steps = (calibration_steps(config) if config.poses else []) + surface_steps(config)
    steps += sweep_steps(config) if config.looks_inside else []
    steps += [*(film_steps(config) if config.film_frames else []), telling_step(config)]
    found = pipeline.play(
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

    return [
        Step("render", f"render {config.patterns.count} images of the scene and its truth", rendering, ("capture", "truth")),
        Step("surface", "reconstruct the surface from the images", reconstruction, ("surface", *MESHES)),
        # its prediction is of the points that have a truth, by the true normals
        Step("evaluate", "compare it with the truth", comparison, ("evaluation",), refines=("predicted_rms_mm",)),
    ]


def sweep_steps(config: Config) -> list[Step]:
    """From the probe's calibration to the tumours under the surface, and how far they are from the truth."""

    def wires(folder: Path, _: Figures) -> Figures:
        path = WirePath(count=config.wires)
        sweep.run(config.sweeping(folder / "wires", scene={"kind": "crosswire"}, path=path, ultrasound=config.in_water()))
        return {}

    def probe(folder: Path, _: Figures) -> Figures:
        places = {"capture": folder / "wires" / "capture", "out": folder / "probe"}
        calibrate_probe.run(calibrate_probe.Config(rig=config.rig, temperature_c=WATER_C, **places))
        return _named("probe", metrics.read(folder / "probe" / metrics.FILE))

    def bottom(folder: Path, _: Figures) -> Figures:
        path = Bob(seconds=config.bottom_s)
        sweep.run(config.sweeping(folder / "bottom", scene={"kind": "tank"}, path=path, ultrasound=config.in_water()))
        return {}

    def lag(folder: Path, _: Figures) -> Figures:
        measure_lag.run(measure_lag.Config(capture=folder / "bottom" / "capture", out=folder / "lag"))
        return _named("lag", metrics.read(folder / "lag" / metrics.FILE))

    def sweeping(folder: Path, _: Figures) -> Figures:
        sweep.run(config.sweeping(folder / "sweep"))
        return {}

    def volume(folder: Path, _: Figures) -> Figures:
        freehand.run(freehand.Config(out=folder / "volume", tissue_m_s=config.tissue_m_s, **_placed(folder)))
        return _named("volume", metrics.read(folder / "volume" / metrics.FILE))

    def tumours(folder: Path, _: Figures) -> Figures:
        places = {"surface": folder / "surface" / "surface.ply", "out": folder / "tumours"}
        segment.run(segment.Config(kind="masses", tissue_m_s=config.tissue_m_s, **places, **_placed(folder)))
        return {}

    def comparison(folder: Path, _: Figures) -> Figures:
        findings, truth = compared(folder)
        captured, placed = sweep_part.read_sweep(folder / "sweep" / "capture"), _placed(folder)
        calibration = probe_files.read(placed["probe"])
        shown = sequences.target_from_pixel(sound_in_water.for_tissue(calibration, truth.transducer.assumed_speed))
        apart = sweep_errors.placement(captured.poses(placed["lag_s"]) @ shown, truth)
        figures = sweep_errors.measure(findings, truth, metrics.read(folder / "tumours" / metrics.FILE))
        return figures | {"sweep_placement_rms_mm": float(np.sqrt(np.nanmean(apart**2)))}

    return [
        Step("wires", f"render {config.wires} B-scans of crossed wires", wires, ("wires",)),
        Step("probe", "calibrate the ultrasound probe", probe, ("probe",)),
        Step("bottom", "render B-scans of a flat bottom, up and down", bottom, ("bottom",)),
        Step("lag", "measure by how much the scanner lags behind the cameras", lag, ("lag",)),
        Step("sweep", "render a sweep over the scene and its truth", sweeping, ("sweep",)),
        Step("volume", "put its B-scans into a volume", volume, ("volume",)),
        Step("tumours", "find tumours in its B-scans", tumours, ("tumours",)),
        Step("compare", "compare them with the truth", comparison),
    ]


def film_steps(config: Config) -> list[Step]:
    """From a film of the moving target to its poses, and how far they are from the truth."""

    def filming(folder: Path, _: Figures) -> Figures:
        film.run(config.filming(folder / "film"))
        return {}

    def tracking(folder: Path, _: Figures) -> Figures:
        track.run(track.Config(rig=config.rig, capture=folder / "film" / "capture", out=folder / "track"))
        tracked = track_report.read(folder / "film", folder / "track")
        own = _named("track", metrics.read(folder / "track" / metrics.FILE))
        return own | track_errors.measure(tracked.errors, tracked.truth)

    return [
        Step("film", f"render {config.film_frames} pairs of frames of the moving target", filming, ("film",)),
        Step("track", "track the target through them, and compare with the truth", tracking, ("track",)),
    ]


def telling_step(config: Config) -> Step:
    """The report of all steps before it."""

    def telling(folder: Path, figures: Figures) -> Figures:
        story = demo_report.read(folder / "capture", folder / "truth", folder / "surface" / surface.POINTS, config.cameras[0])
        inside = None
        if config.looks_inside:
            findings, truth = compared(folder)
            places = {name: folder / name for name in ("sweep", "bottom", "probe", "lag", "volume")}
            inside = sweep_report.read(places, findings, truth)
        tracked = track_report.read(folder / "film", folder / "track") if config.film_frames else None
        outputs = [(name, text) for name, text in OUTPUTS if (folder / name.partition(",")[0]).exists() or name == "report.html"]
        lines = commands(folder, config, config._overrides, inside.lag_s if inside else 0.0)
        demo_report.write(folder / "report.html", story, dict(figures), outputs, lines, inside, tracked)
        return {}

    return Step("report", "write the report", telling, ("report.html",))


def compared(folder: Path) -> tuple[list[sweep_errors.Finding], sweep_errors.SweepTruth]:
    """The true tumours with what was found of each, and the truth."""
    truth = sweep_errors.read_truth(folder / "sweep" / "truth")
    count = int(metrics.read(folder / "tumours" / metrics.FILE)["masses"])
    found = [trimesh.load_mesh(folder / "tumours" / f"mass{number}.ply", process=False) for number in range(count)]
    return sweep_errors.compare(found, truth), truth


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
        *looked_inside(config, found),
        *followed(found),
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


def looked_inside(config: Config, found: Metrics) -> list[str]:
    """What ultrasound found, and how well it knows where it looks; or why it wasn't asked."""
    if not config.looks_inside:
        return (
            []
            if config.path is None
            else [f"left out    ultrasound: nothing is to be found inside the scene ({config.scene['kind']})"]
        )
    errors = sweep_errors.of_each(found, "centre_error_mm")
    off = f", centres off by {', '.join(f'{error:.2f}' for error in errors)} mm" if errors else ""
    count = sum(value == 1 for value in sweep_errors.of_each(found, "inside"))
    false = f"; {found['tumours_false']} more are none" if found["tumours_false"] else ""
    return [
        f"probe       from {found['probe_frames_used']} B-scans of crossed wires: {found['probe_rms_mm']:.3f} mm RMS; image "
        f"centre known to {found['probe_sigma_centre_mm']:.3f} mm, by its own prediction",
        f"lag         {found['lag_ms']:.1f} ms, {found['lag_low_ms']:.1f} to {found['lag_high_ms']:.1f} ms (95 %), true "
        f"{1e3 * config.clocks.lag_s:.1f}; pixels of the sweep off by {found['sweep_placement_rms_mm']:.3f} mm RMS",
        f"tumours     {found['tumours_found']} of {found['tumours_true']} found, {count} inside the surface{off}{false}",
    ]


def followed(found: Metrics) -> list[str]:
    """How well the target was tracked, if there was a film."""
    if "track_found" not in found:
        return []
    medians = f"{shown(found['track_shift_median_mm'], '.3f', ' mm')} and {shown(found['track_turn_median_deg'], '.3f', ' deg')}"
    most = f"{shown(found['track_shift_p95_mm'], '.3f', ' mm')} and {shown(found['track_turn_p95_deg'], '.3f', ' deg')}"
    return [
        f"tracked     the target in {found['track_found']} of {found['track_frames']} frames, in {found['track_visible_found']} "
        f"of {found['track_visible']} that show it whole; off by {medians} in the median, 95 % by less than {most}"
    ]


def _placed(folder: Path) -> dict[str, Any]:
    """What places a sweep's B-scans in the world: fields of `freehand` and `segment`."""
    lag_s = json.loads((folder / "lag" / measure_lag.LAG).read_text(encoding="utf-8"))["lag_s"]
    return {"capture": folder / "sweep" / "capture", "probe": folder / "probe" / calibrate_probe.PROBE, "lag_s": lag_s}


def _named(step: str, figures: Metrics) -> Metrics:
    """Figures of a step by names that no other has, less its seconds: `frames` of the probe is `probe_frames`."""
    kept = {name.removeprefix(f"{step}_"): value for name, value in figures.items() if not name.startswith("seconds_")}
    return {f"{step}_{name}": value for name, value in kept.items()}


def _offer(source: Path, path: Path) -> None:
    """Give a file a second place, without a second copy where the file system can do that."""
    with atomic.new_file(path) as temporary:
        try:
            os.link(source, temporary)
        except OSError:
            shutil.copyfile(source, temporary)
