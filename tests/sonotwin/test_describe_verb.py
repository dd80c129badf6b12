"""`sonotwin describe`: folders of images with usual and unusual names become captures, and wrong ones are refused."""

import json
import shutil

import cv2
import numpy as np
import pytest

from recon.board_detection.kinds.chessboard import Chessboard
from recon.capture import board_part, calibration_files, surface_part
from recon.geometry.camera import Camera
from recon.model.calibration import Calibration
from sonotwin.cli import main
from tests.recon import board_views

BOARD = Chessboard(columns=8, rows=6, square_mm=20)
CHESS = "board={kind: chessboard, columns: 8, rows: 6, square_mm: 20}"
PATTERNS = """\
projector_size: [32, 24]
unwrap: gray
parts:
  - {kind: fringes, axis: columns, pitch: 8, steps: 3}
  - {kind: gray, axis: columns, pitch: 8, bits: 2}
  - {kind: fringes, axis: rows, pitch: 8, steps: 3}
  - {kind: gray, axis: rows, pitch: 8, bits: 2}
"""
COUNT = 10  # of these
POSES = ("1", "2", "10")


@pytest.fixture
def place(tmp_path, monkeypatch):
    """A folder to work in, with a patterns file."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "patterns.yaml").write_text(PATTERNS, encoding="utf-8")
    return tmp_path


def draw(path, level=0, size=(24, 16), kind=np.uint8):
    """An image of one grey level."""
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), np.full(size[::-1], level, kind))


def described(*fields: str) -> dict:
    """The manifest."""
    assert main(["describe", "folder=images", "out=capture", *fields]) == 0
    with open("capture/manifest.json", encoding="utf-8") as file:
        return json.load(file)


def refusal(capsys, *fields: str) -> str:
    """The line that refuses the images; nothing is written."""
    capsys.readouterr()
    assert main(["describe", "folder=images", "out=capture", *fields]) == 2
    said = capsys.readouterr()
    (line,) = said.err.splitlines()
    assert said.out == ""
    return line.removeprefix("sonotwin: ")


@pytest.mark.parametrize(
    "name",
    [
        "cam1/pose{}/{:02d}.png",
        "pose{}/left/image_{}.png",
        "P{}_{:02d}.bmp",
        "left_{}_{}.png",
        "{}-{}.tif",
        "left/{} {}.png",
        "pose{}/{}.jpg",
        "cam1_{}/{}.PNG",
    ],
)
def test_fringes_by_usual_names(place, name):
    """Poses and images come in natural order."""
    for pose in POSES:
        for number in range(COUNT):
            draw(place / "images" / name.format(pose, number), level=20 * number)
    part = described(CHESS, "patterns=patterns.yaml")["board"]
    assert [pose["name"].lstrip("poseP") for pose in part["poses"]] == list(POSES)
    captured = board_part.read_board(place / "capture")
    pose = captured.pose(2)
    assert captured.devices["cam1"].size == (24, 16) and captured.devices["projector"].size == (32, 24)
    assert pose.fringes[:, 0, 0] == pytest.approx(20 * np.arange(COUNT), abs=1)


def test_a_session_as_ours_is_described_as_it_is(place, capsys):
    """Camera 1 has a lit image and fringes, camera 2 one image, in one pose none."""
    for pose in POSES:
        draw(place / f"images/{pose}/cam1/lit.png", level=200)
        for number in range(COUNT):
            draw(place / f"images/{pose}/cam1/{number:04d}.png")
        if pose != "10":
            draw(place / f"images/{pose}/cam2/0000.png", size=(40, 30))
    first, *_ = described(CHESS, "patterns=patterns.yaml")["board"]["poses"]
    assert first["lit"] == {"cam1": "1/cam1/lit.png", "cam2": "1/cam2/0000.png"}
    assert first["fringes"] == {"cam1": [f"1/cam1/{number:04d}.png" for number in range(COUNT)]}
    lines = capsys.readouterr().out.splitlines()
    assert lines == [
        "found       3 poses, 1 to 10; names are <pose>/<camera>/<image>",
        "cam1        3 x 1 lit, 10 under patterns; 24x16, 8 bits",
        "cam2        2 x 1 lit, 0 under patterns; 40x30, 8 bits",
        "lacking     images of cam2 in 10",
        "projector   32x24, 10 patterns",
        "wrote       capture",
        "next        sonotwin calibrate-optics capture=capture out=calibration",
    ]


def test_images_that_are_not_raw_are_named(place, capsys):
    """JPEG by its name, colour by its pixels: grey in a colour file is as it was."""
    for number in range(3):
        draw(place / f"images/left{number}.jpg", level=90)
        grey = np.full((16, 24, 3), 90, np.uint8)
        assert cv2.imwrite(str(place / f"images/right{number}.png"), grey)
    described(CHESS)
    (line,) = (line for line in capsys.readouterr().out.splitlines() if line.startswith("not raw"))
    assert line.startswith("not raw     cam1: images are JPEG: `sonotwin identify` can't measure the camera's noise by them")
    grey[5, 7] = 80, 90, 100
    assert cv2.imwrite(str(place / "images/right2.png"), grey)
    described(CHESS)
    assert "cam2: images are colour: " in capsys.readouterr().out


def test_pairs_without_patterns(place):
    for number in range(3):
        draw(place / f"images/left{number:02d}.png")
        draw(place / f"images/right{number:02d}.png")
    part = described(CHESS)
    assert part["root"] == "../images" and "projector" not in part["devices"]
    assert [pose["lit"] for pose in part["board"]["poses"]][2] == {"cam1": "left02.png", "cam2": "right02.png"}


@pytest.mark.parametrize(
    "fields", [(), ("cameras={cam1: L, cam2: R}",), ("files=<camera>/<pose>.bmp", "cameras={cam1: L, cam2: R}")]
)
def test_pairs_in_two_folders_with_other_names_in_each(fields, place):
    """`L/left01.bmp` and `R/right01.bmp` are one pose, not two halves, as the advice for such folders makes them, too."""
    for number in range(1, 4):
        draw(place / f"images/L/left{number:02d}.bmp")
        draw(place / f"images/R/right{number:02d}.bmp")
    poses = described(CHESS, *fields)["board"]["poses"]
    assert [pose["name"] for pose in poses] == ["01", "02", "03"]
    assert poses[2]["lit"] == {"cam1": "L/left03.bmp", "cam2": "R/right03.bmp"}


def test_cameras_without_a_pose_in_common_are_refused(place, capsys):
    for number in range(3):
        draw(place / f"images/left/a{number}.png")
        draw(place / f"images/right/b{number + 5}.png")
    line = "expected poses that cam1 and cam2 saw together, found none, but cam1 in a0, cam2 in b5, read as <camera>/<pose>"
    assert line in refusal(capsys, CHESS)


def test_given_names(place, capsys):
    """Cameras by their own words; lit images by a template of their own; others are left out."""
    for pose in "ab":
        draw(place / f"images/even/{pose}_c0.tif")
        for number in range(COUNT):
            draw(place / f"images/c0/{pose}/f{number}.tif")
    draw(place / "images/mask.png")
    files = 'files=["<camera>/<pose>/f<image>.tif","even/<pose>_<camera>.tif"]'
    first, second = described(CHESS, "patterns=patterns.yaml", files, "cameras={cam1: c0}")["board"]["poses"]
    assert second["lit"] == {"cam1": "even/b_c0.tif"} and len(first["fringes"]["cam1"]) == COUNT
    assert "left out    1 images" in capsys.readouterr().out


def test_depth_by_the_brightest(place):
    for number in range(3):
        draw(place / f"images/{number}.tif", level=1500 if number == 0 else 100, kind=np.uint16)
    assert described(CHESS)["devices"]["cam1"]["bits"] == 12
    assert described(CHESS, "bits=10")["devices"]["cam1"]["bits"] == 10


def test_a_surface(place, capsys):
    for number in range(COUNT):
        draw(place / f"images/shot {number + 1}.png", level=number)
    camera = Camera((24, 16), np.array([[30.0, 0, 12], [0, 30, 8], [0, 0, 1]]), np.zeros(5))
    projector = Camera((32, 24), np.array([[40.0, 0, 16], [0, 40, 12], [0, 0, 1]]), np.zeros(5))
    calibration_files.write(place / "optics.yaml", Calibration({"cam1": camera, "projector": projector}))
    described("patterns=patterns.yaml", "calibration=optics.yaml", "files=shot <image>.png")
    assert surface_part.read_surface(place / "capture").images[:, 0, 0].tolist() == list(range(COUNT))
    assert "next        sonotwin surface capture=capture out=surface" in capsys.readouterr().out
    described("patterns=patterns.yaml")
    assert "next        sonotwin surface capture=capture calibration=optics.yaml out=surface" in capsys.readouterr().out


def test_photographs_are_calibrated_as_described(place):
    """From bare photographs of a chessboard to a camera's parameters, by the two commands."""
    rng = np.random.default_rng(0)
    camera = Camera((320, 256), np.array([[830.0, 0, 158], [0, 832, 127], [0, 0, 1]]), np.zeros(5))
    (place / "images").mkdir()
    for number in range(6):
        pose = board_views.pose(BOARD, rng.uniform(640, 720), rng.uniform(-0.5, 0.5, 2))
        image = np.uint8(board_views.view(BOARD, camera, pose, noise=0.7, rng=rng))
        assert cv2.imwrite(f"images/IMG_{number}.png", image)
    described(CHESS)
    assert main(["calibrate-optics", "capture=capture", "out=calibration", "distortion=none"]) == 0
    found = calibration_files.read(place / "calibration/optics.yaml").cameras["cam1"]
    assert found.matrix[0, 0] == pytest.approx(830, rel=0.01)


@pytest.fixture
def poses(place):
    """Three poses under ten patterns."""
    for pose in POSES:
        for number in range(COUNT):
            draw(place / f"images/{pose}/{number}.png")
    return place


def test_wrong_numbers_are_refused(poses, capsys):
    fields = (CHESS, "patterns=patterns.yaml")
    (poses / "images/2/7.png").unlink()
    line = refusal(capsys, *fields)
    assert line.startswith("images: expected 10 images, one a pattern of patterns.yaml, found 9 of cam1 in pose 2")
    for pose in POSES:
        draw(poses / f"images/{pose}/7.png")
        draw(poses / f"images/{pose}/even.png")
    line = refusal(capsys, *fields)
    assert "found 11 in each of 3 poses" in line and "lit=[...]" in line
    assert described(*fields, "lit=[even]")["board"]["poses"][0]["lit"] == {"cam1": "1/even.png"}
    shutil.rmtree("capture")
    line = refusal(capsys, CHESS)
    assert "expected one image, as there are no patterns, found 11 in each of 3 poses" in line and "give patterns=NAME" in line
    assert "found 33 of cam1" in (line := refusal(capsys, fields[1], "files=*/<image>.png")) and "board={...}" in line
    assert "files: expected <image>" in refusal(capsys, fields[1], "files=<camera>.png")
    assert not (poses / "capture").exists()


def test_unclear_names_are_refused(poses, capsys):
    fields = (CHESS, "patterns=patterns.yaml")
    (poses / "images/1").rename(poses / "images/cam0")
    assert "found cam0; give cameras={cam1: cam0}" in refusal(capsys, *fields)
    (poses / "images/cam0").rename(poses / "images/1")
    draw(poses / "images/deep/down/mask.png")
    assert "found deep/down/mask.png among them; files='...'" in refusal(capsys, *fields)
    assert "found 1/0.png; give files=" in refusal(capsys, "patterns=patterns.yaml")
    assert refusal(capsys, *fields, "files=<shot>/<image>").startswith(
        "files: expected <camera>, <pose>, <image>, each at most once"
    )
    assert refusal(capsys, *fields, "files=<image>.png").startswith("files: expected <pose>")
    assert refusal(capsys, *fields, "files=<camera>/<pose>/<image>.png").endswith("found images/1/0.png")
    assert refusal(capsys, *fields, "files=<pose>/<image>.png", "lit=[0,1]").count(
        "expected one lit image, found 1/0.png, 1/1.png"
    )


def test_two_meanings_are_refused(place, capsys):
    """Ten poses of ten images: which number is the pose's, the names leave open."""
    for pose in range(COUNT):
        for number in range(COUNT):
            draw(place / f"images/{pose}_{number}.png")
    fields = (CHESS, "patterns=patterns.yaml")
    assert refusal(capsys, *fields).endswith(
        "found 0_0.png, which may be '<pose>_<image>' or '<image>_<pose>'; give one as files="
    )
    for template, last in (("<pose>_<image>", "9_0.png"), ("<image>_<pose>", "0_9.png")):
        assert described(*fields, f"files={template}")["board"]["poses"][9]["fringes"]["cam1"][0] == last


def test_wrong_images_and_fields_are_refused(poses, capsys):
    fields = (CHESS, "patterns=patterns.yaml")
    draw(poses / "images/10/3.png", size=(16, 24))
    assert refusal(capsys, *fields).startswith(
        "images/10/3.png: expected 24x16, as images/1/0.png of the same camera, found 16x24"
    )
    (poses / "images/10/3.png").write_text("text")
    assert refusal(capsys, *fields).startswith("images/10/3.png: expected an image")
    assert refusal(capsys).startswith("describe: expected board, patterns or both")
    assert "board.kind: expected one of 'aprilgrid', 'asymmetric_circles'" in refusal(
        capsys, "board={kind: checkerboard, columns: 9, rows: 6}"
    )
    assert refusal(capsys, "board={kind: chessboard, columns: 9, rows: 6}") == "board.square_mm: expected a value, found none"
    assert main(["describe", "folder=images", "out=images", *fields]) == 2
    assert "apart from what is read" in capsys.readouterr().err
    assert main(["describe", "folder=nowhere", "out=capture", *fields]) == 2
    assert "nowhere: expected a folder of images, found nothing" in capsys.readouterr().err
