"""A sequence as a sweep: poses between its frames where the images are late, and frames that can't be placed in time."""

import numpy as np
import pytest

from recon.errors import InputError
from recon.freehand import sequence_sweep, sequences
from recon.freehand.sequences import FrameNames, Frames
from recon.geometry import rigid
from recon.model.probe import ProbeCalibration

PROBE = ProbeCalibration(rigid.from_rotation_vector([0.3, -0.2, 1.1], [12, -40, 7]), np.array([0.11, 0.125]))
TIMES_S = 1000 + np.arange(12) / 20


def moved(seconds):
    """Poses of a body that turns at 1 rad/s and moves at 30 mm/s, evenly."""
    return np.array([rigid.from_rotation_vector([0, 0, t], [30 * t, 5, 700]) for t in np.asarray(seconds) - 1000])


def written(tmp_path, times_s=TIMES_S, **changed):
    yes = np.ones(len(times_s), bool)
    images = np.arange(len(times_s), dtype=np.uint8)[:, None, None] * np.ones((1, 4, 5), np.uint8)
    valid = {"ProbeToTracker": yes, "Image": yes} | changed
    path = tmp_path / "s.igs.mha"
    transforms = {"ProbeToTracker": moved(1000 + np.arange(len(times_s)) / 20)}
    sequences.write_sequence(path, Frames(np.asarray(times_s), transforms, valid, images))
    return path


def test_a_late_image_shows_the_probe_as_it_stood_before():
    """Also from pixels, whose origin lies 42 mm off: its arc sags by 0.013 mm over a twentieth of a rad. None before any pose."""
    target_from_pixel = sequences.target_from_pixel(PROBE)
    found = sequence_sweep.lagged("s", TIMES_S, moved(TIMES_S) @ target_from_pixel, 0.12)
    assert np.isnan(found[:3]).all()
    np.testing.assert_allclose(found[3:], moved(TIMES_S[3:] - 0.12) @ target_from_pixel, atol=0.02)


def test_poses_off_from_rotations_stay_as_they_are_without_a_lag():
    poses = moved(TIMES_S)
    poses[:, :3, :3] *= 1.005
    assert sequence_sweep.lagged("s", TIMES_S, poses, 0.0) is poses


def test_frames_without_image_or_pose(tmp_path):
    """The track takes poses of frames without an image; images without a pose get their neighbours', with a lag."""
    image, pose = np.ones((2, 12), bool)
    image[4], pose[7] = False, False
    sweep = sequence_sweep.read_sequence_sweep(
        written(tmp_path, Image=image, ProbeToTracker=pose), FrameNames(reference="Tracker")
    )
    assert sweep.frames.tolist() == [0, 1, 2, 3, 5, 6, 7, 8, 9, 10, 11] and sweep.size == (5, 4)
    assert [int(each[0, 0]) for each in sweep.images()] == sweep.frames.tolist()
    assert len(sweep.track.times) == 12 and sweep.track.found.sum() == 11
    assert np.isfinite(sweep.poses()[:, 0, 0]).sum() == 10
    assert np.isfinite(sweep.poses(0.03)[:, 0, 0]).sum() == 10  # all but the first


def test_a_repeated_time_stamp_counts_once(tmp_path):
    times_s = TIMES_S.copy()
    times_s[5] = times_s[4]
    sweep = sequence_sweep.read_sequence_sweep(written(tmp_path, times_s), FrameNames(reference="Tracker"))
    assert len(sweep.times) == 12 and len(sweep.track.times) == 11


def test_frames_without_a_time_stamp_have_no_place_in_time(tmp_path):
    """Their own poses hold without a lag; with one, and for a latency, they are left out."""
    times_s = TIMES_S.copy()
    times_s[[3, 8]] = np.nan
    sweep = sequence_sweep.read_sequence_sweep(written(tmp_path, times_s), FrameNames(reference="Tracker"))
    assert np.isfinite(sweep.poses()).all() and len(sweep.track.times) == 10
    assert np.flatnonzero(np.isnan(sweep.poses(0.03)[:, 0, 0])).tolist() == [0, 3, 8]
    assert sweep.timed().frames.tolist() == [0, 1, 2, 4, 5, 6, 7, 9, 10, 11] and len(sweep.timed().times) == 10


def test_time_stamps_that_tell_nothing(tmp_path):
    def complaint(times_s, lag_s=0.1):
        path = written(tmp_path, times_s)
        sweep = sequence_sweep.read_sequence_sweep(path, FrameNames(reference="Tracker"))
        assert np.isfinite(sweep.poses()).all(), "no time is needed without a lag"
        with pytest.raises(InputError) as fault:
            sweep.poses(lag_s)
        return str(fault.value).removeprefix(f"{path}: ")

    assert complaint(np.full(12, np.nan)).startswith("lag_s: expected frames with a pose and a time stamp, found none")
    again = np.concatenate([TIMES_S[:6], TIMES_S[:6]])
    assert complaint(again) == (
        "Seq_Frame0006_Timestamp: expected 1000.25 s or later, as before, found 1000 s: two recordings in one file?"
    )
    assert complaint(TIMES_S * 1e9).startswith("Timestamp: expected seconds below 9e+09, found 1e+12: milliseconds")
    assert complaint(1000 + np.arange(12)).startswith("lag_s: expected B-scans between poses at most 0.25 s apart, found none")
    path = written(tmp_path, np.full(12, np.nan))
    with pytest.raises(InputError, match="Timestamp: expected one in each frame, found none: a latency needs them"):
        sequence_sweep.read_sequence_sweep(path, FrameNames(reference="Tracker")).timed()


def test_a_frame_that_no_transform_leads_to(tmp_path):
    with pytest.raises(InputError, match=r"s.igs.mha: transforms: expected some that lead from Probe to Reference, found Probe"):
        sequence_sweep.read_sequence_sweep(written(tmp_path), FrameNames())
