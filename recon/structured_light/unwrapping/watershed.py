"""Cells of continuous phase, and their gathering into basins that no bottleneck divides.

A cell is a square of pixels that are continuous in themselves; its order holds for all of them. Cells that agree with their
neighbours are gathered from the widest places to the narrow ones, as a watershed floods a landscape.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from recon.compiled import kernel, njit
from recon.structured_light.unwrapping.continuity import CLEAN, INCOMPLETE, TORN, VOID
from recon.threads import in_threads

CELL = 4  # px; a cell's side
BOTTLENECK = 1  # cells; a basin whose half width is more than its outlet's by more than this is cut off there
NONE = 127  # no offset between two cells

Integers = NDArray[np.int32]
Mask = NDArray[np.bool_]


class Tiles(NamedTuple):
    """Pixels gathered into cells."""

    relative: NDArray[np.int8]  # (h, w) orders of the pixels relative to their cell's first
    state: NDArray[np.uint8]  # (rows, columns) of the cells
    right: NDArray[np.int8]  # (rows, columns) offset to the cell on the right, or NONE
    down: NDArray[np.int8]  # (rows, columns) to the cell below


def gather(phase: NDArray[np.float32], flags: NDArray[np.uint8]) -> Tiles:
    """Gather pixels into cells, from their phase : (h, w) cycles and the flags of its continuity : (h, w)."""
    shape = phase.shape[0] // CELL, phase.shape[1] // CELL
    offsets = np.full((2, *shape), NONE, np.int8)
    tiles = Tiles(np.zeros(phase.shape, np.int8), np.zeros(shape, np.uint8), offsets[0], offsets[1])
    in_threads(_gather, shape[0], phase, flags, tiles)
    in_threads(_compare, shape[0], phase, tiles)
    return tiles


@kernel
def _gather(first, end, phase, flags, tiles):
    """Judge the cells of rows `first` to `end`, not included, and follow the phase in them."""
    for i in range(first, end):
        for j in range(tiles.state.shape[1]):
            tiles.state[i, j] = _state(flags, i * CELL, j * CELL)
            if tiles.state[i, j] == CLEAN:
                _follow(phase, tiles.relative, i * CELL, j * CELL)


@kernel
def _compare(first, end, phase, tiles):
    """Offsets of the cells of rows `first` to `end`, not included, to their neighbours."""
    relative, state, right, down = tiles
    rows, columns = state.shape
    for i in range(first, end):
        for j in range(columns):
            if state[i, j] != CLEAN:
                continue
            if j + 1 < columns and state[i, j + 1] == CLEAN:
                right[i, j] = _offset(phase, relative, i * CELL, j * CELL + CELL - 1, 1, 0)
            if i + 1 < rows and state[i + 1, j] == CLEAN:
                down[i, j] = _offset(phase, relative, i * CELL + CELL - 1, j * CELL, 0, 1)


@njit(inline="always")
def _state(flags, top, left):
    """State of a cell from the flags of its pixels."""
    clean, torn, void = 0, 0, 0
    for v in range(top, top + CELL):
        for u in range(left, left + CELL):
            clean += flags[v, u] == CLEAN
            torn += flags[v, u] == TORN
            void += flags[v, u] == VOID
    if clean == CELL * CELL:
        return CLEAN
    return TORN if torn > 0 else (VOID if 2 * void > CELL * CELL else INCOMPLETE)


@njit(inline="always")
def _follow(phase, relative, top, left):
    """Orders of a cell's pixels relative to its first: down its left column, then along its rows."""
    for v in range(top, top + CELL):
        if v > top:
            relative[v, left] = relative[v - 1, left] - np.floor(phase[v, left] - phase[v - 1, left] + np.float32(0.5))
        for u in range(left + 1, left + CELL):
            relative[v, u] = relative[v, u - 1] - np.floor(phase[v, u] - phase[v, u - 1] + np.float32(0.5))


@njit(inline="always")
def _offset(phase, relative, v, u, du, dv):
    """The common offset of all pixel pairs between two cells, NONE if they differ; (v, u) is the first cell's first pair."""
    result = NONE
    for k in range(CELL):
        y, x = v + k * du, u + k * dv
        step = relative[y, x] - np.floor(phase[y + dv, x + du] - phase[y, x] + np.float32(0.5)) - relative[y + dv, x + du]
        if k > 0 and step != result:
            return NONE
        result = int(step)
    return result


@njit
def depth(state):
    """Chessboard distance of each cell to the nearest that is not continuous, in cells; the image's edge is no obstacle."""
    rows, columns = state.shape
    distance = np.empty((rows, columns), np.int32)
    for i in range(rows):
        for j in range(columns):
            nearest = rows + columns if state[i, j] == CLEAN else 0
            for di, dj in ((0, -1), (-1, -1), (-1, 0), (-1, 1)):
                if i + di >= 0 and 0 <= j + dj < columns:
                    nearest = min(nearest, distance[i + di, j + dj] + 1)
            distance[i, j] = nearest
    for i in range(rows - 1, -1, -1):
        for j in range(columns - 1, -1, -1):
            nearest = distance[i, j]
            for di, dj in ((0, 1), (1, 1), (1, 0), (1, -1)):
                if i + di < rows and 0 <= j + dj < columns:
                    nearest = min(nearest, distance[i + di, j + dj] + 1)
            distance[i, j] = nearest
    return distance


@njit(inline="always")
def _find(parent, shift, cell):
    """Root of a cell and the cell's order less the root's."""
    root, total = cell, 0
    while parent[root] != root:
        total += shift[root]
        root = parent[root]
    node, rest = cell, total
    while parent[node] != root:
        above, step = parent[node], shift[node]
        parent[node], shift[node] = root, rest
        node, rest = above, rest - step
    return root, total


@njit
def _descending(distance):
    """Indices of the cells from the greatest distance to the least: counting sort."""
    top = distance.max()
    start = np.zeros(top + 2, np.int64)
    for value in distance:
        start[top - value + 1] += 1
    start = np.cumsum(start)
    order = np.empty(distance.size, np.int32)
    for cell, value in enumerate(distance):
        order[start[top - value]] = cell
        start[top - value] += 1
    return order


@njit(inline="always")
def _contact(right, down, cell, way):
    """The neighbour of a cell to the right, to the left, below or above, and its offset from the cell; NONE without contact."""
    rows, columns = right.shape
    i, j = cell // columns, cell % columns
    near, step = cell, NONE
    if way == 0 and j + 1 < columns:
        near, step = cell + 1, int(right[i, j])
    if way == 1 and j > 0:
        near, step = cell - 1, int(right[i, j - 1])
    if way == 2 and i + 1 < rows:
        near, step = cell + columns, int(down[i, j])
    if way == 3 and i > 0:
        near, step = cell - columns, int(down[i - 1, j])
    return near, -step if way % 2 and step != NONE else step


@njit
def flood(distance, right, down):
    """Gather cells into basins, from the widest places to the narrow ones: a watershed of the distance to the nearest gap.

    Two basins that meet are one unless the narrower is wider than their meeting place by more than BOTTLENECK on each side.

    Returns
    -------
    basin : (rows, columns) int32, the root cell's index, -1 where not continuous
    offset : (rows, columns) int32, order less the root's
    broken : (rows, columns) bool, cells whose contacts within their basin contradict each other
    """
    rows, columns = distance.shape
    count = rows * columns
    parent, shift = np.arange(count).astype(np.int32), np.zeros(count, np.int32)
    peak = distance.copy().ravel()
    flooded = np.zeros(count, np.bool_)
    flat = distance.ravel()
    for cell in _descending(flat):
        level = flat[cell]
        if level == 0:
            break
        flooded[cell] = True
        for way in range(4):
            near, step = _contact(right, down, cell, way)  # order of `near` less that of `cell`
            if step == NONE or not flooded[near]:
                continue
            a, shift_a = _find(parent, shift, cell)
            b, shift_b = _find(parent, shift, near)
            if a == b or min(peak[a], peak[b]) > level + BOTTLENECK:
                continue
            if peak[a] >= peak[b]:
                parent[b], shift[b] = a, shift_a + step - shift_b
            else:
                parent[a], shift[a] = b, shift_b - step - shift_a
    basin, offset = np.full((rows, columns), -1, np.int32), np.zeros((rows, columns), np.int32)
    broken = np.zeros((rows, columns), np.bool_)
    for cell in range(count):
        if flat[cell] > 0:
            root, total = _find(parent, shift, cell)
            basin[cell // columns, cell % columns], offset[cell // columns, cell % columns] = root, total
    for i in range(rows):
        for j in range(columns):
            if right[i, j] != NONE and basin[i, j] == basin[i, j + 1] and offset[i, j + 1] - offset[i, j] != right[i, j]:
                broken[i, j] = True
            if down[i, j] != NONE and basin[i, j] == basin[i + 1, j] and offset[i + 1, j] - offset[i, j] != down[i, j]:
                broken[i, j] = True
    return basin, offset, broken


def number(basin: Integers, broken: Mask) -> tuple[Integers, set[int], int]:
    """Number the basins from 0; returns the new map, the broken basins and the number of basins."""
    inside = basin >= 0
    roots, numbers = np.unique(basin[inside], return_inverse=True)
    numbered = np.full(basin.shape, -1, np.int32)
    numbered[inside] = numbers
    return numbered, set(numbered[broken].tolist()), len(roots)
