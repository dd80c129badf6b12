"""A bracket that gives and wires that slip are found, named and measured, and what they leave open is in the covariance."""

import numpy as np
import pytest

from recon.errors import InputError
from recon.geometry import rigid
from recon.probe_calibration import movement, point_calibration
from recon.probe_calibration.movement import FrameEquations
from recon.probe_calibration.point_calibration import Noise, Sightings
from tests.recon import probe_motions

NOISE = Noise(probe_motions.ANGLE_DEG, probe_motions.POSITION_MM, probe_motions.PIXEL_PX, probe_motions.SLICE_MM)
DRAWS = 8  # means of squared errors over the 8 expected have a standard deviation of 0.18
STILL = np.zeros(6), np.zeros(3)
FRAMES, UNKNOWNS, BY_PROBE, BY_WIRES = 12, 11, slice(2, 8), slice(8, 11)
WEIGHTS = np.array([300.0, 300.0, 500.0, 500.0, 500.0, *np.full(6, 5.0)])  # of slopes: a pixel, a rad and a mm over 0.2 mm
SESSIONS = 300
ALL = np.ones(FRAMES, bool)


def calibrations(rig, seeds, grows, after=None):
    """Calibrations, each with the true pose of the probe at the end, and the growth of this and of the wires' place.

    It grows evenly, or all at once after a share of the frames.
    """
    probe, size = probe_motions.true_probe(rig), rig.probe.image_size
    for seed in seeds:
        rng = np.random.default_rng([seed, 5])
        seen = probe_motions.observe(probe, *probe_motions.motion(rig, 90.0), rng)
        by_probe, by_wires = grows(rng)
        poses = []
        times = np.linspace(-1, 1, len(seen.poses))
        for time, pose in zip(times if after is None else np.sign(times - 2 * after + 1), seen.poses, strict=True):
            given = rigid.moved(probe.target_from_image, time * by_probe)
            poses.append(pose @ probe.target_from_image @ rigid.invert(given))
            poses[-1][:3, 3] += time * by_wires
        found = point_calibration.calibrate(Sightings(np.array(poses), seen.pixels), size, NOISE)
        yield found, rigid.moved(probe.target_from_image, by_probe), by_probe, by_wires


def squared(found, probe, target_from_image):
    """Squared error of the eight parameters over their covariance; 8 are expected."""
    error = np.concatenate([probe.scale - found.calibration.scale,
                            rigid.difference(found.calibration.target_from_image, target_from_image)])  # fmt: skip
    return error @ np.linalg.solve(found.calibration.uncertainty.covariance, error)


def sideways(rng, length):
    way = rng.standard_normal(3)
    return length * way / np.linalg.norm(way)


def test_nothing_moves_where_there_is_but_noise(rig):
    """None is found, and those that can't be excluded widen the covariance but little."""
    probe, errors = probe_motions.true_probe(rig), []
    for found, at_the_end, *_ in calibrations(rig, range(DRAWS), lambda rng: STILL):
        assert found.moved is None
        errors.append(squared(found, probe, at_the_end))
    assert 0.6 < np.mean(errors) / 8 < 1.25


@pytest.mark.parametrize("gives_mm", [0.12, 0.25])
def test_a_bracket_that_gives_too_little_to_be_found_is_in_the_covariance(rig, gives_mm):
    """With 0.6 deg a mm, by which a rigid bracket would make squared errors at the end larger than predicted."""
    probe, errors, named = probe_motions.true_probe(rig), [], []

    def gives(rng):
        return np.concatenate([sideways(rng, np.radians(0.3 * gives_mm)), sideways(rng, gives_mm / 2)]), np.zeros(3)

    for found, at_the_end, *_ in calibrations(rig, range(DRAWS), gives):
        named.append(found.moved is not None)
        errors.append([squared(found, probe, pose) for pose in (probe.target_from_image, at_the_end)])
    middle, end = np.mean(errors, axis=0) / 8
    assert np.mean(named) < 0.5
    assert middle < 1.25 and 0.6 < end < 1.4


def test_a_bracket_that_gives_is_found_and_in_the_covariance(rig):
    """By 1 mm and 0.6 deg from the first frame to the last, in any direction; where it ends is where the sweep will find it."""
    probe, errors, shifts = probe_motions.true_probe(rig), [], []

    def gives(rng):
        return np.concatenate([sideways(rng, np.radians(0.3)), sideways(rng, 0.5)]), np.zeros(3)

    for found, at_the_end, *_ in calibrations(rig, range(DRAWS), gives):
        assert found.moved is not None and found.moved.what == movement.PROBE
        errors.append([squared(found, probe, pose) for pose in (probe.target_from_image, at_the_end)])
        shifts.append(found.moved.shift_mm)
    middle, end = np.mean(errors, axis=0) / 8
    assert middle < 1.25 and end < 1.25 and end > 0.3
    assert np.median(shifts) == pytest.approx(1.0, rel=0.3)


@pytest.mark.parametrize(("after", "slips_mm"), [(0.5, 0.5), (0.8, 1.2)])
def test_a_bracket_that_slips_all_at_once_is_found_though_its_frames_look_like_outliers(rig, after, slips_mm):
    """The later frames are as right as the earlier ones, and where they have the probe is where the sweep will find it."""
    probe, errors = probe_motions.true_probe(rig), []

    def slips(rng):
        return np.concatenate([sideways(rng, np.radians(0.3 * slips_mm)), sideways(rng, slips_mm / 2)]), np.zeros(3)

    sure = []
    for found, at_the_end, *_ in calibrations(rig, range(7), slips, after):
        sure.append(found.moved is not None)
        errors.append(squared(found, probe, at_the_end))
    assert np.mean(sure) > 0.85 and np.median(errors) / 8 < 1.6


def test_a_bracket_that_slips_by_millimetres_is_refused_by_name(rig):
    """Where it stays afterwards isn't known to a millimetre, however many frames there are."""

    def slips(rng):
        return np.concatenate([sideways(rng, np.radians(0.9)), sideways(rng, 1.5)]), np.zeros(3)

    for seed in range(2):
        with pytest.raises(InputError, match="the probe moved against its target"):
            list(calibrations(rig, [seed], slips, 0.7))


def test_wires_that_slip_are_found_and_do_no_harm(rig):
    """By 0.8 mm; without that the errors would be several times what is predicted."""
    probe, errors = probe_motions.true_probe(rig), []
    for found, *_, by_wires in calibrations(rig, range(DRAWS), lambda rng: (np.zeros(6), sideways(rng, 0.4))):
        assert found.moved is not None and found.moved.what == movement.WIRES and found.moved.turn_deg == 0
        assert np.linalg.norm(found.moved.growth - by_wires) < 0.25
        errors.append(squared(found, probe, probe.target_from_image))
    assert 0.6 < np.mean(errors) / 8 < 1.3


def test_the_wires_radius_is_uncertain_along_the_depth(rig, rng):
    """Of 0.05 mm, common to all frames: more frames don't average it away."""
    probe, size = probe_motions.true_probe(rig), rig.probe.image_size
    seen = probe_motions.observe(probe, *probe_motions.motion(rig), rng)
    exact, open_ = (point_calibration.calibrate(seen, size, NOISE, ahead_sigma_mm=sigma) for sigma in (0.0, 0.05))
    added = open_.calibration.uncertainty.covariance - exact.calibration.uncertainty.covariance
    depth = np.concatenate([np.zeros(5), open_.calibration.target_from_image[:3, 1]])
    np.testing.assert_allclose(added, 0.05**2 * np.outer(depth, depth), atol=1e-9)


def at_solution(slopes, left):
    """Equations at the least squares of residuals left : (n, 3), and the step that led there."""
    flat = slopes.reshape(-1, UNKNOWNS)
    step = -np.linalg.lstsq(flat, left.ravel())[0]
    return FrameEquations(slopes, left + slopes @ step, BY_PROBE, BY_WIRES, np.zeros(UNKNOWNS)), step


def drawn(rng, noise):
    """Residuals of the true parameters of the middle, their slopes, and half the movement of the parameters to the end."""
    slopes = WEIGHTS * rng.standard_normal((FRAMES, 3, UNKNOWNS))
    kind = rng.choice(3, p=[movement.STILL, movement.GIVES, movement.SLIP])
    step = np.zeros(UNKNOWNS)
    if kind == 1:
        step[BY_PROBE] = noise * rng.choice(movement.SIZES) * movement.PROPORTIONS @ rng.standard_normal(6)
    if kind == 2:
        step[BY_WIRES] = noise * rng.choice(movement.SIZES) * rng.standard_normal(3)
    after = np.arange(FRAMES) >= rng.integers(1, FRAMES)
    course = np.linspace(-1, 1, FRAMES) if rng.random() < movement.EVEN else np.where(after, 1.0, -1.0)
    return slopes, noise * rng.standard_normal((FRAMES, 3)) - course[:, None] * (slopes @ step), step


@pytest.mark.parametrize("noise", [0.5, 2.0])
def test_squared_errors_at_both_ends_are_those_predicted(rng, noise):
    """Of the probe and of the scales, over movements drawn as assumed: 8 by definition, known to 0.2 by so many draws."""
    squared, rigid = [], []
    for _ in range(SESSIONS):
        slopes, left, growth = drawn(rng, noise)
        equations, back = at_solution(slopes, left)
        step, covariance = movement.average(equations, ALL, ALL)
        flat, rest = slopes.reshape(-1, UNKNOWNS), np.sum(equations.residuals**2)
        still = np.linalg.inv(flat.T @ flat)[:8, :8] * rest / (3 * FRAMES - UNKNOWNS)
        for end in (-growth, growth):
            error = (end - back - step)[:8]
            squared.append(error @ np.linalg.solve(covariance[:8, :8], error))
            rigid.append((end - back)[:8] @ np.linalg.solve(still, (end - back)[:8]))
    assert np.mean(squared) == pytest.approx(8, abs=5 * np.std(squared) / np.sqrt(2 * SESSIONS))
    assert 6.5 < np.mean(squared) < 9.5 and np.mean(rigid) > 20


def test_frames_that_turn_out_to_be_right_count_as_if_they_had_been_used(rng):
    """The last four of twelve, outliers to a rigid bracket: added later or adjusted with the others, the outcome is the same."""
    slopes, left, _ = drawn(rng, 1.0)
    used = np.arange(FRAMES) < 8
    back = -np.linalg.lstsq(slopes[used].reshape(-1, UNKNOWNS), left[used].ravel())[0]
    known = np.zeros(UNKNOWNS)
    step, covariance = movement.average(FrameEquations(slopes, left + slopes @ back, BY_PROBE, BY_WIRES, known), used, ALL)
    together, back_together = at_solution(slopes, left)
    expected, same = movement.average(together, ALL, ALL)
    np.testing.assert_allclose(back + step, back_together + expected, atol=1e-9)
    np.testing.assert_allclose(covariance, same, rtol=1e-6, atol=1e-12)


def test_a_movement_is_found_by_two_residuals_a_frame(rng):
    """As a wall's line has, of frames that are no multiple of three."""
    count = 20
    slopes = WEIGHTS * rng.standard_normal((count, 2, UNKNOWNS))
    growth = np.zeros(UNKNOWNS)
    growth[BY_PROBE] = movement.PROPORTIONS @ rng.standard_normal(6)
    noise, course = rng.standard_normal((count, 2)), np.linspace(-1, 1, count)[:, None]
    found = []
    for left in (noise, noise - course * (slopes @ growth)):
        flat = slopes.reshape(-1, UNKNOWNS)
        step = -np.linalg.lstsq(flat, left.ravel())[0]
        equations = FrameEquations(slopes, left + slopes @ step, BY_PROBE, BY_WIRES, np.zeros(UNKNOWNS))
        found.append(movement.find(equations, np.ones(count, bool)))
    still, moved = found
    assert still is None and moved.what == movement.PROBE
    np.testing.assert_allclose(moved.growth, growth[BY_PROBE], atol=0.3 * np.abs(growth).max())
    assert moved.alike == 1
