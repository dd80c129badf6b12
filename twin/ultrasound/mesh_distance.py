"""Signed distances of a grid's points to closed meshes: to the triangles themselves, however large or small they are.

The nearest triangle is sought in a tree of boxes. A point is inside where the line through it along z has entered the body more
often than it has left it, or the other way round of a mesh that is turned inside out.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from recon.compiled import kernel, njit
from recon.threads import in_threads

Array = NDArray[np.float64]

LEAF = 4  # triangles
ASIDE = 1e-6 * np.array([np.sqrt(2), np.sqrt(3)])  # of a step, by which lines pass beside vertices that lie in a grid's planes


class Grid(NamedTuple):
    """Points evenly along x, y and z."""

    first: Array  # (3,) mm
    steps: Array  # (3,) mm
    counts: NDArray[np.int64]  # (3,)


class Tree(NamedTuple):
    """Triangles in the boxes of a full binary tree: below box k, from 1, are 2 k and 2 k + 1; the last half has the triangles."""

    corners: Array  # (LEAF n, 3, 3) mm
    low: Array  # (2 n, 3) mm
    high: Array  # (2 n, 3) mm


def signed_distances(corners: Array, grid: Grid, most_mm: float) -> NDArray[np.float32]:
    """Distances : (nx, ny, nz) mm of a grid's points to the triangles : (n, 3, 3) mm of closed meshes, negative inside any.

    most_mm : of a distance; those of points farther away are cut to it.
    """
    turns = np.zeros(tuple(grid.counts), np.int32)
    _count_turns(turns, corners, grid.first[:2] + ASIDE * grid.steps[:2], grid)
    distance, tree = np.empty(turns.shape, np.float32), _tree(corners)
    in_threads(_measure, len(distance), distance, tree, grid, float(most_mm))
    return np.where(np.cumsum(turns, axis=2) == 0, distance, -distance)


def _tree(corners: Array) -> Tree:
    """Halve the triangles across the widest spread of their middles, again and again; some stand twice, for equal halves."""
    leaves = 1 << int(np.ceil(np.log2(max(len(corners) / LEAF, 1))))
    order = (np.arange(LEAF * leaves) * len(corners) // (LEAF * leaves))[None]
    middles = corners.mean(axis=1)
    while len(order) < leaves:
        places = middles[order]
        widest = np.ptp(places, axis=1).argmax(axis=1)[:, None, None]
        along = np.take_along_axis(places, widest, axis=2)[..., 0]
        order = np.take_along_axis(order, np.argpartition(along, order.shape[1] // 2, axis=1), axis=1)
        order = order.reshape(2 * len(order), -1)
    low, high = [corners[order].min(axis=(1, 2))], [corners[order].max(axis=(1, 2))]
    while len(low[0]) > 1:
        low.insert(0, np.minimum(low[0][::2], low[0][1::2]))
        high.insert(0, np.maximum(high[0][::2], high[0][1::2]))
    return Tree(corners[order.ravel()], np.concatenate([low[0], *low]), np.concatenate([high[0], *high]))


@kernel
def _measure(first, end, distance, tree, grid, most_mm):
    """Unsigned distances of the points from one plane of x to another."""
    for i in range(first, end):
        for j in range(distance.shape[1]):
            known = -1
            for k in range(distance.shape[2]):
                x = grid.first[0] + i * grid.steps[0]
                y = grid.first[1] + j * grid.steps[1]
                z = grid.first[2] + k * grid.steps[2]
                square, known = _nearest(tree, x, y, z, most_mm * most_mm, known)
                distance[i, j, k] = np.sqrt(square)


@njit(inline="always")
def _nearest(tree, x, y, z, most, known):
    """Squared distance of a point to the nearest triangle, `most` if all are farther, and its number; `known` is one nearby."""
    best, found, leaves = most, -1, len(tree.low) // 2
    if known >= 0:
        square = _square_to_triangle(tree.corners[known], x, y, z)
        if square < best:
            best, found = square, known
    box = 1
    while box > 0:
        if _square_to_box(tree.low[box], tree.high[box], x, y, z) < best:
            if box < leaves:
                box *= 2
                continue
            for triangle in range(LEAF * (box - leaves), LEAF * (box - leaves + 1)):
                square = _square_to_triangle(tree.corners[triangle], x, y, z)
                if square < best:
                    best, found = square, triangle
        while box & 1:  # the second of two, or the root: both are done
            box >>= 1
        box += box > 0
    return best, found


@njit(inline="always")
def _square_to_box(low, high, x, y, z):
    a = max(low[0] - x, x - high[0], 0.0)
    b = max(low[1] - y, y - high[1], 0.0)
    c = max(low[2] - z, z - high[2], 0.0)
    return a * a + b * b + c * c


@kernel
def _square_to_triangle(corners, x, y, z):
    """Squared distance of a point to a triangle: to its plane above it, or else to the nearest edge."""
    ax, ay, az = corners[0, 0], corners[0, 1], corners[0, 2]
    bx, by, bz = corners[1, 0] - ax, corners[1, 1] - ay, corners[1, 2] - az
    cx, cy, cz = corners[2, 0] - ax, corners[2, 1] - ay, corners[2, 2] - az
    px, py, pz = x - ax, y - ay, z - az
    bb, bc, cc = bx * bx + by * by + bz * bz, bx * cx + by * cy + bz * cz, cx * cx + cy * cy + cz * cz
    pb, pc = px * bx + py * by + pz * bz, px * cx + py * cy + pz * cz
    at_b, at_c = bb * pc - bc * pb, cc * pb - bc * pc  # shares of c and b in the foot on the plane, times `whole`
    whole = bb * cc - bc * bc
    if at_b >= 0 and at_c >= 0 and at_b + at_c <= whole and whole > 0:
        b, c = at_c / whole, at_b / whole
        return _square(px - b * bx - c * cx, py - b * by - c * cy, pz - b * bz - c * cz)
    b = _clipped(pb, bb)
    best = _square(px - b * bx, py - b * by, pz - b * bz)
    c = _clipped(pc, cc)
    best = min(best, _square(px - c * cx, py - c * cy, pz - c * cz))
    s = _clipped(pc - pb + bb - bc, bb - 2 * bc + cc)  # from b to c
    return min(best, _square(px - bx - s * (cx - bx), py - by - s * (cy - by), pz - bz - s * (cz - bz)))


@njit(inline="always")
def _clipped(part, whole):
    return min(max(part / whole, 0.0), 1.0) if whole > 0 else 0.0


@njit(inline="always")
def _square(x, y, z):
    return x * x + y * y + z * z


@kernel
def _count_turns(turns, corners, place, grid):
    """Add 1 where a line along z, beside each column of points, has left the body, and -1 where it has entered it."""
    for n in range(len(corners)):
        x0, x1 = (
            min(corners[n, 0, 0], corners[n, 1, 0], corners[n, 2, 0]),
            max(corners[n, 0, 0], corners[n, 1, 0], corners[n, 2, 0]),
        )
        y0, y1 = (
            min(corners[n, 0, 1], corners[n, 1, 1], corners[n, 2, 1]),
            max(corners[n, 0, 1], corners[n, 1, 1], corners[n, 2, 1]),
        )
        for i in range(int(np.ceil((x0 - place[0]) / grid.steps[0])), int(np.floor((x1 - place[0]) / grid.steps[0])) + 1):
            for j in range(int(np.ceil((y0 - place[1]) / grid.steps[1])), int(np.floor((y1 - place[1]) / grid.steps[1])) + 1):
                x, y = place[0] + i * grid.steps[0], place[1] + j * grid.steps[1]
                left = _is_left(corners[n, 0], corners[n, 1], x, y)
                if left == _is_left(corners[n, 1], corners[n, 2], x, y) == _is_left(corners[n, 2], corners[n, 0], x, y):
                    k = int(np.ceil((_height(corners[n], x, y) - grid.first[2]) / grid.steps[2]))
                    turns[i, j, min(max(k, 0), turns.shape[2] - 1)] += 1 if left else -1


@kernel
def _is_left(a, b, x, y):
    """Whether a place lies left of the way from a to b: to the last bit the opposite of what it is of the way back."""
    swapped = a[0] > b[0] or (a[0] == b[0] and a[1] > b[1])
    if swapped:
        a, b = b, a
    return ((b[0] - a[0]) * (y - a[1]) - (b[1] - a[1]) * (x - a[0]) > 0) != swapped


@njit(inline="always")
def _height(corners, x, y):
    """Z of a triangle's plane."""
    ax, ay = corners[1, 0] - corners[0, 0], corners[1, 1] - corners[0, 1]
    bx, by = corners[2, 0] - corners[0, 0], corners[2, 1] - corners[0, 1]
    px, py, across = x - corners[0, 0], y - corners[0, 1], ax * by - ay * bx
    a, b = (px * by - py * bx) / across, (ax * py - ay * px) / across
    return corners[0, 2] + a * (corners[1, 2] - corners[0, 2]) + b * (corners[2, 2] - corners[0, 2])
