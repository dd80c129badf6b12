"""Is the mistake behind frames that contradict each other named, by crossed wires and by N-wires alike?"""

import re
from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from recon import registry
from recon.errors import InputError
from recon.geometry import rigid
from recon.probe_calibration import misreadings, phantom_frames, plus_phantom, point_calibration, probe_figures, tank_calibration
from recon.probe_calibration.phantom_frames import PhantomFrames
from recon.probe_calibration.wire_dots import Dots
from sonotwin.choices import read_rig
from tests.recon import bscans, probe_motions, wire_rows


def crossing(rig, rng):
    sightings = probe_motions.observe(probe_motions.true_probe(rig), *probe_motions.motion(rig), rng)
    order = rng.permutation(len(sightings.poses))  # what its motion repeats reversed is another's mistake
    return phantom_frames.of_pairs("drawn", bscans.SIZE, sightings.poses[order], sightings.pixels[order])


def rows(rig, rng):
    probe = probe_motions.true_probe(rig)
    seen = wire_rows.observe(probe, wire_rows.FCAL, wire_rows.poses_over(probe, wire_rows.FCAL, bscans.SIZE, rng), rng)
    dots = tuple(Dots(*both, 20.0) for both in zip(seen.pixels, seen.pixel_covariance, strict=True))
    numbers, known = np.arange(len(dots)), plus_phantom.FCAL
    return PhantomFrames("drawn", bscans.SIZE, seen, numbers, dots, phantom="n_wires", known=known, poses=seen.poses)


@pytest.fixture(params=[crossing, rows])
def frames(request, rig, rng):
    return request.param(rig, rng)


def at(frames, poses):
    """The same frames with poses that are told otherwise."""
    return replace(frames, sightings=replace(frames.sightings, poses=poses), poses=poses)


def calibrate(rig, frames, **more):
    return tank_calibration.calibrate(
        frames, rig.probe, tank_calibration.Settings(phantom=frames.phantom, temperature_c=22, **more)
    )


def refusal(rig, frames):
    with pytest.raises(InputError) as raised:
        calibrate(rig, frames)
    assert "\n" not in str(raised.value)
    return str(raised.value)


def turned_by(poses, change):
    """Poses with a change of their rotations."""
    result = poses.copy()
    result[:, :3, :3] = change(Rotation.from_matrix(poses[:, :3, :3])).as_matrix()
    return result


def shifted_by(poses, change):
    """Poses with a change of their translations."""
    result = poses.copy()
    result[:, :3, 3] = change(poses[:, :3, 3])
    return result


def _as_radians(turn):
    return Rotation.from_rotvec(turn.as_rotvec(degrees=True))


READ = {
    "poses in m:": lambda poses: shifted_by(poses, lambda places: places / 1000),
    "poses in inches:": lambda poses: shifted_by(poses, lambda places: places / 25.4),
    "poses of target_from_world, the inverse:": np.linalg.inv,
    "poses of transposed rotations:": lambda poses: turned_by(poses, lambda turn: turn.inv()),
    "poses of a quaternion that begins with w": lambda poses: turned_by(
        poses, lambda turn: Rotation.from_quat(turn.as_quat()[:, [3, 0, 1, 2]])
    ),
    "poses of a quaternion that ends with w": lambda poses: turned_by(
        poses, lambda turn: Rotation.from_quat(turn.as_quat()[:, [1, 2, 3, 0]])
    ),
    "poses of axes y and z swapped": lambda poses: shifted_by(poses, lambda places: places[:, [0, 2, 1]]),
    "poses of translations of the wrong handedness, x": lambda poses: shifted_by(poses, lambda places: places * [-1, 1, 1]),
    "poses in reversed order:": lambda poses: poses[::-1],
    "B-scans late by 2 of the poses:": lambda poses: np.concatenate([poses[2:], poses[:2]]),
    "B-scans early by 1 of the poses:": lambda poses: np.roll(poses, 1, axis=0),
}


ROWS_READ = (  # one of each sort of mistake: readings are told alike, and rows differ by what misfits
    "poses in inches:",
    "poses of target_from_world, the inverse:",
    "poses of a quaternion that begins with w",
    "B-scans late by 2 of the poses:",
)


@pytest.mark.parametrize(("frames", "named"), [*product([crossing], READ), *product([rows], ROWS_READ)], indirect=["frames"])
def test_poses_that_mean_something_else_are_named(named, rig, frames):
    assert calibrate(rig, frames)
    assert f"; likely {named}" in refusal(rig, at(frames, READ[named](frames.poses)))


def test_degrees_that_were_read_as_radians_are_asked_for(rig, frames):
    assert "are degrees read as radians?" in refusal(rig, at(frames, turned_by(frames.poses, _as_radians)))


def test_poses_that_only_some_b_scans_have_are_shifted_among_these(rig, frames):
    """Every third B-scan has no pose, as without tracking; late by two means two of those that have one."""
    there = np.arange(len(frames.numbers)) % 3 > 0
    late = frames.poses.copy()
    late[there], late[~there] = np.roll(frames.poses[there], -2, axis=0), np.nan
    seen = tuple(each if found else replace(each, reason="no pose") for each, found in zip(frames.seen, there, strict=True))
    some = replace(frames.sightings.of(there), poses=late[there])
    assert "likely B-scans late by 2 of the poses" in refusal(rig, replace(frames, seen=seen, sightings=some, poses=late))


def test_units_that_nothing_tells_apart_are_all_named(rng):
    """Of one point, on a bracket that isn't the design."""
    size, probe = probe_motions.foreign_probe(rng)
    probe = replace(probe, scale=np.full(2, 0.12))
    seen = probe_motions.observe(probe, *point_calibration.motion(size, roll_deg=60.0), rng)
    frames = phantom_frames.of_pairs("drawn", size, shifted_by(seen.poses, lambda places: places / 25.4), seen.pixels)
    with pytest.raises(InputError, match="likely poses in cm or poses in inches: read so"):
        tank_calibration.calibrate(frames, read_rig("meza2021").probe, tank_calibration.Settings(temperature_c=22))


@pytest.mark.parametrize("fault", [np.diag([1.0, 1, -1, 1]), np.full((4, 4), np.nan), np.zeros((4, 4))])
def test_poses_that_are_none_are_refused_as_such(fault, rig, frames):
    """Nothing else is asked of them."""
    assert "likely" not in refusal(rig, at(frames, frames.poses @ fault))


@pytest.mark.parametrize("first", [10, 19])
@pytest.mark.parametrize("pushed", [False, True])
def test_the_frame_before_which_something_moved_is_named(first, pushed, rig, frames):
    """By 15 mm and 8 degrees: refused with the frame or the movement, or calibrated by the frames of one end, as is told."""
    step = rigid.from_rotation_vector(np.radians([5.0, -4.0, 5.0]), [9.0, -8.0, 9.0])
    poses = frames.poses.copy()
    about = rigid.transform(np.eye(3), poses[:, :3, 3].mean(axis=0))
    poses[first:] = about @ step @ rigid.invert(about) @ poses[first:] if pushed else poses[first:] @ step
    try:
        found = calibrate(rig, at(frames, poses)).adjustment
    except InputError as error:
        told = re.search(r"were lost, at about frame (\d+)", str(error))
        assert "the probe moved against its target" in str(error) if told is None else abs(int(told[1]) - first) <= 1
    else:
        assert found.moved is not None or found.outliers[first:].all() or found.outliers[:first].all()


def few(rig, rng, count):
    """Sightings of a crossing in fewer frames than usual, in any order."""
    drawn = point_calibration.motion(bscans.SIZE, count, 35.0, 180.0)
    seen = probe_motions.observe(probe_motions.true_probe(rig), *drawn, rng)
    return seen.of(rng.permutation(count))


def test_frames_of_both_sides_of_a_slip_are_no_calibration_though_most_agree(rig):
    """By a scale that is wrong by a tenth or more, to noise, with the others as outliers: in 5 of these 9 without a check."""
    refused, count = [], 15
    for seed in range(2, 20, 2):
        rng = np.random.default_rng([seed, count])
        seen, slip = few(rig, rng, count), rng.standard_normal((2, 3))
        way, axis = slip / np.linalg.norm(slip, axis=1, keepdims=True)
        step = rigid.from_rotation_vector(np.radians(3.0) * axis, 5.0 * way)
        late = (np.arange(count) >= count / 2)[:, None, None]
        slipped = np.where(late, seen.poses @ step, seen.poses)
        refused.append(refusal(rig, phantom_frames.of_pairs("drawn", bscans.SIZE, slipped, seen.pixels)))
    assert sum("expected frames that agree, found" in each for each in refused) >= 4


def test_the_two_sides_of_a_slip_are_named_where_frames_of_both_agree(rig):
    """By the numbers of their B-scans, of which every third shows the crossing."""
    rng = np.random.default_rng(0)
    seen = few(rig, rng, 16)
    seen.poses[8:] = seen.poses[8:] @ rigid.from_rotation_vector(np.radians([0, 2.0, 0]), [0, 4.0, 0])
    frames = phantom_frames.of_pairs("drawn", bscans.SIZE, seen.poses, seen.pixels)
    frames = replace(frames, numbers=100 + 3 * np.arange(16))
    kind, settings = registry.kind(phantom_frames.PHANTOMS, frames.phantom), tank_calibration.Settings()
    said = misreadings.two_parts(frames, np.arange(16) % 4 == 0, kind, settings)
    assert re.match(
        r"; frames 100 to (118|121|124) agree .*, and so do (121|124|127) to 145, but not .* frame (121|124|127)$", said
    )


def test_a_movement_that_was_found_is_of_both_parts_beside_a_few_wrong_echoes(rig):
    """A push by 2.5 mm half-way, which is found and in the covariance, and three echoes of something else."""
    rng = np.random.default_rng([1, 200, 9])
    seen = probe_motions.observe(probe_motions.true_probe(rig), *point_calibration.motion(bscans.SIZE, 200, 35.0, 180.0), rng)
    seen.poses[100:, :3, 3] += 2.5 / np.sqrt(3)
    seen.pixels[[30, 90, 150], 0] = bscans.SIZE[0] - 1 - seen.pixels[[30, 90, 150], 0]
    found = calibrate(rig, phantom_frames.of_pairs("drawn", bscans.SIZE, seen.poses, seen.pixels)).adjustment
    assert found.moved is not None and found.outliers.sum() == 3


def test_a_third_of_the_frames_that_show_something_else_are_no_second_part(rig):
    """Anywhere, or all at the end."""
    for seed, anywhere in product(range(3), (True, False)):
        rng = np.random.default_rng(seed)
        seen = few(rig, rng, 24)
        which = rng.permutation(24)[:8] if anywhere else np.arange(16, 24)
        seen.pixels[which] = rng.uniform(0, 1, (8, 2)) * bscans.SIZE
        found = calibrate(rig, phantom_frames.of_pairs("drawn", bscans.SIZE, seen.poses, seen.pixels)).adjustment
        assert set(np.flatnonzero(found.outliers)) >= set(which)


def test_frames_at_no_rest_by_any_reading_get_no_name(rig, frames, rng):
    """A wrong name is worse than none."""
    hand = [rigid.from_rotation_vector(*step) for step in rng.standard_normal((len(frames.poses), 2, 3)) * [[0.1], [20.0]]]
    for poses in (hand @ frames.poses, np.roll(frames.poses, 7, axis=0)):
        assert "likely" not in refusal(rig, at(frames, poses))


def test_lengths_of_poses_that_differ_from_the_scanners_are_warned_of(rig, rng):
    """By 4 and 8 %, as another depth setting would. Not where the scanner's scale isn't known, as of another one's images."""
    frames, settings = crossing(rig, rng), tank_calibration.Settings(temperature_c=22)
    long, longer = (at(frames, shifted_by(frames.poses, lambda places, by=by: by * places)) for by in (1.04, 1.08))
    for given, scanner_sy, told in ((frames, None, False), (long, None, True), (longer, None, True), (longer, np.nan, False)):
        result = tank_calibration.calibrate(given, rig.probe, settings, scanner_sy)
        figures = probe_figures.measure(given, result, rig.probe, settings)
        lines = list(probe_figures.describe(given, result, figures, rig.probe, settings))
        assert any(line.startswith("warning     pixels are 1.0") and "wrong lengths" in line for line in lines) == told, lines


def test_sightings_that_are_given_twice_are_warned_of(rig, rng):
    """Each row of a table counts, so that sigma would be smaller by the root of two."""
    seen = crossing(rig, rng).sightings
    for which, told in ((np.arange(30), False), (np.tile(np.arange(30), 2), True)):
        frames = phantom_frames.of_pairs("drawn", bscans.SIZE, seen.poses[which], seen.pixels[which])
        said = "30 frames repeat pose and pixel of others"
        assert any(said in line for line in probe_figures.describe_frames(frames, 0.0)) == told


def test_diagonals_that_run_the_other_way_are_named(rig, rng):
    """No single image shows it."""
    frames = rows(rig, rng)
    other = replace(frames, known=replace(frames.known, wires=frames.known.wires.restrung([0, 1, 2])))
    assert "likely front and back exchanged of all diagonals, as of a left-handed frame: read so" in refusal(rig, other)


def test_an_image_that_is_mirrored_is_no_other_reading_of_poses(rig, rng):
    """It fits as well as the truth, and only the design tells."""
    frames = crossing(rig, rng)
    pixels = frames.sightings.pixels * [-1, 1] + [bscans.SIZE[0] - 1, 0]
    said = refusal(rig, replace(frames, sightings=replace(frames.sightings, pixels=pixels)))
    assert "mirrored left to right" in said and "likely" not in said
