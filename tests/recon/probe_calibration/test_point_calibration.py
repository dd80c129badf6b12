"""A probe's calibration is repeatable, right, as sure as it says, and refuses what leaves it open."""

import re
from dataclasses import replace

import numpy as np
import pytest
from scipy import stats
from scipy.spatial.transform import Rotation

from recon.errors import InputError
from recon.estimation.equations import Step
from recon.geometry import rigid
from recon.model.probe import ProbeCalibration
from recon.model.rig import Pose
from recon.probe_calibration import point_calibration, probe_checks, repeatability, sound_in_water
from recon.probe_calibration.point_calibration import Noise, Sightings, calibrate
from tests.recon import bscans, moving_phantoms
from tests.recon.probe_motions import (
    ANGLE_DEG,
    PIXEL_PX,
    POSITION_MM,
    SLICE_MM,
    foreign_probe,
    motion,
    observe,
    poses_of,
    true_probe,
    with_outliers,
)

NOISE = Noise(ANGLE_DEG, POSITION_MM, PIXEL_PX, SLICE_MM)
SIZE = bscans.SIZE
POINTS = repeatability.five_points(SIZE)
CENTRE, MIDDLE = 0, (np.array(SIZE) - 1) / 2


@pytest.fixture
def probe(rig):
    return true_probe(rig)


@pytest.fixture
def frames(rig):
    return motion(rig)


def errors(calibration, probe):
    """Distances (5,) mm of the five points from where they are."""
    return np.linalg.norm(calibration.to_target(POINTS) - probe.to_target(POINTS), axis=1)


def test_without_noise_the_calibration_is_the_truth(probe, frames):
    result = calibrate(Sightings(poses_of(probe, *frames), frames[1]), SIZE, NOISE)
    assert errors(result.calibration, probe).max() < 1e-6
    assert result.rms_mm < 1e-6


def test_the_closed_form_is_exact_for_four_frames(probe, frames):
    poses = poses_of(probe, *frames)[:4]
    pose, scale, _ = point_calibration.closed_form(poses, frames[1][:4])
    assert errors(ProbeCalibration(pose, scale), probe).max() < 1e-5


@pytest.mark.parametrize("roll_deg", [180, 35])
def test_five_calibrations_agree_and_are_right(rig, probe, rng, roll_deg):
    """Bars of CR1, CR2 at centre, corners and mean, and of the true error; a probe that can't be rolled keeps them too."""
    turns, pixels = motion(rig, roll_deg)
    made = [calibrate(observe(probe, turns, pixels, rng), SIZE, NOISE).calibration for _ in range(5)]
    first, second = repeatability.cr1(made, POINTS), repeatability.cr2(made, POINTS)
    assert first[CENTRE] <= 0.20 and first[1:].mean() <= 0.25 and first.mean() <= 0.30
    assert second[CENTRE] <= 0.13 and second[1:].mean() <= 0.17 and second.mean() <= 0.20
    assert max(errors(each, probe).max() for each in made) <= 0.30
    assert errors(repeatability.average(made), probe).max() < 0.15  # 0.3 / sqrt(5)


def test_the_covariance_is_honest(probe, frames, rng):
    """Errors of 8 calibrations, normalised by their covariance, are chi-square with 8 degrees of freedom each."""
    total = 0.0
    for _ in range(8):
        made = calibrate(observe(probe, *frames, rng), SIZE, NOISE).calibration
        turn = Rotation.from_matrix(probe.target_from_image[:3, :3] @ made.target_from_image[:3, :3].T).as_rotvec()
        shift = probe.target_from_image[:3, 3] - made.target_from_image[:3, 3]
        error = np.concatenate([probe.scale - made.scale, turn, shift])
        total += error @ np.linalg.solve(made.uncertainty.covariance, error)
    low, high = stats.chi2.ppf([0.0005, 0.9995], 8 * 8)
    assert low < total < high * 79 / 77  # the noise level itself is measured, from 79 degrees of freedom


def test_a_lag_that_is_off_by_its_sigma_moves_the_probe_as_far_as_its_covariance_says(probe, frames, rng):
    """Frames of a probe in motion: all poses are late together, by 0.3 mm and 0.1 degrees here, to any side."""
    seen = observe(probe, *frames, rng)
    late = rigid.moved(seen.poses, rng.standard_normal((len(seen.poses), 6)) * [*3 * [np.radians(0.1)], *3 * [0.3]])
    still, known = (calibrate(replace(seen, poses=poses), SIZE, NOISE).calibration for poses in (late, seen.poses))
    unsure = calibrate(replace(seen, pose_by_lag=late - seen.poses), SIZE, NOISE).calibration
    assert np.array_equal(unsure.to_target(POINTS), known.to_target(POINTS))
    by_lag = point_calibration.point_covariance(unsure, POINTS) - point_calibration.point_covariance(known, POINTS)
    shifts = np.linalg.norm(still.to_target(POINTS) - known.to_target(POINTS), axis=1)
    assert shifts.max() > 0.05 and np.sqrt(np.trace(by_lag, axis1=1, axis2=2)) == pytest.approx(shifts, rel=0.1, abs=0.03)


@pytest.mark.parametrize(("field", "value", "complaint"), [
    ("pixel_covariance", [[[1.0, 2.0], [2.0, 1.0]]] * 30, "pixel_covariance: frame 0: expected a covariance, found a negative"),
    ("pose_covariance", -np.tile(np.eye(6), (30, 1, 1)), "pose_covariance: frame 0: expected a covariance, found a negative"),
    ("directions", np.zeros((30, 2)), r"directions: expected numbers of shape \(30, 2, 2\)"),
])  # fmt: skip
def test_what_is_no_covariance_or_of_another_shape_is_refused(probe, frames, rng, field, value, complaint):
    with pytest.raises(InputError, match=complaint):
        calibrate(replace(observe(probe, *frames, rng), **{field: value}), SIZE, NOISE)


def test_covariances_may_be_lists(probe, frames, rng):
    seen = observe(probe, *frames, rng)
    given = np.tile(PIXEL_PX**2 * np.eye(2), (30, 1, 1))
    by_lists, by_arrays = (calibrate(replace(seen, pixel_covariance=one), SIZE, NOISE) for one in (given.tolist(), given))
    assert np.array_equal(by_lists.residuals, by_arrays.residuals)


def test_the_level_of_the_noise_is_measured(probe, frames, rng):
    """Told half the noise, it finds a factor of two and the same covariance."""
    sightings = observe(probe, *frames, rng)
    right = calibrate(sightings, SIZE, NOISE)
    half = calibrate(sightings, SIZE, Noise(ANGLE_DEG / 2, POSITION_MM / 2, PIXEL_PX / 2, SLICE_MM / 2))
    assert half.noise_factor == pytest.approx(2 * right.noise_factor, rel=1e-3)
    expected = np.diag(right.calibration.uncertainty.covariance)
    assert np.diag(half.calibration.uncertainty.covariance) == pytest.approx(expected, rel=1e-2)


def test_a_third_of_wrong_crossings_does_no_harm(probe, frames, rng):
    """The bars with 30 % outliers are 1.5 times those without."""
    made = []
    for _ in range(5):
        sightings, wrong = with_outliers(observe(probe, *frames, rng), 0.3, rng)
        result = calibrate(sightings, SIZE, NOISE)
        assert result.outliers[wrong].all() and result.outliers.sum() <= len(wrong) + 1
        made.append(result.calibration)
    first, second = repeatability.cr1(made, POINTS), repeatability.cr2(made, POINTS)
    assert first[CENTRE] <= 0.30 and first[1:].mean() <= 0.375 and first.mean() <= 0.45
    assert second[CENTRE] <= 0.195 and second[1:].mean() <= 0.255 and second.mean() <= 0.30
    assert max(errors(each, probe).max() for each in made) <= 0.45


def test_outliers_that_agree_with_each_other_are_still_outliers(probe, frames, rng):
    """A reverberation, always 50 px below the wire, in a third of the upper frames."""
    sightings = observe(probe, *frames, rng)
    shallow = np.flatnonzero(sightings.pixels[:, 1] < 200)[::3]
    sightings.pixels[shallow, 1] += 50
    result = calibrate(sightings, SIZE, NOISE)
    assert result.outliers[shallow].all()
    assert errors(result.calibration, probe).max() < 0.45


@pytest.mark.parametrize("count", [8, 15])
def test_few_good_frames_are_not_taken_for_outliers_of_each_other(probe, frames, count):
    """Twelve unknowns fit six frames by themselves: their residuals are small, and others' would look large beside them."""
    kept = []
    for seed in range(6):
        rng = np.random.default_rng([seed, count])
        some = rng.choice(len(frames[1]), count, replace=False)
        adjusted = calibrate(observe(probe, frames[0][some], frames[1][some], rng), SIZE, NOISE, max_sigma_mm=100)
        kept.append((~adjusted.outliers).mean())
    assert np.mean(np.array(kept) > 0.8) >= 0.9


def test_a_frame_that_alone_shows_what_others_leave_open_is_no_outlier(probe, frames):
    """Turns about one axis leave open how far the image stands along it; the one frame of another turn would show that."""
    turns = np.outer(np.linspace(-35, 35, len(frames[1])), [1, 0, 0])
    turns[-1] = [0, 25, 10]
    sightings, planar = Sightings(poses_of(probe, turns, frames[1]), frames[1]), np.arange(len(turns)) < len(turns) - 1
    true = point_calibration._Estimate(*point_calibration.closed_form(sightings.poses, sightings.pixels))
    equations, _ = point_calibration._normal_equations(true, sightings.of(planar), NOISE, np.ones(planar.sum()))
    values, vectors = np.linalg.eigh(equations.shared)
    assert values[0] < 1e-9 * values[-1]
    moved = true.moved(Step(20.0 * vectors[:, 0], np.zeros((0, 0))))
    off = point_calibration._squared(moved, sightings, NOISE)
    assert off[planar].max() < 1 and off[-1] > 10 * point_calibration.GATE
    assert point_calibration._squared_as_predicted(moved, sightings, NOISE, planar)[-1] < 1


def test_wires_are_found_in_images_by_themselves(probe, frames, rng):
    turns, pixels = frames
    turns, pixels = turns[::2], pixels[::2]
    images = [bscans.image(bscans.spot(pixel) + bscans.face(), rng) for pixel in pixels]
    images[3] = bscans.image(bscans.face(), rng)
    poses = observe(probe, turns, pixels, rng).poses
    poses[5] = np.nan
    sightings, found = point_calibration.from_images(images, poses)
    assert {k: each.reason for k, each in enumerate(found) if not each.found} == {
        3: "no echo stands out",
        5: point_calibration.NO_POSE,
    }
    assert errors(calibrate(sightings, SIZE, NOISE).calibration, probe).max() < 0.45  # half the frames: 0.3 * sqrt(2)


def test_predicted_errors_of_pixels_are_those_of_the_parameters(probe, frames, rng):
    """Pixels placed by calibrations drawn from the covariance scatter as predicted."""
    made = calibrate(observe(probe, *frames, rng), SIZE, NOISE).calibration
    draws = rng.multivariate_normal(np.zeros(8), made.uncertainty.covariance, 4000)
    placed = []
    for step in draws:
        turn = Rotation.from_rotvec(step[2:5]).as_matrix() @ made.target_from_image[:3, :3]
        moved = rigid.transform(turn, made.target_from_image[:3, 3] + step[5:])
        placed.append(ProbeCalibration(moved, made.scale + step[:2]).to_target(POINTS))
    predicted = point_calibration.point_covariance(made, POINTS)
    sampled = np.array([np.cov(np.array(placed)[:, k], rowvar=False) for k in range(len(POINTS))])
    assert np.trace(sampled, axis1=1, axis2=2) == pytest.approx(np.trace(predicted, axis1=1, axis2=2), rel=0.1)  # 3 sigma: 0.07


def test_poses_known_to_differ_are_weighted_so(probe, frames, rng):
    """With half of the poses ten times worse, telling so gives a better calibration, and an honest level of noise."""
    good, bad = observe(probe, *frames, rng), observe(probe, *frames, rng)
    sigma = np.where(np.arange(30) % 2, 10, 1)
    poses = good.poses.copy()
    for k in np.flatnonzero(sigma > 1):
        poses[k, :3, :3] = Rotation.from_rotvec(np.radians(0.8) * rng.standard_normal(3)).as_matrix() @ bad.poses[k, :3, :3]
    covariance = np.array([np.diag([np.radians(ANGLE_DEG * s) ** 2] * 3 + [POSITION_MM**2] * 3) for s in sigma])
    result = calibrate(Sightings(poses, good.pixels, pose_covariance=covariance), SIZE, NOISE)
    assert 0.7 < result.noise_factor < 1.3
    assert errors(result.calibration, probe).max() < 0.45


@pytest.mark.parametrize(
    ("kept", "named"),
    [
        ((0, 0, 0), "found none"),
        ((1, 0, 0), "planar motion.*c0-c1"),
        ((0, 1, 0), "planar motion.*normal"),
        ((0, 0, 1), "planar motion.*c0-c2"),
    ],
)
def test_a_missing_rotation_is_named(probe, frames, rng, kept, named):
    """The rig's image has its depth axis along the target's normal, and its array along c0-c1."""
    turns = np.outer(np.linspace(-35, 35, 30), kept)
    with pytest.raises(InputError, match=named):
        calibrate(observe(probe, turns, frames[1], rng), SIZE, NOISE)


@pytest.mark.parametrize(
    ("place", "named"),
    [
        (lambda u, v: (u, 0 * v + 200), "one depth only"),
        (lambda u, v: (0 * u + 160, v), "one lateral position only"),
        (lambda u, v: (u, 0.8 * u + 50), "all on one line"),
    ],
)
def test_a_missing_place_in_the_image_is_named(probe, frames, rng, place, named):
    with pytest.raises(InputError, match=named):
        pixels = np.column_stack(place(*frames[1].T))
        calibrate(observe(probe, frames[0], pixels, rng), SIZE, NOISE)


def test_planar_motion_is_seen_behind_outliers(probe, frames, rng):
    turns = np.outer(np.linspace(-35, 35, 30), [1, 0, 0])
    sightings, _ = with_outliers(observe(probe, turns, frames[1], rng), 0.3, rng)
    with pytest.raises(InputError, match="planar motion"):
        calibrate(sightings, SIZE, NOISE)


def test_one_depth_is_seen_behind_outliers(probe, frames, rng):
    sightings, _ = with_outliers(observe(probe, frames[0], frames[1] * [1, 0] + [0, 200], rng), 0.3, rng)
    with pytest.raises(InputError, match="one depth only"):
        calibrate(sightings, SIZE, NOISE)


SWAPPED = np.array([[0.0, 1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
DOWN = np.diag([1.0, 1, -1, 1])


def shifts(poses, matrix):
    result = poses.copy()
    result[:, :3, 3] = poses[:, :3, 3] @ matrix[:3, :3]
    return result


@pytest.mark.parametrize(
    ("wrong", "named"),
    [
        (lambda poses: poses @ SWAPPED, "left-handed"),
        (lambda poses: SWAPPED @ poses, "left-handed"),
        (lambda poses: poses @ np.diag([1, 1, 1, 2.0]), "rigid transform"),
        (lambda poses: poses * np.nan, "not finite"),
        (lambda poses: shifts(poses, np.eye(4) / 1000), "are the poses in mm"),
        (lambda poses: poses[::-1], "one point at rest"),
    ],
)
def test_poses_that_mean_something_else_are_named(probe, frames, rng, wrong, named):
    sightings = observe(probe, *(part[::2] for part in frames), rng)
    with pytest.raises(InputError, match=named) as raised:
        calibrate(Sightings(wrong(sightings.poses), sightings.pixels), SIZE, NOISE)
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize(
    ("wrong", "named"),
    [
        (lambda poses, pixels: (poses, 2 * MIDDLE * [1, 0] + pixels * [-1, 1]), "mirrored left to right"),
        (lambda poses, pixels: (poses, 2 * MIDDLE * [0, 1] + pixels * [1, -1]), "upside down"),
        (lambda poses, pixels: (poses, MIDDLE + 0.6 * (pixels - MIDDLE)[:, ::-1]), "u and v are swapped"),
        (lambda poses, pixels: (poses @ SWAPPED @ DOWN, pixels), r"target's axes are swapped: \(y, x, -z\)"),
    ],
)
def test_axes_swapped_without_contradiction_are_known_by_the_design(probe, frames, rng, wrong, named):
    """They fit as well as the truth; the design of the bracket, good to 10 degrees, tells."""
    designed = probe.target_from_image @ rigid.from_rotation_vector([0.1, -0.1, 0.1], [5, -5, 5])
    poses, pixels = observe(probe, *frames, rng).poses, frames[1]
    if "u and v" in named:
        poses = observe(probe, frames[0], MIDDLE + 0.6 * (pixels - MIDDLE), rng).poses
    assert calibrate(observe(probe, *frames, rng), SIZE, NOISE, designed)
    with pytest.raises(InputError, match=named):
        calibrate(Sightings(*wrong(poses, pixels)), SIZE, NOISE, designed)


def test_u_and_v_swapped_leave_the_image(probe, frames, rng):
    sightings = observe(probe, *frames, rng)
    with pytest.raises(InputError, match="are u and v swapped, or is it another scanner"):
        calibrate(Sightings(sightings.poses, sightings.pixels[:, ::-1]), SIZE, NOISE)


def test_pixels_of_another_scanner_ask_for_the_size_of_its_images(probe, frames, rng):
    """They don't fit with u and v swapped either, so that isn't said."""
    sightings = observe(probe, *frames, rng)
    with pytest.raises(InputError, match=r"another scanner\? give rig\.probe\.image_size") as raised:
        calibrate(Sightings(sightings.poses, sightings.pixels + np.array([320, 0])), SIZE, NOISE)
    assert "swapped" not in str(raised.value)


def test_pixels_from_another_origin_are_of_no_other_scanner(probe, frames, rng):
    """From the image's middle, half of them are negative, which no size mends."""
    sightings = observe(probe, *frames, rng)
    with pytest.raises(InputError, match="from the centre of the top left pixel") as raised:
        calibrate(Sightings(sightings.poses, sightings.pixels - MIDDLE), SIZE, NOISE)
    assert "another scanner" not in str(raised.value)


def test_a_refusal_names_the_worst_frames_and_its_limit_is_a_setting(probe, frames, rng):
    """Frames known by their numbers; three of them 40 mm off, and all noisy."""
    sightings, numbers = observe(probe, *frames, rng), np.arange(len(frames[1])) + 100
    jump = rng.normal(0, 4.0, (len(numbers), 3))
    jump[[4, 9, 17]] = [[40, 0, 0], [0, 40, 0], [0, 0, 40]]
    poses = sightings.poses.copy()
    poses[:, :3, 3] += jump
    with pytest.raises(InputError, match="one point at rest") as raised:
        calibrate(Sightings(poses, sightings.pixels), SIZE, NOISE, numbers=numbers)
    assert {int(word) for word in re.findall(r"frame (\d+) by", str(raised.value))} > {104, 109, 117}
    poses[:, :3, 3] -= 0.9 * jump
    few = Sightings(poses[:14], sightings.pixels[:14])
    with pytest.raises(InputError, match=r"placed to 0.05 mm \(1 sigma\), found .*; allow more by max_sigma_mm=$"):
        calibrate(few, SIZE, NOISE, max_sigma_mm=0.05)
    assert calibrate(few, SIZE, NOISE, max_sigma_mm=50.0)


@pytest.mark.parametrize("seed", range(12))
def test_a_bracket_to_any_side_is_calibrated_whatever_the_design(rig, seed):
    """Of any size, scale and attitude; a design of another bracket, given with every other, only makes a doubt of it."""
    rng = np.random.default_rng([5, seed])
    size, probe = foreign_probe(rng)
    design = rig.probe.target_from_image.matrix()
    sightings = observe(probe, *point_calibration.motion(size), rng)
    found = calibrate(sightings, size, NOISE, design if seed % 2 else None).calibration
    points = repeatability.five_points(size)
    away = np.linalg.norm(found.to_target(points) - probe.to_target(points), axis=1)
    sigma = np.sqrt(np.trace(point_calibration.point_covariance(found, points), axis1=1, axis2=2))
    assert (away < 4 * sigma).all() and sigma.max() < 0.5
    said = list(probe_checks.doubts(found, size, design))
    assert "from its design: another bracket?" in said[0]
    assert (rigid.invert(probe.target_from_image)[1, 3] > 0) == any("below the probe's face" in line for line in said)


@pytest.mark.parametrize("flip", [(-1, 1), (1, -1), (-1, -1)])
def test_a_negative_scale_is_a_turned_image(rng, flip):
    """Pixels counted from the other end, or both, place the wire as well."""
    size, probe = foreign_probe(rng)
    sightings = observe(probe, *point_calibration.motion(size), rng)
    last, points = np.array(size) - 1, repeatability.five_points(size)
    counted = [np.where(np.array(flip) < 0, last - each, each) for each in (sightings.pixels, points)]
    found = calibrate(Sightings(sightings.poses, counted[0]), size, NOISE).calibration
    assert found.scale.min() > 0
    assert np.linalg.norm(found.to_target(counted[1]) - probe.to_target(points), axis=1).max() < 0.5


def test_a_crossing_in_a_part_of_the_image_is_enough(rng):
    """A screen that isn't cropped: wires in its middle third only."""
    size, probe = foreign_probe(rng)
    turns, pixels = point_calibration.motion(size)
    found = calibrate(observe(probe, turns, np.array(size) / 3 + pixels / 3, rng), size, NOISE).calibration
    points = repeatability.five_points(size)
    assert np.linalg.norm(found.to_target(points) - probe.to_target(points), axis=1).max() < 1


def test_an_image_upside_down_puts_the_target_under_water(probe, frames, rng):
    """As a bracket may, so only the design decides."""
    sightings = observe(probe, *frames, rng)
    turned = Sightings(sightings.poses, [0, SIZE[1] - 1] + sightings.pixels * [1, -1])
    found = calibrate(turned, SIZE, NOISE).calibration
    elsewhere = rigid.transform(np.eye(3), [0, 200, 0])
    assert any("upside down" in line for line in probe_checks.doubts(found, SIZE, elsewhere))
    with pytest.raises(InputError, match="as if the image is upside down"):
        calibrate(turned, SIZE, NOISE, probe.target_from_image)


def test_a_refusal_by_the_design_has_the_pose_found_which_is_taken_as_design(probe, frames, rng):
    """The way past it: given as the design, with the digits that are said, the same frames are accepted."""
    poses, pixels = observe(probe, *frames, rng).poses, [SIZE[0] - 1, 0] + frames[1] * [-1, 1]
    with pytest.raises(InputError, match="mirrored left to right") as raised:
        calibrate(Sightings(poses, pixels), SIZE, NOISE, probe.target_from_image)
    fields = dict(re.findall(r"rig\.probe\.target_from_image\.(\w+)=\[([^]]+)\]", str(raised.value)))
    found = Pose(**{name: tuple(map(float, vector.split(","))) for name, vector in fields.items()})
    assert calibrate(Sightings(poses, pixels), SIZE, NOISE, found.matrix())


def test_five_frames_are_too_few(probe, frames, rng):
    with pytest.raises(InputError, match="at least 6 frames"):
        calibrate(observe(probe, *frames, rng).of(range(5)), SIZE, NOISE)


def test_a_calibration_in_water_shows_its_speed_of_sound_and_is_corrected_for_it(probe, frames, rng):
    """The scanner assumes 1540 m/s, so wires in water of 22 degrees stand deeper in its image than they are."""
    speed = sound_in_water.speed_of_sound(22.0)
    in_water = ProbeCalibration(probe.target_from_image, probe.scale * [1, speed / sound_in_water.SCANNER_SPEED])
    made = calibrate(observe(in_water, *frames, rng), SIZE, NOISE).calibration
    assert errors(made, in_water).max() < 0.30
    implied, sigma = sound_in_water.implied_speed(made, probe.scale[1])
    assert abs(implied - speed) < 4 * sigma < 20
    uncorrected = errors(made, probe).max()
    assert uncorrected == pytest.approx(sound_in_water.shown_too_deep(50.0, speed), abs=0.3)
    assert errors(sound_in_water.in_medium(made, float(speed), sound_in_water.SCANNER_SPEED), probe).max() < 0.31


def test_poses_in_cm_are_told_by_the_brackets_length(probe, frames, rng):
    """They fit as well, with all lengths a tenth: only the design tells."""
    sightings = observe(probe, *frames, rng)
    in_cm = Sightings(shifts(sightings.poses, np.eye(4) / 10), sightings.pixels)
    small = Noise(ANGLE_DEG, POSITION_MM / 10, PIXEL_PX, SLICE_MM / 10)
    with pytest.raises(
        InputError, match=r"as if the poses are in cm: multiply their translations by 10; if it is right, give rig.probe"
    ) as raised:
        calibrate(in_cm, SIZE, small, probe.target_from_image)
    assert "\n" not in str(raised.value)


def test_exact_poses_need_no_noise(probe, frames):
    """Nothing is inverted that is singular: a floor of a micrometre stands for none."""
    result = calibrate(Sightings(poses_of(probe, *frames), frames[1]), SIZE, Noise(0, 0, 0, 0))
    assert errors(result.calibration, probe).max() < 1e-6


def test_a_calibrations_error_shows_in_frames_that_it_was_not_made_of(probe, frames, rng):
    """By the true calibration the crossing scatters by noise alone; a shift adds its square, as the probe was turned about."""
    held_out = {0.0: [], 0.5: []}
    noise = []
    for _ in range(8):
        seen = observe(probe, *frames, rng)
        found = calibrate(seen, SIZE, NOISE)
        noise.append(found.noise_mm)
        for shift, values in held_out.items():
            moved = replace(probe, target_from_image=rigid.transform(np.eye(3), [0, shift, 0]) @ probe.target_from_image)
            values.append(point_calibration.held_out_mm(seen, found, moved, NOISE))
    level, true, off = (np.sqrt(np.mean(np.square(each))) for each in (noise, held_out[0.0], held_out[0.5]))
    assert true == pytest.approx(level, rel=0.05)
    assert np.sqrt(off**2 - true**2) == pytest.approx(0.5, rel=0.1)


@pytest.mark.slow
def test_poses_that_err_alike_for_a_while_count_as_fewer(probe, rng):
    """As of a magnetic tracker in a distorted field, by 0.2 mm for five frames each, of a probe that is led slowly: squared
    errors of the image's middle stay within 4 sigma of chi-square of 3, and errors are mostly not taken for a movement.
    """
    some = point_calibration.motion(SIZE, 17, roll_deg=60.0)
    turns, pixels = (moving_phantoms.led(each, 1.0)(np.linspace(0, 1, 80)) for each in some)
    squares, made = [], []
    for _ in range(12):
        seen = observe(probe, turns, pixels, rng)
        seen.poses[:, :3, 3] += np.repeat(0.2 * rng.standard_normal((16, 3)), 5, axis=0)
        made.append(calibrate(seen, SIZE, NOISE))
        off = made[-1].calibration.to_target(MIDDLE) - probe.to_target(MIDDLE)
        squares.append(off @ np.linalg.solve(point_calibration.point_covariance(made[-1].calibration, MIDDLE[None])[0], off))
    assert np.mean(squares) < 3 + 4 * np.sqrt(6 / 12)
    assert np.mean([each.persistence for each in made]) > 1.3
    assert np.mean([each.moved is not None for each in made]) <= 0.5
