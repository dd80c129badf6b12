"""Trilinear values of a grid's columns, point by point, for compiled code."""

from typing import NamedTuple

import numpy as np

from recon.compiled import njit


class Cell(NamedTuple):
    """A cell by its first point, i < 0 outside, and the shares of the way to its last one."""

    i: int
    j: int
    k: int
    a: float
    b: float
    c: float


@njit(inline="always")
def cell_at(first, per_mm, shape, x, y, z):
    """The cell of a grid that holds a point of the world."""
    gx, gy, gz = (x - first[0]) * per_mm, (y - first[1]) * per_mm, (z - first[2]) * per_mm
    if gx < 0 or gy < 0 or gz < 0 or gx > shape[0] - 1 or gy > shape[1] - 1 or gz > shape[2] - 1:
        return Cell(-1, -1, -1, 0.0, 0.0, 0.0)
    i, j, k = min(int(gx), shape[0] - 2), min(int(gy), shape[1] - 2), min(int(gz), shape[2] - 2)
    return Cell(i, j, k, gx - i, gy - j, gz - k)


@njit(inline="always")
def nearest_cell(first, per_mm, shape, x, y, z):
    """The cell of a grid that holds a point of the world, or the grid's point that is nearest to it."""
    gx = min(max((x - first[0]) * per_mm, 0.0), shape[0] - 1.0)
    gy = min(max((y - first[1]) * per_mm, 0.0), shape[1] - 1.0)
    gz = min(max((z - first[2]) * per_mm, 0.0), shape[2] - 1.0)
    i, j, k = min(int(gx), shape[0] - 2), min(int(gy), shape[1] - 2), min(int(gz), shape[2] - 2)
    return Cell(i, j, k, gx - i, gy - j, gz - k)


@njit(inline="always")
def within(v, cell, n):
    """The value of column n of a grid : (nx, ny, nz, m) in a cell."""
    i, j, k, a, b, c = np.uint64(cell.i), np.uint64(cell.j), np.uint64(cell.k), cell.a, cell.b, cell.c
    one, n = np.uint64(1), np.uint64(n)
    near = (v[i, j, k, n] * (1 - c) + v[i, j, k + one, n] * c) * (1 - b)
    near += (v[i, j + one, k, n] * (1 - c) + v[i, j + one, k + one, n] * c) * b
    far = (v[i + one, j, k, n] * (1 - c) + v[i + one, j, k + one, n] * c) * (1 - b)
    far += (v[i + one, j + one, k, n] * (1 - c) + v[i + one, j + one, k + one, n] * c) * b
    return near * (1 - a) + far * a


@njit(inline="always")
def slope_within(v, cell, n):
    """The gradient of column n of a grid : (nx, ny, nz, m) in a cell, for steps from point to point."""
    i, j, k, a, b, c = np.uint64(cell.i), np.uint64(cell.j), np.uint64(cell.k), cell.a, cell.b, cell.c
    one, n = np.uint64(1), np.uint64(n)
    p, q = v[i, j, k, n], v[i, j, k + one, n]
    r, s = v[i, j + one, k, n], v[i, j + one, k + one, n]
    t, u = v[i + one, j, k, n], v[i + one, j, k + one, n]
    w, x = v[i + one, j + one, k, n], v[i + one, j + one, k + one, n]
    along_a = ((t - p) * (1 - c) + (u - q) * c) * (1 - b) + ((w - r) * (1 - c) + (x - s) * c) * b
    along_b = ((r - p) * (1 - c) + (s - q) * c) * (1 - a) + ((w - t) * (1 - c) + (x - u) * c) * a
    along_c = ((q - p) * (1 - b) + (s - r) * b) * (1 - a) + ((u - t) * (1 - b) + (x - w) * b) * a
    return along_a, along_b, along_c
