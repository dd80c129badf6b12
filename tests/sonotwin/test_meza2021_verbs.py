"""`sonotwin export` and `sonotwin import`: what goes out in the rig authors' layout comes back, and theirs comes in as it is."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh

from recon.capture import calibration_files, stereo_frames, surface_part, sweep_part, sweep_tables
from recon.capture.layouts import meza2021
from recon.capture.manifest import CAMERAS, SCANNER, Device, read_manifest
from recon.capture.writer import new_capture
from recon.geometry import rigid
from recon.geometry.camera import Camera
from recon.model.calibration import Calibration
from recon.model.probe import ProbeCalibration
from recon.model.tracks import Track
from recon.probe_calibration import sound_in_water
from sonotwin.cli import main

SIZE, SCAN, COUNT = (64, 48), (40, 30), 6
PERIOD = 25_000_000  # ns
LAG_S = 0.025


def optics() -> Calibration:
    matrix = np.array([[200.0, 0, 31.5], [0, 200, 23.5], [0, 0, 1]])
    beside = rigid.from_rotation_vector([0, -0.2, 0], [-150, 0, 0])
    projector = Camera((1280, 800), np.diag([190.0, 190, 1]), np.zeros(5), rigid.invert(beside))
    cameras = {"cam1": Camera(SIZE, matrix, np.zeros(5)), "cam2": Camera(SIZE, matrix, np.zeros(5), beside)}
    return Calibration(cameras | {"projector": projector})


def probe() -> ProbeCalibration:
    return ProbeCalibration(rigid.from_rotation_vector([-1.5, 0.1, 0], [-70.0, 16, -48]), np.array([0.12, 0.11]))


def poses() -> np.ndarray:
    return np.stack([rigid.from_rotation_vector([3.0, 0.02 * k, 0.1], [5.0 * k, 1, 600]) for k in range(COUNT)])


def noise(count: int, size, seed: int) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (count, *size[::-1]), np.uint8)


@pytest.fixture
def capture(tmp_path) -> Path:
    """A surface by their patterns, and a sweep with frames and poses; the B-scans' stamps are late by a period."""
    sequence = meza2021.patterns()
    times = {"us": LAG_S * 1e9 + PERIOD * np.arange(COUNT), **dict.fromkeys(CAMERAS, PERIOD * np.arange(COUNT))}
    times = {name: np.rint(each).astype(np.int64) for name, each in times.items()}
    images = [(name, image) for k, name in enumerate((SCANNER, *CAMERAS)) for image in noise(COUNT, SCAN if k == 0 else SIZE, k)]
    devices = {SCANNER: Device(size=SCAN)} | {name: Device(size=SIZE) for name in CAMERAS}
    with new_capture(tmp_path / "capture", "rig") as made:
        made.add_calibration(optics())
        made.add_surface({"cam1": noise(sequence.count, SIZE, 9)}, sequence, devices | {"projector": Device(size=(1280, 800))})
        made.add_sweep(times, images, devices, Track(times["cam1"], poses()), "scan", "volume")
        made.add_probe(probe())
    return tmp_path / "capture"


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def test_what_is_exported_comes_back(capture, tmp_path):
    """Images to the byte, poses, scales and cameras to rounding."""
    assert main(["export", f"capture={capture}", f"lag_s={LAG_S}", f"out={tmp_path / 'theirs'}"]) == 0
    assert main(["import", f"folder={tmp_path / 'theirs'}", f"camera_hz={1e9 / PERIOD}", f"out={tmp_path / 'back'}"]) == 0
    before, after = surface_part.read_surface(capture), surface_part.read_surface(tmp_path / "back")
    assert np.array_equal(after.images, before.images) and after.patterns == before.patterns
    sweep = sweep_part.read_sweep(tmp_path / "back")
    assert np.array_equal(np.stack(list(sweep.images())), noise(COUNT, SCAN, 0))
    assert sweep.poses(0.0) == pytest.approx(poses(), abs=1e-9)
    assert sweep.probe is not None and sweep.probe.target_from_image == pytest.approx(probe().target_from_image)
    film = stereo_frames.read_film(tmp_path / "back")
    for k, pair in enumerate(film.pairs()):
        assert np.array_equal(pair[0], noise(COUNT, SIZE, 1)[k]) and np.array_equal(pair[1], noise(COUNT, SIZE, 2)[k])
    for name, camera in optics().cameras.items():
        found = after.calibration.cameras[name]
        assert found.matrix == pytest.approx(camera.matrix) and found.camera_from_world == pytest.approx(camera.camera_from_world)


def test_the_speed_of_sound_comes_back(capture, tmp_path, capsys):
    """Converted to tissue, out and in again: a pixel lies where it lay, unless another speed is given."""
    theirs, fields = tmp_path / "theirs", [f"capture={capture}", f"lag_s={LAG_S}", "tissue_m_s=1450"]
    assert main(["export", *fields, f"out={theirs}"]) == 0
    for given, speed, why in (([], 1450, "as sonotwin-export.json says"), (["speed_m_s=1500"], 1500, "(speed_m_s)")):
        assert main(["import", f"folder={theirs}", *given, f"out={tmp_path / 'back'}"]) == 0
        back = sweep_part.read_sweep(tmp_path / "back").probe
        assert back is not None and back.speed_m_s == speed and why in capsys.readouterr().out
        if not given:
            assert sound_in_water.for_tissue(back, 1540.0).scale == pytest.approx(probe().scale)
    (theirs / "sonotwin-export.json").write_text('{"layout": "meza2021", "speed_m_s": -3}')
    assert main(["import", f"folder={theirs}", f"out={tmp_path / 'other'}"]) == 2
    assert "sonotwin-export.json: speed_m_s: expected" in capsys.readouterr().err


def test_poses_are_those_of_the_frames_beside_them(capture, tmp_path, capsys):
    """By a lag of 0.4 periods B-scans lie between frames; without frames each has its own pose."""
    fields = [f"capture={capture}", f"lag_s={0.6 * LAG_S}", f"out={tmp_path / 'theirs'}"]
    assert main(["export", *fields]) == 0
    assert "10 ms from their B-scans (median; 10 at most), in which the target moved by 2 mm" in capsys.readouterr().out
    assert np.load(tmp_path / "theirs/USdata/target_pose.npy") == pytest.approx(poses()[:-1])
    assert main(["export", *fields, "frames=false"]) == 0
    own = np.load(tmp_path / "theirs/USdata/target_pose.npy")
    assert own[:, 0, 3] == pytest.approx(poses()[:-1, 0, 3] + 2) and not (tmp_path / "theirs/USdata/L").exists()
    assert main(["export", *fields, "apart_s=0.005"]) == 2
    assert "expected frames within 5 ms of a B-scan, found the nearest 10 ms away" in capsys.readouterr().err


def test_their_program_finds_its_files(capture, tmp_path):
    """Names, shapes and numbering are those that their scripts read."""
    ball = trimesh.creation.icosphere(radius=1.0)
    ball.apply_translation((poses()[2] @ probe().target_from_image @ [2.4, 1.6, 0, 1])[:3])
    (tmp_path / "masses").mkdir()
    ball.export(tmp_path / "masses" / "mass0.ply")
    fields = [f"capture={capture}", f"lag_s={LAG_S}", f"masses={tmp_path / 'masses'}", "tissue_m_s=1450"]
    assert main(["export", *fields, f"out={tmp_path / 'theirs'}"]) == 0
    names = {path.rpartition("/")[0] or path for path in contents(tmp_path / "theirs")}
    assert names == {
        "SLdata", "SLdata/images", "USdata", "USdata/L", "USdata/R", "USdata/US", "USdata/USmasks", "cam1_proj_params.npz",
        "cam1_cam2_params.npz", "StereoParams.xml", "US_params.npz", "sonotwin-export.json", ".sonotwin.json",
    }  # fmt: skip
    assert np.load(tmp_path / "theirs" / "USdata" / "target_pose.npy").shape == (COUNT, 4, 4)
    with np.load(tmp_path / "theirs" / "US_params.npz") as given:
        assert given["sy"] == pytest.approx(0.11 * 1450 / 1540) and given["sx"] == pytest.approx(0.12)
    masks = [cv2.imread(str(tmp_path / "theirs" / "USdata" / "USmasks" / f"{k}.png"), cv2.IMREAD_GRAYSCALE) for k in range(COUNT)]
    assert masks[2].shape == SCAN[::-1] and set(np.unique(masks[2])) == {0, 255}
    assert (masks[2] > 0).sum() > (masks[0] > 0).sum()


def test_a_data_set_of_theirs_is_never_replaced(capture, tmp_path, capsys):
    """Its files are as ours, but nothing says that we wrote them."""
    assert main(["export", f"capture={capture}", f"lag_s={LAG_S}", f"out={tmp_path / 'theirs'}"]) == 0
    (tmp_path / "theirs" / ".sonotwin.json").unlink()
    before = contents(tmp_path / "theirs")
    assert main(["export", f"capture={capture}", f"out={tmp_path / 'theirs'}"]) == 2
    assert "expected a new or empty folder, or one that export wrote" in capsys.readouterr().err
    assert contents(tmp_path / "theirs") == before


@pytest.fixture
def theirs(tmp_path) -> Path:
    """A data set as their programs leave it: coloured images of other kinds, loose axes, and a scale that runs backwards."""
    folder = tmp_path / "dataset"
    for name, size, suffix in (("L", SIZE, ".bmp"), ("R", SIZE, ".bmp"), ("US", SCAN, ".png")):
        (folder / "USdata" / name).mkdir(parents=True)
        for k, image in enumerate(noise(12, size, len(name))):
            cv2.imwrite(str(folder / "USdata" / name / f"im{k + 1}{suffix}"), cv2.cvtColor(image, cv2.COLOR_GRAY2BGR))
    loose = np.tile(np.eye(4), (12, 1, 1))
    loose[:, :3, :3] = np.array([[1, 0.015, 0], [0, 1.01, 0], [0, 0, 0.995]])
    loose[:, 0, 3] = np.arange(12)
    np.save(folder / "USdata" / "target_pose.npy", loose)
    np.save(folder / "USdata" / "cross_point.npy", np.full((12, 2), 7.0))
    np.savez(folder / "US_params.npz", sx=0.12, sy=-0.11, T_I_T=probe().target_from_image)
    np.savez(folder / "cam1_cam2_params.npz", **meza2021.parameters(optics(), "cam2"))
    return folder


def test_theirs_is_read_as_it_is(theirs, tmp_path, caplog):
    assert main(["import", f"folder={theirs}", "speed_m_s=1488", "purpose=probe", f"out={tmp_path / 'capture'}"]) == 0
    said = " ".join(record.getMessage() for record in caplog.records)
    assert "axes of 12 poses are up to 2 % off a rotation" in said and "sy is negative" in said
    sweep = sweep_part.read_sweep(tmp_path / "capture")
    assert np.array_equal(sweep.image(9), noise(12, SCAN, 2)[9]), "im10 comes after im9"
    assert all(rigid.fault(pose) is None for pose in sweep.poses(0.0))
    assert sweep.probe is not None and sweep.probe.speed_m_s == 1488 and (sweep.probe.scale > 0).all()
    pixel = np.array([30.0, 20.0])
    assert sweep.probe.to_target(pixel) == pytest.approx((probe().target_from_image @ [0.12 * 30, -0.11 * 20, 0, 1])[:3])
    assert read_manifest(tmp_path / "capture").sweep.purpose == "probe"
    read, pixels = sweep_tables.read_pairs(tmp_path / "capture" / "pairs.csv")
    assert read == pytest.approx(sweep.poses(0.0)) and (pixels == 7.0).all()


def save(name: str, rows):
    return lambda folder: np.save(folder / "USdata" / name, rows)


@pytest.mark.parametrize(("spoil", "complaint"), [
    (lambda folder: (folder / "USdata" / "L" / "im3.bmp").unlink(), "R: expected 11 frames, as in L/, found 12"),
    (lambda folder: (folder / "USdata" / "US" / "im2.png").write_bytes(b"none"), "im2.png: expected an image"),
    (lambda folder: (folder / "cam1_cam2_params.npz").write_bytes(b"PK"), "cam1_cam2_params.npz: expected"),
    (save("target_pose.npy", np.ones((12, 4, 4))), "target_pose.npy: frame 0: expected a rigid"),
    (save("target_pose.npy", np.ones((0, 4, 4))), "target_pose.npy: expected 12 frames, as in L/, found 0"),
    (save("target_pose.npy", np.array([{}])), "target_pose.npy: expected an array of numbers"),
    (save("cross_point.npy", np.ones((12, 3))), "expected numbers of shape (n, 2), found float64 of shape (12, 3)"),
])  # fmt: skip
def test_bad_folders_are_one_line(theirs, tmp_path, capsys, spoil, complaint):
    spoil(theirs)
    assert main(["import", f"folder={theirs}", f"out={tmp_path / 'capture'}"]) == 2
    said = capsys.readouterr().err.splitlines()
    assert complaint in said[-1] and said[-1].startswith("sonotwin: ")
    assert not (tmp_path / "capture").exists()


def test_a_folder_of_something_else_is_refused(tmp_path, capsys):
    (tmp_path / "other").mkdir()
    assert main(["import", f"folder={tmp_path / 'other'}", f"out={tmp_path / 'capture'}"]) == 2
    assert "expected SLdata/images or USdata/US, as in the rig authors' data set, found neither" in capsys.readouterr().err


def test_other_fringes_are_left_out_by_name(capture, tmp_path, capsys):
    path = capture / "manifest.json"
    content = json.loads(path.read_text())
    content["surface"]["patterns"]["parts"][1]["first"] = 0
    path.write_text(json.dumps(content))
    assert main(["export", f"capture={capture}", f"lag_s={LAG_S}", f"out={tmp_path / 'theirs'}"]) == 0
    assert "left out    surface: expected 8 bits, a centre line and 8 fringes of 12 px" in capsys.readouterr().out
    assert not (tmp_path / "theirs" / "SLdata").exists()


def test_a_calibration_goes_out_for_other_programs_and_comes_back(capture, tmp_path, capsys):
    """From a capture or a file, beside one of the same kind alone; what has no place is said."""
    out = tmp_path / "out"
    assert main(["export", "layout=ros", f"capture={capture}", f"out={out}"]) == 0
    assert "left out    projector: the layout has no place for it" in capsys.readouterr().out
    assert sorted(path.name for path in out.glob("[!.]*")) == ["cam1.yaml", "cam2.yaml"]
    found = calibration_files.read(out).cameras
    assert found["cam2"].camera_from_world == pytest.approx(optics().cameras["cam2"].camera_from_world)
    assert main(["export", "layout=kalibr", f"calibration={out}", f"out={tmp_path / 'chain'}"]) == 0
    assert contents(tmp_path / "chain").keys() == {"camchain.yaml", ".sonotwin.json"}
    assert main(["export", "layout=kalibr", f"calibration={out}", "lag_s=0.05", f"out={tmp_path / 'none'}"]) == 2
    assert "export: lag_s: expected none with layout=kalibr, which is for the calibration" in capsys.readouterr().err
    assert list(calibration_files.read(tmp_path / "chain" / "camchain.yaml").cameras) == ["cam1", "cam2"]
    assert main(["export", "layout=slstudio", f"calibration={out}", f"out={tmp_path / 'none'}"]) == 2
    assert "layout: expected cam1 and projector for SLStudio, found cam1, cam2" in capsys.readouterr().err
    assert main(["export", f"out={tmp_path / 'none'}"]) == 2 and not (tmp_path / "none").exists()
    assert "export: capture: needs a value" in capsys.readouterr().err
