"""Boards and surfaces are recorded as the operator has it; what is wrong is said, and not kept unless told to."""

import cv2
import numpy as np
import pytest

from recon.acquisition.board_recording import BoardPlan, record_board
from recon.acquisition.exposure_setting import Exposing
from recon.acquisition.frame_checks import Limits
from recon.acquisition.guidance import EvenGuide
from recon.acquisition.pictures import Picture, hidden
from recon.acquisition.recording import open_recording
from recon.acquisition.surface_recording import SurfacePlan, record_surface
from recon.artwork.projected_images import images
from recon.capture.board_part import read_board
from recon.capture.manifest import read_manifest
from recon.devices.interfaces import DeviceError
from recon.devices.pattern_player import Stage, Triggered
from recon.model.boards import AsymmetricCircles
from recon.model.patterns import Fringes, GrayCode, Patterns
from tests.recon.acquisition import stand_ins
from tests.recon.acquisition.stand_ins import Bench, BenchCamera, Scripted

BOARD = AsymmetricCircles(columns=3, rows=4, spacing_mm=10, diameter_mm=8)
LIMITS = Limits(saturated=0.05)


@pytest.fixture(autouse=True)
def larger(monkeypatch):
    """Cameras large enough for the detector."""
    monkeypatch.setattr(stand_ins, "SIZE", (384, 288))
    monkeypatch.setattr(stand_ins, "RASTER", (416, 300))


def patterns() -> Patterns:
    parts = [
        part
        for axis in ("columns", "rows")
        for part in (Fringes(axis=axis, pitch=16, steps=4), GrayCode(axis=axis, pitch=16, bits=5))
    ]
    return Patterns(projector_size=stand_ins.RASTER, unwrap="gray", parts=tuple(parts))


def printed(shift: tuple[float, float]) -> np.ndarray:
    """Reflectance of the board, 0.9 on its paper."""
    image = np.full(stand_ins.SIZE[::-1], 0.9, np.float32)
    for x, y, _ in BOARD.points():
        centre = ((3.6 * x + 70 + shift[0]) * 16, (3.6 * y + 80 + shift[1]) * 16)
        cv2.circle(image, tuple(int(value) for value in centre), int(3.6 * 4 * 16), 0.1, -1, cv2.LINE_AA, 4)
    return cv2.GaussianBlur(image, (0, 0), 1.0).astype(float)


def bench() -> tuple[Bench, Stage]:
    made = Bench(0.5)
    return made, Stage(made, {"cam1": BenchCamera("cam1", made)}, Triggered(timeout_s=0.01))


def record(tmp_path, stage, operator, count=3, say=print, show=hidden):
    plan = BoardPlan(BOARD, patterns(), list(images(patterns())), count, Exposing(level=0.8), LIMITS)
    with open_recording(tmp_path / "out") as recording:
        return record_board(recording, stage, operator, EvenGuide(BOARD, 255), plan, say, show)


def at(made: Bench, *shift: float):
    return lambda: setattr(made, "reflectance", printed(shift))


def test_poses_that_add_something_are_kept(tmp_path):
    """One is nearly where another was, one isn't in the image; what is refused is said."""
    made, stage = bench()
    moves = [at(made, 0, 0), at(made, 3, 0), at(made, 60, 20), at(made, 400, 0), at(made, 90, -30)]
    said: list[str] = []
    shown: list[Picture] = []
    names = record(tmp_path, stage, Scripted(["wait", *["take"] * 5], moves), say=said.append, show=shown.append)
    assert names == ["00", "01", "02"]
    assert sum("nearly a pose" in line for line in said) == 1 and sum("doesn't find the board" in line for line in said) == 1
    captured = read_board(tmp_path / "out")
    assert captured.poses == ("00", "01", "02") and captured.pose(1).fringes.shape[0] == patterns().count
    device = read_manifest(tmp_path / "out").devices["cam1"]
    assert device.exposure_s == pytest.approx(0.75 * 0.0111, rel=0.1) and len(shown) > 30


def test_a_recording_that_goes_on_refuses_poses_of_the_one_before(tmp_path):
    made, stage = bench()
    assert record(tmp_path, stage, Scripted(["take"], [at(made, 0, 0)]), count=1) == ["00"]
    assert record(tmp_path, stage, Scripted(["take"] * 2, [at(made, 2, 0), at(made, 60, 20)])) == ["01"]


def test_a_board_that_moves_under_the_fringes_isnt_kept(tmp_path):
    made, stage = bench()
    said: list[str] = []
    show, moved = made.show, []

    def nudged(pattern):
        if np.ptp(pattern) and not moved:
            moved.append(at(made, 2, 0)())
        return show(pattern)

    made.show = nudged
    assert record(tmp_path, stage, Scripted(["take"], [at(made, 0, 0)]), say=said.append) == []
    assert any("moved by 2.0 px" in line for line in said)


def test_what_was_recorded_stays_when_a_camera_is_unplugged(tmp_path):
    made, stage = bench()

    def unplug():
        stage.cameras["cam1"].unplugged = True

    with pytest.raises(DeviceError, match="cam1: unplugged"):
        record(tmp_path, stage, Scripted(["take"] * 3, [at(made, 0, 0), at(made, 60, 20), unplug]))
    assert read_board(tmp_path / "out").poses == ("00", "01")


def surface(tmp_path, stage, operator, said):
    chosen = patterns()
    plan = SurfacePlan(chosen, list(images(chosen)), Exposing(level=0.8), LIMITS)
    with open_recording(tmp_path / "out") as recording:
        return record_surface(recording, stage, operator, plan, said.append, hidden)


def test_a_surface_without_faults_is_kept_at_once(tmp_path):
    _, stage = bench()
    operator = Scripted(["wait", "take"])
    assert surface(tmp_path, stage, operator, [])
    assert len(operator.asked) == 1 and "surface" in read_manifest(tmp_path / "out").contents


def test_faults_are_asked_about(tmp_path):
    """A dark thing: not kept if the operator ends instead of a second try before anything was taken, kept if after it."""
    made, stage = bench()
    made.reflectance[:] = 1e-4
    operator = Scripted(["take", "end"])
    assert surface(tmp_path, stage, operator, [])
    assert "no fringes" in operator.asked[1].text and "dark" in operator.asked[1].text
    assert not surface(tmp_path, stage, Scripted(["end"]), [])


def test_what_moves_meanwhile_is_a_fault(tmp_path):
    made, stage = bench()
    made.reflectance = printed((0, 0))
    show = made.show
    made.show = lambda pattern: (at(made, made.shows, 0)() if made.shows > 12 else None, show(pattern))[1]
    operator = Scripted(["take", "end"])
    surface(tmp_path, stage, operator, [])
    assert "cam1 moved" in operator.asked[1].text
