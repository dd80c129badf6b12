"""`sonotwin patterns`: from images over a camera on the projector's axis and `describe` to the projector's pixels."""

import csv
import shlex
from pathlib import Path

import cv2
import numpy as np
import pytest

from recon.capture import board_part, calibration_files, surface_part
from recon.geometry.camera import Camera
from recon.model.calibration import Calibration
from recon.structured_light.decode import decode
from sonotwin.cli import main

SMALL = ["patterns.projector_size=[96,64]", "rig.projector.optics.size=[96,64]"]


@pytest.fixture(autouse=True)
def place(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


def rows() -> list[dict[str, str]]:
    with open("projected/timing_sheet.csv", encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def shoot(column: str) -> None:
    """Save what a camera on the projector's axis sees under the names of the sheet, with a black level, and not saturated."""
    for row in rows():
        if row[column]:
            image = cv2.imread(f"projected/{row['file']}", cv2.IMREAD_UNCHANGED)
            assert image.ndim == 2 and image.dtype == np.uint8
            Path(row[column]).parent.mkdir(parents=True, exist_ok=True)
            assert cv2.imwrite(row[column], np.uint16(100 + 15 * image.astype(int)))


def described(kind: str, *more: str) -> None:
    """Run the command of README.txt that makes a capture of the images of a kind."""
    (line,) = [line for line in Path("projected/README.txt").read_text(encoding="utf-8").splitlines() if f"folder={kind}" in line]
    assert main([*shlex.split(line)[1:], "bits=12", *more]) == 0


def test_images_become_a_surface_and_its_projector_pixels(place):
    """By the sheet's names and the command of the folder, nothing else."""
    assert main(["patterns", "patterns=gray_surface", *SMALL, "out=projected"]) == 0
    shoot("surface_image")
    camera = Camera((96, 64), np.array([[100.0, 0, 48], [0, 100, 32], [0, 0, 1]]), np.zeros(5), np.eye(4))
    calibration_files.write(Path("optics.yaml"), Calibration({"cam1": camera, "projector": camera}))
    described("surface")
    capture = surface_part.read_surface("surface_capture")
    found = decode(capture.images, capture.patterns, bits=12)
    assert np.abs(found.columns - np.arange(96)).max() < 0.01


def test_images_become_a_boards_pose(place):
    """Both axes, and the lit image beside them."""
    assert main(["patterns", "patterns=gray_alone", *SMALL, "out=projected"]) == 0
    shoot("board_image")
    described("board")
    capture = board_part.read_board("board_capture")
    pose = capture.pose(0)
    assert (pose.lit["cam1"] == 100 + 15 * 255).all()
    found = decode(pose.fringes, capture.patterns, bits=12)
    assert (found.columns == np.arange(96)).all() and (found.rows == np.arange(64)[:, None]).all()


def test_the_sheet_says_times_and_names(place, capsys):
    """An exposure of a period and a quarter and a delay of a period take three periods; it is said to be better as two."""
    assert main(["patterns", *SMALL, "exposure_s=0.0125", "refresh_hz=100", "out=projected"]) == 0
    assert (
        "12.50 ms, which is 1.25 of its periods, within which it makes grey of flashes; better 20.00 ms"
        in capsys.readouterr().out
    )
    sheet = rows()
    assert [row["file"] for row in sheet] == sorted(path.name for path in Path("projected").glob("*.png"))
    assert {row["least_ms"] for row in sheet} == {"30.000"} and {row["exposure_ms"] for row in sheet} == {"12.500"}
    assert [row["order"] for row in sheet] == [str(k) for k in range(9)]
    assert sheet[0]["what"] == "centre line, columns, 2 px wide at 47.5" and sheet[0]["binary"] == "yes"
    assert sheet[8]["what"] == "fringe 8 of 8, columns, pitch 12 px, shift 360 deg" and sheet[8]["binary"] == "no"
    assert sheet[8]["surface_image"] == "surface/cam1/0008.png" and sheet[8]["board_image"] == ""


def test_the_same_bytes_and_no_other_folder_replaced(place, capsys):
    assert main(["patterns", *SMALL, "out=projected"]) == 0
    before = {path.name: path.read_bytes() for path in Path("projected").iterdir()}
    assert main(["patterns", *SMALL, "out=projected"]) == 0
    assert {path.name: path.read_bytes() for path in Path("projected").iterdir()} == before
    Path("mine").mkdir()
    Path("mine/0000.png").write_bytes(b"")
    assert main(["patterns", *SMALL, "out=mine"]) == 2
    assert "expected a new or empty folder, or one that patterns wrote" in capsys.readouterr().err


def test_another_projector_is_refused_with_both_ways_on(place, capsys):
    assert main(["patterns", "patterns=twelve_step_gray", "out=projected"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "expected the rig's [1280, 800], found [1920, 1080]" in line
    assert "patterns.projector_size=[1280,800] or rig.projector.optics.size=[1920,1080]" in line
    assert not list(place.iterdir())


def test_gamma_is_said_where_it_matters_and_written_where_it_is_wanted(place, capsys):
    """Three steps are bent; levels are raised by linearise_gamma, and nothing is said for a linear projector."""
    cue = ["patterns=three_step_cue", "rig.projector.optics.size=[1024,768]", "out=projected"]
    assert main(["patterns", *cue]) == 0
    assert "give linearise_gamma=2.2" in capsys.readouterr().out
    plain = cv2.imread("projected/0000.png", cv2.IMREAD_UNCHANGED)[0]
    assert main(["patterns", *cue, "linearise_gamma=2.2"]) == 0
    assert "made for a projector of gamma 2.2" in capsys.readouterr().out
    raised = cv2.imread("projected/0000.png", cv2.IMREAD_UNCHANGED)[0]
    assert (raised >= plain).all() and raised[(plain > 20) & (plain < 240)].min() > 70
    assert main(["patterns", *cue, "rig.projector.gamma=1"]) == 0
    assert "gamma " not in capsys.readouterr().out
