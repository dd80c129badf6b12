"""The demonstration, whole: from a command to a report; small here, and with its sweeps among the slow tests."""

import html
import json
import os
import re
import shlex
import shutil
from pathlib import Path

import numpy as np
import pytest

from recon.capture import manifest, probe_files
from recon.errors import InputError
from recon.files import atomic
from recon.files.occupied import occupied
from recon.files.written_files import LIST
from recon.probe_calibration.repeatability import five_points
from recon.tracking import networks
from sonotwin import demonstration, pipeline, rendered_session
from sonotwin.cli import main
from sonotwin.config import load
from sonotwin.demonstration import Config
from sonotwin.pipeline import Step
from sonotwin.verbs import evaluate, film, reconstruct, render, sweep, track
from sonotwin.verbs.demo import followed, looked_inside
from tests.twin.small_rigs import half_as_fields
from twin.evaluation import sweep_errors, track_errors

SMALL = (  # cameras at half their size: fringes of ten pixels a period
    "rig.cam1.optics.size=[640,512]",
    "rig.cam1.optics.focal_px=[1660.0,1665.5]",
    "rig.cam1.optics.centre_px=[308.75,261.25]",
    "rig.cam1.sensor.pixel_um=9.6",
    "rig.cam2.optics.size=[640,512]",
    "rig.cam2.optics.focal_px=[1659.0,1664.5]",
    "rig.cam2.optics.centre_px=[305.75,258.75]",
    "rig.cam2.sensor.pixel_um=9.6",
    "tracing.samples=4",
    "scene.edge_mm=1.5",
    "poses.count=3",
    "board_samples=2",
    "film_frames=0",  # a camera of half the size shows the tracker half a target
)
COARSE = [  # B-scans of half the lines and two thirds of the rows, too few for beams from several directions
    "ultrasound=linear",
    *(
        f"{part}.{field}"
        for part in ("rig.probe", "ultrasound")
        for field in ("image_size=[161,272]", "scale_mm_per_px=[0.2458,0.18375]")
    ),
]
MADE = ("report.html", "surface.ply", "surface.glb", "metrics.json", "result/optics/calibration.html", "truth/board.npz")
MADE_INSIDE = (
    "result/probe/probe.yaml",
    "result/latency/lag.json",
    "result/volume/scan/volume.nrrd",
    "result/masses/scan/mass0.ply",
    "result/poses/scan/poses.csv",
    "result/scene/scan/scene.html",
    "result/scene/scan/slicer/masses.mrk.json",
    "truth/sweep/scan/scene.json",
)


def figures(folder):
    return json.loads((folder / "metrics.json").read_text(encoding="utf-8"))


def test_a_small_demonstration_runs_through(tmp_path, capsys):
    out = tmp_path / "demo"
    assert main(["demo", *SMALL, "path=none", f"out={out}", f"board={tmp_path / 'board'}"]) == 0
    assert not [name for name in MADE if not (out / name).is_file()]
    metrics = figures(out)
    # With four samples a pixel rendering noise adds to the sensor's; at this size edges are a larger part of the image.
    # Three poses of a board that is printed and bowed as in life leave the scale open, as the calibration says.
    assert metrics["surface_interior_rms_mm"] < 3 * np.hypot(metrics["limit_rms_mm"], metrics["point_sigma_mm"])
    assert metrics["point_error_rms_mm"] < 2.5 * metrics["point_sigma_mm"]
    assert metrics["shape_error_rms_mm"] < 2.5 * metrics["shape_sigma_mm"] < 0.25
    assert metrics["coverage"] > 0.95 and metrics["gross_error_fraction"] < 0.01
    steps = ("board", "render", "reconstruct", "evaluate", "report", "demo")
    assert all(f"seconds_{name}" in metrics for name in steps)
    assert max(metrics[f"reprojection_rms_{name}_px"] for name in ("cam1", "cam2", "projector")) < 0.02
    printed = capsys.readouterr().out.splitlines()
    wrote = [re.fullmatch(r"wrote +(.*)/\{(.*)\}", line) for line in printed if line.startswith("wrote")]
    assert len(wrote) == 7  # two renders, four steps of the reconstruction, and the evaluation
    assert all((Path(folder) / name).exists() for folder, names in (line.groups() for line in wrote) for name in names.split(","))
    assert (out / "surface.ply").read_bytes() == (out / "result" / "surface" / "surface.ply").read_bytes()
    report = html.unescape((out / "report.html").read_text(encoding="utf-8"))
    assert f"sonotwin render '{SMALL[0]}' '{SMALL[1]}'" in report and "conditions=lifelike" in report
    last = printed[-5:]
    assert [line.split()[0] for line in last] == ["measured", "accuracy", "calibrated", "coverage", "look"]
    assert str(out / "report.html") in last[-1]


def test_the_tank_is_seen_by_the_scanner_of_the_sweep():
    """Also by one of another size whose settings are a file, so that no override names it."""
    parts = {part.name: part.settings for part in rendered_session.parts(load("demo", COARSE, Config), Path("out"))}
    for name in ("wires", "bottom", "scan"):
        assert parts[name].ultrasound.image_size == (161, 272)


@pytest.mark.slow
def test_the_demonstration_is_as_good_as_the_noise_allows(rig, tmp_path, capsys):
    """Without errors of the laboratory: outside, inside, and the report of both; steps that are lost come back the same.

    By cameras of half the size, by fewer B-scans and frames. A pixel's noise is that of a whole camera, the calibration's
    twice as large: `make accuracy ONLY=session` has the bars of whole ones.
    """
    few = ["wires=20", "bottom_s=2.5", "clocks.camera_hz=12", "path.speed_mm_s=28"]
    fields = ["conditions=ideal", *half_as_fields(rig), *few, f"out={tmp_path / 'demo'}", f"board={tmp_path / 'board'}"]
    assert main(["demo", *fields]) == 0
    demonstrated = load("demo", fields, Config)
    check_figures(demonstrated.out, capsys.readouterr().out.splitlines())
    check_motion_of_frames(demonstrated)
    check_lost_steps(demonstrated, capsys)


def check_figures(out: Path, printed: list[str]) -> None:
    """What was measured against the truth, the lines that say so, and the report."""
    assert not [name for name in (*MADE, *MADE_INSIDE) if not (out / name).is_file()]
    metrics = figures(out)
    # the surface's noise and the calibration's: a common shift of all points, of another size in each session
    noise = np.hypot(metrics["limit_rms_mm"], metrics["point_sigma_mm"])
    assert metrics["surface_interior_rms_mm"] < 1.1 * noise and metrics["point_error_rms_mm"] < 2.5 * metrics["point_sigma_mm"]
    assert 0.02 < metrics["point_sigma_mm"] < 0.08  # by geometry: as of drawn points with a sighting's noise, of such pixels
    assert metrics["shape_error_rms_mm"] < 0.1 * metrics["limit_rms_mm"]
    assert metrics["surface_rms_mm"] < 0.1  # better than the paper's planes
    assert metrics["coverage"] > 0.98 and metrics["gross_error_fraction"] < 1e-4
    assert 0.9 < metrics["z_std"] < 3  # sigma is of noise alone, a third of one camera's: beside it the calibration's form shows
    assert (metrics["tumours_true"], metrics["tumours_found"], metrics["tumours_false"]) == (3, 3, 0)
    assert metrics["lag_low_ms"] - 2 < 50 < metrics["lag_high_ms"] + 2
    assert metrics["placement_rms_mm"] < 1
    assert metrics["track_visible_found"] == metrics["track_visible"] > 12 and metrics["track_false"] == 0
    assert metrics["track_shift_median_mm"] < 0.1 and metrics["track_within_bound"] > 0.8
    for k in range(3):
        assert metrics[f"tumour{k}_centre_error_mm"] < 1 and metrics[f"tumour{k}_inside"] == 1
        assert metrics[f"tumour{k}_volume_mm3"] == pytest.approx(metrics[f"tumour{k}_true_volume_mm3"], rel=0.08)
    assert metrics["tumour0_dice"] > 0.85
    assert all(f"seconds_{name}" in metrics for name in ("render", "board", "wires", "bottom", "scan", "reconstruct", "evaluate"))
    said = ["measured", "accuracy", "calibrated", "probe", "lag", "tumours", "tracked", "coverage", "look"]
    assert [line.split()[0] for line in printed[-9:]] == said
    report = html.unescape((out / "report.html").read_text(encoding="utf-8"))
    assert "From board to tumour" in report and 'data-slide="scene"' in report
    assert "sonotwin reconstruct" in report and "tumours, found" in report
    assert (out / "report.html").stat().st_size < 12e6
    for name in ("wires", "bottom"):  # the demonstration measures the scan's alone
        expected = track_errors.read_truth(out / "truth", name)
        errors = track_errors.compare(track_errors.read_track(out / "result" / "poses" / name / "poses.csv", expected), expected)
        track = track_errors.measure(errors, expected)
        assert track["track_visible_found"] == track["track_visible"] > 0
        assert track["track_false"] == 0 and track["track_shift_median_mm"] < 0.1
    truth = sweep_errors.read_truth(out / "truth", "scan")
    probe = probe_files.read(out / "result" / "probe" / "probe.yaml")
    off, sigma = sweep_errors.probe_errors(probe, truth, five_points(truth.transducer.image_size))
    assert off.max() < 0.6 and (off < 4 * sigma).all()


def check_motion_of_frames(config: Config) -> None:
    """By their truth the board moves over an exposure as fast as from frame to frame, and is seen whole in most of them."""
    with np.load(config.out / "truth" / "sweep" / "scan" / "film.npz") as film:
        places, speed = film["world_from_target"][:, :3, 3], film["shift_mm"] / 0.01
    between = (places[2:] - places[:-2]) * config.clocks.camera_hz / 2
    assert np.median(np.linalg.norm(speed[1:-1] - between, axis=1)) < 0.1 * np.median(np.linalg.norm(between, axis=1))
    assert track_errors.visible_whole(track_errors.read_truth(config.out / "truth", "scan")).mean() > 0.9


def check_lost_steps(config: Config, capsys) -> None:
    """They and those that build on them come back to the same bytes, while the truth is away; no other step is done again.

    But for the seconds in metrics.json, and its digest in the list.
    """
    result = config.out / "result"

    def contents() -> dict[str, bytes]:
        files = (path for path in sorted(result.rglob("*")) if path.is_file() and path.name not in ("metrics.json", LIST))
        return {str(path.relative_to(result)): path.read_bytes() for path in files}

    before = contents()
    for name in ("surface", "poses/wires", "latency"):
        shutil.rmtree(result / name)
    (config.out / "truth").rename(config.out.parent / "truth")
    try:
        assert reconstruct.run(config.reconstruction) == 0
    finally:
        (config.out.parent / "truth").rename(config.out / "truth")
    said = capsys.readouterr().out
    assert all(f"kept        {name}" in said for name in ("optics", "poses/scan", "poses/bottom"))
    assert contents() == before


def silent(_):
    pass


def step(folder, name, works=True, makes=(), figure=None):
    def work(figures):
        for made in makes:
            with atomic.listed_file(folder, made, pipeline.DEMO) as path:
                path.write_text(name, encoding="utf-8")
        if not works:
            raise KeyboardInterrupt
        return {figure or name: len(figures)}

    return Step(name, f"do {name}", work, makes)


def test_steps_see_the_figures_before_them(tmp_path):
    told, folder = [], tmp_path / "demo"
    metrics = pipeline.play([step(folder, "first"), step(folder, "second")], folder, {"seed": 3}, told.append)
    assert told == ["1/2 do first", "2/2 do second"]
    assert (metrics["first"], metrics["second"]) == (0, 2)  # its figure, and its seconds
    assert metrics == figures(folder)
    assert json.loads((folder / "demo.json").read_text(encoding="utf-8")) == {"seed": 3}


def test_a_run_that_was_killed_leaves_nothing_to_the_next(tmp_path):
    """A first run is complete, a second dies halfway, killed ones have left temporary folders and files, a third starts clean."""
    folder, afresh = tmp_path / "demo", {"truth": "the twin"}
    report = step(folder, "report", makes=("report.html",))
    pipeline.play([step(folder, "render"), report], folder, {}, silent, afresh)
    with atomic.new_folder(folder / "truth", "the twin") as truth:
        (truth / "scene.json").write_text("{}")
    (folder / ".truth.4194305.new").mkdir()
    (folder / ".report.4194305.new.html").write_text("half")
    (folder / ".demo.4194305.new.json").write_text("half")
    with pytest.raises(KeyboardInterrupt):
        pipeline.play([step(folder, "render", works=False), report], folder, {}, silent, afresh)
    assert sorted(path.name for path in folder.iterdir()) == [".sonotwin.json", "demo.json"]  # no old report beside a new capture
    pipeline.play([step(folder, "render"), report], folder, {}, silent, afresh)
    assert sorted(path.name for path in folder.iterdir()) == [".sonotwin.json", "demo.json", "metrics.json", "report.html"]


def test_a_folder_with_a_changed_file_is_refused_before_anything_is_removed(tmp_path):
    folder = tmp_path / "demo"
    pipeline.play([step(folder, "render")], folder, {}, silent)
    with atomic.new_folder(folder / "truth", "the twin") as truth:
        for name in ("a.json", "b.json"):
            (truth / name).write_text("{}")
    (folder / "truth" / "a.json").write_text("annotated")
    with pytest.raises(InputError, match="changed since"):
        pipeline.play([step(folder, "render")], folder, {}, silent, {"truth": "the twin"})
    assert {path.name for path in (folder / "truth").glob("*.json")} == {"a.json", "b.json", ".sonotwin.json"}


def test_a_sweep_of_ones_own_in_the_capture_is_no_part_of_a_demonstration(tmp_path, capsys):
    """It is named before any work, and stays."""
    parts = {"sweeps": {"mine": {"images": {"us": "sweep/mine/us"}}}, "devices": {"us": {"size": [16, 16]}}}
    (tmp_path / "demo" / "capture").mkdir(parents=True)
    (tmp_path / "demo" / "capture" / "manifest.json").write_text(json.dumps({"schema": manifest.SCHEMA} | parts))
    assert main(["demo", f"out={tmp_path / 'demo'}"]) == 2
    assert "found sweep/mine in it" in capsys.readouterr().err


def test_hidden_files_of_others_stay(tmp_path):
    """What isn't a step's own temporary is nobody's to delete."""
    folder = tmp_path / "demo"
    report = step(folder, "report", makes=("report.html",))
    pipeline.play([report], folder, {}, silent)
    others = {".git", ".notes.2024.md", ".report.html", ".other.4194305.new"}
    for name in others:
        (folder / name).mkdir()
    pipeline.play([report], folder, {}, silent)
    assert others < {path.name for path in folder.iterdir()}


def test_a_figure_has_one_meaning(tmp_path):
    """A step that contradicts an earlier one is stopped."""
    first, second = step(tmp_path, "first", figure="points"), step(tmp_path, "second", figure="points")
    with pytest.raises(ValueError, match="second: points: expected 0 as before, found 2"):
        pipeline.play([first, second], tmp_path / "a", {}, silent)


def test_other_peoples_files_are_left_alone(tmp_path):
    (tmp_path / "thesis.tex").write_text("years of work", encoding="utf-8")
    with pytest.raises(InputError, match="found other files"):
        pipeline.play([step(tmp_path, "render")], tmp_path, {}, silent)
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.tex"]


MODELS = {"render": render, "sweep": sweep, "reconstruct": reconstruct, "evaluate": evaluate, "film": film, "track": track}


@pytest.mark.parametrize(("overrides", "verbs"), [
    (["scene=sphere", "poses=paper"], ["render", "render", "reconstruct", "evaluate", "film", "track"]),  # it hides nothing
    (["poses=none", "path=none", "film_frames=0"], ["render", "reconstruct", "evaluate"]),
    (["poses=none", "clocks.lag_s=0.08", "scene.edge_mm=1.5", *COARSE], ["render", *3 * ["sweep"], "reconstruct", "evaluate"]),
    (["scene=two_objects", "poses.count=4", "shooting.gain=2", "seed=3", "path=none", "film_frames=0"],
     ["render", "render", "reconstruct", "evaluate"]),
])  # fmt: skip
def test_the_commands_of_the_report_give_the_settings_of_the_steps(tmp_path, overrides, verbs):
    """Each line, read as a shell would, is the demonstration's own settings of that step again."""
    out = tmp_path / "a b"
    config = load("demo", [*overrides, f"out={out}"], Config)
    first, *lines = [shlex.split(line)[1:] for line in demonstration.commands(config)]
    assert load("demo", first[1:], Config) == config
    assert [line[0] for line in lines] == verbs
    steps = [part.settings for part in rendered_session.parts(config, out)]
    steps += [config.reconstruction, config.comparison, *(config.filming or ())]
    for (verb, *fields), settings in zip(lines, steps, strict=True):
        assert load(verb, fields, MODELS[verb].Config) == settings
    assert all("add=true" in line and f"out={out}" in line for line in lines if line[0] in ("render", "sweep")), "one capture"


@pytest.mark.parametrize("overrides", [[], ["scene=two_objects", "poses.count=4", "shooting.gain=2", "seed=3"]])
def test_each_part_has_the_demonstrations_settings(overrides, tmp_path):
    """The demonstration's fields reach each part, but for those that it sets itself; the others are its verb's own defaults."""
    config = load("demo", overrides, Config)
    own = {
        "board": {"scene", "patterns", "cameras", "shooting", "tracing"},
        "render": {"poses"},
        "wires": {"scene", "path", "ultrasound", "clocks"},
        "bottom": {"scene", "path", "ultrasound"},
        "scan": set[str](),
    }
    for part in rendered_session.parts(config, tmp_path):
        model = type(part.settings)
        shared = set(model.model_fields) & set(Config.model_fields) - {"out", "add"} - own[part.name]
        assert {name: getattr(part.settings, name) for name in shared} == {name: getattr(config, name) for name in shared}
        usual = load(part.verb, [f"out={tmp_path}"], model)
        rest = set(model.model_fields) - set(Config.model_fields) - {"add", "name", "filmed"}
        assert {name: getattr(part.settings, name) for name in rest} == {name: getattr(usual, name) for name in rest}


@pytest.mark.parametrize(("overrides", "inside"), [([], True), (["path=none"], False), (["scene=sphere"], False)])
def test_only_what_has_tumours_is_looked_into(overrides, inside):
    config = load("demo", overrides, Config)
    assert config.looks_inside is inside


def test_what_is_left_out_is_said():
    """A sphere hides nothing, and a person might wonder; who asks for no path knows."""
    sphere, none = (load("demo", overrides, Config) for overrides in (["scene=sphere"], ["path=none"]))
    (line,) = looked_inside(sphere, {})
    assert line.startswith("left out") and "sphere" in line
    assert looked_inside(none, {}) == []


def test_missing_networks_are_told_before_any_work(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(networks.load, "__defaults__", (tmp_path, *networks.load.__defaults__[1:]))
    assert main(["demo", f"out={tmp_path / 'demo'}"]) == 2
    assert "detector.onnx: expected a network, found none" in capsys.readouterr().err
    assert not (tmp_path / "demo").exists()


def test_how_the_target_was_tracked_is_said():
    found = {"found": 17, "frames": 24, "visible": 15, "visible_found": 14}
    errors = {"shift_median_mm": 0.03, "shift_p95_mm": 0.08, "turn_median_deg": 0.15, "turn_p95_deg": 0.3}
    (line,) = followed({f"track_{name}": value for name, value in (found | errors).items()})
    assert line.startswith("tracked     the target in 17 of 24 frames, in 14 of 15 that show it whole; off by 0.030 mm and 0.150")
    assert followed({}) == []


def test_two_scanners_are_refused_before_any_work(tmp_path, capsys):
    assert main(["demo", "ultrasound.image_size=[161,272]", f"out={tmp_path / 'demo'}"]) != 0
    assert "ultrasound.image_size: expected rig.probe's [321, 408]" in capsys.readouterr().err
    assert not (tmp_path / "demo").exists()


def test_a_second_demonstration_into_the_folder_is_refused_at_once(tmp_path, capsys):
    """It would empty the capture of the first one."""
    out = tmp_path / "out"
    with occupied(out):
        assert main(["demo", f"out={out}", f"board={tmp_path / 'board'}", *SMALL]) == 2
    said = capsys.readouterr().err
    assert f"found process {os.getpid()} on " in said and said.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def test_a_folder_of_others_is_no_place_for_the_board(tmp_path, capsys):
    """It stays as it is, and nothing is begun beside it."""
    (tmp_path / "paper").mkdir()
    (tmp_path / "paper" / "thesis.tex").write_text("years of work")
    assert main(["demo", f"board={tmp_path / 'paper'}", f"out={tmp_path / 'demo'}"]) == 2
    assert "paper: expected a new or empty folder, or one that the twin wrote" in capsys.readouterr().err
    assert [path.name for path in (tmp_path / "paper").iterdir()] == ["thesis.tex"] and not (tmp_path / "demo").exists()
