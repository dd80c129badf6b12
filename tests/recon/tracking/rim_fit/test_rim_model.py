"""The step of a rim's fit: that of a dense solution of all equations and priors, and no longer than the model holds."""

import numpy as np
import pytest

from recon.tracking.rim_fit import rim_model, sectors
from recon.tracking.rim_fit.rim_model import GLOBAL, Prior
from recon.tracking.rim_fit.rim_parameters import LEAST_VARIANCE, Rim, inverse_shape, moved, plausible, window, with_levels
from recon.tracking.rim_fit.sector_levels import COMMON, REDUCED
from recon.tracking.rim_fit.sectors import SECTORS
from tests.recon.tracking.rim_fit import plain_rims

RIM = Rim(60.3, 58.8, 40.0, 3.0, 36.0, 20.0, 1.0, -2.0, 120.0, 8.0, 5.0, 1.3, 0.4, -0.2)


def jacobian(geometry):
    """Derivatives of edge, level inside, level outside and variance by the parameters : (SECTORS, COMMON, GLOBAL)."""
    geometry = geometry.view(np.recarray)
    one = np.ones(SECTORS)
    result = np.zeros((SECTORS, COMMON, GLOBAL))
    result[:, 0, :5] = np.stack(
        [
            geometry.nx,
            geometry.ny,
            geometry.nx * geometry.ux,
            geometry.nx * geometry.uy + geometry.ny * geometry.ux,
            geometry.ny * geometry.uy,
        ],
        axis=1,
    )
    result[:, 1, 5:8] = result[:, 2, 8:11] = np.stack([one, geometry.x, geometry.y], axis=1)
    result[:, 3, 11:] = np.stack([one, geometry.cos, geometry.sin], axis=1)
    return result


@pytest.mark.parametrize(("place", "sigma"), [(np.inf, 0.3), (0.2, 0.3), (np.inf, np.inf)])
def test_the_step_is_that_of_a_dense_solution(rng, place, sigma):
    geometry = sectors.geometry(RIM, 0.0, 0.4)
    root = rng.normal(0, 5, (SECTORS, COMMON, COMMON))
    normal, right = root @ root.transpose(0, 2, 1), rng.normal(0, 10, (SECTORS, COMMON))
    weights = np.where(rng.random(SECTORS) < 0.2, 0, rng.random(SECTORS))
    slopes, step, inverse = np.ones((SECTORS, GLOBAL)), np.zeros(GLOBAL), np.zeros((GLOBAL, GLOBAL))
    rim_model._slopes(geometry, slopes)
    reduced = np.zeros(SECTORS, REDUCED)
    reduced["normal"], reduced["right"] = normal, right
    prior = Prior(RIM.x - 0.3, RIM.y + 0.4, RIM.a + 0.5, RIM.b - 0.2, RIM.c + 0.1, place, sigma)
    assert rim_model._solve(reduced, weights, slopes, RIM, prior, step, inverse)

    chain = jacobian(geometry)
    whole = np.einsum("j,jmp,jmn,jnq->pq", weights, chain, normal, chain)
    side = np.einsum("j,jmp,jm->p", weights, chain, right)
    for k, back, known in ((0, -0.3, place), (1, 0.4, place), (2, 0.5, sigma), (3, -0.2, sigma), (4, 0.1, sigma)):  # before
        whole[k, k] += known**-2
        side[k] += back * known**-2
    for k, gradient in ((6, RIM.dark_x), (7, RIM.dark_y), (9, RIM.bright_x), (10, RIM.bright_y)):  # light is nearly even
        whole[k, k] += 4 / ((RIM.bright - RIM.dark) ** 2 + 1)
        side[k] -= gradient * 4 / ((RIM.bright - RIM.dark) ** 2 + 1)
    np.testing.assert_allclose(step, np.linalg.solve(whole, side), rtol=1e-6, atol=1e-8)
    np.testing.assert_allclose(inverse, np.linalg.inv(whole), rtol=1e-6, atol=1e-9 * np.abs(inverse).max())
    np.testing.assert_allclose(rim_model._by_sector(slopes, step), chain @ step, atol=1e-12)


def test_an_undetermined_step_is_refused():
    broken = np.zeros(SECTORS, REDUCED)
    broken["normal"][:, 0, 0] = np.nan
    step, inverse, slopes = np.zeros(GLOBAL), np.zeros((GLOBAL, GLOBAL)), np.ones((SECTORS, GLOBAL))
    prior = Prior(*RIM[:5], np.inf, np.inf)
    assert not rim_model._solve(broken, np.ones(SECTORS), slopes, RIM, prior, step, inverse)


def test_slopes_of_the_edge_are_differences_of_outlines():
    """The outline's move along its normal, for small steps of centre and shape."""
    geometry, slopes = sectors.geometry(RIM, 0.0, 0.4), np.ones((SECTORS, GLOBAL))
    rim_model._slopes(geometry, slopes)
    u, normal = np.stack([geometry["ux"], geometry["uy"]], axis=1), np.stack([geometry["nx"], geometry["ny"]], axis=1)

    def outline(rim):
        return np.array([rim.x, rim.y]) + u @ plain_rims.shape_of(rim)

    for p, name in enumerate(Rim._fields[:5]):
        other = RIM._replace(**{name: RIM[p] + 1e-3})
        move = ((outline(other) - outline(RIM)) * normal).sum(axis=1) / 1e-3
        np.testing.assert_allclose(slopes[:, p], move, atol=1e-9)


def test_the_excess_is_the_mean_square_of_the_edges(rng):
    reduced = np.zeros(SECTORS, REDUCED)
    reduced["normal"], reduced["right"] = rng.uniform(1, 2, (SECTORS, COMMON, COMMON)), rng.normal(size=(SECTORS, COMMON))
    reduced["normal"][3] = 0
    weights = rng.random(SECTORS)
    others = np.arange(SECTORS) != 3
    squares = weights[others] * reduced["right"][others, 0] ** 2 / reduced["normal"][others, 0, 0]
    assert rim_model._excess(reduced, weights) == pytest.approx(squares.sum() / (weights.sum() - 6))


@pytest.mark.parametrize("size", [0.01, 1.0, 30.0])
def test_a_step_is_no_longer_than_the_model_holds(rng, size):
    """Place and shape move by the reach at most, the variance falls to 0.15 or grows to 3 of itself, and motion is part of it."""
    for _ in range(50):
        wanted = rng.normal(0, size, GLOBAL)
        step = wanted.copy()
        found = moved(RIM, step, 2.0)
        np.testing.assert_allclose(np.array(found) - np.array(RIM), step, atol=1e-12)
        expected = wanted * 1.0
        expected[:5] *= min(1, 2.0 / np.abs(wanted[:5]).max())
        np.testing.assert_allclose(step[:11], expected[:11])
        share = min(1, (0.85 if wanted[11] < 0 else 2) * RIM.variance / np.abs(wanted[11:]).max())
        variance = max(RIM.variance + share * wanted[11], LEAST_VARIANCE)
        motion = np.array(RIM[12:]) + share * wanted[12:]
        motion *= min(1, (variance - LEAST_VARIANCE) / np.linalg.norm(motion))
        np.testing.assert_allclose(found[11:], [variance, *motion], atol=1e-12)


def test_parameters_are_read_as_an_ellipse():
    shape = inverse_shape(RIM)
    np.testing.assert_allclose([[shape.a, shape.b], [shape.b, shape.c]], np.linalg.inv(plain_rims.shape_of(RIM)))
    assert window(RIM, 1.2, (90, 105)) == plain_rims.box_of(RIM, 1.2, (90, 105))
    assert with_levels(RIM, 7.0, 9.0) == RIM._replace(dark=7, dark_x=0, dark_y=0, bright=9, bright_x=0, bright_y=0)


@pytest.mark.parametrize(
    ("changed", "expected"),
    [
        ({}, True),
        ({"x": np.nan}, False),
        ({"b": np.inf}, False),
        ({"x": -2.0}, False),
        ({"y": 121.0}, False),
        ({"a": 3.0, "b": 0.0, "c": 2.9}, False),
        ({"a": 50.0, "b": 0.0, "c": 9.0}, False),
        ({"a": 200.0, "c": 200.0}, False),
    ],
)
def test_only_ellipses_of_a_ring_are_plausible(changed, expected):
    assert plausible(RIM._replace(**changed), (120, 120)) == expected
