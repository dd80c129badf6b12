"""Continuity of a wrapped phase from pixel to pixel, and the carrying of orders along it.

A step of the surface is a jump of the phase. It is looked for with an antisymmetric stencil along rows and columns: the phase
difference over three pixels less the prediction by the slopes two pixels further out. Curvature and a crease in the middle cancel
in it; the rest is the jump (less whole periods), third derivatives and noise of 2.7 sigma. The mean over three neighbours
beside each other, for which any border is straight enough, shows smaller jumps still.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from recon.compiled import kernel, njit
from recon.threads import in_threads

Image = NDArray[np.float32]
Integers = NDArray[np.int32]
Flags = NDArray[np.uint8]
Mask = NDArray[np.bool_]

VOID, TORN, INCOMPLETE, CLEAN = 0, 1, 2, 3  # not measured; next to a jump; too near a gap to decide; continuous both ways

SLACK = 0.008  # cycle (0.05 rad) of mismatch that third derivatives and texture may cause
SIGMAS = 4.5  # of the stencil's noise; one in 150 000 comparisons fails by chance
STENCIL_NOISE = 2.7 / (2 * math.pi)  # cycle a rad: sqrt(2 (1.75^2 + 0.75^2)) = 2.69
REACH = 8  # px that an order is carried along clean pixels, less than two cells of the unwrapping
BLIND_REACH = 5  # px that it is carried where the stencil is incomplete: the stencil's own reach


class Carried(NamedTuple):
    """Orders of pixels. Both (h, w)."""

    order: Integers
    known: Mask


class Field(NamedTuple):
    """Phases that orders are carried along. All (h, w)."""

    phase: Image  # cycles
    sigma: Image  # rad
    flags: Flags


@njit(inline="always")
def wrap(cycles):
    """The difference of two phases in cycles, to [-0.5, 0.5)."""
    return cycles - np.floor(cycles + np.float32(0.5))


def continuity(phase: Image, sigma: Image, valid: Mask) -> Flags:
    """Classify pixels by the continuity of their phase.

    Parameters
    ----------
    phase : (h, w) float32, cycles
    sigma : (h, w) float32, rad
    valid : (h, w) bool

    Returns
    -------
    flags : (h, w) uint8
        VOID, TORN, INCOMPLETE or CLEAN.
    """
    across, down = np.full((2, *phase.shape), np.nan, np.float32)
    jumps, flags = np.empty((2, *phase.shape), np.uint8)
    height, width = phase.shape
    in_threads(_compare, height, phase, valid, across, down)
    in_threads(_find_jumps, height, across, down, sigma, jumps)
    in_threads(lambda first, end: _combine(first, end, jumps, valid, np.empty(width, np.uint8), flags), height)
    return flags


@kernel
def _compare(first, end, phase, valid, across, down):
    """Mismatch at the pairs (u, u + 1) and (v, v + 1), cycles, of rows `first` to `end`, not included; NaN where incomplete."""
    height, width = phase.shape
    outside = np.float32(0.75)
    for v in range(first, end):
        p = phase[v]
        for u in range(3, width - 4):
            inner = wrap(p[u] - p[u - 1]) + wrap(p[u + 1] - p[u]) + wrap(p[u + 2] - p[u + 1])
            outer = wrap(p[u - 1] - p[u - 2]) + wrap(p[u - 2] - p[u - 3]) + wrap(p[u + 3] - p[u + 2]) + wrap(p[u + 4] - p[u + 3])
            across[v, u] = wrap(inner - outside * outer)
        run = 0
        for u in range(width):
            run = run + 1 if valid[v, u] else 0
            if u >= 4 and run < 8:
                across[v, u - 4] = np.nan
        if v < 3 or v >= height - 4:
            continue
        a, b, c, d = phase[v - 3], phase[v - 2], phase[v - 1], phase[v]
        e, f, g, h = phase[v + 1], phase[v + 2], phase[v + 3], phase[v + 4]
        for u in range(width):
            inner = wrap(d[u] - c[u]) + wrap(e[u] - d[u]) + wrap(f[u] - e[u])
            outer = wrap(c[u] - b[u]) + wrap(b[u] - a[u]) + wrap(g[u] - f[u]) + wrap(h[u] - g[u])
            down[v, u] = wrap(inner - outside * outer)
        for u in range(width):
            above = valid[v - 3, u] & valid[v - 2, u] & valid[v - 1, u] & valid[v, u]
            below = valid[v + 1, u] & valid[v + 2, u] & valid[v + 3, u] & valid[v + 4, u]
            down[v, u] = down[v, u] if above & below else np.float32(np.nan)


@kernel
def _find_jumps(first, end, across, down, sigma, jumps):
    """Judge the pixels of rows `first` to `end`, not included."""
    height, width = sigma.shape
    for v in range(first, end):
        over, here, under = across[max(v - 1, 0)], across[v], across[min(v + 1, height - 1)]
        for u in range(1, width - 1):  # the first and last column apart: without limits on u this takes vector instructions
            jumps[v, u] = _judge(over[u], here[u], under[u], down[v, u - 1], down[v, u], down[v, u + 1], sigma[v, u])
        for u, left, right in ((0, 0, min(1, width - 1)), (width - 1, max(width - 2, 0), width - 1)):
            jumps[v, u] = _judge(over[u], here[u], under[u], down[v, left], down[v, u], down[v, right], sigma[v, u])


@njit(inline="always")
def _judge(over, x, under, left, y, right, s):
    """Bit 0 torn across, 1 torn down, 2 incomplete across, 3 incomplete down; from the mismatches at a pixel and beside it."""
    single = np.float32(SLACK) + np.float32(SIGMAS * STENCIL_NOISE) * s
    triple = np.float32(SLACK) + np.float32(SIGMAS * STENCIL_NOISE / math.sqrt(3)) * s
    torn = np.uint8((abs(x) > single) | (abs(over + x + under) > 3 * triple))
    torn |= np.uint8(2) * np.uint8((abs(y) > single) | (abs(left + y + right) > 3 * triple))
    return torn | np.uint8(4) * np.uint8(x != x) | np.uint8(8) * np.uint8(y != y)


@kernel
def _combine(first, end, jumps, valid, seen, flags):
    """A pixel is torn if any stencil is whose middle it touches, incomplete if any is; clean otherwise."""
    height, width = valid.shape
    for v in range(first, end):
        seen[:] = 0
        for k in range(-2, 2):
            y = min(max(v + k, 0), height - 1)
            for u in range(width):
                seen[u] |= jumps[y, u] & np.uint8(2 | 8)
            for u in range(2, width - 1):
                seen[u] |= jumps[v, u + k] & np.uint8(1 | 4)
        for u in (0, 1, width - 1):
            if 0 <= u < width:
                seen[u] |= np.uint8(4)
        for u in range(width):
            flags[v, u] = VOID
            if valid[v, u]:
                flags[v, u] = TORN if seen[u] & 3 else (INCOMPLETE if seen[u] & 12 else CLEAN)


def carry(order: Integers, known: Mask, phase: Image, sigma: Image, flags: Flags, wanted: int, reach: int) -> Carried:
    """Carry orders from known pixels to their neighbours, as far as the phase follows the slope it had among the known ones.

    Looks along the row and the column, both ways, up to `reach` px. A pixel gets an order if at least one way leads to it over
    continuous pixels and no two ways contradict each other.

    Parameters
    ----------
    order : (h, w) int32
    known : (h, w) bool, where the order is known
    phase : (h, w) float32, cycles
    sigma : (h, w) float32, rad
    flags : (h, w) uint8, of `continuity`
    wanted : int, least flag of a pixel to be filled, crossed or started from: CLEAN or INCOMPLETE
    reach : int, px

    Returns
    -------
    order, known
        Copies with the new ones in.
    """
    before, after, field = Carried(order, known), Carried(order.copy(), known.copy()), Field(phase, sigma, flags)
    in_threads(_carry, len(order), before, after, field, wanted, reach)
    return after


@kernel
def _carry(first, end, before, after, field, wanted, reach):
    """Carry orders to the pixels of rows `first` to `end`, not included."""
    order, known, phase, sigma, flags = before.order, before.known, field.phase, field.sigma, field.flags
    for v in range(first, end):
        for u in range(phase.shape[1]):
            if known[v, u] or flags[v, u] < wanted:
                continue
            candidate, ways, clash = 0, 0, False
            tolerance = SLACK + SIGMAS * 2.5 * sigma[v, u] / (2 * math.pi)
            for dv, du in ((0, 1), (0, -1), (1, 0), (-1, 0)):
                distance = _nearest_known(known, flags, wanted, reach, v, u, dv, du)
                if distance == 0:
                    continue
                total, smooth = _along_slope(order, phase, v, u, dv, du, distance, tolerance)
                if smooth:
                    here = math.floor(total - phase[v, u] + 0.5)
                    clash = clash or (ways > 0 and here != candidate)
                    candidate, ways = here, ways + 1
            if ways > 0 and not clash:
                after.order[v, u], after.known[v, u] = candidate, True


@njit(inline="always")
def _nearest_known(known, flags, wanted, reach, v, u, dv, du):
    """Steps to the nearest known pixel that another follows two steps behind, over continuous ones; 0 without."""
    height, width = known.shape
    for step in range(1, reach + 1):
        y, x = v + step * dv, u + step * du
        if not (0 <= y < height and 0 <= x < width) or flags[y, x] < wanted:
            return 0
        if known[y, x]:
            y, x = y + 2 * dv, x + 2 * du
            return step if 0 <= y < height and 0 <= x < width and known[y, x] else 0
    return 0


@njit(inline="always")
def _along_slope(order, phase, v, u, dv, du, distance, tolerance):
    """Absolute phase of a pixel in cycles, followed from a known one; and whether it keeps the slope between known ones."""
    y, x = v + distance * dv, u + distance * du
    start = order[y, x] + phase[y, x]
    slope = (start - order[y + 2 * dv, x + 2 * du] - phase[y + 2 * dv, x + 2 * du]) / 2
    total, smooth = start, True
    for step in range(distance - 1, -1, -1):
        change = wrap(phase[v + step * dv, u + step * du] - phase[v + (step + 1) * dv, u + (step + 1) * du] - slope)
        smooth = smooth and abs(change) < tolerance
        total += slope + change
    return total, smooth and abs(total - start - distance * slope) <= 2 * tolerance
