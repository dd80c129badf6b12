"""Displacement of a body's points: a field on a grid, its inverse, and both for compiled code; and flows that lead to one.

A point that rests at X lies at `x = X + u(X)`, with u trilinear between the points of a grid and constant beyond it: this defines
where everything is. Where x rested follows from a table of the inverse and steps `X <- x - u(X)`, which halve the error at least
where no strain exceeds one half.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from recon.compiled import kernel, njit
from recon.threads import in_threads
from twin.trilinear import Cell, nearest_cell, slope_within

Array = NDArray[np.float64]
Field = NDArray[np.float32]

STEPS = 2  # from the table of the inverse on: the error falls below 0.01 mm in a dent of 3 mm within 8 mm
CLOSE_MM = 0.005  # a step after which no other is taken
LEAST_STRETCH = 0.3  # that counts; where a field shrinks lengths by more, borders may be missed
STEPS_OF_TABLE = 40  # at the table's own points, at most
STILL_MM = 1e-4  # by which a step moves a point whose rest is found: less than lies between the table's points
STEPS_OF_FLOW = 4


class Displacement(NamedTuple):
    """A field of displacements and the table of its inverse, for compiled code; with empty grids nothing moves."""

    first: Array  # (3,) mm in the world, the first grid point
    per_mm: float  # grid points
    moved: Field  # (nx, ny, nz, 3) mm, from where a point rests to where it is
    back: Field  # (nx, ny, nz, 3) mm, from where a point is to where it rested
    stretch: float  # least length of what rested 1 mm long


NOWHERE = Displacement(np.zeros(3), 1.0, np.zeros((0, 0, 0, 3), np.float32), np.zeros((0, 0, 0, 3), np.float32), 1.0)
"""of a body that keeps its form"""


class Flow(NamedTuple):
    """A steady flow, trilinear between the points of a grid and constant beyond it, for compiled code."""

    first: Array  # (3,) mm in the world, the first grid point
    per_mm: float  # grid points
    moved: Field  # (nx, ny, nz, 3) mm, in a unit of time


def displacement(first: Array, step_mm: float, moved: Field) -> Displacement:
    """Set up a field : (nx, ny, nz, 3) mm on a grid in the world, and the table of its inverse."""
    moved = np.ascontiguousarray(moved, np.float32)
    slopes = np.zeros(len(moved) - 1)
    in_threads(_steepest, len(slopes), slopes, moved)
    stretch = max(1 - float(np.sqrt(slopes.max())) / step_mm, LEAST_STRETCH)
    field = Displacement(np.asarray(first, float), 1 / step_mm, moved, np.zeros_like(moved), stretch)
    in_threads(_tabulate, len(moved), field)
    return field


def led_through(flow: Flow) -> Displacement:
    """The displacement of points that drift through a field of small displacements, as through a steady flow.

    The flow of a field without divergence keeps volumes, where the field itself keeps them to first order alone.
    Midpoint rule, in steps of a quarter.
    """
    moved = np.zeros_like(flow.moved)
    in_threads(_lead, len(moved), moved, flow)
    return displacement(flow.first, 1 / flow.per_mm, moved)


def led_to(flow: Flow, points: Array) -> Array:
    """Where points : (n, 3) mm lie that rested at these, by `led_through`, of which the cells about them alone are worked out."""
    found = points.copy()
    in_threads(_lead_some, len(points), found, points, flow)
    return found


def moved_to(field: Displacement, points: Array) -> Array:
    """Where points : (n, 3) mm lie that rested at these."""
    return _carried(field, points, 0)


def rested_at(field: Displacement, points: Array) -> Array:
    """Where points : (n, 3) mm rested that lie at these."""
    return _carried(field, points, STEPS_OF_TABLE)


def volume_ratio(field: Displacement) -> Array:
    """Volume of each cell of the grid over that at rest : (nx - 1, ny - 1, nz - 1), from the gradient in its middle."""
    u = field.moved.astype(float)
    slopes = np.stack([_slope(u, axis) * field.per_mm for axis in range(3)], axis=-1)
    return np.linalg.det(np.eye(3) + slopes)


def _slope(u: Array, axis: int) -> Array:
    """Difference along an axis, averaged over the others, in the cells' middles : (nx - 1, ny - 1, nz - 1, 3)."""
    values = np.diff(u, axis=axis)
    for other in {0, 1, 2} - {axis}:
        low, high = (np.take(values, range(n, values.shape[other] - 1 + n), axis=other) for n in (0, 1))
        values = (low + high) / 2
    return values


def _carried(field: Displacement, points: Array, steps: int) -> Array:
    flat = np.ascontiguousarray(np.asarray(points, float).reshape(-1, 3))
    if not field.moved.size:
        return flat.reshape(np.shape(points)).copy()
    found = np.empty_like(flat)
    in_threads(_carry, len(flat), found, flat, field, steps)
    return found.reshape(np.shape(points))


@njit(inline="always")
def _vector(v, first, per_mm, x, y, z):
    """The vector of a field at a place."""
    cell = nearest_cell(first, per_mm, v.shape, x, y, z)
    i, j, k, one = np.uint64(cell.i), np.uint64(cell.j), np.uint64(cell.k), np.uint64(1)
    p, q, r = (1 - cell.a) * (1 - cell.b), (1 - cell.a) * cell.b, cell.a * (1 - cell.b)
    s = cell.a * cell.b
    low, high = 1 - cell.c, cell.c
    first, second, third, fourth = v[i, j], v[i, j + one], v[i + one, j], v[i + one, j + one]
    u = p * (low * first[k, 0] + high * first[k + one, 0]) + q * (low * second[k, 0] + high * second[k + one, 0])
    u += r * (low * third[k, 0] + high * third[k + one, 0]) + s * (low * fourth[k, 0] + high * fourth[k + one, 0])
    w = p * (low * first[k, 1] + high * first[k + one, 1]) + q * (low * second[k, 1] + high * second[k + one, 1])
    w += r * (low * third[k, 1] + high * third[k + one, 1]) + s * (low * fourth[k, 1] + high * fourth[k + one, 1])
    t = p * (low * first[k, 2] + high * first[k + one, 2]) + q * (low * second[k, 2] + high * second[k + one, 2])
    t += r * (low * third[k, 2] + high * third[k + one, 2]) + s * (low * fourth[k, 2] + high * fourth[k + one, 2])
    return u, w, t


@njit(inline="always")
def _stepped(moved, first, per_mm, point, rested, steps):
    """Where a point rested, by steps from a place on."""
    rx, ry, rz = rested
    for _ in range(steps):
        u, v, w = _vector(moved, first, per_mm, rx, ry, rz)
        rx, ry, rz = point[0] - u, point[1] - v, point[2] - w
    return rx, ry, rz


@njit(inline="always")
def carried_along(moved, first, per_mm, x, y, z):
    """Where a point lies that rests at a place."""
    u, v, w = _vector(moved, first, per_mm, x, y, z)
    return x + u, y + v, z + w


@kernel
def carried_back(moved, back, first, per_mm, x, y, z):
    """Where a point rested that lies at a place."""
    u, v, w = _vector(back, first, per_mm, x, y, z)
    rx, ry, rz = x + u, y + v, z + w
    for _ in range(STEPS):
        u, v, w = _vector(moved, first, per_mm, rx, ry, rz)
        off = abs(x - u - rx) + abs(y - v - ry) + abs(z - w - rz)
        rx, ry, rz = x - u, y - v, z - w
        if off < CLOSE_MM:
            break
    return rx, ry, rz


@njit(inline="always")
def _spans(first, per_mm, count, x):
    """1 within a grid along an axis, 0 beside it, where the field goes on as at its end."""
    return 1.0 if 0 <= (x - first) * per_mm <= count - 1 else 0.0


@kernel
def cofactors(moved, first, per_mm, x, y, z):
    """Sides of a unit cube that rested at a place, as vectors of their areas, row by row, and its volume.

    Areas of normal n have become those of normal `n @ rows` (Nanson), and a step d rested as `rows @ d / volume`.
    """
    cell = nearest_cell(first, per_mm, moved.shape, x, y, z)
    a, b, c = slope_within(moved, cell, 0), slope_within(moved, cell, 1), slope_within(moved, cell, 2)
    x_per_mm = per_mm * _spans(first[0], per_mm, moved.shape[0], x)
    y_per_mm = per_mm * _spans(first[1], per_mm, moved.shape[1], y)
    z_per_mm = per_mm * _spans(first[2], per_mm, moved.shape[2], z)
    p0, p1, p2 = 1 + x_per_mm * a[0], x_per_mm * b[0], x_per_mm * c[0]  # what 1 mm along x has become
    q0, q1, q2 = y_per_mm * a[1], 1 + y_per_mm * b[1], y_per_mm * c[1]
    r0, r1, r2 = z_per_mm * a[2], z_per_mm * b[2], 1 + z_per_mm * c[2]
    across_x = q1 * r2 - q2 * r1, q2 * r0 - q0 * r2, q0 * r1 - q1 * r0
    across_y = r1 * p2 - r2 * p1, r2 * p0 - r0 * p2, r0 * p1 - r1 * p0
    across_z = p1 * q2 - p2 * q1, p2 * q0 - p0 * q2, p0 * q1 - p1 * q0
    return across_x, across_y, across_z, p0 * across_x[0] + p1 * across_x[1] + p2 * across_x[2]


@njit(inline="always")
def _drift(flow, x, y, z):
    """By how much a point drifts in one of the steps of a unit of time: midpoint rule."""
    step = 1 / STEPS_OF_FLOW
    u, v, w = _vector(flow.moved, flow.first, flow.per_mm, x, y, z)
    u, v, w = _vector(flow.moved, flow.first, flow.per_mm, x + step / 2 * u, y + step / 2 * v, z + step / 2 * w)
    return step * u, step * v, step * w


@kernel
def _lead(first, end, moved, flow):
    """Fill planes of a field : of zeros by how far the grid's points drift, a column at once, as none waits for another."""
    step = 1 / flow.per_mm
    for i in range(first, end):
        x = flow.first[0] + step * i
        for j in range(moved.shape[1]):
            y = flow.first[1] + step * j
            for _ in range(STEPS_OF_FLOW):
                for k in range(moved.shape[2]):
                    z = flow.first[2] + step * k
                    u, v, w = _drift(flow, x + moved[i, j, k, 0], y + moved[i, j, k, 1], z + moved[i, j, k, 2])
                    moved[i, j, k, 0] += u
                    moved[i, j, k, 1] += v
                    moved[i, j, k, 2] += w


@kernel
def _lead_some(first, end, found, points, flow):
    """Carry points along with the corners of their cells."""
    step = 1 / flow.per_mm
    for n in range(first, end):
        cell = nearest_cell(flow.first, flow.per_mm, flow.moved.shape, points[n, 0], points[n, 1], points[n, 2])
        for corner in range(8):
            a, b, c = corner // 4, corner // 2 % 2, corner % 2
            share = (cell.a if a else 1 - cell.a) * (cell.b if b else 1 - cell.b) * (cell.c if c else 1 - cell.c)
            x, y = flow.first[0] + step * (cell.i + a), flow.first[1] + step * (cell.j + b)
            z = flow.first[2] + step * (cell.k + c)
            for _ in range(STEPS_OF_FLOW):
                u, v, w = _drift(flow, x, y, z)
                x, y, z = x + u, y + v, z + w
                found[n, 0], found[n, 1], found[n, 2] = found[n, 0] + share * u, found[n, 1] + share * v, found[n, 2] + share * w


@kernel
def _steepest(first, end, slopes, moved):
    """The largest sum of squared differences along all three axes, in the middle of a cell, of planes of cells."""
    for i in range(first, end):
        for j in range(moved.shape[1] - 1):
            for k in range(moved.shape[2] - 1):
                middle, slope = Cell(i, j, k, 0.5, 0.5, 0.5), 0.0
                for n in range(3):
                    a, b, c = slope_within(moved, middle, n)
                    slope += a * a + b * b + c * c
                slopes[i] = max(slopes[i], slope)


@kernel
def _tabulate(first, end, field):
    """Fill planes of the inverse's table."""
    back, step = field.back, 1 / field.per_mm
    for i in range(first, end):
        x = field.first[0] + step * i
        for j in range(back.shape[1]):
            y = field.first[1] + step * j
            for k in range(back.shape[2]):
                z = field.first[2] + step * k
                rx, ry, rz = x, y, z
                for _ in range(STEPS_OF_TABLE):
                    u, v, w = _vector(field.moved, field.first, field.per_mm, rx, ry, rz)
                    off = abs(x - u - rx) + abs(y - v - ry) + abs(z - w - rz)
                    rx, ry, rz = x - u, y - v, z - w
                    if off < STILL_MM:
                        break
                back[i, j, k, 0], back[i, j, k, 1], back[i, j, k, 2] = rx - x, ry - y, rz - z


@kernel
def _carry(first, end, found, points, field, steps):
    """Carry points along, or back in so many steps from the table on."""
    for n in range(first, end):
        x, y, z = points[n, 0], points[n, 1], points[n, 2]
        if steps == 0:
            u, v, w = _vector(field.moved, field.first, field.per_mm, x, y, z)
            found[n, 0], found[n, 1], found[n, 2] = x + u, y + v, z + w
        else:
            u, v, w = _vector(field.back, field.first, field.per_mm, x, y, z)
            rested = _stepped(field.moved, field.first, field.per_mm, (x, y, z), (x + u, y + v, z + w), steps)
            found[n, 0], found[n, 1], found[n, 2] = rested
