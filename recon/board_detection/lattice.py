"""Which of the points found is which point of a grid, seen in perspective, among points that belong to none."""

from collections import deque

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from recon.board_detection.findings import ENOUGH, MIRRORED, BoardNotFound

Array = NDArray[np.float64]
Integers = NDArray[np.int64]

SEEDS = 8  # points to begin from, those with the most regular neighbours
NEIGHBOURS = 8  # of a seed that may be a step away
TOLERANCE = 0.3  # of a step, between where a neighbour is expected and found
TURNS = [np.array([[1, 0], [0, 1]]), np.array([[0, -1], [1, 0]]), np.array([[-1, 0], [0, -1]]), np.array([[0, 1], [-1, 0]])]
MIRROR = np.array([[-1, 0], [0, 1]])


def assign(points: Array, cells: Integers, steps: Integers) -> Integers:
    """Assign points to the nodes of a grid.

    Parameters
    ----------
    points : (k, 2) px
        Points found, in any order, some of them wrong, some perhaps missing.
    cells : (n, 2)
        Where the grid has points, whole numbers, x to the right and y down.
    steps : (2, 2)
        Two steps, as rows, at right angles and equally long, that lead from any point to its neighbours; the second is the first
        turned from x to y.

    Returns
    -------
    (n,)
        Number of the point in each cell, -1 where it is missing. The view is never mirrored. Where the grid looks the same after
        a turn, its first cell is the one nearer to the image's upper left.

    Raises
    ------
    BoardNotFound
        If less than three quarters are there, or they could as well be placed in another way, or only a mirrored grid fits.
    """
    best: list[Integers] = []
    count = 0
    most_mirrored = 0
    grids: list[dict[tuple[int, int], int]] = []
    seen: set[bytes] = set()
    for grown in _grown_grids(points, steps):
        if (form := _form(grown)) in seen:  # most seeds grow into the same grid, turned or shifted: placements would be the same
            continue
        seen.add(form)
        grids.append(grown)
        for assignment in _placements(grown, cells, TURNS):
            found = int((assignment >= 0).sum())
            if found > count:
                best, count = [], found
            if found == count:
                best.append(assignment)
        if count == len(cells):
            break
        most_mirrored = max(most_mirrored, max(map(_size, _placements(grown, cells, [t @ MIRROR for t in TURNS])), default=0))
    if most_mirrored > count and most_mirrored >= ENOUGH * len(cells):
        raise BoardNotFound(MIRRORED)
    if count < ENOUGH * len(cells):
        raise BoardNotFound(f"found {count} of {len(cells)} circles")
    symmetries = _symmetries(cells)
    if len({min(tuple(a[turn]) for turn in symmetries) for a in best}) > 1:
        if count == len(cells):
            raise BoardNotFound(f"found more circles than the board's {len(cells)}: wrong board size")
        raise BoardNotFound(_too_few(max(grids, key=len), cells, steps))
    return min((best[0][turn] for turn in symmetries), key=lambda a: tuple(_from_upper_left(points, a)))


def _too_few(grown: dict[tuple[int, int], int], cells: Integers, steps: Integers) -> str:
    """The reason why a grid fits a board in several places: a whole one of fewer rows, or points that are missing."""
    found, expected = (sorted(np.ptp(places, axis=0) + 1)[::-1] for places in (np.array(list(grown)), cells))
    if np.count_nonzero(steps) == 2 and found[0] * found[1] == len(grown):
        return "found {} x {} circles instead of {} x {}: wrong board size, or some hidden".format(*found, *expected)
    return f"found {len(grown)} of {len(cells)} circles, not enough to tell which are missing"


def _symmetries(cells: Integers) -> list[Integers]:
    """The turns that map the grid onto itself, as orders of its cells."""
    itself = {(int(x), int(y)): k for k, (x, y) in enumerate(cells)}
    return [order for turn in TURNS for order in _placements(itself, cells, [turn]) if (order >= 0).all()]


def _size(assignment: Integers) -> int:
    return int((assignment >= 0).sum())


def _from_upper_left(points: Array, assignment: Integers) -> Array:
    first = points[assignment[assignment >= 0][0]]
    return np.array([first.sum(), first[0]])


def _grown_grids(points: Array, steps: Integers):
    """Grids that begin with two neighbours of a point as the two steps, as maps from cells to points."""
    if len(points) < 4:
        return
    nearest = KDTree(points).query(points, min(NEIGHBOURS + 1, len(points)))[1][:, 1:]
    offsets = points[nearest] - points[:, None]
    for seed in np.argsort(-_regularity(offsets), kind="stable")[:SEEDS]:
        for a in offsets[seed]:
            for b in offsets[seed]:
                if a[0] * b[1] - a[1] * b[0] > 0.3 * np.hypot(*a) * np.hypot(*b):
                    yield _grow(points, int(seed), a, b, steps)


def _regularity(offsets: Array) -> Array:
    """Neighbours with another right opposite : (k,), from offsets : (k, m, 2); in a grid all have one, elsewhere few."""
    length = np.hypot(offsets[..., 0], offsets[..., 1])
    apart = np.linalg.norm(offsets[:, :, None] + offsets[:, None], axis=-1)
    return (apart < TOLERANCE * length[:, :, None]).any(axis=2).sum(axis=1)


def _grow(points: Array, seed: int, a: Array, b: Array, steps: Integers) -> dict[tuple[int, int], int]:
    """Walk from point to point; each step is expected to be as long as the one before."""
    cells = {(0, 0): seed}
    taken = {seed}
    local = {(0, 0): np.array([a, b])}
    queue = deque([(0, 0)])
    while queue:
        cell = queue.popleft()
        for axis in (0, 1):
            for sign in (1, -1):
                goal = (cell[0] + sign * int(steps[axis, 0]), cell[1] + sign * int(steps[axis, 1]))
                if goal in cells:
                    continue
                move = local[cell]
                away = np.hypot(*(points - points[cells[cell]] - sign * move[axis]).T)
                nearest = int(np.argmin(away))
                if nearest in taken or away[nearest] > TOLERANCE * np.hypot(*move.T).min():
                    continue
                cells[goal] = nearest
                taken.add(nearest)
                local[goal] = move.copy()
                local[goal][axis] = sign * (points[nearest] - points[cells[cell]])
                queue.append(goal)
    return cells


def _form(grown: dict[tuple[int, int], int]) -> bytes:
    """The same of all grids that differ by a turn and a shift of their cells alone."""
    places, numbers = np.array(list(grown)), np.array(list(grown.values()))
    order = np.argsort(numbers)
    turned = [places[order] @ turn.T for turn in TURNS]
    return numbers[order].tobytes() + min((cells - cells.min(axis=0)).tobytes() for cells in turned)


def _placements(grown: dict[tuple[int, int], int], cells: Integers, turns: list[Integers]) -> list[Integers]:
    """Placements of the grid that cover most of the grown points, as assignments."""
    places, numbers = np.array(list(grown)), np.array(list(grown.values()))
    options = []
    for turn in turns:
        turned = places @ turn.T
        shifts = (turned[:, None] - cells[None]).reshape(-1, 2)
        low, high = shifts.min(axis=0), shifts.max(axis=0)
        counts = np.bincount(np.ravel_multi_index(tuple((shifts - low).T), tuple(high - low + 1)))
        best = np.column_stack(np.unravel_index(np.flatnonzero(counts == counts.max()), tuple(high - low + 1))) + low
        options += [(counts.max(), turned, shift) for shift in best]
    most = max(option[0] for option in options)
    assignments = []
    for found, turned, shift in options:
        if found == most:
            there = {(int(x), int(y)): n for (x, y), n in zip(turned - shift, numbers, strict=True)}
            assignments.append(np.array([there.get((int(x), int(y)), -1) for x, y in cells]))
    return assignments
