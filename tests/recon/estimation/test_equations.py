"""Steps and covariances with own unknowns eliminated, against dense least squares and draws."""

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.stats import chi2

from recon.estimation.covariance import inverse
from recon.estimation.equations import NormalEquations, Rows, Undetermined, eliminate
from recon.estimation.levenberg_marquardt import Unreachable, descend
from recon.estimation.parameters import Blocks, of_block

VIEWS, ROWS, SHARED, OWN = 7, 9, 4, 3
SIGMA = 0.02  # of a reading of the curves


def dense(by_shared, by_own):
    """All derivatives side by side : (p * m, g + p * k)."""
    whole = np.zeros((VIEWS, ROWS, SHARED + VIEWS * OWN))
    whole[..., :SHARED] = by_shared
    for p in range(VIEWS):
        whole[p, :, SHARED + p * OWN : SHARED + (p + 1) * OWN] = by_own[p]
    return whole.reshape(VIEWS * ROWS, -1)


@pytest.fixture
def rows(rng):
    units = np.geomspace(1e-3, 1e3, SHARED)
    shapes = (VIEWS, ROWS, SHARED), (VIEWS, ROWS, OWN), (VIEWS, ROWS)
    by_shared, by_own, left = map(rng.standard_normal, shapes)
    return units * by_shared, by_own, left


@pytest.mark.parametrize("damping", [0.0, 0.3])
def test_the_step_is_that_of_all_unknowns_at_once(rows, damping):
    by_shared, by_own, left = rows
    matrix = dense(by_shared, by_own)
    normal = matrix.T @ matrix
    expected = np.linalg.solve(normal + damping * np.diag(np.diag(normal)), matrix.T @ left.ravel())
    found = NormalEquations.of_rows(*rows).step(damping)
    np.testing.assert_allclose(np.concatenate([found.shared, found.own.ravel()]), expected, rtol=1e-8)
    np.testing.assert_allclose(Rows(matrix, left.ravel()).step(damping), expected, rtol=1e-8)


def test_the_covariance_is_that_of_a_dense_gauss_newton(rows):
    """With a prior on some: of shared unknowns, whose own ones are eliminated."""
    by_shared, by_own, _ = rows
    prior = np.diag([0.0, 4.0, 0.0, 1e4])
    whole = dense(by_shared, by_own)
    information = whole.T @ whole
    information[:SHARED, :SHARED] += prior
    expected = np.linalg.inv(information)[:SHARED, :SHARED]
    found = inverse(NormalEquations.of_rows(*rows).held(prior, np.zeros(SHARED)).reduced()[0])
    scale = np.sqrt(np.diag(expected))
    np.testing.assert_allclose(found / np.outer(scale, scale), expected / np.outer(scale, scale), atol=1e-9)


def test_rows_without_own_unknowns_are_the_same_problem(rows):
    by_shared, by_own, left = rows
    free = eliminate(by_own, np.concatenate([by_shared, left[..., None]], axis=2))
    alone = NormalEquations.of_rows(free[..., :SHARED], np.zeros((VIEWS, ROWS - OWN, 0)), free[..., SHARED])
    np.testing.assert_allclose(alone.step().shared, NormalEquations.of_rows(*rows).step().shared, rtol=1e-8)


def test_own_unknowns_are_eliminated_and_noise_stays_one(rng):
    """Of 500 groups of 5 equations with 2 unknowns of any size each, three remain: variance 1 to 5 standard deviations."""
    own = rng.standard_normal((500, 5, 2))
    noise = rng.standard_normal((500, 5, 1))
    free = eliminate(own, own @ (1e3 * rng.standard_normal((500, 2, 1))) + noise)
    assert free.shape == (500, 3, 1) and free.var() == pytest.approx(1, abs=5 * np.sqrt(2 / 1500))


def test_what_is_undetermined_has_no_step(rows):
    """Two shared unknowns that always go together; damped, or held, they have one."""
    by_shared, by_own, left = rows
    twice = np.concatenate([by_shared, by_shared[..., :1]], axis=2)
    equations = NormalEquations.of_rows(twice, by_own, left)
    assert np.isfinite(equations.held(np.eye(SHARED + 1), np.zeros(SHARED + 1)).step().shared).all()
    with pytest.raises(Unreachable):
        equations._replace(shared=np.zeros_like(equations.shared), cross=np.zeros_like(equations.cross)).step()
    with pytest.raises(Undetermined):
        Rows(twice[0], left[0]).step()


TIME = np.linspace(0, 2, ROWS)
TRUTH = np.array([1.3, 0.4])  # a rate and a bend, of all curves


def curves(shared, own):
    """Decays of one rate and one bend, each with its own height, offset and delay : (p, m)."""
    (rate, bend), (height, offset, delay) = shared, own.T[..., None]
    late = TIME - delay
    return height * np.exp(-rate * late - bend * late**2) + offset


def drawn(rng):
    own = np.column_stack([rng.uniform(1, 2, VIEWS), rng.normal(0, 0.2, VIEWS), rng.normal(0, 0.05, VIEWS)])
    return own, curves(TRUTH, own) + SIGMA * rng.standard_normal((VIEWS, ROWS))


def fit(readings, own):
    """The shared pair and its covariance; delays are known to 0.05, as if measured once more."""

    def linearise(unknowns):
        shared, own = unknowns
        step = 1e-6
        by_shared = [(curves(shared + d, own) - curves(shared - d, own)) / (2 * step) for d in step * np.eye(2)]
        by_own = [(curves(shared, own + d) - curves(shared, own - d)) / (2 * step) for d in step * np.eye(3)]
        held = np.broadcast_to([0, 0, 1 / 0.05], (VIEWS, 1, 3))
        left = np.concatenate([(readings - curves(shared, own)) / SIGMA, -own[:, 2:] / 0.05], axis=1)
        rows = np.concatenate([np.stack(by_shared, axis=-1) / SIGMA, np.zeros((VIEWS, 1, 2))], axis=1)
        own_rows = np.concatenate([np.stack(by_own, axis=-1) / SIGMA, held], axis=1)
        return NormalEquations.of_rows(rows, own_rows, left), float(np.sum(left**2))

    found = descend((TRUTH, own), linearise, lambda at, step: (at[0] + step.shared, at[1] + step.own))
    return found, inverse(found.system.reduced()[0])


def test_the_minimum_is_scipys(rng):
    _, readings = drawn(rng)
    start = np.column_stack([np.full(VIEWS, 1.5), np.zeros((VIEWS, 2))])

    def residuals(packed):
        shared, own = packed[:2], packed[2:].reshape(VIEWS, 3)
        return np.append((readings - curves(shared, own)) / SIGMA, own[:, 2] / 0.05)

    expected = least_squares(residuals, np.append(TRUTH, start), xtol=1e-14, ftol=1e-14, gtol=1e-14)
    found, covariance = fit(readings, start)
    sigma = np.sqrt(np.diag(covariance))
    assert np.abs((found.estimate[0] - expected.x[:2]) / sigma).max() < 1e-3  # a cost that changes by 1e-10
    dense_covariance = np.linalg.inv(expected.jac.T @ expected.jac)[:2, :2]
    np.testing.assert_allclose(covariance / np.outer(sigma, sigma), dense_covariance / np.outer(sigma, sigma), atol=1e-3)


def test_predicted_uncertainties_cover_the_errors(rng):
    """Squared errors of 200 fits over their covariance, against chi-square (99.9 %); delays are drawn as they are held."""
    total = 0.0
    for _ in range(200):
        own, readings = drawn(rng)
        found, covariance = fit(readings, own)
        error = found.estimate[0] - TRUTH
        total += error @ np.linalg.solve(covariance, error)
    low, high = chi2.ppf([0.0005, 0.9995], 2 * 200)
    assert low < total < high


def test_blocks_are_packed_side_by_side():
    blocks = Blocks({"scale": 2, "pose": 6, "none": 0, "wire": 3})
    packed = np.arange(len(blocks))
    scale, pose, none, wire = blocks.split(packed)
    assert np.concatenate([scale, pose, none, wire]).tolist() == packed.tolist() and packed[blocks["wire"]].tolist() == [8, 9, 10]


def test_names_of_a_block_are_found_wherever_they_stand():
    places, own = of_block(("cam1.fx", "cam10.fx", "cam1.cx"), "cam1")
    assert places.tolist() == [0, 2] and own == ("fx", "cx")
    assert len(of_block(("cam1.fx",), "cam2")[0]) == 0
