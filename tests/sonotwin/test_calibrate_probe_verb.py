"""`sonotwin calibrate-probe`, from B-scans of crossed wires to files."""

import contextlib
import csv
import io
import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from recon.capture import lag_files, probe_files, sweep_tables
from recon.geometry import rigid
from recon.model.probe import NAMES
from recon.probe_calibration import phantom_frames, point_calibration, probe_checks, repeatability, sound_in_water
from sonotwin import config
from sonotwin.choices import read_rig
from sonotwin.cli import main
from sonotwin.verbs import calibrate_probe, reconstruct
from tests import added
from tests.recon import bscans, captures, moving_phantoms, probe_motions, sweep_sets

LAG_S = 0.03
FILES = [".sonotwin.json", "US_params.npz", "frames.csv", "metrics.json", "probe.yaml"]


@pytest.fixture(scope="module")
def capture(tmp_path_factory, rig) -> Path:
    return sweep_sets.wires(tmp_path_factory.mktemp("wires") / "capture", rig, np.random.default_rng(0), LAG_S)


def calibrate(*fields: str) -> list[str]:
    """Lines that were said."""
    with contextlib.redirect_stdout(io.StringIO()) as said:
        assert main(["calibrate-probe", *fields]) == 0
    return said.getvalue().splitlines()


@pytest.fixture(scope="module")
def calibrated(capture) -> tuple[Path, list[str]]:
    """The folder of a calibration as measured, and what was said."""
    out = capture.parent / "probe"
    return out, calibrate(f"capture={capture}", f"out={out}", f"lag_s={LAG_S}")


def test_b_scans_become_a_calibration(calibrated, rig):
    """The place of every corner is as sure as is said: within 4 sigma, of some 0.1 mm."""
    out, lines = calibrated
    assert sorted(path.name for path in out.iterdir()) == FILES
    found, true = probe_files.read(out / "probe.yaml"), sweep_sets.probe_in_water(rig)
    pixels = repeatability.five_points(bscans.SIZE)
    sigma = np.sqrt(np.trace(point_calibration.point_covariance(found, pixels), axis1=1, axis2=2))
    away = np.linalg.norm(found.to_target(pixels) - true.to_target(pixels), axis=1)
    assert (away < 4 * sigma).all() and sigma.max() < 0.2
    figures = json.loads((out / "metrics.json").read_text())
    assert (figures["frames"], figures["frames_rejected"]) == (30, 2)
    assert figures["frames_used"] + figures["frames_outliers"] == 28
    assert figures["sigma_bottom_right_mm"] == pytest.approx(sigma[4])
    assert [line.split()[0] for line in lines] == [
        *("find", "rejected", "rejected", "calibrate", "probe", "pose", "uncertain", "sound", "depth", "wrote")
    ]
    assert re.fullmatch(r"find +30 frames, 321x408: crossing in 28, 2 rejected, \d+ s", lines[0])
    assert "1 no echo stands out: frame 4" in lines[1] and "1 the target was not tracked: frame 12" in lines[2]


@pytest.mark.slow
def test_the_lag_is_found_with_the_probe(tmp_path, rig, rng, capsys):
    """Of B-scans 60 ms late, that a moving probe took: its file is one of measure-lag; else they are refused by its name."""
    sweep, frames = moving_phantoms.over_crossing(rig, 0.06, rng, seconds=20.0)
    images = (bscans.image(bscans.spot(each.pixel) + bscans.face(), rng) for each in frames.seen)
    captures.write_sweep(tmp_path / "capture", images, sweep.times, sweep.track, bscans.SIZE, name="moving")
    out, fields = tmp_path / "out", [f"capture={tmp_path / 'capture'}", "tank_speed=1540"]
    lines = calibrate(*fields, "lag_s=free", f"out={out}")
    assert sorted(path.name for path in out.iterdir()) == sorted([*FILES, "lag.json"])
    found, figures = lag_files.read(out / "lag.json"), json.loads((out / "metrics.json").read_text())
    assert abs(found.lag_s - 0.06) < 4 * found.sigma_s < 0.008
    assert figures["lag_ms"] == pytest.approx(1e3 * found.lag_s)
    assert all(abs(figures[f"lag_correlation_{name}"]) < 1 for name in NAMES)
    assert any(line.startswith("lag ") for line in lines)
    assert complaint(capsys, *fields, f"out={tmp_path / 'late'}").endswith("with lag_s=0.06 they agree: give lag_s=free")
    for more in (["lag_sigma_s=0.01"], ["pairs=a.csv", "capture=null"]):
        assert "lag" in complaint(capsys, *fields, *more, "lag_s=free", f"out={tmp_path / 'none'}")


def test_a_bracket_that_was_bent_since_is_noticed(calibrated, capture):
    """The same frames agree with an earlier calibration, and not with one of which the bracket stood two degrees otherwise."""
    out, _ = calibrated
    before = probe_files.read(out / "probe.yaml")
    bent = rigid.moved(before.target_from_image, np.array([np.radians(2.0), 0, 0, 0, 0, 0]))
    path = capture.parent / "bent.yaml"
    probe_files.write(path, replace(before, target_from_image=bent))
    again = [calibrate(f"capture={capture}", f"out={capture.parent / 'again'}", f"lag_s={LAG_S}", f"earlier={earlier}")
             for earlier in (out / "probe.yaml", path)]  # fmt: skip
    lines = [next(line for line in said if "both calibrations" in line or "since" in line) for said in again]
    assert lines[0].startswith("earlier") and "0.00 deg" in lines[0]
    assert lines[1].startswith("warning") and "2.00 deg" in lines[1] and "bent bracket" in lines[1]


def test_frames_that_scatter_by_more_than_noise_are_warned_of(capture, tmp_path):
    """As by a slip that few frames don't show: here noise is told to be a tenth of what it is."""
    told = ["noise.angle_deg=0.008", "noise.position_mm=0.005", "noise.slice_mm=0.01"]
    fields = [f"capture={capture}", f"out={tmp_path / 'out'}", f"lag_s={LAG_S}"]
    assert not any("assumed noise only" in line for line in calibrate(*fields))
    assert any("assumed noise only: a bracket that slipped" in line for line in calibrate(*fields, *told))


def test_the_authors_program_reads_it(calibrated):
    """Equation 1 with the names of the authors' file puts a pixel where the calibration does; the speed is kept beside them."""
    out, _ = calibrated
    assert probe_files.read(out / "US_params.npz").speed_m_s == probe_files.read(out / "probe.yaml").speed_m_s < 1500
    with np.load(out / "US_params.npz") as file:
        point = file["T_I_T"] @ [file["sx"] * 100, file["sy"] * 200, 0, 1]
    assert point[:3] == pytest.approx(probe_files.read(out / "probe.yaml").to_target([100, 200]), abs=1e-9)


def test_every_frame_is_accounted_for(calibrated):
    out, _ = calibrated
    with (out / "frames.csv").open(newline="") as stream:
        table = list(csv.DictReader(stream))
    assert [int(row["frame"]) for row in table] == list(range(30))
    assert table[sweep_sets.BLANK]["status"] == table[sweep_sets.UNTRACKED]["status"] == "rejected"
    assert table[sweep_sets.BLANK]["reason"] == "no echo stands out"
    used = [float(row["residual_mm"]) for row in table if row["status"] == "used"]
    figures = json.loads((out / "metrics.json").read_text())
    assert np.sqrt(np.mean(np.square(used))) == pytest.approx(figures["rms_mm"], abs=1e-3)


def test_the_scale_tells_the_speed_of_sound_in_the_water(calibrated):
    """1488 m/s at 22 degrees, though nobody has told the temperature."""
    figures = json.loads((calibrated[0] / "metrics.json").read_text())
    expected = float(sound_in_water.speed_of_sound(sweep_sets.WATER_C))
    assert abs(figures["implied_speed_m_per_s"] - expected) < 4 * figures["implied_speed_sigma_m_per_s"] < 10
    assert figures["water_speed_m_per_s"] is None
    assert probe_files.read(calibrated[0] / "probe.yaml").speed_m_s == pytest.approx(figures["implied_speed_m_per_s"])


def test_the_temperature_makes_it_fit_tissue(capture, calibrated, rig, tmp_path):
    """In water the scanner shows depths 3.4 % too deep; converted, its own scale comes back, which is right for tissue."""
    lines = calibrate(f"capture={capture}", f"out={tmp_path / 'out'}", f"lag_s={LAG_S}", f"temperature_c={sweep_sets.WATER_C}")
    found, measured = (probe_files.read(folder / "probe.yaml") for folder in (tmp_path / "out", calibrated[0]))
    assert found.speed_m_s == sound_in_water.SCANNER_SPEED
    ratio = sound_in_water.SCANNER_SPEED / float(sound_in_water.speed_of_sound(sweep_sets.WATER_C))
    assert found.scale[1] / measured.scale[1] == pytest.approx(ratio, rel=1e-9)
    assert abs(found.scale[1] - rig.probe.scale_mm_per_px[1]) < 4 * found.uncertainty.sigma("sy")
    assert found.uncertainty.sigma("sy") > ratio * measured.uncertainty.sigma("sy"), "the thermometer's share"
    (said,) = (line for line in lines if line.startswith("water "))
    assert "1488.4 m/s" in said and "1.68 mm too deep at 50 mm" in said
    (said,) = (line for line in lines if line.startswith("depth "))
    assert "converted from this water to 1540 m/s" in said


def test_pairs_found_elsewhere_give_the_same_kind_of_result(rig, rng, tmp_path):
    probe = probe_motions.true_probe(rig)
    seen = probe_motions.observe(probe, *probe_motions.motion(rig), rng)
    table = np.column_stack([seen.poses[:, :3].reshape(-1, 12), seen.pixels])
    sweep_tables.write_rows(tmp_path / "pairs.csv", sweep_tables.PAIRS, table.tolist())
    lines = calibrate(f"pairs={tmp_path / 'pairs.csv'}", f"out={tmp_path / 'out'}")
    found = probe_files.read(tmp_path / "out" / "probe.yaml")
    assert np.linalg.norm(found.to_target([160, 204]) - probe.to_target([160, 204])) < 0.3
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == FILES
    assert "crossing in 30, 0 rejected" in lines[0]


def pairs_of(probe, size, rng, path: Path, tank_speed: float = 1488.4) -> Path:
    """Pairs of a probe whose scanner assumes 1540 m/s, in a tank of another speed."""
    in_tank = sound_in_water.in_medium(probe, sound_in_water.SCANNER_SPEED, tank_speed)
    seen = probe_motions.observe(in_tank, *point_calibration.motion(size, roll_deg=90), rng)
    sweep_tables.write_rows(path, sweep_tables.PAIRS, np.column_stack([seen.poses[:, :3].reshape(-1, 12), seen.pixels]).tolist())
    return path


@pytest.mark.parametrize("seed", range(5))
def test_another_probe_takes_two_commands(seed, tmp_path, capsys):
    """The refusal of the first has the fields of the second; another bracket, and what it may mean, is a warning."""
    rng = np.random.default_rng([8, seed])
    size, probe = probe_motions.foreign_probe(rng)
    fields = [f"pairs={pairs_of(probe, size, rng, tmp_path / 'pairs.csv')}", f"out={tmp_path / 'out'}"]
    first = complaint(capsys, *fields)
    assert "another scanner? give rig.probe.image_size=[width,height], and temperature_c, the water's" in first
    lines = calibrate(*fields, f"rig.probe.image_size=[{size[0]},{size[1]}]", f"temperature_c={sweep_sets.WATER_C}")
    found, points = probe_files.read(tmp_path / "out" / "probe.yaml"), repeatability.five_points(size)
    sigma = np.sqrt(np.trace(point_calibration.point_covariance(found, points), axis1=1, axis2=2))
    assert (np.linalg.norm(found.to_target(points) - probe.to_target(points), axis=1) < 4 * sigma).all()
    assert any(line.startswith("warning") and "another bracket?" in line for line in lines)
    (pose,) = (line for line in lines if line.startswith("pose "))
    origin = re.search(r"rig\.probe\.target_from_image\.translation_mm=\[([^]]+)\]", pose)
    assert np.array(origin[1].split(","), float) == pytest.approx(found.target_from_image[:3, 3], abs=0.06)
    assert json.loads((tmp_path / "out" / "metrics.json").read_text())["implied_speed_m_per_s"] is None


def test_depths_count_from_the_faces_row(rig, rng, tmp_path):
    """On an uncropped screen, 80 rows below the first: without that row the conversion to tissue would be off by 0.33 mm."""
    probe = replace(probe_motions.true_probe(rig), face_row=80.0)
    fields = [f"pairs={pairs_of(probe, bscans.SIZE, rng, tmp_path / 'pairs.csv')}", f"temperature_c={sweep_sets.WATER_C}"]
    points, found = repeatability.five_points(bscans.SIZE), {}
    for row in (80, 0):
        calibrate(*fields, f"face_row={row}", f"out={tmp_path / str(row)}")
        found[row] = probe_files.read(tmp_path / str(row) / "probe.yaml")
        assert found[row].face_row == row == probe_files.read(tmp_path / str(row) / "US_params.npz").face_row
    sigma = np.sqrt(np.trace(point_calibration.point_covariance(found[80], points), axis1=1, axis2=2))
    assert (np.linalg.norm(found[80].to_target(points) - probe.to_target(points), axis=1) < 4 * sigma).all()
    off = 80 * rig.probe.scale_mm_per_px[1] * (1 - 1488.4 / 1540)
    assert np.linalg.norm(found[0].to_target(points) - found[80].to_target(points), axis=1) == pytest.approx(off, rel=0.05)


def test_another_scanners_scale_makes_no_speed_of_sound(rig, rng, tmp_path, capsys):
    """A depth setting of 58 mm in images of the same size would make 1738 m/s; the temperature needs no scale."""
    deeper = replace(probe_motions.true_probe(rig), scale=np.array(rig.probe.scale_mm_per_px) * [1.0, 1.168])
    fields = [f"pairs={pairs_of(deeper, bscans.SIZE, rng, tmp_path / 'pairs.csv')}", f"out={tmp_path / 'out'}"]
    found = complaint(capsys, *fields)
    assert re.search(r"sy: expected to imply a speed of sound of 1400 to 1600 m/s, found 173\d: .*temperature_c=", found)
    lines = calibrate(*fields, f"temperature_c={sweep_sets.WATER_C}")
    assert any(line.startswith("warning") and "another depth setting" in line for line in lines)
    found = probe_files.read(tmp_path / "out" / "probe.yaml")
    assert found.speed_m_s == sound_in_water.SCANNER_SPEED and found.scale == pytest.approx(deeper.scale, rel=0.01)
    sx, sy = deeper.scale
    calibrate(*fields, f"rig.probe.scale_mm_per_px=[{sx},{sy}]")
    assert probe_files.read(tmp_path / "out" / "probe.yaml").speed_m_s == pytest.approx(1488.4, rel=0.01)


def test_degrees_fahrenheit_are_named(rig, rng, tmp_path):
    fields = [
        f"pairs={pairs_of(probe_motions.true_probe(rig), bscans.SIZE, rng, tmp_path / 'pairs.csv')}",
        f"out={tmp_path / 'out'}",
    ]
    fahrenheit = sweep_sets.WATER_C * 1.8 + 32
    assert any("degrees Fahrenheit" in line for line in calibrate(*fields, f"temperature_c={fahrenheit}"))
    assert not any("Fahrenheit" in line for line in calibrate(*fields, f"temperature_c={sweep_sets.WATER_C}"))


def test_a_scale_of_the_rig_is_none_of_wider_images(rig, rng, tmp_path, capsys):
    """Twice as many mm a pixel both ways, of as many px: another scanner's, which is told, and the temperature asked for."""
    wider = replace(probe_motions.true_probe(rig), scale=2 * np.array(rig.probe.scale_mm_per_px))
    fields = [f"pairs={pairs_of(wider, bscans.SIZE, rng, tmp_path / 'pairs.csv')}", f"out={tmp_path / 'out'}"]
    assert "rig.probe.scale_mm_per_px=[sx,sy] by the scanner (found in the tank: " in complaint(capsys, *fields)
    lines = list(calibrate(*fields, f"temperature_c={sweep_sets.WATER_C}"))
    assert not any("not the tank's speed" in line for line in lines)
    assert any("times as wide as rig.probe.scale_mm_per_px: wrong lengths of the poses, or another" in line for line in lines)


def test_a_tank_of_something_else_has_its_speed_given(rig, rng, tmp_path):
    """Of oil, say, of which no temperature of water tells."""
    probe = probe_motions.true_probe(rig)
    path = pairs_of(probe, bscans.SIZE, rng, tmp_path / "pairs.csv", tank_speed=1380.0)
    lines = calibrate(f"pairs={path}", f"out={tmp_path / 'out'}", "tank_speed=1380")
    assert probe_files.read(tmp_path / "out" / "probe.yaml").scale == pytest.approx(probe.scale, rel=0.01)
    assert not any(line.startswith("warning") for line in lines)


def test_another_bracket_is_a_warning_and_its_pose_is_said(rig, rng, tmp_path):
    """In the fields of the rig, so that it can be given as the design."""
    probe = replace(probe_motions.true_probe(rig), target_from_image=rigid.transform(np.eye(3), [40, 20, -10]))
    fields = [f"pairs={pairs_of(probe, bscans.SIZE, rng, tmp_path / 'pairs.csv')}", f"out={tmp_path / 'out'}"]
    lines = calibrate(*fields)
    assert any(line.startswith("warning") and "another bracket?" in line for line in lines)
    (pose,) = (line for line in lines if line.startswith("pose "))
    origin = re.search(r"rig\.probe\.target_from_image\.translation_mm=\[([^]]+)\]", pose)
    assert np.array(origin[1].split(","), float) == pytest.approx([40, 20, -10], abs=0.3)
    assert not any(line.startswith("warning") for line in calibrate(*fields, *pose.split()[1:]))


def test_a_sequence_of_plus_gives_the_same_calibration(capture, calibrated, rig, tmp_path):
    """Poses as they were at rest, so the same to a hair; of the whole screen the calibration is that of its own pixels.

    A screen is another image than the scanner's, so its scale has to be given, or the temperature.
    """
    whole = sweep_sets.recorded(tmp_path / "wires.igs.mha", capture)
    screen = sweep_sets.recorded(tmp_path / "screen.igs.nrrd", capture, screen=True)
    calibrate(f"sequence={whole}", "reference=Tracker", f"out={tmp_path / 'whole'}")
    part = [*sweep_sets.BORDER, *bscans.SIZE]
    scale = "rig.probe.scale_mm_per_px=[{},{}]".format(*rig.probe.scale_mm_per_px)
    calibrate(f"sequence={screen}", "reference=Tracker", f"clip={part}".replace(" ", ""), scale, f"out={tmp_path / 'screen'}")
    ours, whole, screen = (
        probe_files.read(folder / "probe.yaml") for folder in (calibrated[0], tmp_path / "whole", tmp_path / "screen")
    )
    pixels = repeatability.five_points(bscans.SIZE)
    np.testing.assert_allclose(whole.to_target(pixels), ours.to_target(pixels), atol=1e-3)
    np.testing.assert_allclose(screen.to_target(pixels + np.array(sweep_sets.BORDER)), ours.to_target(pixels), atol=1e-3)
    figures = json.loads((tmp_path / "screen" / "metrics.json").read_text())
    assert (figures["frames"], figures["frames_rejected"]) == (30, 2)


def complaint(capsys, *fields: str) -> str:
    assert main(["calibrate-probe", *fields]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    return line.removeprefix("sonotwin: ")


def test_what_is_wrong_is_said_in_one_line_and_nothing_is_written(capture, rig, rng, tmp_path, capsys):
    out = tmp_path / "out"
    fields = [f"capture={capture}", f"out={out}"]
    assert complaint(capsys, f"out={out}") == "calibrate-probe: expected one of capture, sequence, pairs and runs, found none"
    assert complaint(capsys, *fields, "pairs=a.csv").endswith("runs, found capture and pairs")
    assert complaint(capsys, *fields, "reference=Tracker").startswith("calibrate-probe: reference: expected none without a seq")
    assert complaint(capsys, f"out={out}", "pairs=a.csv", "lag_s=0.1").startswith("calibrate-probe: lag_s: expected none with")
    assert complaint(capsys, *fields, "noise.angle_deg=-1").startswith("calibrate-probe: noise.angle_deg: expected finite")
    assert complaint(capsys, *fields, "temperature_c=120").startswith("temperature_c: expected 0 to 95 degrees Celsius")
    assert complaint(capsys, *fields, "medium_speed=1450") == (
        "calibrate-probe: medium_speed: expected temperature_c or tank_speed with it, found none"
    )
    assert complaint(capsys, *fields, "temperature_c=22", "tank_speed=1480") == (
        "calibrate-probe: tank_speed: expected without temperature_c, found both"
    )
    assert complaint(capsys, *fields, "wire_speed=20000").startswith("calibrate-probe: wire_speed: expected ")
    assert complaint(capsys, *fields, "assumed_speed=1.54").startswith("calibrate-probe: assumed_speed: expected ")
    assert complaint(capsys, *fields, "seed=-1").startswith("calibrate-probe: seed: expected ")
    assert complaint(capsys, *fields, "lag_s=1e7").startswith("calibrate-probe: lag_s: expected ")
    assert "dynamic_range_db: expected 20 to 120 dB, found 0" in complaint(capsys, *fields, "appearance.dynamic_range_db=0")
    silent = [f"noise.{name}=0" for name in ("angle_deg", "position_mm", "pixel_px", "slice_mm")]
    assert complaint(capsys, *fields, *silent).startswith("calibrate-probe: noise: expected one standard deviation above zero")
    scanner = [f"lag_s={LAG_S}", "rig.probe.scale_mm_per_px=[0.1229,0.0122]"]
    assert "calibration: sy: expected to imply a speed of sound" in complaint(capsys, *fields, *scanner)
    assert "are the clocks others?" in complaint(capsys, *fields, "lag_s=100")
    assert complaint(capsys, f"pairs={tmp_path / 'a.csv'}", f"out={out}").endswith("a.csv: expected a file, found none")
    darker = "appearance.min_contrast_db=55"
    found = complaint(capsys, *fields, f"lag_s={LAG_S}", darker)
    assert found == ("wires: expected 6 frames or more with a pose and the crossing, found 0 "
                     "(most often: no echo stands out; another scanner? give appearance.min_contrast_db)")  # fmt: skip
    true = probe_motions.true_probe(rig)
    over = rigid.transform(np.diag([1.0, -1, -1]), [0, true.scale[1] * (bscans.SIZE[1] - 1), 0])
    upside_down = probe_checks.described(replace(true, target_from_image=true.target_from_image @ over)).split()
    found = complaint(capsys, *fields, f"lag_s={LAG_S}", *upside_down)
    assert found.startswith("wires: calibration: expected target_from_image near its design") and "upside down" in found
    copied = shutil.copytree(capture, tmp_path / "capture")
    image = copied / "sweep" / "us" / "0007.png"
    image.write_bytes(image.read_bytes()[:-30])
    assert complaint(capsys, f"capture={copied}", f"out={out}").startswith(f"{image}: expected a whole PNG image")
    assert not out.exists()


def test_a_motion_without_turns_is_named(rig, tmp_path, capsys):
    """A probe that is only moved about tells nothing of where its image is."""
    probe = probe_motions.true_probe(rig)
    pixels = probe_motions.motion(rig)[1]
    table = []
    for pixel in pixels:
        pose = rigid.transform(probe_motions.LOOKING_AWAY @ probe.target_from_image[:3, :3].T, np.zeros(3))
        pose[:3, 3] = probe_motions.WIRE - rigid.apply(pose, probe.to_target(pixel))
        table.append([*pose[:3].ravel(), *pixel])
    sweep_tables.write_rows(tmp_path / "pairs.csv", sweep_tables.PAIRS, table)
    found = complaint(capsys, f"pairs={tmp_path / 'pairs.csv'}", f"out={tmp_path / 'out'}")
    assert "pairs.csv: motion: expected turns of the probe about two axes" in found


def test_other_folders_are_not_replaced(capture, tmp_path, capsys):
    """Not even a capture's calibration folder, where a probe.yaml may lie beside the cameras' file."""
    out = tmp_path / "calibration"
    out.mkdir()
    for name in ("probe.yaml", "optics.yaml"):
        (out / name).write_text("mine")
    assert "expected a new or empty folder, or one that calibrate-probe wrote" in complaint(
        capsys, f"capture={capture}", f"out={out}"
    )
    assert "apart from what is read" in complaint(capsys, f"capture={capture}", f"out={capture.parent}")
    assert len(list(out.iterdir())) == 2


BEAD = '''
"""A bead on a thread: one round spot, its middle the mean of the pixels near its top."""

import numpy as np

from recon.probe_calibration.cross_wire import Appearance, Crossing
from recon.probe_calibration.point_phantom import MIN_FRAMES, SHOWS, WAYS, calibrate, describe, figures, read, sight

NOTHING = np.full(2, np.nan)


def find(image, appearance, known):
    """The bead, below the face's ringing."""
    look = appearance or Appearance()
    level = np.asarray(image, float)[look.top_px :]
    rise = level.max() - np.median(level)
    if rise < 255 / look.dynamic_range_db * 2 * look.min_contrast_db:
        return Crossing(NOTHING, np.full((2, 2), np.nan), np.nan, "no bead")
    v, u = np.nonzero(level > level.max() - 0.3 * rise)
    return Crossing(np.array([u.mean(), v.mean() + look.top_px]), np.eye(2), rise * look.dynamic_range_db / 255)
'''


def test_another_phantom_is_one_module(capture, rig, tmp_path, monkeypatch, capsys):
    """Its finder is found by the name in `phantom`, and its point calibrates the probe."""
    fields = [f"capture={capture}", f"out={tmp_path / 'out'}", f"lag_s={LAG_S}", "phantom=bead"]
    assert main(["calibrate-probe", *fields]) == 2
    assert "phantom: expected 'crossed_wires', 'n_wires', " in capsys.readouterr().err
    added.add(monkeypatch, tmp_path / "ours", phantom_frames.PHANTOMS, "bead", BEAD)
    calibrate(*fields)
    found, true = probe_files.read(tmp_path / "out" / "probe.yaml"), sweep_sets.probe_in_water(rig)
    pixels = repeatability.five_points(bscans.SIZE)
    assert np.linalg.norm(found.to_target(pixels) - true.to_target(pixels), axis=1).max() < 1.0


@pytest.mark.parametrize(("given", "sy"), [
    ([], None),
    (["rig.probe.image_size=[640,480]"], np.nan),
    (["rig.probe.image_size=[640,480]", "rig.probe.scale_mm_per_px=[0.1229,0.1225]"], 0.1225),
    (["rig=meza2021"], 0.1225),
    (["rig.probe.scale_mm_per_px=[0.1,0.2]"], 0.2),
])  # fmt: skip
def test_a_scale_that_was_given_counts_in_reconstruct_too(given, sy, tmp_path):
    own = config.load("calibrate-probe", [*given, "pairs=p.csv", "out=o"], calibrate_probe.Config)
    whole = config.load("reconstruct", [*given, "capture=c", "out=o"], reconstruct.Config)
    passed = calibrate_probe.Config(rig=whole.rig, scale_given=whole.scale_given, pairs="p.csv", out="o")
    for one in (own, passed):
        found = one.scanner_sy(one.rig.probe, read_rig().probe)
        assert found is None if sy is None else found == pytest.approx(sy, nan_ok=True)
