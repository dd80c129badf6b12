"""CR1 and CR2 are the distances that they are named after, rotations are averaged as such, and the mean is as sure as it says."""

import numpy as np
import pytest
from scipy import stats

from recon.geometry import rigid
from recon.model.calibration import Uncertainty
from recon.model.probe import NAMES, ProbeCalibration
from recon.probe_calibration import point_calibration, repeatability

TRUTH = ProbeCalibration(rigid.from_rotation_vector([0.3, -1.2, 0.4], [20.0, -15.0, 60.0]), np.array([0.1229, 0.1184]))
SIGMAS = np.array([2e-4, 3e-4, 2e-3, 1e-3, 3e-3, 0.05, 0.08, 0.11])  # of NAMES
POINTS = repeatability.five_points((321, 408))
X = NAMES.index("tx")


def claiming(calibration, sigmas):
    return ProbeCalibration(
        calibration.target_from_image, calibration.scale, Uncertainty(NAMES, np.diag(np.square(sigmas))), 1488.0, 12.0
    )


def drawn(rng, count, excess=None):
    """Calibrations with errors as they claim, and errors of a covariance beyond that."""
    steps = SIGMAS * rng.standard_normal((count, 8))
    if excess is not None:
        steps += excess * rng.standard_normal((count, 8))
    return [claiming(repeatability.after(TRUTH, step), SIGMAS) for step in steps]


def along_x(x, sigma):
    """A calibration off by some mm along the target's x."""
    sigmas = SIGMAS.copy()
    sigmas[X] = sigma
    return claiming(repeatability.after(TRUTH, x * (np.arange(8) == X)), sigmas)


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


def test_figures_stand_at_the_papers_places():
    expected = {"centre": 1.0, "corner": 10.0, "corners": 4.75, "mean": 4.0}
    assert repeatability.at_places(np.array([1.0, 2, 3, 4, 10])) == expected


def test_the_expected_repeatability_is_that_of_drawn_calibrations(rng):
    """Means of 200 sets of five, each calibration drawn by the covariance that it claims; they are known to 2 %."""
    sets = [drawn(rng, 5) for _ in range(200)]
    covariances = np.stack([point_calibration.point_covariance(one, POINTS) for one in sets[0]])
    for measure, expect in (
        (repeatability.cr1, repeatability.expected_cr1),
        (repeatability.cr2, repeatability.expected_cr2),
    ):
        found = np.mean([measure(each, POINTS) for each in sets], axis=0)
        assert found == pytest.approx(expect(covariances), rel=0.06)


def test_the_surer_run_weighs_more():
    """Of 0.1 and 0.2 mm as standard deviations the weights are 4 and 1, where both agree within these."""
    found = repeatability.mean([along_x(0.0, 0.1), along_x(0.1, 0.2)])
    assert repeatability.step_between(TRUTH, found.calibration)[X] == pytest.approx(0.02)
    assert found.calibration.uncertainty.sigma("tx") == pytest.approx((0.1**-2 + 0.2**-2) ** -0.5)
    assert (found.calibration.speed_m_s, found.calibration.face_row) == (1488.0, 12.0)
    assert found.chi_square == pytest.approx(0.1**2 / (0.1**2 + 0.2**2)) and found.freedom == 8


def test_scatter_beyond_the_covariances_is_in_the_means():
    """Two runs 1 mm apart that claim 0.1 mm: half of 1 mm by one difference, wider by Student's factor for one."""
    found = repeatability.mean([along_x(0.0, 0.1), along_x(1.0, 0.1)])
    excess = (1.0 / 2 - 0.1**2) * stats.t.ppf(stats.norm.cdf(1), 1) ** 2
    assert found.calibration.uncertainty.sigma("tx") == pytest.approx(np.sqrt((0.1**2 + excess) / 2))
    assert found.calibration.uncertainty.sigma("ty") == pytest.approx(SIGMAS[NAMES.index("ty")] / np.sqrt(2))
    assert found.chi_square == pytest.approx(1 / (2 * 0.1**2)) and found.chance < 1e-6


def test_chi_square_is_that_of_the_runs(rng):
    """Of 200 sets that scatter as they claim: the mean is the degrees of freedom, the chance is even."""
    found = [repeatability.mean(drawn(rng, 4)) for _ in range(200)]
    assert np.mean([one.chi_square for one in found]) == pytest.approx(24, abs=4 * np.sqrt(2 * 24 / 200))
    assert stats.kstest([one.chance for one in found], "uniform").pvalue > 1e-3


@pytest.mark.parametrize("count", [2, 5])
@pytest.mark.parametrize("excess", [0.0, 3.0, 30.0])
def test_the_means_standard_deviation_covers_its_error(rng, count, excess):
    """One holds 68 % and two 95 %, on whatever the scatter is beyond the covariances: of a bracket that is put on anew, here.

    Too large is allowed for, by the little that is known of scatter from few runs; too small isn't, but for two runs' tails.
    """
    inside = []
    for _ in range(300):
        made = drawn(rng, count, excess * SIGMAS * (np.arange(8) >= X))
        found = repeatability.mean(made).calibration
        away = repeatability.step_between(TRUTH, found) / np.sqrt(np.diag(found.uncertainty.covariance))
        inside.append(np.abs(away[X:, None]) < [1, 2])
    one, two = np.mean(inside, axis=(0, 1))
    assert 0.64 < one < 0.90 and two > (0.78 if count == 2 else 0.89)


def test_what_errs_alike_in_all_runs_does_not_average_out(rng):
    """The echo of one wire of unknown radius: its 0.1 mm stay in the mean of a hundred runs, and their scatter lacks them."""
    alike = np.tile(0.1 * (np.arange(8) == X), (100, 1, 1))
    off = 0.1 * rng.standard_normal()
    own = [repeatability.after(one, off * (np.arange(8) == X)) for one in drawn(rng, 100)]
    made = [claiming(one, np.hypot(SIGMAS, 0.1 * (np.arange(8) == X))) for one in own]
    found = repeatability.mean(made, alike)
    assert found.calibration.uncertainty.sigma("tx") == pytest.approx(0.1, rel=0.05)
    assert 1e-3 < found.chance < 1 - 1e-3, "judged by what is each run's own"
    assert repeatability.mean(made).chance > 0.99, "and as too good by all"


def test_a_run_that_is_off_is_found_by_the_others(rng):
    made = drawn(rng, 5)
    made[3] = claiming(repeatability.after(made[3], 1.0 * (np.arange(8) == X)), SIGMAS)
    chances = [chance for _, chance in repeatability.against_others(made)]
    assert chances[3] < 1e-6 and min(chances[:3]) > 100 * chances[3]


def test_runs_without_covariances_have_their_scatter_alone():
    made = shifted(0, 3, 6)
    found = repeatability.mean(made)
    assert repeatability.step_between(made[1], found.calibration) == pytest.approx(np.zeros(8), abs=1e-12)
    factor = stats.t.ppf(stats.norm.cdf(1), 2)
    assert found.calibration.uncertainty.sigma("tx") == pytest.approx(factor * 3 / np.sqrt(3))
    assert np.isnan([found.chi_square, *(chance for _, chance in repeatability.against_others(made))]).all()
