"""A length measured on the board gives the scale: weighed with what is usual of prints, and as well known as it says."""

from dataclasses import replace

import numpy as np
import pytest

from recon.board_detection.kinds.asymmetric_circles import AsymmetricCircles
from recon.errors import InputError
from recon.model.calibration import with_scale
from recon.optical_calibration import joint_calibration, known_length, uncertainty
from recon.optical_calibration.joint_calibration import Settings
from tests.recon.board_sets import BOARD, devices, random_poses, sightings

PRINT, CALIPER_MM = 3e-4, 0.03
ENDS = known_length.longest(BOARD.points())


@pytest.fixture(scope="module")
def cameras(rig):
    return devices(rig)


def calibrated(cameras, released):
    """By 12 poses, of a board whose shape is found with them, or taken as designed."""
    rng = np.random.default_rng(12)
    seen = sightings(cameras, random_poses(cameras, 12, rng), rng)
    settings = Settings(distortion="decentred", shape={"released": released})
    return joint_calibration.calibrate(seen, BOARD, {name: camera.size for name, camera in cameras.items()}, settings)


@pytest.fixture(scope="module")
def result(cameras):
    return calibrated(cameras, released=True)


def baseline(result):
    """Distance of the cameras, mm, and the standard deviation of the scale of what they measure, by the result."""
    found = result.adjustment.calibration
    volume = uncertainty.working_volume(found, [620.0, 680.0])
    return np.linalg.norm(found.cameras["cam2"].centre), uncertainty.scale(found, "cam1", "cam2", volume)


def test_the_scale_is_as_well_known_as_it_says(result):
    """Of 100 boards printed larger by 3e-4 RMS, measured to 0.03 mm: the error over the predicted sigma, to 4 standard deviations
    of chi-square; images of a larger board, farther away, are the same."""
    rng = np.random.default_rng(5)
    was, _ = baseline(result)
    length = known_length.length_of(result.adjustment.points, ENDS)
    left = []
    for larger, noise in rng.standard_normal((100, 2)) * [PRINT, CALIPER_MM]:
        found, step = known_length.with_length(result, PRINT, (length * (1 + larger) + noise, CALIPER_MM), "board")
        now, sigma = baseline(found)
        assert now / was == pytest.approx(1 + step, abs=1e-12)
        assert found.adjustment.points == pytest.approx((1 + step) * result.adjustment.points)
        left.append((step - larger) / sigma)
    expected = PRINT * CALIPER_MM / length / np.hypot(PRINT, CALIPER_MM / length)
    assert sigma == pytest.approx(expected, rel=0.25), "a little more, by the noise of the images"
    assert abs(np.mean(np.square(left)) - 1) < 4 * np.sqrt(2 / 100)


def test_without_a_length_the_print_counts(result):
    """As it did: at least what is usual of prints."""
    found, step = known_length.with_length(result, None, None, "board")
    known = found.adjustment.calibration.uncertainty
    made = result.adjustment.calibration
    assert step == 0 and known.has_scale
    assert np.allclose(known.covariance, with_scale(made.uncertainty, made.cameras, PRINT).covariance)
    assert baseline(found)[1] == pytest.approx(PRINT, rel=0.1)


def test_a_well_known_scale_isnt_widened_again(result):
    """By a step that isn't told how well the board is printed; one that is told, widens it."""
    length = known_length.length_of(result.adjustment.points, ENDS)
    made = known_length.with_length(result, PRINT, (length, 0.005), "board")[0].adjustment.calibration
    assert with_scale(made.uncertainty, made.cameras, None) is made.uncertainty
    wider = replace(made, uncertainty=with_scale(made.uncertainty, made.cameras, PRINT))
    volume = uncertainty.working_volume(made, [620.0, 680.0])
    assert uncertainty.scale(made, "cam1", "cam2", volume) < 7e-5
    assert uncertainty.scale(wider, "cam1", "cam2", volume) == pytest.approx(PRINT, rel=0.1)


def test_a_length_of_another_board_is_refused(result):
    length = known_length.length_of(result.adjustment.points, ENDS)
    with pytest.raises(InputError, match=r"board_length_mm: expected .* found .*another board or line of points"):
        known_length.with_length(result, PRINT, (length + 6.0, CALIPER_MM), "board")
    known_length.with_length(result, 0.02, (length + 6.0, CALIPER_MM), "board")


def test_a_length_that_cannot_tell_the_scale_is_refused(cameras, result):
    """Of a board that is taken as designed, whose description has its lengths; and beside a scale that is exact."""
    with pytest.raises(
        InputError, match="board_length_mm: expected a board whose shape is found beside it, found none; a board as"
    ):
        known_length.with_length(calibrated(cameras, released=False), PRINT, (100.0, CALIPER_MM), "board")
    tolerances = replace(result.tolerances, print_mm=0.0, stretch_mm=0.0)
    with pytest.raises(InputError, match="board_length_mm: expected a board_scale above 0"):
        known_length.with_length(replace(result, tolerances=tolerances), 0.0, (100.0, CALIPER_MM), "board")


def test_the_longest_line_is_a_row_or_a_column():
    """Of 4 x 11 discs a column: of each second row, so that it has six."""
    design = AsymmetricCircles(columns=4, rows=11, spacing_mm=15, diameter_mm=9).points()
    assert known_length.length_of(design, known_length.longest(design)) == pytest.approx(150)
    assert known_length.length_of(design[:, [1, 0, 2]], known_length.longest(design[:, [1, 0, 2]])) == pytest.approx(150)


def test_the_way_to_a_better_scale_is_the_cheapest_that_is_worth_while():
    assert "caliper" in known_length.describe(3e-4, 150.0) and "200" in known_length.describe(3e-4, 150.0)
    assert "microscope" in known_length.describe(3e-4) and "glass" in known_length.describe(4e-5)
    assert known_length.describe(1e-5) == "scale       known to 10 ppm"
