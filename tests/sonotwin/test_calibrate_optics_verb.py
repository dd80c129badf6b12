"""`sonotwin calibrate-optics`, from a capture of a board to files, on synthetic photographs of two small cameras."""

import contextlib
import io
import itertools
import json
import re
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from threadpoolctl import threadpool_limits

import sonotwin
from recon.board_detection.kinds.chessboard import Chessboard
from recon.capture import calibration_files
from recon.capture.manifest import BoardPart, Device
from recon.capture.writer import new_capture, write_pose
from recon.geometry import rigid
from recon.geometry.camera import Camera
from recon.model.calibration import PRINT_SCALE, Calibration, with_scale
from recon.model.patterns import Fringes, GrayCode, Patterns
from recon.session.optics_step import dropped
from sonotwin.cli import main
from sonotwin.verbs import reconstruct
from tests.recon import board_views

SIZE = (320, 256)
BOARD = Chessboard(columns=8, rows=6, square_mm=20)
FILES = [".sonotwin.json", "StereoParams.xml", "calibration.html", "cam1_cam2_params.npz", "metrics.json", "optics.yaml"]


def cameras() -> dict[str, Camera]:
    lens = np.array([-0.1, 0.1, 0.0, 0.0])
    beside = rigid.from_rotation_vector(np.deg2rad([0, 15, 0]), [-172.0, -4, 45])
    first = Camera(SIZE, np.array([[830.0, 0, 158], [0, 832, 127], [0, 0, 1]]), lens)
    return {"cam1": first, "cam2": Camera(SIZE, np.array([[828.0, 0, 161], [0, 830, 126], [0, 0, 1]]), lens, beside)}


@pytest.fixture(scope="module")
def session(tmp_path_factory) -> Path:
    """capture/ and truth/ of nine poses; in the last one camera 2's view is black."""
    folder, rng = tmp_path_factory.mktemp("session"), np.random.default_rng(0)
    poses = []
    for number in range(9):
        middle, tilt = rng.uniform(-20, 20, 2), rng.uniform(-0.5, 0.5, 2)
        pose = board_views.pose(BOARD, rng.uniform(640, 720), tilt, rng.uniform(-0.2, 0.2), middle)
        lit = {name: np.uint8(board_views.view(BOARD, camera, pose, noise=0.7, rng=rng)) for name, camera in cameras().items()}
        if number == 8:
            lit["cam2"][:] = 2
        poses.append(lit)
    with new_capture(folder / "capture", "small") as capture:
        records = tuple(write_pose(capture.folder, f"{number:02d}", lit, {}) for number, lit in enumerate(poses))
        capture.add_board(BoardPart(board=BOARD, poses=records), {name: Device(size=SIZE) for name in cameras()})
    (folder / "truth" / "calibration").mkdir(parents=True)
    calibration_files.write(folder / "truth" / "calibration" / "optics.yaml", Calibration(cameras()))
    return folder


@pytest.fixture(scope="module")
def calibrated(session) -> tuple[Path, list[str]]:
    """The folder of a calibration, and what was said."""
    out = session / "calibration"
    fields = [f"capture={session / 'capture'}", f"truth={session / 'truth'}", f"out={out}", "distortion=radial2"]
    with contextlib.redirect_stdout(io.StringIO()) as said:
        assert main(["calibrate-optics", *fields]) == 0
    return out, said.getvalue().splitlines()


def test_the_interface_gives_the_verbs_calibration(session, calibrated):
    """From images in memory; the verb adds that a print's scale shows in no image."""
    captured, bits = sonotwin.read_board(session / "capture"), dict.fromkeys(cameras(), 8)
    poses = [captured.pose(number) for number in range(len(captured.poses))]
    sightings = [sonotwin.find_board(pose.name, BOARD, pose.lit, None, None, bits) for pose in poses]
    settings = sonotwin.OpticsSettings(distortion="radial2")
    found = sonotwin.calibrate_optics(sightings, BOARD, dict.fromkeys(cameras(), SIZE), settings).adjustment.calibration
    written = sonotwin.read_calibration(calibrated[0] / "optics.yaml")
    for name, camera in found.cameras.items():
        assert np.allclose(camera.matrix, written.cameras[name].matrix, rtol=1e-9)
        assert np.allclose(camera.camera_from_world, written.cameras[name].camera_from_world, atol=1e-9)
    known = with_scale(found.uncertainty, found.cameras, PRINT_SCALE)
    assert np.allclose(known.covariance, written.uncertainty.covariance, rtol=1e-6)


def test_a_capture_becomes_a_calibration(session, calibrated):
    out, lines = calibrated
    assert [line.split()[0] for line in lines][:3] == ["detect", "dropped", "uncertain"] and lines[-1].startswith("wrote ")
    assert re.fullmatch(r"detect +9 poses: cam1 9, cam2 8, \d+ s", lines[0])
    assert lines[1].startswith("dropped     08 cam2: ")
    assert any(line.startswith("error ") for line in lines)
    assert sorted(path.name for path in out.iterdir()) == FILES

    found, true = calibration_files.read(out / "optics.yaml"), cameras()
    assert list(found.cameras) == ["cam1", "cam2"]
    for name, camera in found.cameras.items():
        sigma = found.uncertainty.sigma(f"{name}.fx")
        assert abs(camera.matrix[0, 0] - true[name].matrix[0, 0]) < 4 * sigma < 20
    figures = json.loads((out / "metrics.json").read_text())
    assert figures["poses"] == 9 and figures["reprojection_rms_cam1_px"] < 0.15
    assert figures["cam2_rotation_error_deg"] < 0.3 and figures["shape_error_rms_mm"] < 1
    assert {"seconds_detect", "seconds_adjust", "scale_sigma_ppm", "cam2_translation_error_mm"} <= figures.keys()
    for name in ("StereoParams.xml", "cam1_cam2_params.npz"):
        pair = calibration_files.read(out / name, dict.fromkeys(("cam1", "cam2"), SIZE)).cameras["cam2"]
        assert np.allclose(pair.camera_from_world, found.cameras["cam2"].camera_from_world, atol=1e-9)
    page = (out / "calibration.html").read_text(encoding="utf-8")
    assert f"sonotwin calibrate-optics capture={session / 'capture'}" in page and "distortion=radial2" in page, "to make it again"


def test_opencv_programs_read_it(calibrated):
    """A clinic's own program: a point through the matrices of the file is where the camera sees it."""
    out, _ = calibrated
    storage = cv2.FileStorage(str(out / "optics.yaml"), cv2.FileStorage_READ)
    node = storage.getNode("cam2")
    pose = node.getNode("camera_from_world").mat()
    point = np.array([[10.0, -20, 650]])
    seen, _ = cv2.projectPoints(
        point, cv2.Rodrigues(pose[:3, :3])[0], pose[:3, 3], node.getNode("matrix").mat(), node.getNode("distortion").mat()
    )
    assert seen.ravel() == pytest.approx(
        calibration_files.read(out / "optics.yaml").cameras["cam2"].project(point).ravel(), abs=1e-6
    )


def complaint(capsys, *fields: str) -> str:
    assert main(["calibrate-optics", *fields]) == 2
    captured = capsys.readouterr()
    (line,) = captured.err.splitlines()
    return line.removeprefix("sonotwin: ")


@pytest.fixture
def copied(session, tmp_path) -> Path:
    shutil.copytree(session, tmp_path / "session")
    return tmp_path / "session"


def test_what_is_wrong_is_said_in_one_line_and_nothing_is_written(copied, tmp_path, capsys):
    capture, out = copied / "capture", tmp_path / "out"
    fields = [f"capture={capture}", f"out={out}"]
    assert complaint(capsys, f"out={out}") == "calibrate-optics: capture: needs a value; give capture=..."
    assert complaint(capsys, *fields, "distortion=fisheye").startswith("calibrate-optics: distortion: expected ")
    assert complaint(capsys, *fields, "shape.in_plane_mm=-1").startswith("calibrate-optics: shape.in_plane_mm: expected ")
    assert "expected a folder apart from what is read" in complaint(capsys, f"capture={capture}", f"out={copied}")
    assert "expected a calibration file" in complaint(capsys, *fields, f"truth={tmp_path}")
    calibration_files.write(copied / "truth" / "calibration" / "optics.yaml", Calibration({"cam1": cameras()["cam1"]}))
    assert "truth/calibration/optics.yaml: expected cam2, found cam1" in complaint(capsys, *fields, f"truth={copied / 'truth'}")
    image = capture / "board" / "03" / "cam1" / "lit.png"
    image.write_bytes(image.read_bytes()[:-30])
    assert complaint(capsys, *fields).startswith(f"{image}: expected a whole PNG image")
    image.unlink()
    assert complaint(capsys, *fields) == f"{image}: expected a file, found none"
    assert not out.exists()


def test_a_capture_without_a_board_or_that_one_camera_sees_is_refused(copied, tmp_path, capsys):
    manifest = copied / "capture" / "manifest.json"
    content = json.loads(manifest.read_text())
    black = np.full((SIZE[1], SIZE[0]), 3, np.uint8)
    for path in (copied / "capture" / "board").glob("*/cam2/lit.png"):
        cv2.imwrite(str(path), black)
    fields = [f"capture={copied / 'capture'}", f"out={tmp_path / 'out'}"]
    said = complaint(capsys, *fields)
    assert said.startswith("small: expected two devices or more that see the board, found cam1 (cam2: ")
    assert said.endswith("; devices=[cam1] calibrates it alone")
    del content["board"]
    manifest.write_text(json.dumps(content))
    assert "expected board, the poses of a calibration board, found none" in complaint(capsys, *fields)
    assert not (tmp_path / "out").exists()


def test_one_camera_alone_is_calibrated_by_command(session, tmp_path, capsys):
    """From lit images; the other camera isn't looked at, and nothing is said in mm, as nothing is measured with one."""
    out = tmp_path / "out"
    fields = [f"capture={session / 'capture'}", f"out={out}", f"truth={session / 'truth'}", "distortion=radial2"]
    assert main(["calibrate-optics", *fields, "devices=[cam1]"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert re.fullmatch(r"detect +9 poses: cam1 9, \d+ s", lines[0])
    assert re.fullmatch(r"uncertain +projection 0\.\d+ px \(1 sigma\); one camera alone measures no points", lines[1])
    assert not [line for line in lines if "cam2" in line]
    assert sorted(path.name for path in out.iterdir()) == [".sonotwin.json", "calibration.html", "metrics.json", "optics.yaml"]
    found = calibration_files.read(out / "optics.yaml")
    assert list(found.cameras) == ["cam1"]
    assert abs(found.cameras["cam1"].matrix[0, 0] - 830) < 4 * found.uncertainty.sigma("cam1.fx") < 40
    assert "point_sigma_mm" not in json.loads((out / "metrics.json").read_text())
    assert not re.search(r"\bnan\b|unknown", (out / "calibration.html").read_text(encoding="utf-8").split("</style>")[1])


def small_projector() -> Camera:
    pose = rigid.from_rotation_vector(np.deg2rad([0, -15, 0]), [172.0, 4, 45])
    return Camera((256, 160), np.array([[560.0, 0, 127], [0, 560, 80], [0, 0, 1]]), np.zeros(5), pose)


class Erring:
    """A sequence whose grey fringes are shifted by errors of a share of a step, drawn anew with each showing."""

    def __init__(self, patterns: Patterns, share: float) -> None:
        self._patterns, self._share, self._rng = patterns, share, np.random.default_rng(4)

    def images(self):
        """As `Patterns.images`."""
        images = iter(self._patterns.images())
        for part in self._patterns.parts:
            for image in itertools.islice(images, part.count):
                off = self._share * part.pitch / part.steps * self._rng.standard_normal() if isinstance(part, Fringes) else 0.0
                moved = np.float32([[1, 0, off], [0, 1, 0]] if part.axis == "columns" else [[1, 0, 0], [0, 1, off]])
                size = image.shape[::-1]
                yield cv2.warpAffine(np.float32(image), moved, size, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)


def under_patterns_alone(folder, count: int, shown: Patterns | Erring, described: Patterns, gamma: float = 1.0) -> None:
    """A board in some poses under the small projector's patterns, seen by camera 1 of a gamma, and described as under others."""
    camera, projector, rng = cameras()["cam1"], small_projector(), np.random.default_rng(0)
    board = Chessboard(columns=6, rows=5, square_mm=24)
    with new_capture(folder, "patterns") as capture:
        records = []
        for number in range(count):
            placed = board_views.pose(board, rng.uniform(640, 720), rng.uniform(-0.5, 0.5, 2), 0.1, rng.uniform(-15, 15, 2))
            stack = board_views.under_patterns(board, camera, projector, shown, placed, rng)[1:]
            stack = np.uint8(np.rint(255 * (stack / 255) ** gamma))
            records.append(write_pose(capture.folder, f"{number:02d}", {}, {"cam1": stack}))
        devices = {"cam1": Device(size=SIZE), "projector": Device(size=projector.size)}
        capture.add_board(BoardPart(board=board, patterns=described, poses=tuple(records)), devices)


def test_camera_and_projector_by_gray_code_alone(tmp_path, capsys):
    """What many rigs record: one camera, and in each pose the code with its inverses, nothing else."""
    camera, projector = cameras()["cam1"], small_projector()
    code = tuple(GrayCode(axis=axis, pitch=1, bits=8, inverted=True) for axis in ("columns", "rows"))
    patterns = Patterns(projector_size=projector.size, unwrap="gray", parts=code)
    under_patterns_alone(tmp_path / "capture", 6, patterns, patterns)
    fields = [f"capture={tmp_path / 'capture'}", f"out={tmp_path / 'out'}", "distortion=radial1"]
    assert main(["calibrate-optics", *fields]) == 0
    assert re.match(r"detect +6 poses: cam1 6, projector 6,", capsys.readouterr().out)
    found = calibration_files.read(tmp_path / "out" / "optics.yaml")
    for name, true in (("cam1", camera), ("projector", projector)):
        assert abs(found.cameras[name].matrix[0, 0] - true.matrix[0, 0]) < 4 * found.uncertainty.sigma(f"{name}.fx") < 60, name
    figures = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert figures["reprojection_rms_projector_px"] < 0.15 and figures["point_sigma_mm"] < 3


def test_three_steps_through_a_cameras_gamma_are_straightened_and_said(tmp_path, capsys):
    projector = small_projector()
    parts = [p for a in ("columns", "rows") for p in (Fringes(axis=a, pitch=16, steps=3), GrayCode(axis=a, pitch=16, bits=4))]
    patterns = Patterns(projector_size=projector.size, unwrap="gray", parts=tuple(parts))
    under_patterns_alone(tmp_path / "capture", 3, patterns, patterns, gamma=1.6)
    assert main(["calibrate-optics", f"capture={tmp_path / 'capture'}", f"out={tmp_path / 'out'}", "distortion=radial1"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert re.match(
        r"linearity +light isn't linear, it goes with level\^1\.[56] or so: 3 steps of 16 px were bent by up to", lines[1]
    )
    found = calibration_files.read(tmp_path / "out" / "optics.yaml")
    assert abs(found.cameras["projector"].matrix[0, 0] - 560) < 4 * found.uncertainty.sigma("projector.fx") < 20


@pytest.mark.slow
def test_grey_fringes_whose_shifts_err_are_warned_of(tmp_path, capsys):
    """By a tenth of a step, which moves all points of a pose alike, so that residuals hardly show it."""
    projector = small_projector()
    parts = [p for a in ("columns", "rows") for p in (Fringes(axis=a, pitch=16, steps=4), GrayCode(axis=a, pitch=16, bits=4))]
    patterns = Patterns(projector_size=projector.size, unwrap="gray", parts=tuple(parts))
    under_patterns_alone(tmp_path / "capture", 7, Erring(patterns, 0.1), patterns)
    assert main(["calibrate-optics", f"capture={tmp_path / 'capture'}", f"out={tmp_path / 'out'}", "distortion=radial1"]) == 0
    (told,) = [line for line in capsys.readouterr().out.splitlines() if "do the steps of grey fringes err" in line]
    assert told.startswith("warning     the projector's coordinates shift by") and "the uncertainty includes it" in told


@pytest.mark.parametrize(
    ("shown", "refusal", "fields"),
    [
        ({"backwards": True}, "fringe orders jump", "backwards: true"),
        ({"first": 4}, "expected it to stand still", "origin: 135.5 of columns, 87.5 of rows"),
    ],
)
def test_fringes_other_than_described_are_named(shown, refusal, fields, tmp_path, capsys):
    """The refusal's usual cause is images out of order; here all sets of fringes were shown otherwise."""
    projector = small_projector()
    code = [GrayCode(axis=axis, pitch=16, bits=4) for axis in ("columns", "rows")]
    given, true = (
        Patterns(
            projector_size=projector.size,
            unwrap="gray",
            parts=tuple(part for bits in code for part in (Fringes(axis=bits.axis, pitch=16, steps=8, **own), bits)),
        )
        for own in ({}, shown)
    )
    under_patterns_alone(tmp_path / "capture", 4, true, given)
    assert main(["calibrate-optics", f"capture={tmp_path / 'capture'}", f"out={tmp_path / 'out'}", "distortion=radial1"]) == 2
    line = capsys.readouterr().err
    assert refusal in line and line.endswith(f" (the images fit patterns with {fields} in each set of fringes)\n")
    assert not (tmp_path / "out").exists()


def test_devices_that_the_capture_lacks_are_refused(session, tmp_path, capsys):
    fields = [f"capture={session / 'capture'}", f"out={tmp_path / 'out'}"]
    expected = "small: expected images of projector, as devices, found cam1, cam2"
    assert complaint(capsys, *fields, "devices=[cam1,projector]") == expected
    refused = complaint(capsys, *fields, "devices=[cam2]")
    assert refused.startswith("small: expected images of cam1, the world's frame, found cam2; to calibrate another camera alone,")
    assert complaint(capsys, *fields, "devices=[cam3]").startswith("calibrate-optics: devices.0: expected ")


def test_reasons_are_told_though_nothing_can_be_calibrated(copied, tmp_path, capsys):
    """What was not found is listed before the complaint; a camera that has no place in the calibration isn't looked through."""
    capture = copied / "capture"
    manifest = json.loads((capture / "manifest.json").read_text())
    for pose in manifest["board"]["poses"]:
        pose["lit"] = {"cam1": pose["lit"]["cam1"], "cam3": pose["lit"]["cam2"]}
    manifest["devices"]["cam3"] = manifest["devices"]["cam2"]
    (capture / "manifest.json").write_text(json.dumps(manifest))
    for path in (capture / "board").glob("*/cam1/lit.png"):
        cv2.imwrite(str(path), np.full((SIZE[1], SIZE[0]), 3, np.uint8))
    assert main(["calibrate-optics", f"capture={capture}", f"out={tmp_path / 'out'}"]) == 2
    said = capsys.readouterr()
    detect, *dropped = said.out.splitlines()
    assert re.fullmatch(r"detect +9 poses: cam1 0, \d+ s", detect)
    assert len(dropped) == 1 and dropped[0].startswith("dropped     cam1 in 9 poses alike, such as 00 cam1: ")
    assert dropped[0].endswith("(poses 00, 01, 02, 03, 04, 05, 06, 07, 08)")
    assert said.err.startswith("sonotwin: small: expected cam1 to see the board, found none (cam1: ")


def test_poses_that_fail_alike_are_one_line():
    """By their words, whatever the numbers; a few keep a line each, and so do those of another cause."""
    reasons = {f"{k:02d} cam1": f"found {29 + k % 3} of 44 circles" for k in range(52)}
    few = {"03 cam2": "image is mirrored", "my pose cam2": "image is mirrored"}
    many, *others = dropped(reasons | few)
    assert many.startswith("dropped     cam1 in 52 poses alike, such as 00 cam1: found 29 of 44 circles (poses 00, 01,")
    assert many.endswith(", 39 and others)") and others == [f"dropped     {name}: {reason}" for name, reason in few.items()]


def few_poses(copied) -> Path:
    """The capture with its first five poses."""
    manifest = json.loads((copied / "capture" / "manifest.json").read_text())
    del manifest["board"]["poses"][5:]
    (copied / "capture" / "manifest.json").write_text(json.dumps(manifest))
    return copied / "capture"


def test_a_third_camera_is_warned_of(copied, tmp_path, capsys):
    """In five poses."""
    capture = few_poses(copied)
    manifest = json.loads((capture / "manifest.json").read_text())
    for pose in manifest["board"]["poses"]:
        pose["lit"]["cam3"] = pose["lit"]["cam2"]
    manifest["devices"]["cam3"] = manifest["devices"]["cam2"]
    (capture / "manifest.json").write_text(json.dumps(manifest))
    assert main(["calibrate-optics", f"capture={capture}", f"out={tmp_path / 'out'}", "distortion=radial2"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line for line in lines if "cam3" in line] == [
        "warning     cam3: not calibrated, as only cam1, cam2, projector can be"
    ]
    assert list(calibration_files.read(tmp_path / "out" / "optics.yaml").cameras) == ["cam1", "cam2"]


def test_other_folders_are_not_replaced(session, tmp_path, capsys):
    out = tmp_path / "mine"
    out.mkdir()
    (out / "mine.txt").write_text("mine")
    found = complaint(capsys, f"capture={session / 'capture'}", f"out={out}")
    assert "expected a new or empty folder, or one that calibrate-optics wrote" in found
    assert [path.name for path in out.iterdir()] == ["mine.txt"]


def test_a_session_calibrates_to_the_same_bytes_whatever_threads_linear_algebra_had(copied, tmp_path):
    """A script has loaded NumPy, with a thread a core, before it runs a session; the command begins with one thread."""
    capture, alone, result = few_poses(copied), tmp_path / "alone", tmp_path / "result"
    with threadpool_limits(1, "blas"):
        assert main(["calibrate-optics", f"capture={capture}", f"out={alone}"]) == 0
    with threadpool_limits(2, "blas"):
        reconstruct.run(reconstruct.Config(rig=sonotwin.read_rig(), capture=capture, out=result))
    assert (result / "optics" / "optics.yaml").read_bytes() == (alone / "optics.yaml").read_bytes()
