"""Sequences with poses that can't be believed, and with poses in a file of their own."""

import json
from dataclasses import replace

import numpy as np
import pytest

from recon.errors import InputError
from recon.freehand import scans, sequence_checks, sequence_sweep, sequences
from recon.freehand.sequences import FrameNames, Frames
from recon.geometry import rigid
from recon.model.pose_checks import LOST
from recon.session import volume_step
from sonotwin.cli import main

COUNT = 30
NAMES = FrameNames(reference="Tracker")
IMAGE = np.array([[0.9, 0, 0, 0], [0, 0, -0.9, 0], [0, 0.9, 0, 0], [0, 0, 0, 1.0]])  # depth across the sweep
TIMES_S = 100 + np.arange(COUNT) / 20


def sweep(rng) -> Frames:
    """A sweep of 29 steps of 1.5 mm over tissue that changes from image to image, small and coarse."""
    poses = np.array([rigid.from_rotation_vector([0, 0.01 * k, 0], [300, 1.5 * k, 650]) for k in range(COUNT)])
    images = rng.integers(0, 255, (COUNT, 40, 30), np.uint8)
    transforms = {"ProbeToTracker": poses, "ImageToProbe": np.tile(IMAGE, (COUNT, 1, 1))}
    return Frames(TIMES_S, transforms, dict.fromkeys([*transforms, "Image"], np.ones(COUNT, bool)), images)


def with_poses(frames: Frames, poses) -> Frames:
    return replace(frames, transforms=frames.transforms | {"ProbeToTracker": poses})


@pytest.fixture
def frames(rng) -> Frames:
    return sweep(rng)


def spoiled(frames: Frames, fault: str):
    poses = frames.transforms["ProbeToTracker"].copy()
    if fault == "identity":
        poses[[4, 9, 20]] = np.eye(4)
    elif fault == "frozen":
        poses[10:20] = poses[10]
    elif fault == "far":
        poses[7, 0, 3] += 5000
    return with_poses(frames, poses)


@pytest.mark.parametrize(
    ("fault", "left_out"), [("identity", [4, 9, 20]), ("frozen", list(range(11, 20))), ("far", [7]), ("", [])]
)
def test_a_volume_is_made_of_what_can_be_believed(fault, left_out, frames, tmp_path, caplog):
    """As large as without the fault, where it was 13 times as large by three lost poses, and beyond memory by one 5 m away."""
    path, out = tmp_path / "s.igs.mha", tmp_path / "out"
    sequences.write_sequence(path, spoiled(frames, fault))
    assert main(["freehand", f"sequence={path}", "reference=Tracker", "spacing_mm=1", f"out={out}"]) == 0
    figures = json.loads((out / "metrics.json").read_text())
    assert (figures["poses_left_out"], figures["frames_placed"]) == (len(left_out), COUNT - len(left_out))
    assert max(figures[f"voxels_{axis}"] for axis in "xyz") < 100
    said = caplog.text
    assert (
        (f"ProbeToTracker: left out {len(left_out)} of 30 poses, from frame {left_out[0]} on" in said) if left_out else not said
    )
    sweep = sequence_sweep.read_sequence_sweep(path, NAMES)
    assert np.flatnonzero(np.isnan(sweep.poses()[:, 0, 0])).tolist() == left_out


@pytest.mark.parametrize(
    ("others", "complaint"),
    [
        ([], "ProbeToTracker: poses: expected those of a probe that moves, found all 30 the same to the last digit: no tracking"),
        ([7], "found 21 of 30 poses, from frame 9 on: the same to the last digit as the one before while the images change"),
        ([0, 12], "found 26 of 30 poses, from frame 2 on: the same to the last digit as the one before while the images change"),
        ([29], "found 28 of 30 poses, from frame 1 on: the same to the last digit as the one before while the images change"),
    ],
)
def test_a_sequence_without_tracking_is_named(others, complaint, frames, tmp_path, capsys, caplog):
    """The matrix of frame 3 in all frames but a few, of which one is far off and the rest are as they were."""
    path, out = tmp_path / "s.igs.mha", tmp_path / "out"
    poses = np.tile(frames.transforms["ProbeToTracker"][3], (COUNT, 1, 1))
    poses[others] = frames.transforms["ProbeToTracker"][others]
    if others == [7]:
        poses[7, 0, 3] += 5000
    sequences.write_sequence(path, with_poses(frames, poses))
    given = ["freehand", f"sequence={path}", "reference=Tracker", f"out={out}"]
    assert main(given) == 2
    said = capsys.readouterr().err
    assert complaint in said and said.endswith("give implausible=take\n") and said.count("\n") == 1 and not out.exists()
    with pytest.raises(InputError, match="the same to the last digit"):
        sequence_sweep.read_sequence_sweep(path, NAMES)
    assert main([*given, "implausible=take"]) == 0 and "taken all the same" in caplog.text


def test_a_probe_that_stands_still_before_a_reference_that_moves_is_named(frames, tmp_path, caplog):
    """A reference at rest is usual, and ImageToProbe always is; of neither anything is said."""
    path = tmp_path / "s.igs.mha"
    moving, resting = frames.transforms["ProbeToTracker"], np.tile(frames.transforms["ProbeToTracker"][3], (COUNT, 1, 1))
    valid = frames.valid | {"ReferenceToTracker": np.ones(COUNT, bool)}
    for probe, reference in ((moving, resting), (resting, moving)):
        transforms = frames.transforms | {"ProbeToTracker": probe, "ReferenceToTracker": reference}
        sequences.write_sequence(path, replace(frames, transforms=transforms, valid=valid))
        assert not caplog.text
        sequence_checks.read_tracking(path, "Reference", "Image")
    assert "ProbeToTracker: the same to the last digit in all 30 frames while ReferenceToTracker moves: was Probe" in caplog.text


def test_a_reference_that_is_lost_counts_as_well(frames, tmp_path):
    reference = np.array([rigid.from_rotation_vector([0.2, 0, 0], [0.01 * (k % 3), 20, 900]) for k in range(COUNT)])
    reference[5] = np.eye(4)
    yes = np.ones(COUNT, bool)
    path = tmp_path / "s.igs.mha"
    transforms, valid = frames.transforms | {"ReferenceToTracker": reference}, frames.valid | {"ReferenceToTracker": yes}
    sequences.write_sequence(path, replace(frames, transforms=transforms, valid=valid))
    read, left_out = sequence_checks.read_tracking(path, "Reference", "Image")
    assert left_out == 1 and np.flatnonzero(~read.valid["ReferenceToTracker"]).tolist() == [5]
    assert sequence_checks.read_tracking(path, "Tracker", "Image")[1] == 0, "it isn't on the way"


@pytest.mark.parametrize("reference", ["LPS", "Ras", "Tracker"])
def test_poses_by_way_of_ras_are_checked_too(reference, frames, tmp_path):
    """3D Slicer's frame, and half a turn from it the results'; neither hides lost poses, nor that there was no tracking."""
    path = tmp_path / "s.igs.mha"
    ras = {"TrackerToRas": np.tile(sequences.RAS_FROM_LPS, (COUNT, 1, 1))}
    for poses, left_out in ((spoiled(frames, "identity"), 3), (spoiled(frames, "far"), 1), (frames, 0)):
        valid = frames.valid | {"TrackerToRas": np.ones(COUNT, bool)}
        sequences.write_sequence(path, replace(poses, transforms=poses.transforms | ras, valid=valid))
        assert sequence_checks.read_tracking(path, reference, "Image")[1] == left_out
    still = np.tile(frames.transforms["ProbeToTracker"][3], (COUNT, 1, 1))
    sequences.write_sequence(path, replace(frames, transforms=frames.transforms | ras | {"ProbeToTracker": still}, valid=valid))
    with pytest.raises(InputError, match=r"ProbeToTracker.*: poses: expected those of a probe that moves, found all 30 the same"):
        sequence_checks.read_tracking(path, reference, "Image")


def test_the_mark_of_a_tool_that_is_not_seen_is_no_pose(frames, tmp_path):
    path = tmp_path / "s.igs.mha"
    sequences.write_sequence(path, frames)
    data = path.read_bytes()
    head, _, rest = data.partition(b"Seq_Frame0003_ProbeToTrackerTransform = ")
    text = " ".join([*(["1", "0", "0", repr(LOST)] * 3), "0 0 0 1"]).encode()
    path.write_bytes(head + b"Seq_Frame0003_ProbeToTrackerTransform = " + text + rest[rest.index(b"\n") :])
    assert np.flatnonzero(~sequences.read_tracking(path).valid["ProbeToTracker"]).tolist() == [3]


def test_time_stamps_that_are_all_the_same_are_named(frames, tmp_path):
    path = tmp_path / "s.igs.mha"
    sequences.write_sequence(path, replace(frames, times_s=np.full(COUNT, 5.0)))
    with pytest.raises(InputError, match=r"Timestamp: expected one of each frame.*found only 1 different time in 30 frames"):
        sequence_sweep.read_sequence_sweep(path, NAMES).poses(0.05)


@pytest.fixture
def apart(frames, tmp_path):
    """The same sweep saved as PLUS saves each device's buffer: images at 20 a second, poses at 40."""
    video, tracker = tmp_path / "Video.igs.mha", tmp_path / "Tracker.igs.mha"
    sequences.write_sequence(video, Frames(TIMES_S, {}, {"Image": np.ones(COUNT, bool)}, frames.images))
    steps = np.arange(2 * COUNT) / 2
    poses = np.array([rigid.from_rotation_vector([0, 0.01 * k, 0], [300, 1.5 * k, 650]) for k in steps])
    yes = np.ones(2 * COUNT, bool)
    transforms = {"ProbeToTracker": poses, "ImageToProbe": np.tile(IMAGE, (2 * COUNT, 1, 1))}
    sequences.write_sequence(tracker, Frames(100 + steps / 20 + 0.003, transforms, dict.fromkeys(transforms, yes)))
    return video, tracker


def test_images_and_poses_in_a_file_each(apart, frames, tmp_path):
    """Poses lie between those of the tracker's file, which were 3 ms later: 0.09 mm of 1.5 mm a frame."""
    video, tracker = apart
    at = sequence_sweep.read_sequence_sweep(video, NAMES, tracker).poses()
    assert np.isnan(at[0]).all() and np.isfinite(at[1:]).all()
    np.testing.assert_allclose(at[1:, :3, 3], frames.transforms["ProbeToTracker"][1:, :3, 3] - [0, 0.09, 0], atol=1e-6)
    out = tmp_path / "out"
    assert main(["freehand", f"sequence={video}", f"tracker={tracker}", "reference=Tracker", f"out={out}"]) == 0
    assert json.loads((out / "metrics.json").read_text())["frames_placed"] == COUNT - 1


def test_identities_of_a_video_file_give_way_to_its_tracker(apart):
    """As PLUS's recorders fill them in; a frame without a time has no pose, and the others keep theirs."""
    video, tracker = apart
    right = sequence_sweep.read_sequence_sweep(video, NAMES, tracker).poses()
    whole = sequences.read_sequence(video)
    identities = {"ProbeToTracker": np.tile(np.eye(4), (COUNT, 1, 1))}
    times_s = whole.times_s.copy()
    times_s[7] = np.nan
    valid = whole.valid | {"ProbeToTracker": np.ones(COUNT, bool)}
    sequences.write_sequence(video, replace(whole, times_s=times_s, transforms=identities, valid=valid))
    found = sequence_sweep.read_sequence_sweep(video, NAMES, tracker).poses()
    assert np.isnan(found[7]).all()
    np.testing.assert_array_equal(np.delete(found, 7, axis=0), np.delete(right, 7, axis=0))


@pytest.mark.parametrize("late_s", [0.0002, 0.0013, 0.004])
def test_a_lost_pose_of_a_file_of_its_own_is_blended_into_none(late_s, apart, tmp_path, caplog):
    """One identity in 60 rows, just after or before an image, made places up to 37 mm off; a stylus is nobody's business."""
    video, tracker = apart
    good = sequences.read_tracking(tracker)
    good = replace(good, times_s=good.times_s - 0.003 - late_s)
    sequences.write_sequence(tracker, good)
    right = sequence_sweep.read_sequence_sweep(video, NAMES, tracker).poses()
    poses = good.transforms["ProbeToTracker"].copy()
    poses[22:24] = np.eye(4)
    stylus = np.where((np.arange(len(poses)) % 2)[:, None, None], np.eye(4), good.transforms["ProbeToTracker"])
    transforms = good.transforms | {"ProbeToTracker": poses, "StylusToTracker": stylus}
    sequences.write_sequence(tracker, replace(good, transforms=transforms, valid=dict.fromkeys(transforms, np.ones(60, bool))))
    found = sequence_sweep.read_sequence_sweep(video, NAMES, tracker).poses()
    known = np.isfinite(found).all(axis=(1, 2))
    np.testing.assert_allclose(found[known], right[known], atol=0.02)
    assert known.sum() >= COUNT - 1
    assert "Tracker.igs.mha: ProbeToTracker: left out 2 of 60 poses, from frame 22 on: the identity" in caplog.text


def test_a_reference_that_was_seen_once_holds_no_longer(apart):
    """One that is at rest holds where it is seen in all rows, and else between those in which it is."""
    video, tracker = apart
    good = sequences.read_tracking(tracker)
    rows, reference = np.arange(len(good.times_s)), rigid.from_rotation_vector([0, 0.3, 0], [10, 20, 900])
    transforms = good.transforms | {"ReferenceToTracker": np.tile(reference, (len(rows), 1, 1))}
    for seen, held in ((rows == 40, 0), ((rows == 40) | (rows == 41), 0), ((rows >= 20) & (rows < 40), 9), (rows >= 0, COUNT)):
        sequences.write_sequence(tracker, replace(good, transforms=transforms, valid=good.valid | {"ReferenceToTracker": seen}))
        read, _ = sequence_checks.read_tracking(video, "Reference", "Image", tracker=tracker)
        assert read.valid["ReferenceToTracker"].sum() == held


def test_a_jittering_reference_near_the_origin_is_in_millimetres(frames, tmp_path, rng, caplog):
    """A sweep's own extent tells the unit, also where a calibration in mm is on the way."""
    path = tmp_path / "s.igs.mha"
    still = np.tile(np.eye(4), (COUNT, 1, 1))
    still[:, :3, 3] = rng.normal(0, 0.1, (COUNT, 3))
    image = np.tile(rigid.transform(np.eye(3), [30, 60, 80]) @ IMAGE, (COUNT, 1, 1))
    transforms = frames.transforms | {"TrackerToRas": still, "ImageToProbe": image}
    frames = replace(frames, transforms=transforms, valid=frames.valid | {"TrackerToRas": np.ones(COUNT, bool)})
    sequences.write_sequence(path, frames)
    assert sequence_checks.read_tracking(path, "Ras", "Image")[1] == 0 and not caplog.text
    metres = frames.transforms["ProbeToTracker"].copy()
    metres[:, :3, 3] *= 1e-3
    sequences.write_sequence(path, with_poses(frames, metres))
    with pytest.raises(InputError, match=r"metres\? multiply the translations by 1000; to use them all the same, give"):
        sequence_checks.read_tracking(path, "Tracker", "Image")


def test_files_of_other_times_are_refused(apart, frames, tmp_path, capsys):
    video, tracker = apart
    late = tmp_path / "Late.igs.mha"
    sequences.write_sequence(late, replace(sequences.read_sequence(video), times_s=TIMES_S + 50))
    for path, given, complaint in (
        (late, tracker, "tracker: expected poses while the images were taken, at 150.000 to 151.450 s, found some at 100.003"),
        (video, video, "tracker: expected transforms in each frame, such as ProbeToTracker, found none"),
    ):
        assert main(["freehand", f"sequence={path}", f"tracker={given}", "reference=Tracker", f"out={tmp_path / 'out'}"]) == 2
        said = capsys.readouterr().err
        assert complaint in said and said.count("\n") == 1 and not (tmp_path / "out").exists()


def test_a_spacing_that_leaves_gaps_is_advised_against(frames, tmp_path):
    """B-scans 1.5 mm apart: sticks of nine voxels reach over eight steps, of 0.19 mm and more."""
    path = tmp_path / "s.igs.mha"
    sequences.write_sequence(path, frames)
    placed = scans.of_sequence(path, NAMES)
    (said,) = volume_step.advice(placed, scans.VolumeSettings(spacing_mm=0.1))
    assert said.startswith("advice      B-scans or pixels are up to 1.5 mm apart") and "give spacing_mm=0.2, " in said
    assert not list(volume_step.advice(placed, scans.VolumeSettings(spacing_mm=0.2)))
    assert "give spacing_mm=1.5, " in next(volume_step.advice(placed, scans.VolumeSettings(spacing_mm=0.5, hole_voxels=0)))
