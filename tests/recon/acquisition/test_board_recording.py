"""Boards are recorded where the guide asks for them; what is refused is said, and kept only if the operator says so."""

import shutil

import numpy as np
import pytest

from recon.acquisition.board_recording import BoardPlan, record_board
from recon.acquisition.exposure_setting import Exposing
from recon.acquisition.frame_checks import Limits
from recon.acquisition.pictures import hidden
from recon.acquisition.recording import open_recording
from recon.artwork.projected_images import images
from recon.board_guidance.board_room import PoseLimits
from recon.capture.board_part import read_board
from recon.capture.manifest import read_manifest
from recon.devices.interfaces import DeviceError
from recon.errors import InputError
from recon.model.patterns import Fringes, GrayCode, Patterns
from tests.recon.acquisition.board_bench import Hand, hold, small, stage
from tests.recon.board_guidance.held_boards import posed
from tests.recon.board_sets import BOARD

REACH = PoseLimits(depth_mm=(580, 680), volume_mm=(606, 713))  # of large pixels: the lenses would be sharp far beyond
OUTSIDE = posed((400, 0, 660))
HELD = posed((0, 0, 640), (20, 0))


@pytest.fixture(scope="module")
def own(rig):
    """The small rig."""
    return small(rig)


def patterns(rig):
    parts = [
        part
        for axis in ("columns", "rows")
        for part in (Fringes(axis=axis, pitch=16, steps=4), GrayCode(axis=axis, pitch=16, bits=5))
    ]
    return Patterns(projector_size=rig.projector.optics.size, unwrap="gray", parts=tuple(parts))


def record(tmp_path, rig, devices, operator, count=3, said=None, show=hidden):
    chosen = patterns(rig)
    plan = BoardPlan(BOARD, chosen, list(images(chosen)), count, Exposing(level=0.8), Limits(saturated=0.05), rig, REACH)
    with open_recording(tmp_path / "out") as recording:
        return record_board(recording, devices, operator, plan, ([] if said is None else said).append, show)


@pytest.fixture(scope="module")
def recorded(tmp_path_factory, own):
    """Recording `out` of one pose, by camera 1, in a folder of its own."""
    folder = tmp_path_factory.mktemp("recorded")
    made, devices = stage(own, ["cam1"])
    assert record(folder, own, devices, Hand(made, own, ["take"], [HELD]), count=1) == ["00"]
    return folder


def test_poses_are_asked_for_held_and_kept(tmp_path, own):
    made, devices = stage(own)
    hand = Hand(made, own, ["wait", *["take"] * 3])
    assert record(tmp_path, own, devices, hand, count=2) == ["00", "01"]
    captured = read_board(tmp_path / "out")
    assert captured.poses == ("00", "01") and captured.pose(1).fringes.shape[0] == patterns(own).count
    device = read_manifest(tmp_path / "out").devices["cam1"]
    assert device.exposure_s == pytest.approx(0.75 * 0.0111, rel=0.15)
    assert hand.asked[0].text.startswith("hold it at") and len(hand.asked) == 2
    assert any(word in hand.asked[1].text for word in ("nearer", "farther", "left", "right", "up", "down"))


def test_the_asked_pose_is_drawn_where_the_board_comes_to_lie(tmp_path, own):
    """Over camera 1's lit images alone: there while it is held as asked, and the way to it else."""
    made, devices = stage(own)
    shown = []
    aside = posed((10, 5, 640))
    record(tmp_path, own, devices, Hand(made, own, [], [aside]), show=shown.append)
    drawn = [picture.over for picture in shown if picture.over is not None]
    assert {picture.device for picture in shown if picture.over is not None} == {"cam1"}
    assert not drawn[-1].there and " mm " in drawn[-1].words
    made, devices = stage(own, ["cam1"])
    record(tmp_path, own, devices, Hand(made, own, []), show=shown.append)
    last = next(picture for picture in reversed(shown) if picture.over is not None)
    assert last.over.there and last.over.words == "hold still"
    inside = last.image[tuple(np.rint(last.over.first).astype(int)[::-1])]
    assert inside < 0.5 * last.image.max()  # the first disc


def test_refusals_are_said_and_the_same_pose_stays_asked_for_once(tmp_path, own):
    """Under one camera, which is guided, too."""
    made, devices = stage(own, ["cam1"])
    said = []
    hand = Hand(made, own, ["take"] * 4, [None, OUTSIDE, OUTSIDE])
    assert record(tmp_path, own, devices, hand, count=2, said=said) == ["00", "01"]
    refused = [line for line in said if line.startswith("not kept: ")]
    assert len(refused) == 2 and all("cam1: board not found" in line for line in refused)
    asked = [step.world_from_board for step in hand.asked]
    np.testing.assert_array_equal(asked[1], asked[2])
    assert np.abs(asked[3] - asked[2]).max() > 1e-3


def test_a_refused_pose_is_kept_if_the_operator_says_so(tmp_path, own):
    """Unless camera 1 doesn't see the board, which would tell nothing; and of a pose that is refused no pattern is shown."""
    made, devices = stage(own, ["cam1"])
    shows, said = [], []

    def again():
        hold(made, own, HELD)
        shows.append(made.shows)

    hand = Hand(made, own, ["take", "take", "keep", "keep"], [HELD, again, again, OUTSIDE])
    assert record(tmp_path, own, devices, hand, said=said) == ["00", "01"]
    assert any(line.startswith("not kept: too like pose 00") for line in said)
    assert shows[1] - shows[0] < patterns(own).count
    assert any("pose 01, 2 of 3, kept though too like pose 00" in line for line in said)
    assert any(line.startswith("not kept: cam1: board not found") for line in said)


def test_poses_of_the_recording_before_count(tmp_path, own, recorded):
    shutil.copytree(recorded, tmp_path, dirs_exist_ok=True)
    made, devices = stage(own, ["cam1"])
    said = []
    hand = Hand(made, own, ["take", "take"], [HELD])
    assert record(tmp_path, own, devices, hand, count=1, said=said) == ["01"]
    assert said[0] == "pose 00 of before: found by cam1, projector"
    assert any("too like pose 00" in line for line in said)


def test_another_board_than_that_of_the_capture_is_refused_at_once(own, recorded):
    made, devices = stage(own, ["cam1"])
    other = patterns(own).model_copy(update={"parts": patterns(own).parts[::-1]})
    plan = BoardPlan(BOARD, other, list(images(other)), 1, Exposing(), Limits(), own, REACH)
    hand = Hand(made, own, ["take"])
    with open_recording(recorded / "out") as recording, pytest.raises(InputError, match=r"board\.patterns"):
        record_board(recording, devices, hand, plan, print, hidden)
    assert hand.asked == []


def test_a_board_that_moves_under_the_fringes_isnt_kept(tmp_path, own):
    made, devices = stage(own, ["cam1"])
    said, moved, show = [], [], made.show
    nudged = HELD.copy()
    nudged[0, 3] += 1.0  # 1.6 px

    def showing(pattern):
        if np.ptp(pattern) and not moved:
            moved.append(True)
            hold(made, own, nudged)
        return show(pattern)

    made.show = showing
    assert record(tmp_path, own, devices, Hand(made, own, ["take"], [HELD]), said=said) == []
    assert any("the board moved by" in line for line in said)


def test_a_rig_that_is_described_otherwise_is_refused(tmp_path, rig, own):
    made, devices = stage(own)
    with pytest.raises(InputError, match=r"rig\.cam1\.optics\.size: expected 512x409 px as the device has, found 1280x1024"):
        record(tmp_path, own.model_copy(update={"cam1": rig.cam1}), devices, Hand(made, own, ["take"]))


def test_what_was_recorded_stays_when_a_camera_is_unplugged(tmp_path, own):
    made, devices = stage(own, ["cam1"])

    def unplug():
        devices.cameras["cam1"].unplugged = True

    with pytest.raises(DeviceError, match="cam1: unplugged"):
        record(tmp_path, own, devices, Hand(made, own, ["take"] * 2, [None, unplug]))
    assert read_board(tmp_path / "out").poses == ("00",)
