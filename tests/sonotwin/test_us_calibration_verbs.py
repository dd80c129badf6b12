"""The layouts of the rig authors' probe calibration and acquisition: out, in again, and refused where files don't fit."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from recon.capture import calibration_files, stereo_frames, sweep_part, sweep_tables
from recon.capture.layouts import meza2021
from recon.capture.manifest import CAMERAS, SCANNER, Device, read_manifest
from recon.capture.writer import new_capture
from recon.geometry import rigid
from recon.model.calibration import Calibration
from recon.model.tracks import Track
from sonotwin.cli import main
from tests.sonotwin.test_meza2021_verbs import contents, noise, optics

SIZE, SCAN, COUNT = (64, 48), (120, 100), 8
SCALE = np.array([0.12, 0.11])


def scan(pixel: np.ndarray | None, seed: int) -> np.ndarray:
    """A B-scan with the echo of a crossing at a pixel, in dark noise."""
    image = np.random.default_rng(seed).integers(0, 12, SCAN[::-1], np.uint8)
    if pixel is not None:
        cv2.circle(image, np.rint(16 * pixel).astype(int).tolist(), 48, 220, -1, cv2.LINE_AA, 4)
    return cv2.GaussianBlur(image, (0, 0), 1.5)


def wires(folder: Path, seed: int, count: int = COUNT) -> tuple[Path, np.ndarray, np.ndarray]:
    """A filmed sweep over a crossing, which B-scan 2 doesn't show; with poses (n, 4, 4) and pixels (n, 2), NaN of B-scan 2."""
    rng = np.random.default_rng(seed)
    pixels = rng.uniform((40, 30), (80, 70), (count, 2))
    poses = np.stack([rigid.from_rotation_vector([3, 0.02 * k, 0.1], [5.0 * k, 1, 600]) for k in range(count)])
    pixels[2] = np.nan
    scans = [scan(None if k == 2 else pixel, seed + k) for k, pixel in enumerate(pixels)]
    times = (1e9 * np.arange(count)).astype(np.int64)
    images = [(SCANNER, image) for image in scans]
    images += [(camera, image) for k, camera in enumerate(CAMERAS) for image in noise(count, SIZE, seed + k)]
    devices = {SCANNER: Device(size=SCAN)} | {name: Device(size=SIZE) for name in CAMERAS}
    with new_capture(folder, "rig") as made:
        made.add_calibration(optics())
        made.add_sweep(dict.fromkeys(devices, times), images, devices, Track(times, poses), "wires", "probe")
    return folder, poses, pixels


@pytest.fixture
def exported(tmp_path):
    """Two sets as exported, with their poses and crossings."""
    made = [wires(tmp_path / f"wires{seed}", seed) for seed in (1, 5)]
    line = f"capture=[{','.join(str(folder) for folder, _, _ in made)}]"
    assert main(["export", "layout=us_calibration", line, "implausible=take", f"out={tmp_path / 'sets'}"]) == 0
    return tmp_path / "sets", [(poses, pixels) for _, poses, pixels in made]


def test_their_scripts_find_a_set_of_each_capture(exported):
    """Names that they look for; rows of poses, crossings and images that belong together, without the B-scan that shows none."""
    folder, made = exported
    settings = yaml.safe_load((folder / "config.yaml").read_text(encoding="utf-8"))
    assert (settings["w"], settings["h"]) == SCAN and (folder / settings["params_file"]).exists()
    for number, (poses, pixels) in enumerate(made, 1):
        place, seen = folder / f"data{number}", np.isfinite(pixels).all(axis=1)
        assert np.load(place / "target_pose.npy") == pytest.approx(poses[seen])
        assert np.load(place / "cross_point.npy") == pytest.approx(pixels[seen], abs=0.2)
        for field, stem in (("left_folder", "left"), ("right_folder", "right"), ("us_folder", "US")):
            names = {path.name for path in (place / settings[field]).iterdir()}
            assert names == {f"{stem}{k}.png" for k in range(COUNT - 1)}


def test_sets_come_back_as_sweeps_for_the_probe(exported, tmp_path):
    folder, made = exported
    assert main(["import", "layout=us_calibration", f"folder={folder}", f"out={tmp_path / 'back'}"]) == 0
    held = read_manifest(tmp_path / "back")
    assert {name: part.purpose for name, part in held.sweeps.items()} == {"data1": "probe", "data2": "probe"}
    for name, (poses, pixels) in zip(("data1", "data2"), made, strict=True):
        seen = np.isfinite(pixels).all(axis=1)
        sweep = sweep_part.read_sweep(tmp_path / "back", name, implausible="take")
        assert sweep.poses() == pytest.approx(poses[seen]) and np.array_equal(
            sweep.image(0), scan(pixels[0], 1 if name == "data1" else 5)
        )
        read, crossings = sweep_tables.read_pairs(tmp_path / "back" / f"pairs_{name}.csv")
        assert read == pytest.approx(poses[seen]) and crossings == pytest.approx(pixels[seen], abs=0.2)
        assert len(list(stereo_frames.read_film(tmp_path / "back", sweep=name).pairs())) == COUNT - 1
    found = calibration_files.of_capture(tmp_path / "back").cameras["cam2"]
    assert found.camera_from_world == pytest.approx(optics().cameras["cam2"].camera_from_world)


def test_the_result_of_their_script_is_read(exported, tmp_path, caplog):
    folder, _ = exported
    np.savez(folder / "USparams.npz", sx=0.12, sy=-0.11, T_I_T=rigid.from_rotation_vector([1.5, 0, 0], [-70, 16, -48]))
    assert main(["import", "layout=us_calibration", f"folder={folder}", "speed_m_s=1488", f"out={tmp_path / 'back'}"]) == 0
    probe = sweep_part.read_sweep(tmp_path / "back", "data1", implausible="take").probe
    assert probe is not None and probe.speed_m_s == 1488 and probe.scale == pytest.approx(SCALE)
    assert "sy is negative" in " ".join(record.getMessage() for record in caplog.records)


def test_b_scans_without_a_crossing_are_left_for_their_hand(tmp_path, capsys):
    """Then all are written, for PointSegment.py; a set without film has no L and R."""
    folder, poses, _ = wires(tmp_path / "wires", 1)
    for path in (folder / "sweep" / "wires" / "us").glob("*.png"):
        cv2.imwrite(str(path), np.zeros(SCAN[::-1], np.uint8))
    fields = ["layout=us_calibration", f"capture={folder}", "implausible=take", "frames=false"]
    assert main(["export", *fields, f"out={tmp_path / 'sets'}"]) == 0
    assert "none with a crossing: PointSegment.py sets it" in capsys.readouterr().out
    assert sorted(path.name for path in (tmp_path / "sets" / "data1").iterdir()) == ["UScrop", "target_pose.npy"]
    assert np.load(tmp_path / "sets" / "data1" / "target_pose.npy") == pytest.approx(poses)


def test_captures_that_are_no_sets_are_refused(tmp_path, capsys):
    folder, _, _ = wires(tmp_path / "wires", 1)
    line = ["export", "layout=us_calibration", f"out={tmp_path / 'sets'}"]
    for fields, complaint in (
        ([], "export: capture: needs a value"),
        (
            [f"capture={folder}", "tissue_m_s=1450"],
            "tissue_m_s: expected none with layout=us_calibration, which is of crossed wires",
        ),
        ([f"capture=[{folder},{folder}]"], "expected each folder once"),
        ([f"capture={folder}", "sweep=scan"], "expected the name of one of wires"),
        ([f"capture={folder}", "frames=false", "apart_s=0.1"], "apart_s: expected none with frames=false"),
    ):
        assert main([*line, *fields]) == 2 and complaint in capsys.readouterr().err
    assert main(["export", f"capture=[{folder},{tmp_path}]", f"out={tmp_path / 'sets'}"]) == 2
    assert "expected one with layout=meza2021, found 2" in capsys.readouterr().err
    assert not (tmp_path / "sets").exists()


def test_sets_of_other_cameras_do_not_go_out_with_one_file(tmp_path, capsys):
    """By the file of the first capture their script would triangulate the second one's frames elsewhere."""
    made = [wires(tmp_path / f"wires{seed}", seed)[0] for seed in (1, 5)]
    moved = optics()
    aside = rigid.from_rotation_vector([0, 0, 0], [1.0, 0, 0])  # mm
    second = replace(moved.cameras["cam2"], camera_from_world=aside @ moved.cameras["cam2"].camera_from_world)
    calibration_files.write(made[1] / "calibration/optics.yaml", Calibration({**moved.cameras, "cam2": second}))
    line = ["export", "layout=us_calibration", f"capture=[{made[0]},{made[1]}]", "implausible=take", f"out={tmp_path / 'sets'}"]
    assert main(line) == 2 and not (tmp_path / "sets").exists()
    assert f"{made[1]}: expected the cameras' calibration of {made[0]}" in capsys.readouterr().err
    assert main([*line, f"calibration={made[0] / 'calibration/optics.yaml'}"]) == 0


def resize(folder: Path) -> None:
    for path in (folder / "data2" / "UScrop").iterdir():
        cv2.imwrite(str(path), np.zeros((30, 40), np.uint8))


def draw_box(folder: Path) -> None:
    path = str(folder / "data2/L/left2.png")
    cv2.imwrite(path, cv2.rectangle(cv2.imread(path, cv2.IMREAD_COLOR), (5, 5), (20, 20), (0, 255, 0), 3))


@pytest.mark.parametrize(("spoil", "complaint"), [
    (lambda folder: (folder / "data2/R/right3.png").unlink(), "data2/R: expected 7 frames, as in L/, found 6"),
    (lambda folder: (folder / "data2/L/left3.png").rename(folder / "data2/L/left9.png"),
     "R: expected the frame of L/left4.png next, found right3.png: is one lost in between?"),
    (lambda folder: np.save(folder / "data1/cross_point.npy", np.ones((5, 2))),
     "cross_point.npy: expected 7 frames, as in L/, found 5"),
    (lambda folder: [path.unlink() for path in (folder / "data1/UScrop").iterdir()], "data1: expected B-scans in UScrop/ or US/"),
    (draw_box, "left2.png: expected grey, found colour: boxes of the live detection"),
    (resize, "UScrop: expected images of 120x100 px, as in data1, found 40x30"),
    (lambda folder: (folder / "data1/UScrop/US4.png").write_bytes(b"none"), "US4.png: expected an image"),
    (lambda folder: (folder / "cam1_cam2.npz").write_bytes(b"PK"), "cam1_cam2.npz: expected"),
    (lambda folder: [(folder / name).rename(folder / name[-1]) for name in ("data1", "data2")],
     "expected folders data1, data2, ... with L, R and UScrop, as of US-Calibration, found none"),
])  # fmt: skip
def test_bad_sets_are_one_line(exported, tmp_path, capsys, spoil, complaint):
    folder, _ = exported
    spoil(folder)
    assert main(["import", "layout=us_calibration", f"folder={folder}", f"out={tmp_path / 'back'}"]) == 2
    said = capsys.readouterr().err.splitlines()
    assert complaint in said[-1] and said[-1].startswith("sonotwin: ") and not (tmp_path / "back").exists()


@pytest.fixture
def recording(tmp_path) -> Path:
    """What their acquisition saves: BMP, from 0 on, screen and crop."""
    folder = tmp_path / "acquisition"
    for name, stem, size, seed in (
        ("L", "left", SIZE, 1),
        ("R", "right", SIZE, 2),
        ("US", "US", (800, 600), 3),
        ("UScrop", "US", SCAN, 4),
    ):
        (folder / name).mkdir(parents=True)
        for k, image in enumerate(noise(11, size, seed)):
            cv2.imwrite(str(folder / name / f"{stem}{k}.bmp"), image)
    np.savez(folder / "cam1_cam2.npz", **meza2021.parameters(optics(), "cam2"))
    return folder


def test_a_recording_is_read_by_number(recording, tmp_path, capsys):
    """Stills, one a second, to be tracked; the crop counts, and without it the screen."""
    assert main(["import", "layout=stereo_basler", f"folder={recording}", f"out={tmp_path / 'capture'}"]) == 0
    film = stereo_frames.read_film(tmp_path / "capture")
    assert np.diff(film.times).tolist() == [10**9] * 10 and "11 frames of L, R, UScrop, without poses" in capsys.readouterr().out
    pairs = list(film.pairs())
    assert np.array_equal(pairs[10][0], noise(11, SIZE, 1)[10]) and np.array_equal(pairs[10][1], noise(11, SIZE, 2)[10])
    assert contents(tmp_path / "capture" / "sweep" / "us").keys() == {f"{k:04d}.png" for k in range(11)} | {"timestamps.csv"}
    for path in (recording / "UScrop").iterdir():
        path.unlink()
    assert main(["import", "layout=stereo_basler", f"folder={recording}", f"out={tmp_path / 'capture'}"]) == 0
    assert "their program crops it to [247, 67, 321, 408]" in capsys.readouterr().out
    assert read_manifest(tmp_path / "capture").devices[SCANNER].size == (800, 600)


def test_boxes_of_the_live_detection_are_refused(recording, tmp_path, capsys):
    """Grey stored as colour is none."""
    path = recording / "L" / "left4.bmp"
    image = cv2.cvtColor(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE), cv2.COLOR_GRAY2BGR)
    cv2.imwrite(str(path), image)
    line = ["import", "layout=stereo_basler", f"folder={recording}", f"out={tmp_path / 'capture'}"]
    assert main(line) == 0
    cv2.imwrite(str(path), cv2.rectangle(image, (5, 5), (20, 20), (0, 255, 0), 3))
    assert main(line) == 2 and "left4.bmp: expected grey, found colour: boxes" in capsys.readouterr().err


def test_frames_that_begin_with_other_numbers_are_told(recording, tmp_path, capsys, caplog):
    """Without left0 and right10 every pair is of two moments; what the layout has no place for is refused."""
    (recording / "L" / "left0.bmp").unlink()
    for name in ("R/right10.bmp", "US/US10.bmp", "UScrop/US10.bmp"):
        (recording / name).unlink()
    line = ["import", "layout=stereo_basler", f"folder={recording}", f"out={tmp_path / 'capture'}"]
    assert main(line) == 0
    said = [record.getMessage() for record in caplog.records if "begins with right0.bmp" in record.getMessage()]
    assert len(said) == 1 and "belong to L/left1.bmp: are the first ones lost?" in said[0]
    assert main([*line, "speed_m_s=1488"]) == 2
    assert "import: speed_m_s: expected none with layout=stereo_basler" in capsys.readouterr().err


def test_a_recording_and_sets_name_each_other(recording, tmp_path, capsys):
    assert main(["import", "layout=us_calibration", f"folder={recording}", f"out={tmp_path / 'capture'}"]) == 2
    assert "layout=stereo_basler reads one recording" in capsys.readouterr().err
    recording.rename(tmp_path / "data1")
    assert main(["import", "layout=stereo_basler", f"folder={tmp_path}", f"out={tmp_path / 'capture'}"]) == 2
    assert "layout=us_calibration reads data1" in capsys.readouterr().err
