"""`sonotwin compare-tip`, from a needle in B-scans of the twin and noisy poses to a verdict."""

import csv
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from recon.capture import probe_files, sweep_part, tip_files
from recon.capture.manifest import SCANNER, Device
from recon.capture.writer import new_capture
from recon.errors import InputError
from recon.freehand import sequences
from recon.freehand.sequences import Frames
from recon.geometry import rigid
from recon.model.calibration import Uncertainty
from recon.model.probe import NAMES
from recon.model.tip import Tip
from recon.model.tracks import Track
from recon.probe_calibration import needle_echo, sound_in_water
from recon.session import tip_comparison_step
from recon.session.tip_comparison_step import Settings
from sonotwin.cli import main
from tests.recon import needle_scans, stylus_motions, sweep_sets
from tests.recon.probe_motions import true_probe
from tests.recon.stylus_motions import TIP, TIP_MM

COUNT, APART_S = 20, 0.05
WATER = ("tissue_m_s=1488.3", f"tip_radius_mm={needle_scans.RADIUS_MM}")
SIGMA = np.array([2e-5, 2e-5, *np.radians([0.05] * 3), 0.05, 0.05, 0.05])  # of the probe's calibration, as NAMES


def poses(rng, probe):
    """Tips : (n, 3) mm in the image, dips, and poses : (n, 4, 4) of probe and needle in the world."""
    tips = np.column_stack([rng.uniform(12, 28, COUNT), rng.uniform(12, 40, COUNT), 0.2 * rng.standard_normal(COUNT)])
    dips, targets, needles = rng.uniform(10, 45, COUNT), [], []
    for tip, dip in zip(tips, dips, strict=True):
        along = np.array([np.cos(np.radians(dip)), np.sin(np.radians(dip)), 0])
        across = np.cross([0, 0, 1], along)
        turn = np.column_stack([[0, 0, 1], across, -along])  # of the needle: its shaft points to -z
        turn = turn @ Rotation.from_euler("z", rng.uniform(-60, 60), degrees=True).as_matrix()
        image_from_needle = rigid.transform(turn, tip - turn @ TIP)
        held = rigid.transform(Rotation.random(random_state=rng).as_matrix(), [0, 0, 700])
        targets.append(held @ rigid.invert(probe.target_from_image))
        needles.append(held @ image_from_needle)
    return tips, dips, np.array(targets), np.array(needles)


@pytest.fixture(scope="module")
def recording(tmp_path_factory, rig) -> Path:
    folder, rng, probe = tmp_path_factory.mktemp("needle"), np.random.default_rng(11), true_probe(rig)
    tips, dips, targets, needles = poses(rng, probe)
    images = [
        needle_scans.image("water", needle_scans.rod(tip, dip), seed=k)
        for k, (tip, dip) in enumerate(zip(tips, dips, strict=True))
    ]
    seconds = np.arange(COUNT, dtype=float)
    moments = sweep_sets.nanoseconds((seconds[:, None] + [-APART_S, APART_S]).ravel())
    tracked = [
        Track(moments, *(np.repeat(each, 2, axis=0) for each in (one.poses, one.covariance)))
        for one in (stylus_motions.tracked(each, rng) for each in (targets, needles))
    ]
    calibration = replace(probe, uncertainty=Uncertainty(NAMES, np.diag(SIGMA**2)))
    size = rig.probe.image_size
    with new_capture(folder / "capture", "needle") as capture:
        capture.add_probe(calibration)
        scans = ((SCANNER, image) for image in images)
        times, devices = {SCANNER: sweep_sets.nanoseconds(seconds)}, {SCANNER: Device(size=size)}
        capture.add_sweep(times, scans, devices, tracked[0], purpose="volume", bodies={"needle": tracked[1]})
    valid = dict.fromkeys(("ProbeToTracker", "NeedleToTracker", "Image"), np.ones(COUNT, bool))
    transforms = {"ProbeToTracker": tracked[0].poses[::2], "NeedleToTracker": tracked[1].poses[::2]}
    sequences.write_sequence(folder / "needle.igs.mha", Frames(seconds, transforms, valid, np.stack(images)))
    probe_files.write(folder / "probe.yaml", calibration)
    tip = Tip(TIP, TIP_MM**2 * np.eye(3), body="needle")
    tip_files.write(folder / "tip.yaml", tip)
    tip_files.write(folder / "bent.yaml", replace(tip, tip_mm=TIP + np.array([0, 2.0, 0])))
    tip_files.write(folder / "far.yaml", replace(tip, tip_mm=TIP + np.array([0, 40.0, 0])))
    tip_files.write(folder / "stylus.yaml", replace(tip, body="stylus"))
    return folder


SOURCES = (("capture=capture",), ("sequence=needle.igs.mha", "reference=Needle", "probe=probe.yaml"))


@pytest.mark.parametrize("source", SOURCES)
def test_a_needle_as_it_is_calibrated_is_where_tracking_has_it(source, recording, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(recording)
    assert main(["compare-tip", *source, "tip=tip.yaml", *WATER, f"out={tmp_path / 'out'}"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines] == ["find", "off", "beside", "systematic", "scatter", "verdict", "wrote"]
    figures = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert figures["frames_used"] > 0.8 * COUNT and figures["off_median_mm"] < 0.4
    with (tmp_path / "out" / "frames.csv").open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    off = [np.hypot(float(row["off_x_mm"]), float(row["off_y_mm"])) for row in rows if row["status"] == "used"]
    assert len(rows) == COUNT and np.median(off) == pytest.approx(figures["off_median_mm"], abs=1e-3)


def test_a_scatter_that_hides_what_is_off_gives_no_verdict(recording, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(recording)
    rng, find = np.random.default_rng(5), needle_echo.find

    def elsewhere(*args):
        found = find(*args)
        return replace(found, pixel=found.pixel + 20 * rng.standard_normal(2))

    monkeypatch.setattr(needle_echo, "find", elsewhere)
    assert main(["compare-tip", "capture=capture", "tip=tip.yaml", *WATER, f"out={tmp_path / 'out'}"]) == 1
    lines = capsys.readouterr().out.splitlines()
    assert any(line.startswith("warning     no verdict: a scatter of over 3 times") for line in lines)
    assert not any("within what" in line for line in lines)


@pytest.fixture
def compare(recording):
    """The comparison by some of the recording's B-scans, and a tip."""
    sweep = sweep_part.read_sweep(recording / "capture", purpose="volume").from_body("needle")
    settings = Settings(capture=recording, tip=recording, tip_radius_mm=needle_scans.RADIUS_MM)
    probe = sound_in_water.for_tissue(sweep.probe, 1488.3)

    def of(chosen, tip):
        some = replace(sweep, paths=tuple(sweep.paths[k] for k in chosen), frames=sweep.frames[chosen], times=sweep.times[chosen])
        return tip_comparison_step.compare(some, probe, tip, settings)

    return of


def test_too_few_b_scans_that_all_show_the_tip_are_refused(compare, recording):
    tip = tip_files.read(recording / "tip.yaml")
    used = compare(np.arange(COUNT), tip).used
    with pytest.raises(InputError, match=r"expected 5 B-scans or more with a pose and the tip, found 4 in all$"):
        compare(used[:4], tip)


def test_the_shaft_is_looked_for_along_the_tips_axis(compare, monkeypatch, rig):
    """The needle's shaft points to -z of its target, dips as drawn, pixels aren't square, and are drawn for 1540 m/s."""
    given, find = [], needle_echo.find
    monkeypatch.setattr(needle_echo, "find", lambda *args: given.append(args[2].direction) or find(*args))
    compare(np.arange(COUNT), Tip(TIP, np.diag([TIP_MM**2] * 3 + [0.0] * 3), axis=np.array([0.0, 0.0, -1.0])))
    dips = poses(np.random.default_rng(11), true_probe(rig))[1]
    along, down = (np.array(given) * needle_scans.SCALE * [1, 1488.3 / 1540]).T
    assert np.abs(np.degrees(np.arctan2(down, along)) - dips).max() < 0.3


@pytest.mark.parametrize(("given", "said"), [
    (("tip=bent.yaml", "beside_mm=3", *WATER), "* mm elsewhere in the tool's frame: a bent shaft, a target that slipped"),
    (("tip=tip.yaml", WATER[1]), "the image is +3.* % too deep: sound of another speed: give tissue_m_s"),
])  # fmt: skip
def test_what_is_off_is_named_with_its_cause(given, said, recording, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(recording)
    assert main(["compare-tip", "capture=capture", *given, f"out={tmp_path / 'out'}"]) == 1
    (line,) = [line for line in capsys.readouterr().out.splitlines() if line.startswith("warning")]
    assert all(part in line for part in said.split("*"))


@pytest.mark.parametrize(("given", "said"), [
    (("capture=capture", "tip=stylus.yaml"), "stylus.yaml: body: expected the tip of needle, found that of stylus"),
    (("capture=capture", "tip=none.yaml"), "none.yaml: expected a tool's tip, found none"),
    (("capture=capture", "tip=tip.yaml", "body=needel"), "body: expected one of those tracked, needle; found needel; did you"),
    (("sequence=needle.igs.mha", "tip=tip.yaml", "probe=probe.yaml"), "reference: expected the needle's frame in needle.igs.mha"),
    (("sequence=needle.igs.mha", "reference=Needle", "tip=tip.yaml"), "probe: expected the probe's calibration, found none"),
    (("tip=tip.yaml",), "expected capture or sequence, found neither"),
    (("capture=capture", "tip=tip.yaml", "beside_mm=0.001"), "expected 5 B-scans or more with a pose and the tip, found 0"),
    (("capture=capture", "tip=tip.yaml", "beside_mm=-1"), "beside_mm"),
    (("capture=capture", "tip=bent.yaml"), "if it is seen there, it lies elsewhere in the tool's frame: beside_mm=3 measures it"),
    (("capture=capture", "tip=far.yaml", "beside_mm=50"), "no tip near where tracking has it, 20 of 20; another tool's tip.yaml"),
])  # fmt: skip
def test_mistakes_are_named_and_nothing_is_written(given, said, recording, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(recording)
    assert main(["compare-tip", *given, *WATER, f"out={tmp_path / 'out'}"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert said in line and not (tmp_path / "out").exists()
