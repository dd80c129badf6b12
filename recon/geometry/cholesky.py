"""Small symmetric systems in compiled code, without the cost of calling LAPACK."""

import math

import numpy as np

from recon.compiled import njit


@njit(error_model="numpy")
def solve_and_invert(matrix, right, solution, inverse):
    """Solve and invert; False if the matrix isn't positive."""
    n = len(right)
    lower = np.zeros((n, n))
    for i in range(n):
        for j in range(i + 1):
            total = matrix[i, j]
            for k in range(j):
                total -= lower[i, k] * lower[j, k]
            if i == j:
                if not total > 1e-13 * matrix[i, i]:
                    return False
                lower[i, i] = math.sqrt(total)
            else:
                lower[i, j] = total / lower[j, j]
    half = np.zeros((n, n))
    for k in range(n):
        half[k, k] = 1 / lower[k, k]
        for i in range(k + 1, n):
            total = 0.0
            for m in range(k, i):
                total -= lower[i, m] * half[m, k]
            half[i, k] = total / lower[i, i]
    for i in range(n):
        for j in range(i + 1):
            total = 0.0
            for k in range(i, n):
                total += half[k, i] * half[k, j]
            inverse[i, j] = inverse[j, i] = total
    for i in range(n):
        solution[i] = 0.0
        for k in range(n):
            solution[i] += inverse[i, k] * right[k]
    return True
