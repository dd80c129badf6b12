"""Boards, and dialects of probes, clips, tracked sequences and captures, are each added by one module, found by its name."""

import cv2
import numpy as np
import pytest

from recon.artwork import board_drawing
from recon.board_detection.detect import detect
from recon.capture import calibration_files, probe_files
from recon.clips import clip_reader
from recon.freehand import sequences
from recon.model.boards import Board
from sonotwin.cli import main
from tests import added
from tests.recon.tracking import films

NOTCHED = '''"""A square grid of discs without its last one: no turn maps it onto itself."""

from typing import Literal

from recon.board_detection.circle_grid import find_circles
from recon.model.boards import Discs, grid


class Kind(Discs):
    """A grid of discs that lacks the last one."""

    NEIGHBOURS = ((1, 0), (0, 1))
    kind: Literal["notched_circles"] = "notched_circles"

    @property
    def half_turn_is_alike(self):
        """Never, by its notch."""
        return False

    def points(self):
        """Centres of the discs."""
        return grid(self.columns, self.rows, self.spacing_mm)[:-1]

    def find(self, image, full):
        """Its discs in an image."""
        return find_circles(image, self, full)
'''
IN_METRES = '''"""A line of numbers in m: sx, sy of a pixel, and the shift of an image whose axes are the target's."""

import numpy as np

from recon.geometry import rigid
from recon.model.probe import ProbeCalibration


def recognises(path):
    """Whether the line begins with our word."""
    return path.read_bytes().startswith(b"ours")


def read(path, speed_m_s):
    """Read it."""
    numbers = np.array(path.read_text().split()[1:], float)
    return ProbeCalibration(rigid.transform(np.eye(3), 1e3 * numbers[2:]), 1e3 * numbers[:2], None, speed_m_s or 1540.0, 0.0)
'''
STACK = '''"""A stack of images as NumPy writes it."""

import numpy as np

from recon.clips.clip import Clip


def recognises(path):
    """Whether its name ends so."""
    return path.suffix == ".npy"


def read(path):
    """Open it."""
    frames = np.load(path)
    return Clip(path.name, frames.shape[:0:-1], len(frames), None, lambda: iter(frames))
'''


def test_another_board_is_one_module(monkeypatch, tmp_path, capsys):
    """Printed by the verb; found in a drawing of it to 0.05 px, whichever way it lies, as its notch tells that."""
    added.add(monkeypatch, tmp_path / "ours", Board.PACKAGE, "notched_circles", NOTCHED)
    fields = {"kind": "notched_circles", "columns": 5, "rows": 4, "spacing_mm": 20.0, "diameter_mm": 10.0}
    board = Board.model_validate(fields)
    assert main(["print", "part=board", f"board={board_drawing.as_field(board)}", f"out={tmp_path / 'board.pdf'}"]) == 0
    assert "{kind: notched_circles, columns: 5, rows: 4, spacing_mm: 20, diameter_mm: 10}" in capsys.readouterr().out
    image = np.full((4 * 480, 4 * 640), 220, np.uint8)
    pixels = 100 + 4.5 * board.points()[:, :2]
    for place in pixels:
        cv2.circle(image, np.rint(16 * (4 * place + 1.5)).astype(int).tolist(), round(16 * 4 * 22.5), 30, -1, cv2.LINE_AA, 4)
    image = cv2.resize(image, (640, 480), interpolation=cv2.INTER_AREA)
    upside_down = image[::-1, ::-1]
    for shown, expected in ((image, pixels), (upside_down, [639, 479] - pixels)):
        found = detect(shown, board)
        assert np.abs(found.pixels - expected).max() < 0.05


def test_another_dialect_of_probes_calibrations_is_one_module(monkeypatch, tmp_path):
    added.add(monkeypatch, tmp_path / "ours", probe_files.DIALECTS, "in_metres", IN_METRES)
    (tmp_path / "probe.txt").write_text("ours 1e-4 1.2e-4 0.01 0.05 -0.03")
    read = probe_files.read(tmp_path / "probe.txt")
    assert read.scale.tolist() == pytest.approx([0.1, 0.12]) and read.target_from_image[:3, 3].tolist() == pytest.approx(
        [10, 50, -30]
    )


def test_another_dialect_of_clips_is_one_module(monkeypatch, tmp_path, rng):
    added.add(monkeypatch, tmp_path / "ours", clip_reader.DIALECTS, "numpy_stack", STACK)
    frames = rng.integers(0, 255, (3, 20, 30), np.uint8)
    np.save(tmp_path / "clip.npy", frames)
    clip = clip_reader.read(tmp_path / "clip.npy")
    assert clip.size == (30, 20) and clip.count == 3 and np.array_equal(list(clip.stream()), frames)


ARRAYS = '''"""Times, poses and images in one npz."""

import numpy as np

from recon.freehand.sequences import Frames


def recognises(path):
    """Whether its name ends so."""
    return path.suffix == ".npz"


def read_tracking(path):
    """Times and poses."""
    held = np.load(path)
    return Frames(held["times"], {"ProbeToTracker": held["poses"]}, {"ProbeToTracker": np.ones(len(held["times"]), bool)})


def image_shape(path):
    """Height and width."""
    return np.load(path)["images"].shape[1:]


def images(path):
    """One by one."""
    return iter(np.load(path)["images"])
'''


def test_another_dialect_of_tracked_sequences_is_one_module(monkeypatch, tmp_path, rng):
    added.add(monkeypatch, tmp_path / "ours", sequences.DIALECTS, "npz_sequence", ARRAYS)
    images, poses = rng.integers(0, 255, (4, 20, 30), np.uint8), np.tile(np.eye(4), (4, 1, 1))
    poses[:, 0, 3] = np.arange(4)
    np.savez(tmp_path / "sweep.npz", times=np.arange(4.0), poses=poses, images=images)
    read = sequences.read_sequence(tmp_path / "sweep.npz")
    assert np.array_equal(read.images, images) and sequences.image_shape(tmp_path / "sweep.npz") == (20, 30)
    assert np.array_equal(sequences.poses(read, "Tracker", "Probe"), poses)


OPTICS_ALONE = '''"""A folder with a file of cameras."""

from recon.capture import calibration_files


TAKES = ("camera_hz",)


def read_capture(folder, known):
    """Read the cameras."""
    optics = calibration_files.read(folder / "cameras.yaml")

    def fill(capture):
        capture.add_calibration(optics)
        return [f"optics      {', '.join(optics.cameras)}, {known.camera_hz:g} frames a second"]

    return fill
'''


def test_another_layout_of_captures_is_one_module(monkeypatch, tmp_path, rig, capsys):
    added.add(monkeypatch, tmp_path / "ours", "recon.capture.layouts", "optics_alone", OPTICS_ALONE)
    (tmp_path / "theirs").mkdir()
    calibration_files.write(tmp_path / "theirs" / "cameras.yaml", films.optics(rig))
    fields = ["layout=optics_alone", f"folder={tmp_path / 'theirs'}", "camera_hz=25", f"out={tmp_path / 'capture'}"]
    assert main(["import", *fields]) == 0
    assert "optics      cam1, cam2, 25 frames a second" in capsys.readouterr().out
    held = calibration_files.of_capture(tmp_path / "capture", None)
    assert np.array_equal(held.cameras["cam2"].matrix, rig.cam2.optics.camera().matrix)


POINTS_ALONE = '''"""The optical centres of all cameras, as text."""

TAKES = ("calibration",)
ABOUT = "of centres alone"


def write(folder, settings):
    """Write them."""
    from recon.capture import calibration_files

    cameras = calibration_files.read(settings.calibration).cameras
    (folder / "centres.txt").write_text(" ".join(cameras))
    return [f"centres     {len(cameras)}"]
'''


def test_another_layout_to_export_is_one_module(monkeypatch, tmp_path, rig, capsys):
    """It takes the fields that it names, and others are refused."""
    added.add(monkeypatch, tmp_path / "ours", "sonotwin.export_layouts", "centres", POINTS_ALONE)
    calibration_files.write(tmp_path / "cameras.yaml", films.optics(rig))
    fields = ["layout=centres", f"calibration={tmp_path / 'cameras.yaml'}", f"out={tmp_path / 'out'}"]
    assert main(["export", *fields]) == 0
    assert "centres     2" in capsys.readouterr().out and (tmp_path / "out" / "centres.txt").read_text() == "cam1 cam2"
    assert main(["export", *fields, "implausible=take"]) == 2
    assert "export: implausible: expected none with layout=centres, which is of centres alone" in capsys.readouterr().err
