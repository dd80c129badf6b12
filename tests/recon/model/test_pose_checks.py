"""Poses of whole sweeps: what no hand makes is left out by name; what is fast, noisy, at rest or on a motor isn't."""

import logging

import numpy as np
import pytest

from recon.errors import InputError
from recon.geometry import rigid
from recon.model import pose_checks, tracks
from recon.model.tracks import Track

COUNT, RATE_HZ = 60, 20.0
TIMES = np.arange(COUNT) / RATE_HZ


def sweep(rng, speed_mm_s=30.0, rate_hz=RATE_HZ, noise_mm=0.05, count=COUNT):
    """A hand that sweeps to and fro, 650 mm from the tracker."""
    times = np.arange(count) / rate_hz
    places = np.column_stack([100 * np.sin(speed_mm_s * times / 100), 5 * np.sin(3 * times), np.full(count, 650.0)])
    turns = np.column_stack([0.3 * np.sin(times), np.full(count, 0.1), 0.2 * times])
    poses = np.array([rigid.from_rotation_vector(turn, place) for turn, place in zip(turns, places, strict=True)])
    poses[:, :3, 3] += rng.normal(0, noise_mm, (count, 3))
    return poses


def b_scans(rng, along_mm, noise=5.0):
    """Images at places along a sweep through tissue whose structures are 1 mm thick and 8 px wide, with noise in each pixel."""
    tissue = 110 + 30 * rng.standard_normal((int(np.max(along_mm)) + 2, 12, 16))
    whole = np.floor(along_mm).astype(int)
    share = (along_mm - whole)[:, None, None]
    images = np.kron((1 - share) * tissue[whole] + share * tissue[whole + 1], np.ones((1, 8, 8)))
    return np.clip(images + noise * rng.standard_normal(images.shape), 0, 255).astype(np.uint8)


def found(poses, times=TIMES, images=None) -> dict:
    looked_at = None if images is None else lambda: (times, pose_checks.small_images(images))
    return {cause: rows.tolist() for cause, rows in pose_checks.find(times, poses, looked_at).rows.items()}


def judged(poses, times=TIMES, implausible="refuse", unit=""):
    kept, findings = pose_checks.without_implausible("s", times, poses, implausible, unit=unit)
    pose_checks.check_motion("s", times, kept, implausible, unit)
    return kept, findings


@pytest.mark.parametrize("speed_mm_s", [5, 100, 500, 2000])
@pytest.mark.parametrize("rate_hz", [1, 5, 20, 200, 1000])
def test_what_hands_do_is_no_fault(speed_mm_s, rate_hz, rng):
    """From a slow sweep to one faster than any that makes images, by trackers of any rate and 0.2 mm of noise."""
    poses = sweep(rng, speed_mm_s, rate_hz, 0.2, 200)
    times = np.arange(200) / rate_hz
    assert not found(poses, times)
    for packet in (3, 10):  # whose stamps are those of their arrival
        bursts = np.floor(times * rate_hz / packet) * packet / rate_hz + 1e-4 * np.arange(200)
        assert not found(poses, bursts)


def test_poses_relative_to_the_first_begin_with_the_identity(rng):
    poses = sweep(rng)
    assert not found(np.linalg.inv(poses[0]) @ poses)


def test_lost_poses_that_are_written_as_the_identity(rng):
    poses = sweep(rng)
    poses[[3, 9, 10, 40]] = np.eye(4)
    assert found(poses) == {"identity": [3, 9, 10, 40]}


@pytest.mark.parametrize("times", [TIMES, np.zeros(COUNT), np.full(COUNT, np.nan)], ids=["timed", "equal", "none"])
@pytest.mark.parametrize(
    ("rows", "off_mm"), [([20], 5000.0), ([20], 300.0), ([0], 5000.0), ([30, 31, 32], 1500.0), ([59], 400.0)]
)
def test_jumps_are_found_with_times_and_without(rows, off_mm, times, rng):
    poses = sweep(rng)
    poses[rows, 0, 3] += off_mm
    assert found(poses, times) == {"jump": rows}


@pytest.mark.parametrize(("every", "gap_s"), [(12, 1.0), (9, 1.0), (9, 0.5), (8, 10.0), (5, 1.0), (3, 1.0)])
@pytest.mark.parametrize("off_mm", [80.0, 500.0])
def test_gaps_hide_no_jump(every, gap_s, off_mm, rng):
    """Of a tool that is often hidden: a pose that has others within a period of it is judged by them, not by the gaps."""
    times = TIMES + np.cumsum(np.where(np.arange(COUNT) % every == 0, gap_s, 0))
    poses = sweep(rng)
    assert not found(poses, times)
    row = COUNT // 2 // every * every + every // 2
    poses[row, 0, 3] += off_mm
    assert found(poses, times) == {"jump": [row]}


def test_a_jump_next_to_a_gap_costs_no_other_pose(rng):
    poses, row = sweep(rng), 32
    poses[row, 0, 3] += 300
    assert found(poses, TIMES + np.cumsum(np.where(np.arange(COUNT) % 8 == 0, 10, 0))) == {"jump": [row]}


def test_two_sweeps_without_times_are_both_kept(rng):
    """60 poses, and 50 beside them; three that come back are a jump, and so are as many far off at the end."""
    there = sweep(rng, count=110)
    there[60:, :3, 3] = sweep(rng, count=50)[:, :3, 3] + [0, 150, 0]
    assert not found(there, np.full(110, np.nan)) and not found(there[::-1], np.full(110, np.nan))
    there[20:23, 2, 3] += 400
    there[108:, 2, 3] += 400
    assert found(there, np.full(110, np.nan)) == {"jump": [20, 21, 22, 108, 109]}
    there = sweep(rng, count=110)
    there[50:65, 2, 3] += 400
    assert found(there, np.full(110, np.nan)) == {"jump": list(range(50, 65))}


def test_a_single_pose_a_little_aside_is_a_jump(rng):
    """80 mm within a twentieth of a second and back, 64 m/s^2, are beyond any hand."""
    poses = sweep(rng)
    poses[20, 1, 3] += 80
    assert found(poses) == {"jump": [20]}


def test_a_target_seen_from_its_other_side_turns_at_once(rng):
    poses = sweep(rng)
    poses[50:55] = poses[50:55] @ np.diag([-1.0, 1, -1, 1])
    assert found(poses) == {"jump": [50, 51, 52, 53, 54]}


@pytest.mark.parametrize("step_mm", [0.1, 1.5])
@pytest.mark.parametrize("end", [30, COUNT])
def test_a_tracker_that_froze_while_images_change(end, step_mm, rng):
    """With neighbours that differ by little more than noise, and by all that they could; and whether it goes on or not."""
    poses = sweep(rng)
    poses[20:end] = poses[20]
    assert found(poses, images=b_scans(rng, step_mm * np.arange(COUNT))) == {"frozen": list(range(21, end))}


@pytest.mark.parametrize(("step_mm", "noise"), [(0.1, 5.0), (0.05, 10.0), (1.5, 10.0), (0.1, 0.0)])
@pytest.mark.parametrize("rest", [10, 30])
def test_a_motor_that_pauses_is_at_rest(step_mm, noise, rest, rng):
    """Poses of an encoder repeat to the last digit; images then differ by noise, as much as neighbours of a slow motion do."""
    steps = np.concatenate([np.full(20, step_mm), np.zeros(rest), np.full(COUNT - 20 - rest, step_mm)])
    poses = np.tile(rigid.transform(np.eye(3), [0, 0, 650]), (COUNT, 1, 1))
    poses[:, 0, 3] = np.cumsum(steps)
    assert not found(poses, images=b_scans(rng, np.cumsum(steps), noise))


def test_a_sweep_without_any_motion_is_refused(rng, caplog):
    poses = np.tile(sweep(rng)[7], (COUNT, 1, 1))
    poses[:10] = np.nan
    complaint = r"^s: poses: expected those of a probe that moves, found all 50 the same.*implausible=take$"
    with pytest.raises(InputError, match=complaint):
        pose_checks.check_motion("s", TIMES, poses)
    pose_checks.check_motion("s", TIMES, poses, "take")
    assert "s: taken all the same: poses: expected those of a probe that moves, found all 50 the same" in caplog.text
    pose_checks.check_motion("s", TIMES[:14], poses[:14])
    poses[10, 0, 3] += 1e-9
    pose_checks.check_motion("s", TIMES, poses)


def test_a_slow_tracker_repeats_each_pose(rng):
    """As where the latest pose is stored with each image: ten poses a second, 60 images."""
    poses = np.repeat(sweep(rng), 6, axis=0)
    assert not found(poses, np.arange(len(poses)) / 60, b_scans(rng, 0.5 * np.arange(len(poses))))


@pytest.mark.parametrize(
    ("factor", "unit"),
    [(1e-3, "metres? multiply the translations by 1000"), (1e3, "micrometres? divide the translations by 1000")],
)
def test_another_unit_is_named(factor, unit, rng):
    poses = sweep(rng)
    poses[:, :3, 3] *= factor
    with pytest.raises(InputError, match=r"poses: expected a sweep in mm") as fault:
        judged(poses)
    assert str(fault.value).endswith(f"{unit}; to use them all the same, give implausible=take")
    assert judged(poses, implausible="take")[0] is poses


def test_a_sweep_that_may_be_in_centimetres_is_named(rng, caplog):
    """3 mm/s over 9 mm, 65 mm from the tracker; the same in mm, or as fast as hands are, is as usual."""
    poses = sweep(rng)
    judged(poses)
    small = poses.copy()
    small[:, :3, 3] *= 0.1
    judged(small, TIMES / 5)
    assert not caplog.text
    judged(small, unit="length_unit")
    assert "s: all poses lie within 7.8 mm, and up to 65.5 mm from the origin, at " in caplog.text
    assert "mm/s: is it in mm, not in centimetres or inches? Else give length_unit" in caplog.text
    caplog.clear()
    inches = poses.copy()
    inches[:, :3, 3] /= 25.4
    judged(inches)
    assert "s: all poses lie within 3.07 mm" in caplog.text
    caplog.clear()
    judged(small, np.full(COUNT, np.nan))
    assert "up to 65.5 mm from the origin: is it in mm" in caplog.text
    small[:, :3, 3] *= 0.01
    with pytest.raises(InputError, match=r"metres\? give length_unit; to use them all the same, give implausible=take"):
        judged(small, unit="length_unit")


def test_poses_that_are_the_other_way_round_are_named(rng, caplog):
    """Of a hand that trembles by half a degree, 0.6 m from the tracker; one that doesn't turn shows nothing."""
    poses = sweep(rng)
    for turns, told in ((0.0, False), (0.01, True)):
        tremble = np.array([rigid.from_rotation_vector(turn, [0, 0, 600]) for turn in rng.normal(0, turns, (COUNT, 3))])
        turned = tremble @ poses[0]
        turned[:, :3, 3] = poses[:, :3, 3] + [0, 0, 600]
        pose_checks.check_motion("s", TIMES, turned)
        assert not caplog.text
        pose_checks.check_motion("s", TIMES, np.linalg.inv(turned))
        assert ("the other way round?" in caplog.text) == told


def test_what_is_left_out_is_counted_and_beyond_a_share_refused(rng, caplog):
    poses = sweep(rng)
    poses[5:20] = np.eye(4)
    with caplog.at_level(logging.WARNING):
        kept, findings = judged(poses)
    assert "s: left out 15 of 60 poses, from pose 5 on: the identity" in caplog.text
    assert np.isnan(kept[5:20]).all() and np.isfinite(kept[20:]).all() and len(findings.rows_left_out) == 15
    poses[20:30] = np.eye(4)
    with pytest.raises(InputError, match=r"found 25 of 60 poses, from pose 5 on: the identity.* give implausible=take"):
        judged(poses)


@pytest.mark.parametrize("rests", [1, 20])
def test_a_table_that_was_shuffled_is_refused_as_such(rests, rng):
    """Of a hand that moves, and of one that rests in each place: fewer than a third of the rows may jump by more than it does."""
    poses = np.repeat(sweep(rng, 100.0, 5.0, count=400 // rests), rests, axis=0)
    assert not pose_checks.in_no_order(poses)
    shuffled = rng.permutation(poses)
    assert pose_checks.in_no_order(shuffled)
    with pytest.raises(
        InputError, match=r"farther off its neighbours .*, and each as far from the next as from any: rows out of"
    ):
        judged(shuffled, np.arange(400) / RATE_HZ)
    judged(poses, np.arange(400) / RATE_HZ)


def test_a_body_at_rest_is_in_any_order(rng):
    """A tenth to a third of its poses may be flips of the tracker, which are left out with a warning."""
    poses = np.repeat(sweep(rng, count=1), 400, axis=0)
    poses[:, :3, 3] += 0.05 * rng.standard_normal((400, 3))
    flipped = np.sort(rng.choice(400, 60, replace=False))
    poses[flipped, 0, 3] += 200
    kept, findings = judged(poses, np.arange(400) / RATE_HZ)
    assert 40 < len(findings.rows_left_out) < 80 and np.isfinite(kept[:, 0, 0]).sum() > 300


def test_stills_have_the_pose_of_their_moment(rng):
    """One pose a second; a still a second with the same time, up to its rounding to ms, and one between."""
    poses = sweep(rng, rate_hz=1.0, count=5)
    track = Track(np.arange(5) * 10**9, poses)
    at = np.array([0, 10**9 + 400_000, 3 * 10**9, 3_500_000_000])
    np.testing.assert_array_equal(tracks.at(track, at)[:3], poses[[0, 1, 3]])
    assert np.isnan(tracks.at(track, at)[3]).all()
    assert np.isfinite(tracks.shares_at(track, at, 0.0)[:3]).all()
    one = Track(np.array([7]), poses[:1])
    np.testing.assert_array_equal(tracks.at(one, np.array([7])), poses[:1])
    assert tracks.shares_at(one, np.array([7]), 0.0).tolist() == [[1.0]]
