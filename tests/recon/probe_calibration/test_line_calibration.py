"""Is a calibration by N-wires right, as sure as it says, and is each mistake named?"""

from dataclasses import replace

import numpy as np
import pytest

from recon.errors import InputError
from recon.geometry import rigid
from recon.probe_calibration import line_calibration, point_calibration, repeatability
from recon.probe_calibration.line_calibration import DotSightings, Registration, Wires
from recon.probe_calibration.point_calibration import Noise
from tests.recon import bscans, wire_rows
from tests.recon.probe_motions import foreign_probe, true_probe
from tests.recon.wire_rows import FCAL, WORLD_FROM_PHANTOM

SIZE = bscans.SIZE
POINTS = repeatability.five_points(SIZE)
NOISE = Noise(wire_rows.ANGLE_DEG, wire_rows.POSITION_MM, wire_rows.PIXEL_PX, 0.0)
EXACT = Wires(FCAL, place_sigma_mm=1e-3)


@pytest.fixture
def probe(rig):
    return true_probe(rig)


@pytest.fixture
def poses(probe, rng):
    return wire_rows.poses_over(probe, FCAL, SIZE, rng)


def errors(found, probe, points=POINTS):
    """Distances (5,) mm of the five points from where they are."""
    return np.linalg.norm(found.calibration.to_target(points) - probe.to_target(points), axis=1)


def calibrate(sightings, wires=EXACT, **more):
    return line_calibration.calibrate(sightings, wires, SIZE, NOISE, **more)


@pytest.mark.parametrize("rows", [1, 2, 3])
def test_without_noise_the_calibration_is_the_truth(rows, probe, rng):
    """Of one N-wire too, whose middle dots lie in one plane."""
    phantom = replace(FCAL, ends=FCAL.ends[:rows], names=())
    poses = wire_rows.poses_over(probe, phantom, SIZE, rng)
    found = calibrate(wire_rows.observe(probe, phantom, poses, rng, noise=0.0), Wires(phantom, 1e-3))
    assert errors(found, probe).max() < 1e-5
    assert rigid.difference(WORLD_FROM_PHANTOM, found.world_from_phantom) == pytest.approx(np.zeros(6), abs=1e-5)
    assert found.size[0] == pytest.approx(1, abs=1e-6)


def test_any_bracket_and_scanner_will_do(rng):
    size, probe = foreign_probe(rng)
    probe = replace(probe, scale=42.0 / size[0] * np.ones(2))
    poses = wire_rows.poses_over(probe, FCAL, size, rng)
    found = line_calibration.calibrate(wire_rows.observe(probe, FCAL, poses, rng), EXACT, size, NOISE)
    assert errors(found, probe, repeatability.five_points(size)).max() < 0.6


@pytest.mark.slow
@pytest.mark.parametrize("registered", [False, True])
def test_errors_are_as_predicted(registered, probe, rng):
    """Places of pixels over 15 calibrations, with wires beside their places: chi-square of 3, its mean within 4 sigma of 3."""
    squares = []
    for _ in range(15):
        poses = wire_rows.poses_over(probe, FCAL, SIZE, rng)
        beside = 0.1 * rng.standard_normal((9, 3))
        registration = None
        if registered:
            step = rng.standard_normal(6) * np.array([0.5 / line_calibration.ARM_MM] * 3 + [0.5] * 3)
            registration = Registration(rigid.moved(WORLD_FROM_PHANTOM, step), 0.5)
        found = calibrate(wire_rows.observe(probe, FCAL, poses, rng, beside), Wires(FCAL, 0.1, registration))
        away = found.calibration.to_target(POINTS[:1]) - probe.to_target(POINTS[:1])
        covariance = point_calibration.point_covariance(found.calibration, POINTS[:1])
        squares.append(away[0] @ np.linalg.solve(covariance[0], away[0]))
        assert 0.8 < found.noise_factor < 1.25
    assert abs(np.mean(squares) - 3) < 4 * np.sqrt(6 / 15)


def test_wrong_dots_are_left_out(probe, poses, rng):
    """A tenth of the dots at other echoes: the error stays that of the others."""
    sightings = wire_rows.observe(probe, FCAL, poses, rng)
    pixels = sightings.pixels.copy()
    wrong = rng.random(pixels.shape[:3]) < 0.1
    pixels[wrong] += rng.choice([-1, 1], (wrong.sum(), 2)) * rng.uniform(10, 40, (wrong.sum(), 2))
    found = calibrate(replace(sightings, pixels=pixels))
    assert not (found.inliers & wrong[:, 0]).any()
    assert found.inliers.mean() > 0.85
    assert errors(found, probe).max() < 0.5


def test_of_arrangements_that_look_alike_the_right_one_is_taken(probe, rng):
    """Two N-wires of one width, whose diagonals differ: seen from the left as from the right, but for the probe's motion."""
    ends = FCAL.ends[:2].copy()
    ends[1, 1] = [[50, 0, 10], [33, 40, 10]]
    phantom = replace(FCAL, ends=ends, names=())
    poses = wire_rows.poses_over(probe, phantom, SIZE, rng)
    seen = wire_rows.observe(probe, phantom, poses, rng)
    right = seen.pixels[:, 0]
    mirrored = right.reshape(-1, 2, 3, 2)[:, :, ::-1].reshape(right.shape)
    order = rng.random(len(right)) < 0.5
    both = np.stack([np.where(order[:, None, None], right, mirrored), np.where(order[:, None, None], mirrored, right)], axis=1)
    covariance = np.repeat(seen.pixel_covariance, 2, axis=1)
    found = calibrate(DotSightings(seen.poses, both, covariance), Wires(phantom, 1e-3))
    assert errors(found, probe).max() < 0.6


def test_a_diagonal_that_runs_the_other_way_is_told(probe, poses, rng):
    """Its neighbours say so, and the calibration is theirs."""
    found = calibrate(wire_rows.observe(probe, FCAL, poses, rng), Wires(FCAL.restrung([1]), 0.1))
    assert "dots of wire 2b lie elsewhere: is it strung as defined?" in next(found.doubts())
    assert errors(found, probe).max() < 0.5


def test_a_phantom_of_another_size_is_named(probe, poses, rng):
    """No single image shows that either, as scales are unknown."""
    smaller = replace(FCAL, ends=0.95 * FCAL.ends)
    with pytest.raises(InputError, match=r"found it \+[45]\.\d ± .* larger: another phantom"):
        calibrate(wire_rows.observe(probe, FCAL, poses, rng), Wires(smaller, 1e-3))


@pytest.mark.parametrize(("flip", "said"), [
    ((-1, 1), "the image is mirrored left to right"),
    ((1, -1), "the image is upside down"),
    ((-1, -1), "the image is upside down and mirrored"),
])  # fmt: skip
def test_images_that_are_turned_are_named(flip, said, probe, poses, rng):
    sightings = wire_rows.observe(probe, FCAL, poses, rng)
    turned = np.where(np.array(flip) < 0, np.array(SIZE) - 1 - sightings.pixels, sightings.pixels)
    with pytest.raises(InputError, match=f"as if {said};"):
        calibrate(replace(sightings, pixels=turned), expected=probe.target_from_image)


def test_a_lag_is_measured(probe, rng):
    """Of a probe in motion, whose B-scans are 60 ms late: told within 4 sigma, and nothing of B-scans that aren't."""
    poses, lag_s = wire_rows.poses_over(probe, FCAL, SIZE, rng), 0.06
    rates = np.zeros_like(poses)
    for k, pose in enumerate(poses):
        turn, shift = rng.standard_normal(3) * 0.05, rng.standard_normal(3) * 10
        rates[k, :3, :3], rates[k, :3, 3] = rigid.cross(turn) @ pose[:3, :3], shift
    sightings = replace(wire_rows.observe(probe, FCAL, poses, rng), pose_rates=rates)
    assert not list(calibrate(sightings).doubts())
    late = calibrate(replace(sightings, poses=_moved(sightings.poses, rates, lag_s)))
    assert abs(late.late.seconds - lag_s) < 4 * late.late.sigma_s < lag_s
    assert "late by" in next(late.doubts())


def _moved(poses, rates, lag_s):
    later = poses.copy()
    for pose, rate in zip(later, rates, strict=True):
        turn = rate[:3, :3] @ pose[:3, :3].T * lag_s
        pose[:3, :3] = rigid.from_rotation_vector([turn[2, 1], turn[0, 2], turn[1, 0]], np.zeros(3))[:3, :3] @ pose[:3, :3]
        pose[:3, 3] += rate[:3, 3] * lag_s
    return later


def slipped(probe, poses, half):
    """Poses of a target against which the probe moves by a step : (6,) both ways of its middle, after two fifths of them."""
    growth = np.where(np.arange(len(poses)) < 2 * len(poses) // 5, -1, 1)
    moved = [rigid.moved(probe.target_from_image, each * half) for each in growth]
    return np.array([pose @ probe.target_from_image @ rigid.invert(own) for pose, own in zip(poses, moved, strict=True)])


def test_a_slip_of_the_bracket_is_told_and_counts(probe, poses, rng):
    """By 0.6 deg and 0.6 mm: a warning with its size, and the calibration of either end is within its uncertainty."""
    sightings = wire_rows.observe(probe, FCAL, poses, rng)
    assert calibrate(sightings).moved is None
    half = np.array([*np.radians([0.3, 0, 0]), 0, 0.3, 0])
    found = calibrate(replace(sightings, poses=slipped(probe, sightings.poses, half)))
    assert found.moved.what == "probe"
    assert found.moved.growth == pytest.approx(half, abs=0.15), "rad and mm, to some 3 sigma"
    (said,) = found.doubts()
    assert "the probe moved against its target by 0." in said and "a bracket that gives or slips" in said
    for end in (-half, half):
        other = replace(probe, target_from_image=rigid.moved(probe.target_from_image, end))
        away = found.calibration.to_target(POINTS[:1]) - other.to_target(POINTS[:1])
        assert away[0] @ np.linalg.solve(point_calibration.point_covariance(found.calibration, POINTS[:1])[0], away[0]) < 14.2


def test_poses_that_err_alike_for_a_while_are_no_slip(probe, rng):
    """As of a magnetic tracker in a distorted field, by 0.2 mm for five frames each: no movement, but a wider covariance."""
    poses = wire_rows.poses_over(probe, FCAL, SIZE, rng, count=60)
    sightings = wire_rows.observe(probe, FCAL, poses, rng)
    wrong = sightings.poses.copy()
    wrong[:, :3, 3] += np.repeat(0.2 * rng.standard_normal((12, 3)), 5, axis=0)
    right, found = calibrate(sightings), calibrate(replace(sightings, poses=wrong))
    assert found.moved is None
    sigmas = [each.calibration.uncertainty.sigma("tx") for each in (right, found)]
    assert sigmas[1] > 1.2 * found.noise_factor / right.noise_factor * sigmas[0]


def test_a_registration_of_before_the_phantom_was_moved_is_noticed(probe, poses, rng):
    moved = Registration(rigid.moved(WORLD_FROM_PHANTOM, np.array([0, 0, 0.1, 5.0, -3, 0])), 0.5)
    found = calibrate(wire_rows.observe(probe, FCAL, poses, rng), Wires(FCAL, 0.1, moved))
    assert any("from its registration" in doubt for doubt in found.doubts())


def test_a_motion_about_one_axis_needs_a_registration(probe, rng):
    poses = wire_rows.poses_over(probe, FCAL, SIZE, rng, turn_deg=0.0)
    sightings = wire_rows.observe(probe, FCAL, poses, rng)
    with pytest.raises(InputError, match="motion: expected turns of the probe about two axes"):
        calibrate(sightings)
    found = calibrate(sightings, Wires(FCAL, 0.1, Registration(WORLD_FROM_PHANTOM, 0.2)))
    assert errors(found, probe).max() < 1.0


def test_held_out_errors_are_those_of_an_earlier_calibration_too(probe, poses, rng):
    """Of the truth as of ours; more of one that is 2 mm off, where the phantom's place is known."""
    wires = Wires(FCAL, 1e-3, Registration(WORLD_FROM_PHANTOM, 0.05))
    sightings = wire_rows.observe(probe, FCAL, poses, rng)
    matrix = probe.target_from_image @ np.diag([*probe.scale, 1, 1])
    true = calibrate(sightings, wires, earlier=matrix)
    assert true.earlier_held_out_mm == pytest.approx(true.held_out_mm, rel=0.1)
    matrix[0, 3] += 2.0
    assert calibrate(sightings, wires, earlier=matrix).earlier_held_out_mm > 1.0
