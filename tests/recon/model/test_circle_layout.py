"""Lengths, their covariance and bow of the target against points drawn and boards bent."""

import numpy as np
import pytest
from pydantic import ValidationError

from recon.model import circle_layout
from recon.model.rig import Target


def lengths_of(points):
    """c1, c2 aside and c2 of three places : (n, 3, 2) mm, by plane geometry."""
    x, side = points[:, 1] - points[:, 0], points[:, 2] - points[:, 0]
    c1 = np.linalg.norm(x, axis=1)
    return np.column_stack([c1, np.sum(x * side, axis=1) / c1, (x[:, 0] * side[:, 1] - x[:, 1] * side[:, 0]) / c1])


@pytest.mark.parametrize("aside", [0.0, 7.0])
def test_the_covariance_is_that_of_circles_off_their_places(rig, rng, aside):
    """20000 draws: each variance within 4 standard errors, correlations too."""
    target = rig.target.model_copy(update={"c2_aside_mm": aside, "tolerance_mm": 0.05})
    places = circle_layout.circle_centres(target)[:, :2] + 0.05 * rng.standard_normal((20_000, 3, 2))
    drawn = np.cov(lengths_of(places).T)
    expected = circle_layout.length_covariance(target)
    sigma = np.sqrt(np.diag(expected))
    assert np.abs((drawn - expected) / np.outer(sigma, sigma)).max() < 4 * np.sqrt(2 / 20_000)


def test_deviations_have_the_covariance(rig):
    by_deviation = circle_layout.deviations(rig.target)
    lengths = np.stack([by_deviation[1, 0], by_deviation[2, 0], by_deviation[2, 1]])
    np.testing.assert_allclose(lengths @ lengths.T, circle_layout.length_covariance(rig.target), atol=1e-12)
    assert np.abs(by_deviation[0]).max() == 0 and np.abs(by_deviation[:, 2]).max() == 0


def test_a_measured_or_an_exact_target_has_its_own_deviations(rig):
    exact = rig.target.model_copy(update={"tolerance_mm": 0.0})
    assert circle_layout.deviations(exact).shape == (3, 3, 0)
    measured = rig.target.model_copy(update={"covariance_mm2": ((4e-6, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 1e-6))})
    assert circle_layout.deviations(measured).shape == (3, 3, 2)


def test_circles_follow_a_bowed_board(rig, rng):
    """Their slopes are those of the bowed surface in the frame of three of its points, by finite differences."""
    xx, xy, yy = curvature = 1e-3 * np.array([0.6, -0.4, 0.3])
    circles = circle_layout.circles(rig.target.model_copy(update={"curvature_per_m": tuple(1e3 * curvature)}))

    def height(x, y):
        return (xx * x**2 + 2 * xy * x * y + yy * y**2) / 2

    x, y, _ = circles.centres.T
    plane = np.linalg.lstsq(np.column_stack([x, y, np.ones(3)]), height(x, y), rcond=None)[0]
    for k, step in enumerate(([1e-4, 0], [0, 1e-4])):
        slope = (height(x + step[0], y + step[1]) - height(x - step[0], y - step[1])) / 2e-4
        np.testing.assert_allclose(circles.slopes[:, k], slope - plane[k], atol=1e-9)


def test_a_flat_board_has_no_slopes(rig):
    circles = circle_layout.circles(rig.target)
    assert not circles.slopes.any() and circles.radius_mm == 9.0
    np.testing.assert_array_equal(circles.centres, [[0, 0, 0], [25, 0, 0], [0, 40, 0]])


@pytest.mark.parametrize(
    "matrix", [((1.0, 0.5, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)), ((-1.0, 0, 0), (0, 1.0, 0), (0, 0, 1.0))]
)
def test_no_covariance_is_refused(rig, matrix):
    with pytest.raises(ValidationError, match="expected a covariance of c1, c2_aside and c2"):
        Target.model_validate(rig.target.model_dump() | {"covariance_mm2": matrix})
