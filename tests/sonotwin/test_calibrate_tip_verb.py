"""`sonotwin calibrate-tip`, from poses of a tool that pivots to the file of its tip."""

import csv
import json
from pathlib import Path

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from recon.capture import sweep_tables, tip_files
from recon.freehand import sequences
from recon.geometry import rigid
from recon.model.probe import ProbeCalibration
from recon.model.tip import TIP
from recon.model.tracks import Track
from sonotwin.cli import main
from tests.recon.tip_calibration import pivot_films
from twin.tracking.film_session import TRUTH


@pytest.fixture(scope="module")
def tool():
    return pivot_films.draw_tool(np.random.default_rng(5), (150.0, 150.0))


@pytest.fixture(scope="module")
def poses(tool):
    return pivot_films.poses_of(pivot_films.turns(tool, np.random.default_rng(6)), tool.tip)


@pytest.fixture
def table(poses, tmp_path) -> Path:
    sweep_tables.write_track(tmp_path / "poses.csv", pivot_films.tracked(poses, np.random.default_rng(7)))
    return tmp_path / "poses.csv"


def spun(tool, path: Path) -> Path:
    """A table of the tool that turns about its shaft by 150 degrees."""
    upright = Rotation.align_vectors([-pivot_films.UP], [tool.axis])[0]
    turned = Rotation.from_rotvec(np.radians(np.linspace(0, 150, 150))[:, None] * -pivot_films.UP) * upright
    track = pivot_films.tracked(pivot_films.poses_of(turned.as_matrix(), tool.tip), np.random.default_rng(8))
    sweep_tables.write_track(path, track)
    return path


def off(tip: tip_files.Tip, tool) -> float:
    """Squared error of the tip, in standard deviations."""
    error = tip.tip_mm - tool.tip
    return error @ np.linalg.solve(tip.covariance_of(TIP), error)


def test_the_tip_is_found_and_said(table, tool, tmp_path, capsys):
    out = tmp_path / "tip"
    assert main(["calibrate-tip", f"track={table}", f"out={out}"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines if "warning" not in line] == ["found", "tip", "dimple", "bend", "wrote"]
    assert lines[0].startswith("found       ") and "of 200 frames used, 200 with a pose" in lines[0]
    tip = tip_files.read(out / "tip.yaml")
    assert off(tip, tool) < 16.3 and np.linalg.norm(tip.tip_mm - tool.tip) < 0.1 and tip.axis is None
    figures = json.loads((out / "metrics.json").read_text())
    assert figures["frames_used"] == tip.frames > 195 and figures["tip_x_mm"] == pytest.approx(tip.tip_mm[0])
    with (out / "frames.csv").open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    used = np.array([[float(row[name]) for name in ("x_mm", "y_mm", "z_mm")] for row in rows if row["used"] == "1"])
    assert len(rows) == 200 and np.sqrt((used**2).sum(axis=1).mean()) == pytest.approx(tip.rms_mm, abs=1e-4)


def test_frames_without_a_pose_stay_empty(poses, tmp_path):
    track = pivot_films.tracked(poses, np.random.default_rng(7))
    some = track.poses.copy()
    some[10:20] = np.nan
    sweep_tables.write_track(tmp_path / "poses.csv", Track(track.times, some, track.covariance, track.shared))
    assert main(["calibrate-tip", f"track={tmp_path / 'poses.csv'}", f"out={tmp_path / 'tip'}"]) == 0
    rows = (tmp_path / "tip" / "frames.csv").read_text().splitlines()
    assert rows[11].endswith(",0,,,,0") and rows[10].split(",")[2] == "1" and len(rows) == 201


def test_a_second_film_gives_the_axis_and_a_mesh_is_kept(table, tool, tmp_path, capsys):
    spin, needle, out = spun(tool, tmp_path / "spin.csv"), tmp_path / "needle.glb", tmp_path / "tip"
    cone = trimesh.creation.cone(radius=1.0, height=150.0)
    cone.apply_transform(rigid.transform(Rotation.align_vectors([tool.axis], [[0, 0, 1]])[0].as_matrix(), np.zeros(3)))
    cone.apply_translation(tool.tip - 150 * tool.axis)
    cone.export(needle)
    assert main(["calibrate-tip", f"track={table}", f"spin={spin}", f"model={needle}", f"out={out}"]) == 0
    said = capsys.readouterr().out
    assert "turned by 150 deg" in said and "mm beside its line" in said and "model       the tip is 0.0" in said
    tip = tip_files.read(out / "tip.yaml")
    assert np.degrees(np.linalg.norm(tip.axis - tool.axis)) < 0.05 and len(tip.covariance) == 9
    assert tip.model.resolve() == needle.resolve()


def test_a_drawing_will_do(tmp_path, capsys):
    out = tmp_path / "tip"
    fields = ["tip_mm=[0,-2.5,-150]", "tip_sigma_mm=0.3", "axis=[0,0,-2]", "axis_sigma_deg=1"]
    assert main(["calibrate-tip", *fields, f"out={out}"]) == 0
    tip = tip_files.read(out / "tip.yaml")
    assert tip.tip_mm.tolist() == [0, -2.5, -150] and tip.axis.tolist() == [0, 0, -1] and tip.dimple_mm is None
    sigmas = np.sqrt(np.diag(tip.covariance))
    assert sigmas == pytest.approx([0.3, 0.3, 0.3, np.radians(1), np.radians(1), 0])
    assert sorted(path.name for path in out.iterdir() if not path.name.startswith(".")) == ["metrics.json", "tip.yaml"]


def test_the_body_is_named_where_it_has_a_name(table, tmp_path):
    """Of a table's poses nothing but `body` has the name; a rig with one target has none."""
    for given, name in (["rig=three_bodies", "body=needle"], "needle"), (["rig=three_bodies"], ""), ([], ""):
        assert main(["calibrate-tip", f"track={table}", *given, f"out={tmp_path / 'tip'}"]) == 0
        assert tip_files.read(tmp_path / "tip" / "tip.yaml").body == name


def test_an_axis_that_points_away_from_the_tip_is_said(tmp_path, capsys):
    for axis, said in (("[0,0,1]", True), ("[0,0.5,-1]", False)):
        assert main(["calibrate-tip", "tip_mm=[0,-2.5,-150]", f"axis={axis}", f"out={tmp_path / 'tip'}"]) == 0
        assert ("expected from the handle to the tip" in capsys.readouterr().out) is said


def test_a_second_film_mostly_without_the_target_is_refused(table, tool, tmp_path, capsys):
    path = spun(tool, tmp_path / "spin.csv")
    track = sweep_tables.read_track(path)
    some = track.poses.copy()
    some[60:] = np.nan
    sweep_tables.write_track(path, Track(track.times, some, track.covariance, track.shared))
    assert main(["calibrate-tip", f"track={table}", f"spin={path}", f"out={tmp_path / 'tip'}"]) == 2
    said = capsys.readouterr().err
    assert "spin.csv: expected the target in 60 % of the frames, found it in 60 of 150, and in none from 60 to 149" in said


def test_a_sequence_will_do(poses, tool, tmp_path):
    """Poses of another tracker, to 0.01 mm and 0.01 deg, with a picture of no use."""
    rng = np.random.default_rng(9)
    noisy = rigid.moved(poses, rng.standard_normal((200, 6)) * [*np.radians([0.01] * 3), 0.01, 0.01, 0.01])
    probe = ProbeCalibration(np.eye(4), np.ones(2))
    path = tmp_path / "pivot.igs.mha"
    sequences.write_sequence(path, sequences.sequence_of(np.zeros((200, 4, 5), np.uint8), noisy, probe, np.arange(200) / 30))
    assert main(["calibrate-tip", f"sequence={path}", "tool=Probe", f"out={tmp_path / 'tip'}"]) == 0
    assert off(tip_files.read(tmp_path / "tip" / "tip.yaml"), tool) < 16.3


def test_what_is_wrong_is_said_in_one_line(table, poses, tool, tmp_path, capsys):
    def complaint(*fields: str) -> str:
        assert main(["calibrate-tip", f"out={tmp_path / 'out'}", *fields]) == 2
        (line,) = capsys.readouterr().err.splitlines()
        return line.removeprefix("sonotwin: ")

    assert complaint() == "calibrate-tip: expected one of capture, track, sequence or tip_mm, found none"
    assert complaint(f"track={table}", "tip_mm=[0,0,1]").endswith("or tip_mm, found track and tip_mm")
    assert complaint("tip_mm=[0,0,-150]", "axis=[0,0,0]") == "calibrate-tip: axis: expected a direction, found zeros"
    assert "expected none beside spin" in complaint("tip_mm=[0,0,1]", "axis=[0,0,1]", f"spin={table}")
    assert (
        complaint("tip_mm=[0,0,1]", f"model={table}") == f"{table}: expected a model of the tool as STL, GLB or PLY, found .csv"
    )
    (tmp_path / "bad.stl").write_bytes(b"solid nothing")
    assert complaint("tip_mm=[0,0,1]", f"model={tmp_path / 'bad.stl'}").startswith(f"{tmp_path}/bad.stl: expected a model of the")
    assert complaint(f"track={tmp_path}/none.csv").startswith(f"{tmp_path}/none.csv: expected a file")
    assert "least_turn_deg=" in complaint(f"track={table}", "least_turn_deg=40")
    assert "keeps its direction to 1 deg" in complaint("tip_mm=[0,0,-150]", f"spin={table}")
    metres = poses.copy()
    metres[:, :3, 3] *= 1e-3
    sweep_tables.write_track(tmp_path / "metres.csv", Track(np.arange(200, dtype=np.int64), metres))
    assert "metres? multiply the translations by 1000" in complaint(f"track={tmp_path / 'metres.csv'}")
    huge = np.tile(1e9 * np.eye(6), (200, 1, 1))
    sweep_tables.write_track(tmp_path / "huge.csv", Track(np.arange(200, dtype=np.int64), poses, huge))
    assert "expected variances of poses up to 1e+06 mm^2, found 1e+09" in complaint(f"track={tmp_path / 'huge.csv'}")
    rng = np.random.default_rng(3)
    slipped = pivot_films.poses_of(poses[:, :3, :3], *pivot_films.slipping(tool, poses[:, :3, :3], rng, 1.0))
    sweep_tables.write_track(tmp_path / "slipped.csv", pivot_films.tracked(slipped, rng))
    assert "slipped" in complaint(f"track={tmp_path / 'slipped.csv'}")
    assert "expected a folder apart from what is read" in complaint(f"track={table}", f"out={tmp_path}")
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_a_rendered_film_gives_the_tip(tmp_path, capsys):
    """26 pairs, 10 s apart from first to last: within 0.1 mm of the truth, and as predicted."""
    film, out = tmp_path / "film", tmp_path / "tip"
    assert main(["film", "path=pivot", "frames=26", "camera_hz=2.6", "white_dn=120", "seed=3", f"out={film}"]) == 0
    assert main(["calibrate-tip", f"capture={film / 'capture'}", f"out={out}"]) == 0
    tip, truth = tip_files.read(out / "tip.yaml"), np.load(film / "truth" / "sweep" / TRUTH)["tip_mm"]
    error = tip.tip_mm - truth
    assert np.linalg.norm(error) < 0.1 and error @ np.linalg.solve(tip.covariance_of(TIP), error) < 21.1, "1 of 10 000"
    assert tip.frames >= 24 and "has no covariance" in capsys.readouterr().out
