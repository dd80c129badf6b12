"""`sonotwin reconstruct`: each part that a capture holds is used, what is missing is named, and nothing is done twice."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from recon.capture import calibration_files, manifest, probe_files, sweep_part
from recon.capture.manifest import Manifest
from recon.files import metrics, volumes
from recon.files.written_files import LIST
from recon.geometry.camera import Camera
from recon.model.calibration import Calibration
from recon.probe_calibration import tank_calibration
from recon.session import latency_step, probe_step
from sonotwin.cli import main
from tests.recon import probe_motions, sweep_sets
from tests.recon.tracking import films

LAG_S = 0.06


def contents(folder: Path) -> dict[str, bytes]:
    """All files but the lists, which hold digests of files with times."""
    files = (path for path in sorted(folder.rglob("*")) if path.is_file() and path.name != LIST)
    return {str(path.relative_to(folder)): path.read_bytes() for path in files}


@pytest.fixture(scope="module")
def tank(tmp_path_factory, rig) -> Path:
    """A session in a tank: crossed wires and a flat bottom, tracked by another tracker."""
    folder = tmp_path_factory.mktemp("tank")
    rng = np.random.default_rng(5)
    made = {"wires": sweep_sets.wires(folder / "a", rig, rng, LAG_S), "bottom": sweep_sets.bottom(folder / "b", rng, LAG_S)}
    sweeps = {}
    for (name, source), purpose in zip(made.items(), ("probe", "latency"), strict=True):
        read = manifest.read_manifest(source)
        shutil.copytree(source / "sweep", folder / "capture" / "sweep" / name)
        images = {device: f"sweep/{name}/{device}" for device in read.sweep.images}
        sweeps[name] = read.sweep.model_copy(update={"purpose": purpose, "images": images, "track": f"sweep/{name}/track.csv"})
    manifest.write_manifest(folder / "capture", Manifest(schema=manifest.SCHEMA, devices=read.devices, sweeps=sweeps))
    return folder / "capture"


@pytest.fixture(scope="module")
def result(tank, tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("result") / "out"
    assert main(["reconstruct", f"capture={tank}", f"temperature_c={sweep_sets.WATER_C}", f"out={out}"]) == 0
    return out


def test_wires_are_calibrated_with_the_lag_of_the_bottom(result, rig):
    found = metrics.read(result / "metrics.json")
    assert found["latency_lag_ms"] == pytest.approx(1e3 * LAG_S, abs=2.0)
    probe, true = probe_files.read(result / "probe" / "probe.yaml"), probe_motions.true_probe(rig)
    corners = np.array([[0, 0], [320, 0], [0, 407], [320, 407], [160, 203]])
    assert np.linalg.norm(probe.to_target(corners) - true.to_target(corners), axis=1).max() < 0.5
    assert not any("seconds" in name for name in found)


def test_each_step_alone_finds_the_same(result, tank, rig):
    """As laboratories of studies call the steps: with things and settings, without folders."""
    lag = latency_step.measure(sweep_part.read_sweep(tank, "bottom", "latency"))
    frames = probe_step.look(sweep_part.read_sweep(tank, "wires", "probe"), lag_s=lag.lag.seconds)
    probe = probe_step.calibrate(frames, rig.probe, tank_calibration.Settings(temperature_c=sweep_sets.WATER_C))
    found = metrics.read(result / "metrics.json")
    for name, figures in {"latency": lag.figures, "probe": probe.figures}.items():
        timeless = {f"{name}_{key}": value for key, value in figures.items() if not key.startswith("seconds_")}
        assert {key: found[key] for key in timeless} == pytest.approx(timeless, rel=1e-12, nan_ok=True)


def test_nothing_is_done_twice(result, tank, capsys):
    before = contents(result)
    assert main(["reconstruct", f"capture={tank}", f"temperature_c={sweep_sets.WATER_C}", f"out={result}"]) == 0
    said = capsys.readouterr().out
    assert "kept        latency" in said and "kept        probe" in said
    assert contents(result) == before


def test_a_lost_step_is_done_again_with_the_same_outcome(result, tank, capsys):
    before = contents(result)
    shutil.rmtree(result / "latency")
    assert main(["reconstruct", f"capture={tank}", f"temperature_c={sweep_sets.WATER_C}", f"out={result}"]) == 0
    assert "kept        probe" in capsys.readouterr().out
    timed = {name for name in before if name.endswith("metrics.json")}
    assert {name: data for name, data in contents(result).items() if name not in timed} == {
        name: data for name, data in before.items() if name not in timed
    }


def test_a_sweep_alone_becomes_a_volume(rig, tmp_path, capsys):
    """Its own track, the capture's calibration of the probe and the lag that is given are enough."""
    capture = sweep_sets.ball(tmp_path / "ball", rig, lag_s=0.05)
    fields = [f"capture={capture}", "lag_s=0.05", "find=nothing", f"out={tmp_path / 'out'}"]
    assert main(["reconstruct", *fields]) == 0
    volume = volumes.read_volume(tmp_path / "out" / "volume" / "volume.nrrd")
    bright = np.argwhere(volume.voxels > 150)[:, ::-1]
    middle = volume.world_from_voxel @ np.append(bright.mean(axis=0), 1)
    assert middle[:3] == pytest.approx(sweep_sets.BALL, abs=0.3)
    said = capsys.readouterr().out
    assert "left out" not in said
    assert (
        f"taken       probe: {capture}/calibration/probe.yaml, the capture's own, as it has no sweep over crossed wires\n" in said
    )


def test_what_is_missing_is_named(rig, tmp_path, capsys):
    """Without a probe's calibration B-scans have no place; without a flat bottom their time stamps count as they are."""
    capture = sweep_sets.ball(tmp_path / "ball", rig, with_probe=False)
    assert main(["reconstruct", f"capture={capture}", f"out={tmp_path / 'out'}"]) == 1
    lines = [line for line in capsys.readouterr().out.splitlines() if line.startswith("left out")]
    assert lines[0].startswith("left out    latency: no sweep over a flat bottom and no lag_s")
    for line, name in zip(lines[1:], ("volume", "masses", "scene"), strict=True):
        assert line.startswith(f"left out    {name}: no calibration of the probe")


def test_masses_that_could_not_be_sought_are_not_said_to_be_none(rig, tmp_path, capsys):
    """B-scans as dark as water. The scene is made again after another calibration, though its sweep has a track of its own."""
    capture = sweep_sets.ball(tmp_path / "ball", rig, lag_s=0.05, count=3)
    for path in (capture / "sweep").rglob("*.png"):
        path.write_bytes(cv2.imencode(".png", np.full((100, 80), 2, np.uint8))[1].tobytes())
    optics = tmp_path / "optics.yaml"
    camera = Camera((64, 48), np.array([[80.0, 0, 32], [0, 80, 24], [0, 0, 1]]), np.zeros(5))
    calibration_files.write(optics, Calibration({"cam1": camera}))
    fields = [f"capture={capture}", "lag_s=0.05", "spacing_mm=3", f"out={tmp_path / 'out'}", f"calibration={optics}"]
    assert main(["reconstruct", *fields]) == 1
    found = metrics.read(tmp_path / "out" / "metrics.json")
    assert np.isnan(found["scene_masses"]) and found["scene_masses_search_failed"] == 1
    said = "The search for masses failed"
    assert said in capsys.readouterr().out
    assert said in (tmp_path / "out" / "scene" / "scene.html").read_text(encoding="utf-8")
    os.utime(optics, ns=(1, 1))
    assert main(["reconstruct", *fields]) == 1
    again = capsys.readouterr().out
    assert "kept        volume" in again and "kept        scene" not in again


def test_frames_alone_become_poses(rig, tmp_path):
    films.film(tmp_path / "film", rig, np.random.default_rng(4), count=2)
    assert main(["reconstruct", f"capture={tmp_path / 'film'}", "lag_s=0", f"out={tmp_path / 'out'}"]) == 0
    assert metrics.read(tmp_path / "out" / "metrics.json")["poses_frames_found"] == 2


def test_a_part_that_can_t_be_used_is_named_and_the_others_are_used(tank, tmp_path, capsys):
    """Exit status 1 then; what was done stays, and is kept by the next run."""
    capture = shutil.copytree(tank, tmp_path / "capture")
    (capture / "sweep" / "wires" / "us" / "0003.png").write_bytes(b"no image")
    assert main(["reconstruct", f"capture={capture}", f"out={tmp_path / 'out'}"]) == 1
    said = capsys.readouterr().out
    assert "left out    probe:" in said and "0003.png" in said
    assert metrics.read(tmp_path / "out" / "metrics.json")["latency_lag_ms"] == pytest.approx(1e3 * LAG_S, abs=2.0)


@pytest.mark.parametrize(("fields", "complaint"), [
    (["probe=nowhere.yaml"], "probe: expected a file, found nothing at nowhere.yaml"),
    (["calibration=."], "calibration: expected a file, found a folder at ."),
    (["networks=nowhere"], "networks: expected a folder or a file, found nothing at nowhere"),
    (["lag_s=nan"], "reconstruct: lag_s: expected"),
    (["find=cysts"], "reconstruct: find: expected"),
    (["spacing_mm=0"], "reconstruct: spacing_mm: expected"),
    (["spacing_mm=200"], "reconstruct: spacing_mm: expected"),
    (["board_length_mm=[240.1,0.03]"], "board_length_mm: expected beside a board that the optics are calibrated by, found none"),
    (["bars=[nowhere]"], "reconstruct: bar_mm: expected beside bars, found nothing"),
    (["bars=[nowhere]", "bar_mm=[150.0,0.002]"], "nowhere: expected a capture, found no such folder"),
])  # fmt: skip
def test_bad_input_is_one_line(tank, tmp_path, capsys, fields, complaint):
    assert main(["reconstruct", f"capture={tank}", f"out={tmp_path / 'out'}", *fields]) == 2
    said = capsys.readouterr().err
    assert complaint in said and said.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_a_folder_of_something_else_is_refused(tank, tmp_path, capsys):
    (tmp_path / "thesis.txt").write_text("mine")
    assert main(["reconstruct", f"capture={tank}", f"out={tmp_path}"]) == 2
    assert "expected a new or empty folder, or one that reconstruct wrote" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.txt"]


def test_a_latency_that_fails_is_not_taken_for_none(tank, tmp_path, capsys):
    """B-scans without a bottom: the probe is left out rather than calibrated 60 ms off, until a lag is given."""
    capture = shutil.copytree(tank, tmp_path / "capture")
    for path in (capture / "sweep" / "bottom" / "us").glob("*.png"):
        path.write_bytes((capture / "sweep" / "bottom" / "us" / "0000.png").read_bytes())
    fields = [f"capture={capture}", f"out={tmp_path / 'out'}"]
    assert main(["reconstruct", *fields]) == 1
    said = capsys.readouterr().out
    assert "left out    latency: " in said and "left out    probe: latency failed; give lag_s" in said
    assert main(["reconstruct", *fields, f"lag_s={LAG_S}"]) == 0
    assert "probe: the ultrasound probe, from crossed wires" in capsys.readouterr().out


def test_a_changed_rig_is_seen(result, tank, tmp_path, capsys):
    """Steps are known by their settings: those of the rig count for the probe, and not for the latency."""
    out = shutil.copytree(result, tmp_path / "out")
    fields = [f"capture={tank}", f"temperature_c={sweep_sets.WATER_C}", "rig.target.c1_mm=25.5", f"out={out}"]
    assert main(["reconstruct", *fields]) == 0
    said = capsys.readouterr().out
    assert "kept        latency" in said and "kept        probe" not in said


@pytest.mark.slow
def test_killed_anywhere_and_started_again_it_is_as_unbroken(result, tank, tmp_path):
    """SIGKILL at four moments; the next run ends with the same bytes but for metrics.json, and leaves nothing behind."""
    out = tmp_path / "out"
    fields = [f"capture={tank}", f"temperature_c={sweep_sets.WATER_C}", f"out={out}"]
    command = [sys.executable, "-m", "sonotwin", "reconstruct", *fields]
    for wait in np.random.default_rng(3).uniform(1.0, 8.0, 4):
        with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as running:
            try:
                running.wait(wait)
            except subprocess.TimeoutExpired:
                running.kill()
        shutil.rmtree(out / "probe", ignore_errors=True)  # so that there is something to do for the next one
    assert main(["reconstruct", *fields]) == 0
    whole = {name for name in contents(result) if not name.endswith("metrics.json")}
    timeless = {name: data for name, data in contents(out).items() if not name.endswith("metrics.json")}
    assert timeless.keys() == whole
    for name in whole - {"reconstruct.json"}:
        assert timeless[name] == (result / name).read_bytes(), name
