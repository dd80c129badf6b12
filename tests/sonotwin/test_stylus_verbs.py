"""A stylus from end to end: `calibrate-probe phantom=stylus`, of captures and of sequences of PLUS."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from recon.capture import probe_files, tip_files
from recon.capture.manifest import SCANNER, Device
from recon.capture.writer import new_capture
from recon.freehand import sequences
from recon.freehand.sequences import Frames
from recon.geometry import rigid
from recon.model.tracks import Track
from recon.probe_calibration import repeatability
from sonotwin.cli import main
from tests.recon import bscans, stylus_motions, sweep_sets
from tests.recon.probe_motions import true_probe

RADIUS_MM = 0.5


@pytest.fixture(scope="module")
def recording(tmp_path_factory, rig) -> Path:
    """A capture of 40 drawn B-scans with poses of probe and stylus, the same as a sequence, and files of two tips."""
    folder, rng = tmp_path_factory.mktemp("stylus"), np.random.default_rng(4)
    probe = true_probe(rig)
    echo = replace(probe, target_from_image=probe.target_from_image @ rigid.transform(np.eye(3), [0, RADIUS_MM, 0]))
    led = stylus_motions.lead(echo, bscans.SIZE, rng, slice_mm=0.1)
    images = [bscans.image(bscans.spot(pixel) + bscans.face(), rng) for pixel in led.pixels]
    seconds = np.arange(len(images), dtype=float)
    moments = sweep_sets.nanoseconds((seconds[:, None] + [-0.05, 0.05]).ravel())
    target, stylus = (
        Track(moments, *(np.repeat(each, 2, axis=0) for each in (one.poses, one.covariance)))
        for one in (stylus_motions.tracked(poses, rng) for poses in (led.probe, led.stylus))
    )
    with new_capture(folder / "capture", "stylus") as capture:
        scans = ((SCANNER, image) for image in images)
        devices = {SCANNER: Device(size=bscans.SIZE)}
        capture.add_sweep(
            {SCANNER: sweep_sets.nanoseconds(seconds)}, scans, devices, target, purpose="probe", bodies={"stylus": stylus}
        )
    valid = dict.fromkeys(("ProbeToTracker", "StylusToTracker", "Image"), np.ones(len(images), bool))
    transforms = {"ProbeToTracker": target.poses[::2], "StylusToTracker": stylus.poses[::2]}
    sequences.write_sequence(folder / "stylus.igs.mha", Frames(seconds, transforms, valid, np.stack(images)))
    tip = stylus_motions.known_tip(rng)
    tip_files.write(folder / "tip.yaml", tip)
    tip_files.write(folder / "needle.yaml", replace(tip, body="needle"))
    tip_files.write(folder / "bent.yaml", replace(tip, tip_mm=tip.tip_mm + np.array([4.0, 0, 0])))
    return folder


CAPTURE = ("capture=capture", "body=stylus", "lag_s=0")
SEQUENCE = ("sequence=stylus.igs.mha", "reference=Stylus")
WATER = ("tank_speed=1540", f"tip_radius_mm={RADIUS_MM}")


@pytest.mark.parametrize("source", [CAPTURE, SEQUENCE])
@pytest.mark.parametrize("tip", [("tip=tip.yaml",), ()])
def test_a_recording_becomes_a_calibration(source, tip, recording, rig, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(recording)
    assert main(["calibrate-probe", "phantom=stylus", *source, *tip, *WATER, f"out={tmp_path / 'probe'}"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines][:4] == ["find", "calibrate", "held", "tip"]
    assert not any("warning" in line for line in lines)
    points, true = repeatability.five_points(bscans.SIZE), true_probe(rig)
    found = probe_files.read(tmp_path / "probe" / "probe.yaml")
    assert np.linalg.norm(found.to_target(points) - true.to_target(points), axis=1).max() < 0.3
    figures = json.loads((tmp_path / "probe" / "metrics.json").read_text())
    assert figures["held_out_rms_mm"] < 0.4, "with the noise of each frame: 0.3 mm of poses and pixels"
    assert figures["echo_ahead_mm"] == RADIUS_MM


@pytest.mark.parametrize(("given", "said"), [
    ((*CAPTURE, "tip=needle.yaml"), "needle.yaml: body: expected the tip of stylus, found that of needle"),
    ((*CAPTURE, "tip=bent.yaml"), "tip: expected the tip in the B-scans where its file has it, found it 3.9 ±"),
    (("capture=capture", "lag_s=0"), "body: expected the stylus' name among the sweep's bodies, such as needle, found none"),
    (("capture=capture", "body=styluss", "lag_s=0"), "expected one of those tracked, stylus; found styluss; did you mean"),
    ((*SEQUENCE, "body=stylus"), "body: expected none without a capture, found stylus; reference=FRAME has that of a sequence"),
    ((*CAPTURE, "phantom=crossed_wires", "tip=tip.yaml"), "tip: expected none with phantom=crossed_wires, found tip.yaml"),
    ((*CAPTURE, "tip=capture"), "capture: expected a tool's tip"),
    pytest.param(("sequence=stylus.igs.mha", "reference=Tracker", "tip=tip.yaml"), "frames of one point at rest, found",
                 marks=pytest.mark.slow),
    (("capture=capture", "body=stylus", "lag_s=0.2"), "expected poses of the target while the B-scans were taken, found"),
])  # fmt: skip
def test_mistakes_are_named_and_nothing_is_written(given, said, recording, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(recording)
    fields = {"phantom": "stylus"} | dict(field.split("=") for field in (*given, *WATER, f"out={tmp_path / 'probe'}"))
    assert main(["calibrate-probe", *(f"{name}={value}" for name, value in fields.items())]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert said in line and not (tmp_path / "probe").exists()


@pytest.fixture(scope="module")
def late(tmp_path_factory, rig) -> Path:
    """Stylus and probe led about without rest for 12 s, the B-scans 0.2 s behind the poses."""
    folder, rng, probe = tmp_path_factory.mktemp("late"), np.random.default_rng(8), true_probe(rig)

    def of(times):
        pixels = np.column_stack([160 + 110 * np.sin(1.1 * times), 200 + 130 * np.sin(1.7 * times + 1)])
        turns = np.column_stack([40 * np.sin(0.9 * times), 30 * np.sin(1.3 * times + 0.5), 15 * np.sin(0.7 * times)])
        held = [rigid.from_rotation_vector([0.2 * np.sin(t), 0.2 * np.cos(t), 0], [20 * np.sin(t), 0, 700]) for t in times]
        poses = []
        for pixel, turn, stylus in zip(pixels, turns, held, strict=True):
            image = Rotation.from_euler("YXZ", turn, degrees=True).as_matrix()
            target = image @ probe.target_from_image[:3, :3].T
            place = stylus_motions.TIP - target @ probe.to_target(pixel)
            poses.append(stylus @ rigid.transform(target, place))
        return pixels, np.array(poses), np.array(held)

    shown, moments = np.arange(0.5, 12.3, 0.2), np.arange(0, 13, 1 / 30)
    images = [bscans.image(bscans.spot(pixel) + bscans.face(), rng) for pixel in of(shown)[0]]
    target, stylus = (stylus_motions.tracked(poses, rng, sweep_sets.nanoseconds(moments)) for poses in of(moments)[1:])
    with new_capture(folder / "capture", "stylus") as capture:
        scans, devices = ((SCANNER, image) for image in images), {SCANNER: Device(size=bscans.SIZE)}
        times = {SCANNER: sweep_sets.nanoseconds(shown + 0.2)}
        capture.add_sweep(times, scans, devices, target, purpose="probe", bodies={"stylus": stylus})
    tip_files.write(folder / "tip.yaml", stylus_motions.known_tip(rng))
    return folder


@pytest.mark.slow
def test_a_lag_of_a_stylus_that_moves_is_named_and_found(late, rig, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(late)
    fields = ["calibrate-probe", "phantom=stylus", "capture=capture", "body=stylus", "tip=tip.yaml", "tank_speed=1540"]
    assert main([*fields, "lag_s=0", f"out={tmp_path / 'probe'}"]) == 2
    assert "with lag_s=0.2" in capsys.readouterr().err
    assert main([*fields, "lag_s=free", f"out={tmp_path / 'probe'}"]) == 0
    points, true = repeatability.five_points(bscans.SIZE), true_probe(rig)
    found = probe_files.read(tmp_path / "probe" / "probe.yaml")
    assert np.linalg.norm(found.to_target(points) - true.to_target(points), axis=1).max() < 0.3
    assert json.loads((tmp_path / "probe" / "metrics.json").read_text())["lag_ms"] == pytest.approx(200, abs=5)
