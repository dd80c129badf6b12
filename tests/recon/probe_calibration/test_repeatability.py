"""CR1 and CR2 are the distances that they are named after, and rotations are averaged as rotations."""

import numpy as np
import pytest

from recon.geometry import rigid
from recon.model.probe import ProbeCalibration
from recon.probe_calibration import repeatability


def shifted(*x):
    """Calibrations that differ by shifts along the target's x, in mm."""
    return [ProbeCalibration(rigid.transform(np.eye(3), [each, 0, 0]), np.array([0.1, 0.1])) for each in x]


def test_distances_of_three_in_a_row():
    """0, 3 and 6 mm: pairs are 3, 3 and 6 apart, and 3, 0 and 3 from the mean."""
    made = shifted(0, 3, 6)
    assert repeatability.cr1(made, [[7, 9]]) == pytest.approx([4])
    assert repeatability.cr2(made, [[7, 9]]) == pytest.approx([2])


def test_a_difference_of_scale_grows_from_the_origin():
    made = [ProbeCalibration(np.eye(4), np.array([s, 0.1])) for s in (0.10, 0.11)]
    assert repeatability.cr1(made, [[0, 50], [100, 50]]) == pytest.approx([0, 1])


def test_opposite_turns_average_to_none():
    """Mean of the matrices would shrink; the mean rotation doesn't."""
    made = [ProbeCalibration(rigid.from_rotation_vector([0, 0, angle], [1, 2, 3]), np.array([0.1, 0.2])) for angle in (-0.8, 0.8)]
    assert repeatability.average(made).target_from_image == pytest.approx(rigid.transform(np.eye(3), [1, 2, 3]))


def test_turns_on_both_sides_of_half_a_circle_average_there():
    """Rotation vectors of 3.0 and -3.0 rad would average to none."""
    made = [ProbeCalibration(rigid.from_rotation_vector([0, 0, angle], [0, 0, 0]), np.array([0.1, 0.2])) for angle in (-3.0, 3.0)]
    assert repeatability.average(made).target_from_image == pytest.approx(np.diag([-1.0, -1, 1, 1]))
