"""A sweep comes back as written, image by image; what is wrong with it is said in one line before images are read."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from recon.capture import manifest, sweep_part, sweep_tables
from recon.errors import InputError
from recon.geometry import rigid
from recon.model.calibration import Uncertainty
from recon.model.probe import ProbeCalibration
from recon.model.tracks import Track
from tests.recon import captures

SIZE = (24, 16)
START_NS = 1_700_000_000_123_456_789
COUNT, POSES = 5, 9


def images() -> np.ndarray:
    return np.random.default_rng(3).integers(0, 256, (COUNT, SIZE[1], SIZE[0]), np.uint8)


def times() -> np.ndarray:
    return START_NS + 50_000_001 * np.arange(COUNT)


def track(covariance: bool = True) -> Track:
    """Poses every 25 ms, turning at 40 deg/s and moving at 20 mm/s; number 6 is not found."""
    seconds = 0.025 * np.arange(POSES)
    turns = Rotation.from_rotvec(np.outer(np.radians(40) * seconds, [0.6, 0, 0.8])).as_matrix()
    poses = np.array([rigid.transform(turn, [20 * t, -3, 700]) for turn, t in zip(turns, seconds, strict=True)])
    poses[6] = np.nan
    root = np.random.default_rng(4).normal(size=(POSES, 6, 6)) * [1e-3, 1e-3, 1e-3, 0.1, 0.1, 0.1]
    return Track(START_NS + 25_000_000 * np.arange(POSES), poses, np.swapaxes(root, 1, 2) @ root if covariance else None)


def probe() -> ProbeCalibration:
    pose = rigid.from_rotation_vector([1.5, 0.1, 0], [-7.0, 80, 90])
    return ProbeCalibration(pose, np.array([0.12, 0.11]), Uncertainty(("sx", "sy"), np.diag([1e-8, 2e-8])))


@pytest.fixture
def folder(tmp_path) -> Path:
    captures.write_sweep(tmp_path / "capture", images(), times(), track(), SIZE, probe(), "sweep")
    return tmp_path / "capture"


def test_a_sweep_comes_back(folder):
    found = sweep_part.read_sweep(folder)
    assert (found.name, found.size) == ("sweep", SIZE)
    np.testing.assert_array_equal(found.times, times())
    np.testing.assert_array_equal(np.stack(list(found.images())), images())
    np.testing.assert_array_equal(found.image(3), images()[3])
    np.testing.assert_array_equal(found.track.times, track().times)
    np.testing.assert_array_equal(found.track.poses, track().poses)
    for mine, theirs in zip(found.track.covariance[found.track.found], track().covariance[found.track.found], strict=True):
        np.testing.assert_allclose(mine, theirs, rtol=1e-15)
    np.testing.assert_array_equal(found.probe.target_from_image, probe().target_from_image)
    np.testing.assert_array_equal(found.probe.scale, probe().scale)


def test_what_is_optional(tmp_path):
    captures.write_sweep(tmp_path / "capture", iter(images()), times(), track(covariance=False), SIZE)
    found = sweep_part.read_sweep(tmp_path / "capture")
    assert found.probe is None and found.track.covariance is None and found.pose_covariance() is None
    assert found.name == "capture"


def test_poses_are_those_at_the_moment_of_the_image(folder):
    """20 mm/s and 40 deg/s: an image stamped 8 ms late was taken where the probe stood 8 ms before."""
    found = sweep_part.read_sweep(folder)
    seconds = (found.times - START_NS) * 1e-9 - 0.008
    poses = found.poses(lag_s=0.008)
    assert np.isnan(poses[0]).all(), "before the first pose"
    np.testing.assert_allclose(poses[1:, 0, 3], 20 * seconds[1:], atol=1e-6)
    turned = Rotation.from_matrix(poses[1:, :3, :3]).magnitude()
    np.testing.assert_allclose(turned, np.radians(40) * seconds[1:], atol=1e-9)


def test_a_pose_between_two_is_surer_than_either(tmp_path):
    """Halfway the errors of two independent poses average out to half the variance; on a pose it has that pose's."""
    covariance = np.tile(np.diag([1e-6] * 3 + [0.01] * 3), (POSES, 1, 1))
    moments = START_NS + np.array([25_000_000, 37_500_000])
    poses = Track(track().times, track().poses, covariance)
    captures.write_sweep(tmp_path / "capture", images()[:2], moments, poses, SIZE)
    on, halfway = sweep_part.read_sweep(tmp_path / "capture").pose_covariance()
    np.testing.assert_allclose(on, covariance[0], atol=1e-15)
    np.testing.assert_allclose(halfway, covariance[0] / 2, atol=1e-15)


def test_clocks_that_have_nothing_to_do_with_each_other(folder):
    with pytest.raises(InputError, match=r"sweep: expected poses of the target .* are the clocks others\?$"):
        sweep_part.read_sweep(folder).poses(lag_s=1000.0)


def test_scans_of_another_kind(folder):
    """A scanner that saves bitmaps in colour: each number's file is found by its other suffix."""
    for path in (folder / "sweep" / "us").glob("*.png"):
        cv2.imwrite(str(path.with_suffix(".bmp")), cv2.imread(str(path), cv2.IMREAD_COLOR))
        path.unlink()
    np.testing.assert_array_equal(np.stack(list(sweep_part.read_sweep(folder).images())), images())


def test_a_scanner_may_drop_frames(folder):
    """Numbers of the frames need not be without gaps; the images keep their names."""
    path = folder / "sweep" / "us" / "timestamps.csv"
    lines = path.read_text().splitlines()
    path.write_text("\r\n".join([lines[0], *lines[2:4], lines[5]]) + "\r\n\r\n")
    found = sweep_part.read_sweep(folder)
    assert found.frames.tolist() == [1, 2, 4]
    np.testing.assert_array_equal(np.stack(list(found.images())), images()[[1, 2, 4]])


def test_a_sweep_joins_other_parts(folder, tmp_path):
    """Cameras may be in the manifest too, with frames of their own that are read elsewhere."""
    content = json.loads((folder / "manifest.json").read_text())
    content["devices"]["cam1"] = {"size": [64, 48]}
    content["sweep"]["images"]["cam1"] = "sweep/cam1"
    (folder / "manifest.json").write_text(json.dumps(content))
    assert len(sweep_part.read_sweep(folder).paths) == COUNT
    assert manifest.read_manifest(folder).surface is None


def test_a_failed_write_leaves_nothing(tmp_path):
    def breaks_off():
        yield from images()[:2]
        raise OSError(28, "No space left on device")

    with pytest.raises(OSError, match="No space"):
        captures.write_sweep(tmp_path / "capture", breaks_off(), times(), track(), SIZE)
    for wrong in (images()[:-1], images()[:, :-1], images().astype(float)):
        with pytest.raises(ValueError, match="expected"):
            captures.write_sweep(tmp_path / "capture", wrong, times(), track(), SIZE)
    with pytest.raises(ValueError, match="increasing"):
        captures.write_sweep(tmp_path / "capture", images(), times()[::-1], track(), SIZE)
    assert not list(tmp_path.iterdir())


def manifest_with(change):
    def spoil(folder: Path) -> None:
        content = json.loads((folder / "manifest.json").read_text())
        change(content)
        (folder / "manifest.json").write_text(json.dumps(content))

    return spoil


def cell(file: str, line: int, column: int, text: str | None):
    """Put a text into a table; None takes the column away."""

    def spoil(folder: Path) -> None:
        path = folder / "sweep" / file
        lines = [row.split(",") for row in path.read_text().splitlines()]
        lines[line - 1][column : column + 1] = [] if text is None else [text]
        path.write_text("\n".join(",".join(row) for row in lines) + "\n")

    return spoil


STAMPS, TRACK = "us/timestamps.csv", "track.csv"
FAULTS = {
    "no sweep": (manifest_with(lambda m: m.pop("sweep")), "manifest.json: expected sweep, B-scans and the poses of the probe"),
    "no scanner": (
        manifest_with(lambda m: (m["devices"].update(cam1={"size": [64, 48]}), m["sweep"].update(images={"cam1": "a"}))),
        "manifest.json: sweep.images.us: expected a path, found none",
    ),
    "unknown device": (
        manifest_with(lambda m: m["sweep"]["images"].update(cam2="sweep/cam2")),
        "manifest.json: sweep.images.cam2: expected one of the devices us, found cam2",
    ),
    "no track": (manifest_with(lambda m: m["sweep"].pop("track")), "manifest.json: sweep.track: expected a path, found none"),
    "ten bits": (manifest_with(lambda m: m["devices"]["us"].update(bits=10)), "devices.us.bits: expected 8, found 10"),
    "version": (manifest_with(lambda m: m.update(schema="sonotwin-capture/2")), "schema: expected 'sonotwin-capture/1'"),
    "lost probe": (
        lambda f: (f / "calibration/probe.yaml").unlink(),
        "probe.yaml: expected a probe's calibration, found none",
    ),
    "lost image": (lambda f: (f / "sweep/us/0003.png").unlink(), "us/0003.png: expected a file, found none"),
    "lost stamps": (lambda f: (f / "sweep" / STAMPS).unlink(), "timestamps.csv: expected a file, found none"),
    "damaged": (lambda f: (f / "sweep" / TRACK).write_bytes(b"\xff\xfe\x00"), "track.csv: expected a table as CSV text, found"),
    "empty": (lambda f: (f / "sweep" / TRACK).write_text(""), "track.csv: line 1: expected a header time_ns,found,m00"),
    "no header": (cell(STAMPS, 1, 0, "0"), "timestamps.csv: line 1: expected a header frame,time_ns, found 0,time_ns"),
    "no rows": (
        lambda f: (f / "sweep" / STAMPS).write_text("frame,time_ns\n"),
        "timestamps.csv: expected one row or more below the header, found none",
    ),
    "columns": (cell(TRACK, 4, 8, None), "track.csv: line 4: expected 35 columns, found 34"),
    "seconds": (cell(STAMPS, 3, 1, "0.05"), "timestamps.csv: line 3: time_ns: expected a whole number, found '0.05'"),
    "huge": (cell(STAMPS, 3, 1, "9" * 30), "timestamps.csv: line 3: time_ns: expected a whole number, found '999"),
    "backwards": (cell(STAMPS, 4, 1, "5"), "timestamps.csv: line 4: time_ns: expected more than the 17000000001734567"),
    "poses backwards": (cell(TRACK, 5, 0, "5"), "track.csv: line 5: time_ns: expected more than the 1700000000"),
    "frame twice": (
        cell(STAMPS, 4, 0, "1"),
        "timestamps.csv: line 4: frame: expected more than the 1 before, in order of time, found 1",
    ),
    "not found": (cell(TRACK, 2, 1, "no"), "track.csv: line 2: found: expected 0 or 1, found 'no'"),
    "NaN": (cell(TRACK, 3, 5, "nan"), "track.csv: line 3: m03: expected a finite number, found 'nan'"),
    "no number": (cell(TRACK, 3, 5, "x"), "track.csv: line 3: m03: expected a finite number, found 'x'"),
    "no rotation": (
        cell(TRACK, 3, 2, "1.1"),
        "track.csv: line 3: expected a rigid transform of a right-handed frame, row by row, found a matrix that is no rotation",
    ),
    "left-handed": (
        lambda f: [cell(TRACK, 2, 2 + k, "0" if k % 5 else "-1" if k == 0 else "1")(f) for k in range(12)],
        "track.csv: line 2: expected a rigid transform of a right-handed frame, row by row, found a left-handed frame",
    ),
    "covariance": (
        cell(TRACK, 3, 14, "-1"),
        "track.csv: line 3: expected the upper triangle of a covariance, found a matrix that",
    ),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_faults_are_said_before_images_are_read(folder, fault):
    spoil, complaint = FAULTS[fault]
    spoil(folder)
    with pytest.raises(InputError) as caught:
        sweep_part.read_sweep(folder)
    assert complaint in str(caught.value) and "\n" not in str(caught.value)


def test_a_damaged_image_is_named(folder):
    path = folder / "sweep" / "us" / "0002.png"
    path.write_bytes(path.read_bytes()[:-20])
    found = sweep_part.read_sweep(folder)
    found.image(1)
    with pytest.raises(InputError, match=r"us/0002\.png: expected a whole PNG image, found it cut short"):
        found.image(2)


def test_pairs_come_back(tmp_path):
    poses, pixels = track().poses[:6], np.random.default_rng(5).uniform(0, 300, (6, 2))
    numbers = np.column_stack([poses[:, :3].reshape(6, 12), pixels])
    sweep_tables.write_rows(tmp_path / "pairs.csv", sweep_tables.PAIRS, numbers.tolist())
    found = sweep_tables.read_pairs(tmp_path / "pairs.csv")
    np.testing.assert_array_equal(found[0], poses)
    np.testing.assert_array_equal(found[1], pixels)


def test_what_errs_alike_in_all_poses_comes_back_and_does_not_average_out(tmp_path):
    """Halfway between two poses it is as large as on them."""
    own, shared = (np.tile(np.diag([1e-6] * 3 + [size] * 3), (POSES, 1, 1)) for size in (0.01, 0.04))
    poses = Track(track().times, track().poses, own, shared)
    captures.write_sweep(tmp_path / "capture", images()[:2], START_NS + np.array([25_000_000, 37_500_000]), poses, SIZE)
    found = sweep_part.read_sweep(tmp_path / "capture")
    known = found.track.found
    np.testing.assert_allclose(found.track.shared[known], shared[known], rtol=1e-15)
    np.testing.assert_allclose(found.shared_covariance(), shared[:2], atol=1e-15)
    np.testing.assert_allclose(found.pose_covariance()[1], own[0] / 2, atol=1e-15)
    with pytest.raises(ValueError, match="shared: expected with a covariance"):
        Track(track().times, track().poses, None, shared)


def test_poses_that_no_hand_makes_are_left_out(tmp_path, caplog):
    """Lost ones that a tracker wrote as the identity, one a second off, and ten that froze while the B-scans changed."""
    seconds = np.arange(60) / 40
    poses = np.array([rigid.transform(np.eye(3), [20 * t, -3, 700]) for t in seconds])
    moved = poses.copy()
    moved[[3, 4]], moved[50, 0, 3], moved[20:32] = np.eye(4), 4000, poses[20]
    stamps = START_NS + np.round(seconds * 1e9).astype(np.int64)
    shown = np.random.default_rng(1).integers(0, 256, (30, SIZE[1], SIZE[0]), np.uint8)
    captures.write_sweep(tmp_path / "capture", shown, stamps[::2] + 4_000_000, Track(stamps, moved), SIZE)
    sweep = sweep_part.read_sweep(tmp_path / "capture")
    assert np.flatnonzero(~sweep.track.found).tolist() == [3, 4, *range(21, 32), 50] and sweep.left_out == 14
    assert "track.csv: left out 11 of 60 poses, from pose 21 on: the same to the last digit" in caplog.text
    assert np.nanmax(np.abs(sweep.poses()[:, 0, 3] - 20 * (seconds[::2] + 0.004))) < 1e-6
    assert sweep_part.read_sweep(tmp_path / "capture", implausible="take").track.found.all()
    captures.write_sweep(tmp_path / "rest", shown, stamps[::2], Track(stamps, np.tile(poses[3], (60, 1, 1))), SIZE)
    with pytest.raises(InputError, match=r"track.csv: poses: expected those of a probe that moves, found all 60 the same"):
        sweep_part.read_sweep(tmp_path / "rest")
    assert sweep_part.read_sweep(tmp_path / "rest", implausible="take").track.found.all()
