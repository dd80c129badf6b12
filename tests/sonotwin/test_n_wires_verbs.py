"""N-wires from end to end: `sonotwin sweep scene=n_wires` and `calibrate-probe phantom=n_wires`, of captures and sequences."""

import json
from pathlib import Path

import numpy as np
import pytest

from recon.capture import probe_files, sweep_part
from recon.freehand import sequences
from recon.freehand.sequences import Frames
from recon.geometry import rigid
from recon.model.probe import ProbeCalibration
from recon.probe_calibration import point_calibration, repeatability
from sonotwin.cli import main
from tests.recon import bscans, wire_rows
from tests.recon.probe_calibration.test_plus_phantom import transform, written
from tests.recon.probe_motions import true_probe

WATER_C = 22.0


@pytest.fixture(scope="module")
def recording(tmp_path_factory, rig) -> Path:
    """A sequence of PLUS, 30 drawn B-scans of fCal 2, and its configuration with the phantom's registration."""
    folder, rng, probe = tmp_path_factory.mktemp("plus"), np.random.default_rng(5), true_probe(rig)
    poses = wire_rows.poses_over(probe, wire_rows.FCAL, bscans.SIZE, rng, count=60, turn_deg=15.0)
    pixels = wire_rows.dots_of(probe, wire_rows.FCAL, poses)
    inside = ((pixels > 12) & (pixels < np.array(bscans.SIZE) - 13)).all(axis=(1, 2))
    apart = np.linalg.norm(pixels[:, 1::3] - pixels[:, ::3], axis=-1).min(axis=1) > 25
    kept = np.flatnonzero(inside & apart)[:30]
    images = np.stack([wire_rows.drawn(pixels[k], rng) for k in kept])
    times = 0.1 * np.arange(len(kept))
    seen = wire_rows.observe(probe, wire_rows.FCAL, poses[kept], rng).poses
    valid = dict.fromkeys(("ProbeToTracker", "Image"), np.ones(len(kept), bool))
    frames = Frames(times, {"ProbeToTracker": seen}, valid, images)
    sequences.write_sequence(folder / "rows.igs.mha", frames)
    matrix = probe.target_from_image @ np.diag([*probe.scale, np.mean(probe.scale), 1])
    given = transform("Phantom", "Tracker", wire_rows.WORLD_FROM_PHANTOM) + transform("Image", "Probe", matrix)
    (folder / "fcal.xml").write_text(written(transforms=given), encoding="utf-8")
    return folder


def fields(recording, out, *more):
    return ["calibrate-probe", "phantom=n_wires", f"sequence={recording / 'rows.igs.mha'}", "reference=Tracker",
            "tank_speed=1540", f"out={out}", *more]  # fmt: skip


def away(found: ProbeCalibration, true: ProbeCalibration) -> np.ndarray:
    points = repeatability.five_points(bscans.SIZE)
    return np.linalg.norm(found.to_target(points) - true.to_target(points), axis=1)


@pytest.mark.parametrize("registration", ["known", "free"])
def test_a_recording_of_plus_becomes_a_calibration(registration, recording, rig, tmp_path, capsys):
    """To 0.4 mm at corners, by the phantom's definition beside it; the matrix beside it, which is the truth, agrees as well."""
    out = tmp_path / "probe"
    assert main(fields(recording, out, f"wires={recording / 'fcal.xml'}", f"registration={registration}")) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines][:4] == ["find", "calibrate", "held", "wires"]
    assert "dots of all wires in 30, 0 rejected" in lines[0]
    assert away(probe_files.read(out / "probe.yaml"), true_probe(rig)).max() < 0.4
    figures = json.loads((out / "metrics.json").read_text())
    assert figures["held_out_rms_mm"] < 0.25
    assert figures["earlier_held_out_rms_mm"] == pytest.approx(figures["held_out_rms_mm"], abs=0.05)
    assert abs(figures["phantom_size"] - 1) < 4 * figures["phantom_size_sigma"]
    assert not any("warning" in line for line in lines)


@pytest.mark.parametrize(("given", "said"), [
    (["wires=nowhere.xml"], "nowhere.xml: expected a configuration of the PLUS toolkit, found none"),
    (["registration=known"], "registration: expected PhantomToTracker in wires=, found none; registration=free needs none"),
    (["phantom=crossed_wires", "wires=fcal.xml"], "wires: expected none with phantom=crossed_wires, found fcal.xml"),
    (["wires=other.xml"], "is wires= the definition of this phantom"),
    (["wires=metres.xml"], "metres.xml: N-wire 1 (0:0, 0:1, 0:2): expected a wire of 5 to 500 mm, found 0.04 mm: another unit?"),
])  # fmt: skip
def test_mistakes_are_named_and_nothing_is_written(given, said, recording, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(recording)
    ends = wire_rows.FCAL.ends.copy()
    ends[0, 0, :, 0] -= 5
    Path("other.xml").write_text(written(ends), encoding="utf-8")
    Path("metres.xml").write_text(written(wire_rows.FCAL.ends / 1000), encoding="utf-8")
    assert main(fields(recording, tmp_path / "probe", *given)) == 2
    assert said in capsys.readouterr().err
    assert not (tmp_path / "probe").exists()


@pytest.mark.slow
def test_the_twins_phantom_calibrates_its_probe(rig, tmp_path):
    """At the twin's noise of poses: held-out dots to 0.25 mm, corners within 4 sigma, and these below 0.25 mm.

    Squared errors of all places, by their covariance, are chi-square of 3, with its mean within 4 sigma of four seeds from above:
    wires stand exactly in the twin, which their assumed 0.1 mm makes less likely.
    """
    truth = ProbeCalibration(rig.probe.target_from_image.matrix(), np.array(rig.probe.scale_mm_per_px))
    squares = []
    for seed in range(4):
        made, out = tmp_path / f"rows{seed}", tmp_path / f"probe{seed}"
        assert main(["sweep", "scene=n_wires", "ultrasound=water", "path=rows", f"seed={seed}", f"out={made}"]) == 0
        assert len(sweep_part.read_sweep(made / "capture").frames) == 40
        assert main(["calibrate-probe", "phantom=n_wires", f"capture={made / 'capture'}", f"temperature_c={WATER_C}", "lag_s=0",
                     f"out={out}"]) == 0  # fmt: skip
        figures = json.loads((out / "metrics.json").read_text())
        assert figures["frames_rejected"] <= 2
        assert figures["held_out_rms_mm"] < 0.25
        found = probe_files.read(out / "probe.yaml")
        points = repeatability.five_points(bscans.SIZE)
        covariance = point_calibration.point_covariance(found, points)
        sigma = np.sqrt(np.trace(covariance, axis1=1, axis2=2))
        assert (away(found, truth) < 4 * sigma).all() and sigma.max() < 0.25
        off = found.to_target(points) - truth.to_target(points)
        squares.append(np.einsum("ki,kij,kj->k", off, np.linalg.inv(covariance), off).mean())
        assert rigid.difference(truth.target_from_image, found.target_from_image)[:3] == pytest.approx(np.zeros(3), abs=0.02)
        assert figures["moved_mm"] == 0, "the bracket is stiff"
    assert 0.3 < np.mean(squares) < 3 + 4 * np.sqrt(6 / 4)
