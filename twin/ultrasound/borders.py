"""Where borders may lie along rays through the slice, sought for bundles of neighbouring rays at once.

Most of a ray's way lies in one tissue. The distance to the nearest solid, from the middle of a bundle, tells how far all its rays
are sure to meet no border, so that only the rest has to be walked ray by ray.
"""

import numpy as np
from numba import prange
from numpy.typing import NDArray

from recon.compiled import njit
from twin.ultrasound.echo_solids import Body, distance_at

Array = NDArray[np.float64]

BUNDLE = (8, 5)  # rays along the array and across the plane
CLEAR = 1.15  # over a bundle's reach: distances of bent surfaces are true to second order
MOST = 32  # spans of a bundle
GROWTH_MM = 0.3  # by which a span grows
LEAP_MM = 2.5  # at most, less than the margin of the solids' grids


def spans(
    body: Body, world_from_image: Array, x: Array, z: Array, first_mm: Array, deepest: float
) -> tuple[Array, NDArray[np.int64], NDArray[np.bool_]]:
    """Spans of depth outside of which no ray of a bundle meets a border.

    Parameters
    ----------
    x, z : (n,), (m,) mm
        Places of the rays on the probe's face, evenly spaced; bundle (i, j) has those of [8 i, 8 i + 8) and [5 j, 5 j + 5).
    first_mm : (m,) mm
        Depth from which a ray counts, by its place across the plane.
    deepest : mm, to which rays go.

    Returns
    -------
    spans (n / 8, m / 5, MOST, 2) mm, first and last depth; how many there are (n / 8, m / 5); and which of the k solids have
    borders there (n / 8, m / 5, k).
    """
    groups = [np.split(places, range(size, len(places), size)) for places, size in zip((x, z), BUNDLE, strict=True)]
    middles = [np.array([(part[0] + part[-1]) / 2 for part in group]) for group in groups]
    reach = [max(np.ptp(part) for part in group) / 2 for group in groups]
    starts = np.array([part.min() for part in np.split(first_mm, range(BUNDLE[1], len(z), BUNDLE[1]))])
    radius = CLEAR * float(np.hypot(reach[0], reach[1]))
    return _spans(*body.packed(), world_from_image, middles[0], middles[1], radius, starts, deepest)


@njit(parallel=True)
def _spans(flat, where, frame, pose, xs, zs, radius, starts, deepest):
    found = np.zeros((len(xs), len(zs), MOST, 2))
    counts = np.zeros((len(xs), len(zs)), np.int64)
    close = np.zeros((len(xs), len(zs), len(where)), np.bool_)
    for i in prange(len(xs)):
        clear = np.zeros(len(where))  # depth up to which a solid is sure to have no border in the bundle
        for j in range(len(zs)):
            x = pose[0, 0] * xs[i] + pose[0, 2] * zs[j] + pose[0, 3]
            y = pose[1, 0] * xs[i] + pose[1, 2] * zs[j] + pose[1, 3]
            z = pose[2, 0] * xs[i] + pose[2, 2] * zs[j] + pose[2, 3]
            t, count, end = starts[j], 0, -1.0
            clear[:] = t
            while t < deepest:
                met, onwards = False, deepest
                for s in range(len(where)):
                    if t >= clear[s]:
                        d = distance_at(flat, where[s], frame[s], x + pose[0, 1] * t, y + pose[1, 1] * t, z + pose[2, 1] * t)
                        here = abs(d) <= radius + GROWTH_MM
                        clear[s] = t + (GROWTH_MM if here else min(abs(d) - radius, LEAP_MM))
                        close[i, j, s] |= here
                        met |= here
                    onwards = min(onwards, clear[s])
                if met:
                    if t > end and count < MOST:
                        found[i, j, count, 0] = t
                        count += 1
                    end = min(t + GROWTH_MM, deepest)
                    found[i, j, count - 1, 1] = end
                    t += GROWTH_MM
                else:
                    t = onwards
            counts[i, j] = count
    return found, counts, close
