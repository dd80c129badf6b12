"""Fits of artefacts: widths of shells against closed forms, and uncertainties against the scatter of many measurements."""

import numpy as np
import pytest
from scipy import stats

from recon.acceptance.form_probing import ALL, MOST, probe_plane, probe_sphere, shell_width
from tests.recon.acceptance import drawn_surfaces

CENTRE, RADIUS, SIGMA = (30.0, -20.0, 640.0), 19.8, 0.02


def test_shells_hold_their_share(rng):
    """Of 101 even residuals 96 lie within 95 steps; of all the width is the range; a shift of all changes nothing."""
    residuals = rng.permutation(np.linspace(0, 1, 101)) + 3
    assert shell_width(residuals, 1.0) == pytest.approx(1.0)
    assert shell_width(residuals, MOST) == pytest.approx(0.95)


def test_a_few_outliers_are_let_go(rng):
    """Three of a thousand don't count in the shell of all, a fourth does."""
    residuals = 0.01 * rng.standard_normal(1000)
    usual = shell_width(residuals, ALL)
    residuals[:3] = 1.0
    assert shell_width(residuals, ALL) < 1.3 * usual
    residuals[3] = 1.0
    assert shell_width(residuals, ALL) > 0.9


def test_the_width_of_all_grows_with_the_points_and_that_of_most_does_not(rng):
    """Ranges of 100 and 10 000 normal numbers are 5.0 and 7.7 sigma; 95 % lie within 3.92 sigma, however many there are."""
    few, many = (np.mean([shell_width(rng.standard_normal(n), 1.0) for _ in range(60)]) for n in (100, 10_000))
    assert few == pytest.approx(5.0, abs=0.3) and many == pytest.approx(7.7, abs=0.3)
    assert shell_width(rng.standard_normal(40_000), MOST) == pytest.approx(2 * stats.norm.ppf(0.975), abs=0.08)


def test_covariances_count_what_neighbours_share(rng):
    """Errors of centre and radius over their predicted sigma have a deviation of 1, where the fit's usual one would give 2."""
    off = []
    for _ in range(40):
        found = probe_sphere(drawn_surfaces.ball(CENTRE, RADIUS, rng, SIGMA), rng, 2)
        errors = np.append(found.shape.centre - CENTRE, found.shape.radius - RADIUS)
        off.append(errors / np.sqrt(np.diag(found.covariance)))
    spread = np.std(off, axis=0)
    assert (np.abs(spread - 1) < 5 / np.sqrt(2 * len(off))).all()  # 0.56: five deviations of a deviation's own error


@pytest.mark.parametrize("sag", [0.0, 0.3])
def test_widths_scatter_as_predicted(rng, sag):
    """Over 60 noises, of a plane and of a bent one, within five standard deviations of a deviation's own error, 46 %."""
    widths, sigmas = [], []
    for _ in range(60):
        places = np.random.default_rng(3)
        points = drawn_surfaces.plate((0, 0, 650), (200, 150), places, sag=sag)
        noise = np.repeat(SIGMA * rng.standard_normal(400), drawn_surfaces.SHARED)
        found = probe_plane(points + np.outer(noise, [0, 0, 1]), rng, 60)
        widths.append((found.all.mm, found.most.mm))
        sigmas.append((found.all.sigma_mm, found.most.sigma_mm))
    ratio = np.mean(sigmas, axis=0) / np.std(widths, axis=0)
    assert (np.abs(ratio - 1) < 5 / np.sqrt(2 * 60)).all()


def test_points_in_a_plane_are_no_sphere(rng):
    with pytest.raises(ValueError, match="expected a piece of a sphere"):
        probe_sphere(drawn_surfaces.plate((0, 0, 650), (40, 40), rng, SIGMA), rng)
