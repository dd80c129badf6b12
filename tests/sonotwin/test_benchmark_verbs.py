"""`sonotwin score-benchmark` and `render-benchmark`: perfect results have no error, shifted ones theirs, missing ones none."""

import csv
import json
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import trimesh

from recon.capture import calibration_files, sweep_tables
from recon.errors import InputError
from recon.files.volumes import Volume
from recon.geometry.camera import Camera
from recon.model.calibration import Calibration
from recon.model.tracks import Track
from sonotwin import benchmark_sessions
from sonotwin.choices import read_rig
from sonotwin.cli import main
from sonotwin.verbs import score_benchmark
from twin.engine import Engine, results
from twin.evaluation import benchmark_results
from twin.evaluation.surface_errors import Truth
from twin.optics.surface_session import calibration_of

OPTICS, TRACKING = "000000-optics", "000001-tracking"


@pytest.fixture
def truth(tmp_path):
    """The truth of a session of optics and of one of tracking, made by hand."""
    folder = tmp_path / "truth"
    cameras = calibration_of(read_rig()).cameras
    for name in (OPTICS, TRACKING):
        (folder / name / "calibration").mkdir(parents=True)
        calibration_files.write(folder / name / "calibration/optics.yaml", Calibration(dict(cameras)))
    (folder / TRACKING / "sweep").mkdir()
    frames = {"times_ns": np.arange(4) * 10**8, "world_from_target": np.stack([np.eye(4)] * 4), "blur_px": np.zeros((4, 2, 3))}
    frames |= {"visible": np.ones((4, 2, 3)), "inside": np.ones((4, 2, 3), bool)}
    np.savez(folder / TRACKING / "sweep/film.npz", **frames)
    return folder


def give(results, cameras=None, poses=None):
    """Write results as a stranger would."""
    if cameras is not None:
        (results / OPTICS).mkdir(parents=True)
        calibration_files.write(results / OPTICS / "calibration.yaml", Calibration(cameras))
    if poses is not None:
        (results / TRACKING).mkdir(parents=True)
        sweep_tables.write_track(results / TRACKING / "poses.csv", Track(np.arange(4) * 10**8, poses))
    return results


def scores(truth, results, out):
    assert main(["score-benchmark", f"results={results}", f"truth={truth}", f"out={out}"]) == 0
    with (out / "summary.csv").open(encoding="utf-8") as file:
        return {(row["task"], row["figure"]): row for row in csv.DictReader(file)}


def test_perfect_results_have_no_error(truth, tmp_path):
    cameras = dict(calibration_of(read_rig()).cameras)
    found = scores(truth, give(tmp_path / "results", cameras, np.stack([np.eye(4)] * 4)), tmp_path / "out")
    assert float(found["optics", "points_rms_mm"]["mean"]) < 1e-6
    assert float(found["optics", "cam2_rms_px"]["mean"]) < 1e-6
    assert float(found["tracking", "shift_p95_mm"]["mean"]) < 1e-9
    assert float(found["tracking", "dropped_share"]["mean"]) == 0


def test_plain_opencv_gives_two_cameras(truth, tmp_path):
    """As `benchmarks/open_opencv.py` writes them, without the projector that the truth has."""
    first, second = (calibration_of(read_rig()).cameras[name] for name in ("cam1", "cam2"))
    between = second.camera_from_world @ np.linalg.inv(first.camera_from_world)
    (tmp_path / "results" / OPTICS).mkdir(parents=True)
    file = cv2.FileStorage(str(tmp_path / "results" / OPTICS / "calibration.yml"), cv2.FILE_STORAGE_WRITE)
    values = {"M1": first.matrix, "D1": first.distortion, "M2": second.matrix, "D2": second.distortion}
    for name, value in (values | {"R": between[:3, :3], "T": between[:3, 3:]}).items():
        file.write(name, np.array(value))
    file.release()
    assert float(scores(truth, tmp_path / "results", tmp_path / "out")["optics", "points_rms_mm"]["mean"]) < 1e-6


def test_a_shift_of_a_millimetre_is_one(truth, tmp_path):
    """Both cameras moved alike shift all points by as much; poses likewise; a frame without a pose has no error."""
    cameras, poses = {}, np.stack([np.eye(4)] * 4)
    for name, camera in calibration_of(read_rig()).cameras.items():
        motion = camera.camera_from_world @ np.array([[1, 0, 0, 1], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]])
        cameras[name] = Camera(camera.size, camera.matrix, camera.distortion, motion)
    poses[:, 0, 3], poses[3] = 1, np.nan
    found = scores(truth, give(tmp_path / "results", cameras, poses), tmp_path / "out")
    assert float(found["optics", "points_rms_mm"]["mean"]) == pytest.approx(1, abs=1e-3)
    assert float(found["tracking", "shift_median_mm"]["mean"]) == pytest.approx(1)
    assert float(found["tracking", "dropped_share"]["mean"]) == pytest.approx(0.25)


def test_missing_results_are_missing(truth, tmp_path):
    """Neither zero nor perfect: they are counted, and named on the page."""
    (tmp_path / "results").mkdir()
    found = scores(truth, tmp_path / "results", tmp_path / "out")
    assert found["optics", "nothing"]["missing"] == "1" and found["optics", "nothing"]["mean"] == "unknown"
    assert TRACKING in (tmp_path / "out/scores.html").read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("place", "content", "complaint"),
    [
        (f"{TRACKING}/poses.csv", "a,b\n1,2\n", "poses.csv: line 1: expected a header"),
        (f"{TRACKING}/poses.csv", "time_ns,found,m00\n", "expected a header"),
        (f"{OPTICS}/calibration.yaml", "{", "calibration.yaml: expected"),
        ("000001-trackin/poses.csv", "", "000001-trackin: expected the name of a session"),
    ],
)
def test_bad_results_are_refused_in_a_line(truth, tmp_path, capsys, place, content, complaint):
    path = tmp_path / "results" / place
    path.parent.mkdir(parents=True)
    path.write_text(content, encoding="utf-8")
    assert main(["score-benchmark", f"results={tmp_path / 'results'}", f"truth={truth}", f"out={tmp_path / 'out'}"]) == 2
    said = capsys.readouterr().err
    assert complaint in said and said.count("\n") == 1 and not (tmp_path / "out").exists()


def test_a_surface_is_compared_both_ways():
    """A plane 1 mm behind the true one is 1 mm off; of half a plane half is missing, and what there is isn't wrong."""
    camera = read_rig().cam1.optics.camera()
    grid = np.stack(np.meshgrid(np.arange(-40, 40, 0.5), np.arange(-40, 40, 0.5)), axis=-1)
    points = np.dstack([grid, np.full(grid.shape[:2], 650.0)])
    normals, lit = np.broadcast_to([0.0, 0, -1], points.shape), np.ones(grid.shape[:2], bool)
    true = Truth(points, normals, np.zeros(lit.shape, np.uint8), lit, points[..., :2], camera, camera, "", (), ())
    corners = np.array([[-40, -40, 651], [39.5, -40, 651], [39.5, 39.5, 651], [-40, 39.5, 651.0]])
    behind = benchmark_results.surface_figures(trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3]], process=False), true)
    assert behind["to_truth_rms_mm"] == pytest.approx(1) and behind["from_truth_median_mm"] == pytest.approx(1, abs=0.05)
    half = np.minimum(corners, [0.0, 1e3, 650])
    found = benchmark_results.surface_figures(trimesh.Trimesh(half, [[0, 1, 2], [0, 2, 3]], process=False), true)
    assert found["to_truth_rms_mm"] < 1e-9 and found["complete_share"] == pytest.approx(0.5, abs=0.03)


def test_a_sheet_far_away_takes_nothing_from_what_is_complete():
    """A false sheet of a thousand times the area is false, and the true part is as complete as without it."""
    camera = read_rig().cam1.optics.camera()
    grid = np.stack(np.meshgrid(np.arange(-40, 40, 0.5), np.arange(-40, 40, 0.5)), axis=-1)
    points = np.dstack([grid, np.full(grid.shape[:2], 650.0)])
    normals, lit = np.broadcast_to([0.0, 0, -1], points.shape), np.ones(grid.shape[:2], bool)
    true = Truth(points, normals, np.zeros(lit.shape, np.uint8), lit, points[..., :2], camera, camera, "", (), ())
    corners = np.array([[-40, -40, 650], [39.5, -40, 650], [39.5, 39.5, 650], [-40, 39.5, 650.0]])
    far = np.array([[32, 32, 1], [32, 32, 1], [32, 32, 1], [32, 32, 1]]) * corners + [0, 0, 300.0]
    mesh = trimesh.Trimesh([*corners, *far], [[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]], process=False)
    found = benchmark_results.surface_figures(mesh, true)
    assert found["complete_share"] == 1 and found["false_share"] > 0.99


def test_a_false_pose_is_no_found_one(truth, tmp_path):
    """Of four frames one has no pose, and one a pose 3 mm off."""
    poses = np.stack([np.eye(4)] * 4)
    poses[0], poses[1, 0, 3] = np.nan, 3.0
    found = scores(truth, give(tmp_path / "results", poses=poses), tmp_path / "out")
    assert float(found["tracking", "dropped_share"]["mean"]) == 0.5 and float(found["tracking", "false_share"]["mean"]) == 0.25


def test_the_truth_is_the_one_that_the_round_committed_to(truth, tmp_path, capsys):
    committed = {name: benchmark_results.digest(truth / name) for name in (OPTICS, TRACKING)}
    path, results = tmp_path / "benchmark.json", give(tmp_path / "results", poses=np.stack([np.eye(4)] * 4))
    assert scores(truth, results, tmp_path / "without") and "truth       not checked" in capsys.readouterr().out
    path.write_text(json.dumps({"format": benchmark_results.FORMAT, "truth_sha256": committed}), encoding="utf-8")
    assert scores(truth, results, tmp_path / "first") and "not checked" not in capsys.readouterr().out
    (truth / OPTICS / "more.txt").write_text("1", encoding="utf-8")
    arguments = ["score-benchmark", f"results={results}", f"truth={truth}", f"out={tmp_path / 'out'}"]
    assert main(arguments) == 2
    said = capsys.readouterr().err
    assert f"{OPTICS}: expected the truth of SHA-256 {committed[OPTICS]}" in said and said.count("\n") == 1
    assert not (tmp_path / "out").exists() and main([*arguments, "unchecked=true"]) == 0
    path.write_text('{"format": "other"}', encoding="utf-8")
    assert (
        main([*arguments, "out=" + str(tmp_path / "again")]) == 2
        and "benchmark.json: expected a round's" in capsys.readouterr().err
    )


def test_another_round_is_kept(tmp_path):
    """A folder of another seed is refused, and the seed itself isn't published."""
    benchmark_sessions.missing(tmp_path / "round", "secret", 3)
    described = (tmp_path / "round/benchmark.json").read_text(encoding="utf-8")
    assert "secret" not in described and json.loads(described)["seed_sha256"] == benchmark_sessions.commitment("secret")
    assert main(["render-benchmark", f"out={tmp_path / 'round'}", "seed=other", "sessions=3"]) == 2


def test_a_killed_run_is_finished_and_a_truth_stays_as_it_was_committed(tmp_path, monkeypatch):
    """What it left behind is cleared; a truth that was edited since is refused, and so is another version's round."""
    out, name = tmp_path / "round", "000000-optics"
    assert benchmark_sessions.missing(out, "seed", 1) == [0]
    (out / ".making" / name / "capture").mkdir(parents=True)
    for part in ("sessions", "truth"):
        (out / part / name).mkdir(parents=True)
    (out / "truth" / name / "a.txt").write_text("1", encoding="utf-8")
    benchmark_sessions.finish(out, "seed", 1)
    assert not (out / ".making").exists() and benchmark_sessions.missing(out, "seed", 1) == []
    (out / "truth" / name / "a.txt").write_text("2", encoding="utf-8")
    with pytest.raises(InputError, match="was it edited"):
        benchmark_sessions.finish(out, "seed", 1)
    monkeypatch.setattr(benchmark_sessions, "code", lambda: "another")
    with pytest.raises(InputError, match=r"benchmark\.json: code_sha256: expected another"):
        benchmark_sessions.missing(out, "seed", 1)


def test_a_neighbour_is_no_tissue(monkeypatch):
    """The levels of two masses 1.5 mm apart tell them from tissue without a fault, if they are the true ones."""
    balls = [trimesh.creation.icosphere(radius=4).apply_translation((9.5 * k, 0, 0)) for k in range(2)]
    grid = np.arange(-12, 22, 0.5)
    places = np.stack(np.meshgrid(grid, grid, grid, indexing="ij"), axis=-1)
    dark = np.min([np.linalg.norm(places - ball.center_mass, axis=-1) for ball in balls], axis=0) < 4
    voxels = np.where(dark, 10, 100).astype(np.uint8).transpose(2, 1, 0)
    volume = Volume(np.ascontiguousarray(voxels), np.full(3, -12.0), np.full(3, 0.5))
    monkeypatch.setattr(benchmark_results, "passed", lambda drawn, _: np.ones(len(drawn), bool))
    expected = SimpleNamespace(hidden=[SimpleNamespace(mesh=ball) for ball in balls])
    assert benchmark_results.volume_figures(volume, expected)["volume_auc"] == pytest.approx(1, abs=1e-3)


def test_few_sessions_have_no_interval():
    rows = score_benchmark.summary({f"{k:06d}-optics": {"points_rms_mm": float(k)} for k in (0, 4, 8, 12)})
    assert rows[0][4:] == ("6", "unknown", "unknown", "6")


@pytest.mark.slow
def test_workers_change_no_byte(tmp_path):
    """A session of tracking: the same in this process and in another, and no truth in it."""
    found = []
    for workers in (1, 2):
        out = tmp_path / str(workers)
        assert len(list(results(Engine(workers=workers), benchmark_sessions.write, [(out, "bytes", 1)]))) == 1
        found.append(
            {
                path.relative_to(out): path.read_bytes()
                for path in out.rglob("*.*")
                if path.is_file() and path.name != ".sonotwin.json"
            }
        )
    assert found[0] == found[1]
    assert (tmp_path / "1/truth" / TRACKING / "sweep/film.npz").is_file()
    assert not list((tmp_path / "1/sessions").rglob("*.npz")) and not list((tmp_path / "1/sessions").rglob("settings.json"))
