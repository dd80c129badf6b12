"""Spatial unwrapping from a projected centre line: surfaces that continue to the line get its absolute fringe order.

A wrapped phase can be followed across a surface, not across a jump. Pixels are gathered into cells of 4x4 that are continuous
in themselves; cells into basins, cut off at bottlenecks; basins into regions, where most of their common border is continuous.
Two surfaces that touch in the image with a varying jump between them agree by chance wherever the jump passes a whole number
of periods: that opening in an otherwise torn border is a bottleneck, and is refused. The line then gives each region its
absolute order, by vote. A region without the line is reported as unreachable, one whose votes disagree as disputed.

Only a jump that is a whole number of periods (within the noise, some 0.2 to 0.4 rad) along most of the border between two
surfaces, or along an opening as wide as the smaller of them, can fool this, as it fools any use of the phase alone: Gray
code or a second pitch is needed there. Gaps (shadow, dark spots) every few pixels leave no continuous cell and cost coverage.
"""

from collections import Counter, defaultdict
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from recon.compiled import kernel, njit
from recon.structured_light.phase import Fringe
from recon.structured_light.unwrapping import continuity, watershed
from recon.structured_light.unwrapping.continuity import CLEAN, INCOMPLETE, TORN, VOID, wrap
from recon.structured_light.unwrapping.merging import Borders, join
from recon.structured_light.unwrapping.watershed import CELL, NONE
from recon.threads import in_threads

MARGIN_CELLS = 3  # cells that a basin grows into torn ground, so that neighbours across a tear meet
LINE_LEVEL = 0.25  # of full light: brighter is the line
EVERY = (7, 13)  # rows and columns, whose pixels tell how bright the image of the line is without the line
RESIDUAL = 0.2  # cycle that a vote may be off a whole order

Flags = NDArray[np.uint8]
Integers = NDArray[np.int32]
Mask = NDArray[np.bool_]


class Line(NamedTuple):
    """The centre line, in the projector."""

    turns: float  # cycles, the absolute phase of its middle
    width: float  # cycles


class Ground(NamedTuple):
    """Continuous ground: cells of 4x4 px, and the basins that they are gathered in."""

    phase: NDArray[np.float32]  # (h, w) cycles
    relative: NDArray[np.int8]  # (h, w) order of each pixel less its cell's
    basin: Integers  # (rows, columns) the basin of each cell, -1 of none
    offset: Integers  # (rows, columns) order of each cell less its basin's


@dataclass(frozen=True)
class Unwrapped:
    """Absolute fringe orders from the centre line."""

    order: Integers  # (h, w)
    known: Mask  # (h, w) where the order holds
    unreachable: Mask  # (h, w) continuous surface without the line
    regions: int  # with the line
    islands: int  # without
    disputed: int  # in which the line's votes disagree
    votes: int  # sightings of the line on continuous surface that name an order
    sightings: int  # all of them
    residual: float  # cycle, in +-0.5, offset of the line from the fringes, the median over the sightings


def unwrap(fringe: Fringe, valid: Mask, line: NDArray, turns: float, width: float) -> Unwrapped:
    """Unwrap along the surface, starting from the centre line.

    Parameters
    ----------
    fringe : Fringe
        The decoded fringes, (h, w); the line may run in any direction but along the rows.
    valid : (h, w) bool
        Pixels with enough modulation.
    line : (h, w), DN
        The image of the line.
    turns : float, cycles
        The absolute phase of the line's middle: (line - origin) / pitch.
    width : float, cycles
        The line's width.

    Returns
    -------
    Unwrapped
        `sightings` is zero without a line in the image, `residual` far from zero with fringes of another sequence; the caller
        judges both.
    """
    phase = fringe.phase * np.float32(1 / (2 * np.pi))
    flags = continuity.continuity(phase, fringe.sigma, valid)
    relative, state, right, down = watershed.gather(phase, flags)
    distance = watershed.depth(state)
    basin, offset, broken = watershed.flood(distance, right, down)
    basin, broken, count = watershed.number(basin, broken)
    light = _line_light(line, valid, fringe)
    places, values, residuals = _sightings(light, Line(float(turns), width), Ground(phase, relative, basin, offset))
    near = np.abs(residuals) < RESIDUAL
    votes: dict[int, Counter] = defaultdict(Counter)
    for place, value in zip(places[near].tolist(), values[near].tolist(), strict=True):
        votes[place][value] += 1
    ground = _grown(state, basin)
    found = join(count, _borders(state, ground, offset, right, down), votes, broken)
    base = np.array([found.absolute.get(r, 0) for r in found.region.tolist()], np.int32)
    resolved = np.array([r in found.absolute for r in found.region.tolist()], bool)
    contested = np.array([r in found.disputed for r in found.region.tolist()], bool)
    cells = offset + np.append(base + found.lift, 0)[basin].astype(np.int32)
    home = np.where(basin >= 0, np.append(found.region, -1)[basin], -1).astype(np.int32)
    frontier = _frontier(np.where(ground >= 0, np.append(found.region, -1)[ground], -1))
    # A continuous cell right at the frontier may hold pixels of both surfaces; no order is carried within two cells of it.
    closed = _leaks(distance, home, cells, right, down) | _dilated(frontier, 1) | ((basin < 0) & _dilated(frontier, 2))
    reached = (basin >= 0) & np.append(resolved, False)[basin] & ~closed
    island = (basin >= 0) & ~np.append(resolved | contested, True)[basin] & ~closed
    order, known, unreachable = _to_pixels(JoinedCells(cells, basin >= 0, reached, island, closed), relative, flags)
    order, known = continuity.carry(order, known, phase, fringe.sigma, flags, CLEAN, continuity.REACH)
    order, known = continuity.carry(order, known, phase, fringe.sigma, flags, INCOMPLETE, continuity.BLIND_REACH)
    islands = len(set(found.region.tolist()) - set(found.absolute) - found.disputed)
    sighted = int(np.count_nonzero(near)), len(values), _circular_median(residuals)
    return Unwrapped(order, known, unreachable, len(found.absolute), islands, len(found.disputed), *sighted)


def _line_light(image: NDArray, valid: Mask, fringe: Fringe) -> NDArray[np.float32]:
    """Light of the line over full light, where it is bright enough to be the line : (h, w), 0 elsewhere.

    Beside the line it is as dark as between fringes, or as most of the line's image where that is darker: on translucent skin
    nothing is dark between fringes.
    """
    light = np.zeros(image.shape, np.float32)
    some, level, offset = (field[:: EVERY[0], :: EVERY[1]] for field in (valid, image, fringe.offset))
    unlit = np.float32(np.median(level[some] / np.maximum(offset[some], 1))) if some.any() else np.float32(0)
    in_threads(_fill_light, len(image), image, valid, fringe, unlit, light)
    return light


@kernel
def _fill_light(first, end, image, valid, fringe: Fringe, unlit, light):
    offset, modulation, sigma = fringe.offset, fringe.modulation, fringe.sigma
    for v in range(first, end):
        for u in range(image.shape[1]):
            dark = max(min(offset[v, u] - modulation[v, u], unlit * offset[v, u]), np.float32(0))
            level = (image[v, u] - dark) / (offset[v, u] + modulation[v, u] - dark)
            light[v, u] = level if valid[v, u] and level >= LINE_LEVEL + 4 * sigma[v, u] else 0


@njit
def _sightings(light, line: Line, ground: Ground):
    """Sightings of the line on continuous ground: the basin, the absolute order of the basin's root cell, cycles off a whole."""
    rows, columns = ground.basin.shape
    places, values, residuals = [np.int32(0) for _ in range(0)], [np.int32(0) for _ in range(0)], [0.0 for _ in range(0)]
    for v in range(rows * CELL):
        bright, phase = light[v, : columns * CELL], ground.phase[v]
        end = 0
        for u in range(columns * CELL):
            if u < end or bright[u] == 0:
                continue
            end, middle, extent = _lit_run(bright, phase, u)
            if end - u >= 2 and extent < 1.5 * line.width + 0.3:
                near = int(np.floor(middle + 0.5))
                place = ground.basin[v // CELL, near // CELL]
                if place >= 0:
                    here = _phase_between(phase, near, middle)
                    whole = np.floor(line.turns - here + 0.5)
                    places.append(place)
                    values.append(np.int32(whole) - ground.relative[v, near] - ground.offset[v // CELL, near // CELL])
                    residuals.append(line.turns - here - whole)
    return np.array(places), np.array(values), np.array(residuals)


@njit(inline="always")
def _lit_run(bright, phase, start):
    """Lit pixels of a row from `start` on: their end, the middle of their light, and their extent in cycles."""
    u, weight, moment, extent = start, 0.0, 0.0, 0.0
    while u < len(bright) and bright[u] > 0:
        if u > start:
            extent += abs(wrap(phase[u] - phase[u - 1]))
        weight += bright[u]
        moment += bright[u] * u
        u += 1
    return u, moment / weight, extent


@njit(inline="always")
def _phase_between(phase, near, u):
    """Phase at column u of a row, between the nearest pixel and the one on its other side."""
    other = near + 1 if u > near else near - 1
    return phase[near] + abs(u - near) * wrap(phase[other] - phase[near])


def _circular_median(cycles: NDArray[np.float64]) -> float:
    """The median of values in +-0.5 that wrap around, 0 of none: about their mean direction."""
    if not cycles.size:
        return 0.0
    middle = float(np.angle(np.mean(np.exp(2j * np.pi * cycles))) / (2 * np.pi))
    return float(wrap(np.float64(middle + np.median(wrap(cycles - middle)))))


def _borders(state: Flags, ground: Integers, offset: Integers, right: NDArray[np.int8], down: NDArray[np.int8]) -> Borders:
    """Count the contacts between basins that have grown into the torn ground between them."""
    continuous: dict[tuple[int, int], Counter] = defaultdict(Counter)
    torn: Counter = Counter()
    for steps, here, there in ((right, np.s_[:, :-1], np.s_[:, 1:]), (down, np.s_[:-1], np.s_[1:])):
        p, q, step = ground[here], ground[there], steps[here]
        meet = (p != q) & (p >= 0) & (q >= 0)
        jump = step + offset[here] - offset[there]  # order of q's root less that of p's, at this contact
        ripped = (state[here] == TORN) | (state[there] == TORN) | ((state[here] == CLEAN) & (state[there] == CLEAN))
        whole, rip = meet & (step != NONE), meet & (step == NONE) & ripped
        for a, b, k in zip(p[whole].tolist(), q[whole].tolist(), jump[whole].tolist(), strict=True):
            continuous[min(a, b), max(a, b)][k if a < b else -k] += 1
        torn.update((min(a, b), max(a, b)) for a, b in zip(p[rip].tolist(), q[rip].tolist(), strict=True))
    return Borders(continuous, torn)


@njit
def _grown(state, basin):
    """The basins, grown into torn cells by one ring a pass; a cell next to several takes its first neighbour's."""
    rows, columns = basin.shape
    ground = basin.copy()
    for _ in range(MARGIN_CELLS):
        before = ground.copy()
        for i in range(rows):
            for j in range(columns):
                if before[i, j] < 0 and state[i, j] != VOID:
                    ground[i, j] = _neighbour(before, i, j)
    return ground


@njit(inline="always")
def _neighbour(basin, i, j):
    """The basin of a cell's first neighbour that has one, -1 without."""
    rows, columns = basin.shape
    for di, dj in ((0, 1), (0, -1), (1, 0), (-1, 0)):
        if 0 <= i + di < rows and 0 <= j + dj < columns and basin[i + di, j + dj] >= 0:
            return basin[i + di, j + dj]
    return np.int32(-1)


@njit
def _leaks(distance, home, cells, right, down):
    """Cells near a continuous contact that was refused: the jump between the two surfaces lies somewhere in the opening.

    The opening is as wide as the contact is far from the nearest gap, on both sides; the border can bulge that far.
    """
    rows, columns = distance.shape
    leaking = np.zeros((rows, columns), np.bool_)
    for i in range(rows):
        for j in range(columns):
            for y, x, step in ((i, j + 1, right[i, j]), (i + 1, j, down[i, j])):
                if step == NONE or (home[i, j] == home[y, x] and cells[y, x] - cells[i, j] == step):
                    continue
                reach = min(distance[i, j], distance[y, x]) + 2
                leaking[max(i - reach, 0) : y + reach + 1, max(j - reach, 0) : x + reach + 1] = True
    return leaking


def _frontier(home: Integers) -> Mask:
    """Cells at the border between the grounds of two regions."""
    border = np.zeros(home.shape, bool)
    for here, there in ((np.s_[:, :-1], np.s_[:, 1:]), (np.s_[:-1], np.s_[1:])):
        meet = (home[here] != home[there]) & (home[here] >= 0) & (home[there] >= 0)
        border[here] |= meet
        border[there] |= meet
    return border


def _dilated(mask: Mask, cells: int) -> Mask:
    """The mask, grown by a number of cells all round."""
    side = 2 * cells + 1
    return cv2.dilate(mask.view(np.uint8), np.ones((side, side), np.uint8)).view(bool)


class JoinedCells(NamedTuple):
    """Cells after the regions were joined. All (rows, columns)."""

    order: Integers  # of a cell's first pixel
    continuous: Mask
    reached: Mask  # by the line
    island: Mask
    closed: Mask  # leaks and frontiers


class Pixels(NamedTuple):
    """Orders of pixels. All (h, w)."""

    order: Integers
    known: Mask
    unreachable: Mask


def _to_pixels(cells: JoinedCells, relative: NDArray[np.int8], flags: Flags) -> Pixels:
    """Orders of the cells, given to their pixels.

    Islands, leaks and frontiers are marked in the flags, so that no order is carried into them.
    """
    pixels = Pixels(np.zeros(flags.shape, np.int32), np.zeros(flags.shape, bool), np.zeros(flags.shape, bool))
    in_threads(_fill, CELL * len(cells.order), cells, relative, flags, pixels)
    return pixels


@kernel
def _fill(first, end, cells, relative, flags, pixels):
    """Fill rows `first` to `end`, not included."""
    for v in range(first, end):
        for u in range(CELL * cells.order.shape[1]):
            i, j = v // CELL, u // CELL
            if cells.reached[i, j]:
                pixels.order[v, u], pixels.known[v, u] = cells.order[i, j] + relative[v, u], True
                continue
            if cells.closed[i, j]:
                flags[v, u] = min(flags[v, u], np.uint8(TORN))
                continue
            if cells.continuous[i, j]:
                pixels.unreachable[v, u] = cells.island[i, j]
                flags[v, u] = VOID
