"""Tolerances of a board, by what sightings of it show."""

import numpy as np
import pytest

from recon.board_detection.kinds.asymmetric_circles import AsymmetricCircles
from recon.geometry import board_shape
from recon.geometry.board_shape import Tolerances, departures, estimate

DESIGN = AsymmetricCircles(columns=4, rows=11, spacing_mm=15, diameter_mm=9).points()
SIGMA_MM = 0.004  # of each coordinate, as sighted


def sighted(tolerances, rng, sigma_mm=SIGMA_MM):
    """Information and pull of sightings that show all coordinates but a rigid motion and the scale."""
    ways, which = departures(DESIGN)
    departure = (ways * tolerances.sigmas[which]) @ rng.standard_normal(len(which))
    x, y = (DESIGN - DESIGN.mean(axis=0))[:, :2].T
    none, one = 0 * x, 1 + 0 * x
    rigid = [(one, none, none), (none, one, none), (none, none, one), (none, none, x), (none, none, y), (-y, x, none)]
    hidden = [*rigid, (x, y, none)]
    basis = np.linalg.qr(np.stack([np.column_stack(mode).ravel() for mode in hidden], axis=1))[0]
    seen = np.eye(departure.size) - basis @ basis.T
    return seen / sigma_mm**2, seen @ (departure + sigma_mm * rng.standard_normal(departure.size)) / sigma_mm**2


@pytest.mark.parametrize("true", [Tolerances(0.02, 0.03, 0.1, 0.01), Tolerances(0.1, 0.01, 0.02, 0.05)])
def test_tolerances_are_found(rng, true):
    """In the median of twenty boards: those of each point to a seventh, those of a few numbers a board to a factor of two."""
    found = np.median([estimate(*sighted(true, rng), DESIGN, Tolerances()).sigmas for _ in range(20)], axis=0)
    np.testing.assert_allclose(found[[0, 3]], true.sigmas[[0, 3]], rtol=0.15)
    assert (np.abs(np.log2(found[[1, 2]] / true.sigmas[[1, 2]])) < 1).all()


def test_of_a_flat_board_only_the_undecided_is_left(rng):
    """Deviations of each point less than half of the noise, common ones less than twice; fewer numbers than coordinates."""
    found = estimate(*sighted(Tolerances(), rng), DESIGN, Tolerances())
    assert (found.sigmas[[0, 3]] < SIGMA_MM / 2).all() and (found.sigmas[[1, 2]] < 2 * SIGMA_MM).all()
    assert found.determined < 0.5 * DESIGN.size


def test_more_exact_sightings_exclude_more(rng):
    rough, fine = (estimate(*sighted(Tolerances(), rng, sigma), DESIGN, Tolerances()).sigmas for sigma in (0.1, 0.004))
    assert (fine < rough).all()


def test_given_tolerances_are_kept(rng):
    given = Tolerances(print_mm=0.05, bow_mm=0.2)
    found = estimate(*sighted(Tolerances(), rng), DESIGN, given)
    assert (found.print_mm, found.bow_mm) == (0.05, 0.2) and 0 < found.dent_mm < 0.01


def test_a_stretch_leaves_the_scale_as_uncertain(rng):
    """Aspect and shear are seen, the scale isn't: given the print, its variance is the one of a stretch."""
    found = estimate(*sighted(Tolerances(0.002, 0.05, 0.002, 0.002), rng), DESIGN, Tolerances())
    x = (DESIGN - DESIGN.mean(axis=0)) * [1, 1, 0]
    mode = x.ravel() / np.linalg.norm(x)
    variance = mode @ found.covariance(DESIGN) @ mode
    assert variance == pytest.approx(found.stretch_mm**2 * len(DESIGN), rel=0.2)  # on a long board the aspect shares in it


def test_the_evidence_is_that_of_the_whole(rng):
    """Others integrated out beforehand, against the determinant and the quadratic form of all departures."""
    information, pull = sighted(Tolerances(0.02, 0.03, 0.1, 0.01), rng)
    ways, which = departures(DESIGN)
    gram, along, scale = ways.T @ information @ ways, ways.T @ pull, np.array([0.02, 0.05, 0.2, 0.01])[which]
    for way in range(4):
        whole = []
        for sigma in board_shape.SIGMAS_MM:
            each = np.where(which == way, sigma, scale)
            matrix = np.eye(len(each)) + each[:, None] * gram * each
            whole.append((each * along) @ np.linalg.solve(matrix, each * along) / 2 - np.linalg.slogdet(matrix)[1] / 2)
        found = board_shape._evidence(which == way, scale, gram, along)
        np.testing.assert_allclose(np.diff(found), np.diff(whole), rtol=1e-6, atol=1e-6)
