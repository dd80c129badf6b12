"""Films are read as they were written, paired by time, and refused in one line where something doesn't fit."""

import csv
import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from recon.capture import calibration_files, images, manifest, stereo_frames, sweep_part, sweep_tables
from recon.errors import InputError
from recon.model import calibration
from recon.tracking import results
from recon.tracking.tracker import Tracker
from tests.recon import captures, sweep_sets
from tests.recon.tracking import films
from tests.recon.tracking.stand_ins import Told


@pytest.fixture(scope="module")
def blank(rig, tmp_path_factory) -> Path:
    return films.blank(tmp_path_factory.mktemp("blank") / "capture", rig)


@pytest.fixture
def copy(blank, tmp_path) -> Path:
    return Path(shutil.copytree(blank, tmp_path / "capture"))


def test_a_film_is_read_as_it_was_written(blank, rig):
    film = stereo_frames.read_film(blank)
    assert film.name == "blank" and film.times.tolist() == films.stamps(3).tolist() and film.bits is None
    assert film.rate_hz == pytest.approx(30, abs=1e-3)
    for k, (left, right) in enumerate(film.pairs()):
        assert left.shape == right.shape == (1024, 1280)
        assert (left == 10 + k).all() and (right == 10 + 2 * k).all()
    for found, name in zip(film.cameras, stereo_frames.CAMERAS, strict=True):
        true = getattr(rig, name).optics.camera()
        assert np.array_equal(found.matrix, true.matrix) and np.array_equal(found.camera_from_world, true.camera_from_world)


def test_ten_bits_stay_ten_bits(rig, tmp_path):
    film = stereo_frames.read_film(films.blank(tmp_path / "deep", rig, count=1, bits=10))
    (pair,) = film.pairs()
    assert film.bits == 10 and pair[0].dtype == np.uint16


def test_frames_are_read_as_they_are_asked_for(copy, monkeypatch):
    """A long film must not be in memory: after the first pair only the next few have been read."""
    for camera in stereo_frames.CAMERAS:
        place = copy / "sweep" / camera
        for k in range(3, 12):
            (place / f"{k:04d}.png").symlink_to(place / "0000.png")
        sweep_tables.write_stamps(place / "timestamps.csv", films.stamps(12))
    asked = []
    read = stereo_frames.read_image
    monkeypatch.setattr(stereo_frames, "read_image", lambda path, *more: asked.append(path) or read(path, *more))
    pairs = stereo_frames.read_film(copy).pairs()
    assert not asked
    next(pairs)
    assert len(asked) <= 2 * (stereo_frames.AT_ONCE + 1)
    assert len(list(pairs)) == 11 and len(asked) == 24


def test_frames_are_paired_by_time_and_not_by_number(copy):
    """Camera 2 counts from 5, and its clock differs by a third of a period."""
    place = copy / "sweep" / "cam2"
    for k in range(3):
        (place / f"{k:04d}.png").rename(place / f"{k + 5:04d}.png")
    rows = ((k + 5, int(time) + films.PERIOD_NS // 3) for k, time in enumerate(films.stamps(3)))
    sweep_tables.write_rows(place / "timestamps.csv", sweep_tables.STAMPS, rows)
    film = stereo_frames.read_film(copy)
    assert film.frames.tolist() == [[0, 5], [1, 6], [2, 7]] and film.times.tolist() == films.stamps(3).tolist()
    assert [int(right[0, 0]) for _, right in film.pairs()] == [10, 12, 14]


def partners(first_ns, second_ns):
    tables = [(np.arange(len(each)), np.asarray(each, np.int64)) for each in (first_ns, second_ns)]
    return [rows.tolist() for rows in stereo_frames._partners([Path("cam1"), Path("cam2")], tables)]


def test_cameras_that_run_freely_are_paired_in_order(rng, caplog):
    """About 7 a second, 46 ms apart by their phases, with 8 ms of jitter: some are more than half a period apart."""
    period, jitter = 136e6, 8e6
    first = np.arange(80) * period + rng.normal(0, jitter, 80)
    second = np.arange(80) * period + 46e6 + rng.normal(0, jitter, 80)
    assert partners(first, second) == [list(range(80))] * 2
    assert "pairs are 4" in caplog.text and "ms apart (median)" in caplog.text


@pytest.mark.parametrize(("jitter_ms", "most"), [(0.2, 10), (1, 150)])
def test_of_cameras_half_a_period_apart_few_frames_stay_alone(rng, jitter_ms, most):
    """Of 20000 at 60 Hz: a pair more counts more than the nearest of two; alone stay those whose neighbours both are taken."""
    first = np.arange(20_000) * 16_666_667
    second = first + 8_333_333 + np.rint(rng.normal(0, jitter_ms * 1e6, len(first))).astype(np.int64)
    assert len(first) - len(partners(first, second)[0]) <= most


def test_stamps_that_come_in_a_burst_are_paired_soon(rng):
    """Row by row in a window of 1500: work grows with the window's pairs, and not with their pairs."""
    burst = np.concatenate([np.arange(2000) * 10**9, 2000 * 10**9 + np.arange(500) * 33_333])
    assert partners(burst, burst + 5) == [list(range(2500))] * 2


def test_frames_that_one_camera_lost_are_left_out(caplog):
    first, second = films.stamps(40), np.delete(films.stamps(40), [5, 17, 18])
    paired = partners(first, second)
    assert paired == [[k for k in range(40) if k not in (5, 17, 18)], list(range(37))]
    assert "cam1/timestamps.csv: left out 3 of 40 frames, without a partner in cam2; the first is frame 5, 33.3 ms" in caplog.text


def test_the_last_pair_of_cameras_of_which_one_lost_an_earlier_frame_is_kept(caplog):
    """One frame fewer isn't a recording that was cut off at its end, if that frame is the first, or one in between."""
    stamps = films.stamps(40)
    for lost in (0, 17):
        rows = [k for k in range(40) if k != lost]
        assert partners(stamps, stamps[rows]) == [rows, list(range(39))]
        assert partners(stamps[rows], stamps) == [list(range(39)), rows]
    assert caplog.text.count("left out 1 of 40 frames, without a partner") == 4
    caplog.clear()
    assert partners(stamps, stamps[:-1]) == partners(stamps[:-1], stamps) == [list(range(39))] * 2 and not caplog.text


def complaint(folder: Path) -> str:
    with pytest.raises(InputError) as caught:
        list(stereo_frames.read_film(folder).pairs())
    text = str(caught.value)
    assert "\n" not in text
    return text.replace(f"{folder}/", "")


def test_a_frame_without_a_partner_is_named(copy):
    sweep_tables.write_stamps(copy / "sweep/cam2/timestamps.csv", films.stamps(3)[1:])
    assert complaint(copy).startswith(
        "sweep/cam2/timestamps.csv: expected a frame of its own within 25.0 ms of cam1's frame 0, found the nearest 33.3 ms away"
    )


def test_a_recording_that_was_cut_off_between_the_cameras_is_read(copy):
    sweep_tables.write_stamps(copy / "sweep/cam2/timestamps.csv", films.stamps(2))
    assert stereo_frames.read_film(copy).frames.tolist() == [[0, 0], [1, 1]]


def test_clocks_that_differ_are_told(copy):
    sweep_tables.write_stamps(copy / "sweep/cam1/timestamps.csv", films.stamps(3) + 10**9)
    assert "(3 such, in 3 frames of cam1 and 3 frames of cam2)" in complaint(copy)


def test_a_frame_that_isnt_there_is_named(copy):
    (copy / "sweep/cam2/0001.png").unlink()
    assert complaint(copy) == "sweep/cam2/0001.png: expected a file, found none"


def test_a_damaged_frame_is_named(copy):
    path = copy / "sweep/cam1/0002.png"
    path.write_bytes(path.read_bytes()[:200])
    assert complaint(copy).startswith("sweep/cam1/0002.png: expected a whole PNG image, found it cut short")


def test_a_frame_of_another_size_is_named(copy, rig, tmp_path):
    images.write_images([copy / "sweep/cam2/0001.png"], np.zeros((1, 512, 640), np.uint8))
    assert complaint(copy) == "sweep/cam2/0001.png: expected 1280x1024 8-bit, found 640x512 8-bit"


def edited(folder: Path, edit) -> Path:
    path = folder / "manifest.json"
    content = json.loads(path.read_text())
    edit(content)
    path.write_text(json.dumps(content))
    return folder


def test_what_the_manifest_lacks_is_named(copy):
    edited(copy, lambda content: content["sweep"]["images"].pop("cam2"))
    assert complaint(copy) == "manifest.json: sweep.images.cam2: expected a path, found none"
    edited(copy, lambda content: content.pop("sweep"))
    assert complaint(copy) == "manifest.json: expected sweep, with images of cam1, cam2, found none"


def test_cameras_that_dont_fit_are_named(copy, rig):
    edited(copy, lambda content: content["devices"]["cam2"].update(size=[640, 512]))
    assert complaint(copy) == "calibration/optics.yaml: expected cam2 of 640x512 px, found 1280x1024"
    edited(copy, lambda content: [content["devices"][name].update(bits=bits) for name, bits in (("cam1", 10), ("cam2", 12))])
    assert complaint(copy) == "manifest.json: devices.cam2.bits: expected 10, as of cam1, found 12"
    edited(copy, lambda content: [content["devices"][name].update(bits=8, size=[1280, 1024]) for name in stereo_frames.CAMERAS])
    alone = calibration.Calibration({"cam1": rig.cam1.optics.camera(), "projector": rig.projector.optics.camera()})
    calibration_files.write(copy / "calibration/optics.yaml", alone)
    assert complaint(copy) == "calibration/optics.yaml: expected cam2, found cam1, projector"
    edited(copy, lambda content: content.pop("calibration"))
    assert (
        complaint(copy)
        == "manifest.json: expected calibration, the path of a calibration file, found none; give calibration=FILE"
    )


def test_nothing_is_left_of_a_film_that_failed(rig, tmp_path):
    frames = np.zeros((1024, 1280), np.uint8)
    with pytest.raises(ValueError, match="expected 3, one a time, found 1"):
        captures.write_film(tmp_path / "film", [(frames, frames)], films.stamps(3), films.optics(rig), films.devices(rig))
    with pytest.raises(ValueError, match="cam2: expected 1280x1024 uint8"):
        pair = frames, frames[:512]
        captures.write_film(tmp_path / "film", [pair], films.stamps(1), films.optics(rig), films.devices(rig))
    assert not list(tmp_path.iterdir())


@pytest.fixture(scope="module")
def followed(rig, tmp_path_factory):
    """Three frames, the last one not seen by camera 2, tracked, and the folder with what is told of them."""
    folder = tmp_path_factory.mktemp("drawn")
    film = stereo_frames.read_film(films.film(folder / "capture", rig, np.random.default_rng(3), count=3, missing=(2,)))
    tracker = Tracker(film.cameras, rig.target, Told(films.centres(rig, films.places(1)[0])), drift_px=0, board_scale=0)
    pictures = folder / "out"
    pictures.mkdir()
    steps = []
    for k, pair in enumerate(film.pairs()):
        found = tracker.step(*pair, film.times[k] * 1e-9)
        steps.append(results.kept(found, int(film.times[k])))
        results.write_overlay(pictures, k, results.overlay(pair, found, film.cameras))
    results.write_poses(pictures, film, steps)
    return steps, pictures


def test_poses_are_those_of_the_target(followed):
    steps, folder = followed
    track = sweep_tables.read_track(folder / results.POSES)
    assert track.found.tolist() == [True, True, False]
    assert np.array_equal(track.poses[:2], results.track_of(steps).poses[:2]) and track.covariance is not None
    apart = np.linalg.norm(track.poses[:2, :3, 3] - films.places(2)[:, :3, 3], axis=1)
    assert apart.max() < 0.05
    with (folder / results.FRAMES).open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert [row["found"] for row in rows] == ["1", "1", "0"] and rows[1]["how"] == "predicted"
    assert rows[2]["reason"].startswith("only camera 1 sees the target") and rows[2]["sigma_mm"] == ""
    assert 0 < float(rows[0]["sigma_mm"]) < 0.1


def test_overlays_show_both_views(followed):
    picture = cv2.imread(str(followed[1] / "overlays" / "0000.jpg"))
    assert picture is not None and picture.shape == (512, 1280, 3)
    coloured = np.ptp(picture.astype(int), axis=2) > 60
    assert coloured[:, :640].any() and coloured[:, 640:].any()


def test_a_sweeps_poses_are_handed_on(rig, tmp_path, rng):
    """B-scans stay where they are; the folder of the poses is a capture of them."""
    source = sweep_sets.bottom(tmp_path / "there" / "capture", rng, 0.0)
    before = sweep_part.read_sweep(source)
    out = tmp_path / "elsewhere" / "track"
    out.mkdir(parents=True)
    sweep_tables.write_track(out / results.POSES, before.track)
    (out / results.BODIES / "needle").mkdir(parents=True)
    sweep_tables.write_track(out / results.BODIES / "needle" / results.POSES, before.track)
    assert results.hand_on(out, source, out)
    after = sweep_part.read_sweep(out)
    assert len(after.paths) == len(before.paths) and np.array_equal(after.image(3), before.image(3))
    assert np.array_equal(after.track.poses, before.track.poses, equal_nan=True)
    assert np.array_equal(after.bodies["needle"].poses, before.track.poses, equal_nan=True) and not before.bodies
    results.hand_on(out, source, out, tmp_path / "elsewhere" / "optics.yaml")
    assert manifest.read_manifest(out).calibration == "../optics.yaml"


def test_without_b_scans_nothing_is_handed_on(blank, tmp_path):
    assert not results.hand_on(tmp_path, blank, tmp_path) and not list(tmp_path.iterdir())
