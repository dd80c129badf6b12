"""The normal equations, against matrices of all derivatives."""

import numpy as np
import pytest

from recon.optical_calibration.bundle import Sightings, add_up

POSES, POINTS, ROBUST = 3, 5, 3.0
OWN = (2, 4, 3)  # parameters of each device


@pytest.fixture
def sightings(rng):
    """Of three devices, the last a projector; the second misses a point, and one residual isn't a number."""
    form = (POSES, POINTS, len(OWN))
    turns = np.linalg.qr(rng.standard_normal((POSES, 3, 3)))[0]
    whitening = np.tril(rng.standard_normal((*form, 2, 2)))
    whitening[..., [0, 1], [0, 1]] = rng.uniform(0.5, 2, (*form, 2))
    whitening[1, 2, 1] = 0
    residuals = rng.standard_normal((*form, 2)) * 2
    residuals[1, 2, 1] = residuals[2, 3, 0] = np.nan
    return Sightings(
        residuals,
        rng.standard_normal((len(OWN), POSES, POINTS, 2, max(OWN))),
        rng.standard_normal((len(OWN), POSES, POINTS, 2, 3)),
        rng.standard_normal((POSES, POINTS, 3)),
        turns,
        np.cumsum([0, *OWN]),
        whitening,
        len(OWN) - 1,
    )


def all_rows(sightings, gradient):
    """Whitened rows : (m, u) of all unknowns, the shared ones first, their residuals : (m,), and the lengths : (p, n, d)."""
    own, shared = sum(OWN), sum(OWN) + 3 * POINTS
    rows, values, lengths = [], [], np.zeros((POSES, POINTS, len(OWN)))
    for p, n in np.ndindex(POSES, POINTS):
        block, left = np.zeros((len(OWN), 2, shared + 6 * POSES)), sightings.residuals[p, n].copy()
        for d, count in enumerate(OWN):
            by_point = sightings.by_point[d, p, n]
            block[d, :, sightings.first[d] : sightings.first[d] + count] = sightings.by_parameter[d, p, n, :, :count]
            block[d, :, own + 3 * n : own + 3 * n + 3] = by_point @ sightings.turns[p]
            block[d, :, shared + 6 * p : shared + 6 * p + 3] = np.cross(sightings.arms[p, n], by_point)
            block[d, :, shared + 6 * p + 3 : shared + 6 * p + 6] = by_point
        block[-1] -= gradient[p, n] @ block[0]
        left[-1] -= gradient[p, n] @ left[0]
        for d in range(len(OWN)):
            white = sightings.whitening[p, n, d] @ left[d]
            if white.any() and np.isfinite(white).all():
                lengths[p, n, d] = np.linalg.norm(white)
                root = np.sqrt(min(1, ROBUST / lengths[p, n, d]))
                rows.append(root * sightings.whitening[p, n, d] @ block[d])
                values.append(root * white)
    return np.concatenate(rows), np.concatenate(values), lengths


@pytest.mark.parametrize("shaped", [False, True])
def test_the_sums_are_the_products_of_all_rows(sightings, rng, shaped):
    gradient = rng.standard_normal((POSES, POINTS, 2, 2))
    rows, values, expected = all_rows(sightings, gradient)
    found, lengths = add_up(sightings, gradient, shaped, ROBUST)
    np.testing.assert_allclose(lengths, expected, rtol=1e-12)
    assert (lengths > ROBUST).any() and (lengths[1, 2, 1], lengths[2, 3, 0], lengths[2, 3, 2]) == (0, 0, 0)
    points, end = sum(OWN), sum(OWN) + 3 * POINTS
    shared = rows[:, : end if shaped else points]
    np.testing.assert_allclose(found.shared, shared.T @ shared, atol=1e-12)
    np.testing.assert_allclose(found.right, shared.T @ values, atol=1e-12)
    for p in range(POSES):
        pose = rows[:, end + 6 * p : end + 6 * p + 6]
        np.testing.assert_allclose(found.cross[p], shared.T @ pose, atol=1e-12)
        np.testing.assert_allclose(found.own[p], pose.T @ pose, atol=1e-12)
        np.testing.assert_allclose(found.own_right[p], pose.T @ values, atol=1e-12)


def test_an_exact_sighting_still_counts(sightings, rng):
    """Without a residual there is nothing to mend, but the unknowns are as well determined as with one."""
    gradient = rng.standard_normal((POSES, POINTS, 2, 2))
    kept = sightings.residuals.copy()
    kept[np.isfinite(kept)] = 0
    found, lengths = add_up(sightings._replace(residuals=kept), gradient, True, 1e9)
    usual, _ = add_up(sightings, gradient, True, 1e9)
    assert not lengths.any() and not found.right.any()
    np.testing.assert_allclose(found.shared, usual.shared, atol=1e-12)
