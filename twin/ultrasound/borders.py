"""Where borders may lie along rays through the slice, sought for bundles of neighbouring rays at once.

Most of a ray's way lies in one tissue. The distance to the nearest solid, from the middle of a bundle, tells how far all its rays
are sure to meet no border, so that only the rest has to be walked ray by ray.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from recon.compiled import kernel, njit
from recon.threads import in_threads
from twin.ultrasound.echo_solids import Body, resting_distance, resting_place, shrinking
from twin.ultrasound.scan_lines import Lines, widening, world_from_lines

Array = NDArray[np.float64]

BUNDLE = (8, 5)  # rays along the array and across the plane
CLEAR = 1.15  # over a bundle's reach: distances of bent surfaces are true to second order
MOST = 32  # spans of a bundle
GROWTH_MM = 0.3  # by which a span grows
LEAP_MM = 2.5  # at most, less than the margin of the solids' grids
START, STOP = range(2)  # columns of a span
INSIDE, NEAR, OUTSIDE = -1, 0, 1  # side of a solid on which a bundle runs throughout a span; NEAR where it may meet the border


class Spans(NamedTuple):
    """Spans of depth, by bundles of rays along the array and across the plane."""

    depths: Array  # (n / 8, m / 5, MOST, 2) mm, START and STOP
    counts: NDArray[np.int64]  # (n / 8, m / 5)
    sides: NDArray[np.int8]  # (n / 8, m / 5, MOST, k) of each solid: INSIDE, OUTSIDE or NEAR


class _Bundles(NamedTuple):
    """Middles of the bundles on the probe's face, and figures common to all."""

    poses: Array  # (n / 8, 4, 4) mm, of a line through each
    across: Array  # (m / 5,) mm
    first_mm: Array  # (m / 5,) depth from which they count
    deepest_mm: float
    radius_mm: float  # around the middle, within which a bundle's rays run


def spans(body: Body, lines: Lines, world_from_face: Array, along: Array, z: Array, first_mm: Array, deepest_mm: float) -> Spans:
    """Spans of depth outside of which no ray of a bundle meets a border.

    Parameters
    ----------
    along, z : (n,), (m,) mm
        Places of the rays on the probe's face, evenly spaced; bundle (i, j) has those of [8 i, 8 i + 8) and [5 j, 5 j + 5).
    first_mm : (m,) mm
        Depth from which a ray counts, by its place across the plane.
    deepest_mm : to which rays go.
    """
    groups = [np.split(places, range(size, len(places), size)) for places, size in zip((along, z), BUNDLE, strict=True)]
    middles = [np.array([(part[0] + part[-1]) / 2 for part in group]) for group in groups]
    reach = [max(np.ptp(part) for part in group) / 2 for group in groups]
    starts = np.array([part.min() for part in np.split(first_mm, range(BUNDLE[1], len(z), BUNDLE[1]))])
    radius = CLEAR * float(np.hypot(reach[0] * widening(deepest_mm, lines.bend), reach[1]))
    bundles = _Bundles(world_from_lines(lines, world_from_face, middles[0]), middles[1], starts, deepest_mm, radius)
    solids, shape = body.packed(), (len(middles[0]), len(middles[1]))
    found = Spans(np.zeros((*shape, MOST, 2)), np.zeros(shape, np.int64), np.zeros((*shape, MOST, len(solids.grid)), np.int8))

    def fill(first: int, end: int) -> None:
        clear, side = np.zeros(len(solids.grid)), np.zeros(len(solids.grid), np.int8)
        _fill(first, end, found, solids, bundles, clear, side)

    in_threads(fill, len(middles[0]))
    return found


@kernel
def _fill(first, end, spans, solids, bundles, clear, side):
    depths, counts = spans.depths, spans.counts
    for i in range(first, end):
        pose = bundles.poses[i]
        for j in range(len(bundles.across)):
            across = bundles.across[j]
            x, y, z = pose[0, 2] * across + pose[0, 3], pose[1, 2] * across + pose[1, 3], pose[2, 2] * across + pose[2, 3]
            t, count, stop = bundles.first_mm[j], 0, -1.0
            clear[:] = t
            while t < bundles.deepest_mm:
                point = x + pose[0, 1] * t, y + pose[1, 1] * t, z + pose[2, 1] * t
                met, free = _borders_near(clear, side, solids, point, t, bundles.radius_mm)
                if not met:
                    t = min(free, bundles.deepest_mm)
                    continue
                begins = t > stop and count < MOST
                if begins:
                    depths[i, j, count, START] = t
                    count += 1
                stop = min(t + GROWTH_MM, bundles.deepest_mm)
                depths[i, j, count - 1, STOP] = stop
                for solid in range(len(side)):
                    if begins or side[solid] == NEAR:
                        spans.sides[i, j, count - 1, solid] = side[solid]
                t += GROWTH_MM
            counts[i, j] = count


@njit(inline="always")
def _borders_near(clear, side, solids, point, t, radius_mm):
    """Whether a border may lie in a bundle at a depth, and the depth up to which none may; keeps the solids' sides."""
    met, free = False, np.inf
    x, y, z = resting_place(solids, point[0], point[1], point[2])
    for solid in range(len(clear)):
        if not solids.mirrors[solid]:
            side[solid], clear[solid] = OUTSIDE, np.inf
        elif clear[solid] < t + GROWTH_MM:
            d = shrinking(solids) * resting_distance(solids, solid, x, y, z)
            side[solid] = NEAR if abs(d) <= radius_mm + GROWTH_MM else INSIDE if d < 0 else OUTSIDE
            clear[solid] = t + (GROWTH_MM if side[solid] == NEAR else min(abs(d) - radius_mm, shrinking(solids) * LEAP_MM))
        met |= side[solid] == NEAR
        free = min(free, clear[solid])
    return met, free
