"""Small systems, against LAPACK."""

import numpy as np
import pytest

from recon.geometry.cholesky import solve_and_invert


@pytest.mark.parametrize("size", [1, 3, 14])
def test_solution_and_inverse_are_those_of_lapack(rng, size):
    root = rng.normal(size=(size, size + 2))
    matrix, right = root @ root.T, rng.normal(size=size)
    solution, inverse = np.empty(size), np.empty((size, size))
    assert solve_and_invert(matrix, right, solution, inverse)
    np.testing.assert_allclose(inverse, np.linalg.inv(matrix), rtol=1e-7, atol=1e-9 * np.abs(inverse).max())
    np.testing.assert_allclose(solution, np.linalg.solve(matrix, right), rtol=1e-7, atol=1e-9 * np.abs(solution).max())


@pytest.mark.parametrize("matrix", [np.diag([1.0, -1.0]), np.ones((2, 2)), np.full((2, 2), np.nan)])
def test_a_matrix_that_is_not_positive_is_refused(matrix):
    assert not solve_and_invert(matrix, np.ones(2), np.empty(2), np.empty((2, 2)))
