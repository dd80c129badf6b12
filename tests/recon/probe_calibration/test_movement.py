"""A bracket that gives and wires that slip are found, named and measured, and what they leave open is in the covariance."""

import numpy as np
import pytest

from recon.errors import InputError
from recon.geometry import rigid
from recon.probe_calibration import movement, point_calibration
from recon.probe_calibration.point_calibration import Noise, Sightings
from tests.recon import probe_motions

NOISE = Noise(probe_motions.ANGLE_DEG, probe_motions.POSITION_MM, probe_motions.PIXEL_PX, probe_motions.SLICE_MM)
DRAWS = 16  # means of squared errors over the 8 expected have a standard deviation of 0.125
STILL = np.zeros(6), np.zeros(3)


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


@pytest.mark.parametrize(("after", "slips_mm"), [(0.5, 0.5), (0.7, 0.8), (0.8, 1.2)])
def test_a_bracket_that_slips_all_at_once_is_found_though_its_frames_look_like_outliers(rig, after, slips_mm):
    """The later frames are as right as the earlier ones, and where they have the probe is where the sweep will find it."""
    probe, errors = probe_motions.true_probe(rig), []

    def slips(rng):
        return np.concatenate([sideways(rng, np.radians(0.3 * slips_mm)), sideways(rng, slips_mm / 2)]), np.zeros(3)

    sure = []
    for found, at_the_end, *_ in calibrations(rig, range(12), slips, after):
        sure.append(found.moved is not None)
        errors.append(squared(found, probe, at_the_end))
    assert np.mean(sure) > 0.85 and np.median(errors) / 8 < 1.6


def test_a_bracket_that_slips_by_millimetres_is_refused_by_name(rig):
    """Where it stays afterwards isn't known to a millimetre, however many frames there are."""

    def slips(rng):
        return np.concatenate([sideways(rng, np.radians(0.9)), sideways(rng, 1.5)]), np.zeros(3)

    for seed in range(4):
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
