"""Curves over small holes of a measured skin, such as gloss leaves where it saturates the cameras.

The skin around a hole is fitted by a quadratic on the chart, which bridges the hole: over 8 mm of skin that is bent with a radius
of 60 mm a chord would be off by 0.13 mm. A hole that skin doesn't surround is its rim, and stays open.
"""

from collections.abc import Iterator

import numpy as np
import trimesh
from numpy.typing import NDArray

from recon.skin_projection.lines_of_sight import Sight

Array = NDArray[np.float64]

OPEN = np.deg2rad(100)  # widest sector about the hole without skin


def bridged(points: Array, chain: Array, sight: Sight, skin: trimesh.Trimesh) -> Array:
    """A curve's points on the skin : (n, 3) mm, with those over small holes, which are NaN, bridged.

    chain : (n, 2), of their places on the chart; one that ends where it begins is closed
    """
    missing = np.isnan(points[:, 0])
    if not missing.any() or missing.all():
        return points
    result, charted = points.copy(), sight.chart(skin.vertices)
    widest_mm = 15.0  # way of a curve over a hole
    uneven_mm = 0.3  # standard deviation of the skin about the quadratic, beyond which it isn't bridged
    for gap in _gaps(missing, bool((chain[0] == chain[-1]).all())):
        places = chain[gap]
        way = np.linalg.norm(np.diff(places, axis=0), axis=1).sum()
        nearness = _patch(places, charted) if way <= widest_mm else None
        if nearness is not None:
            filled, uneven = nearness
            at = sight.world(np.column_stack([places, filled]))
            off = sight.world(np.column_stack([places, filled + uneven])) - at
            if np.linalg.norm(off, axis=1).max() <= uneven_mm:
                result[gap] = at
    return result


def _gaps(missing: NDArray[np.bool_], closed: bool) -> Iterator[NDArray[np.int64]]:
    """Numbers of points in each run of missing ones that has known ones at both ends; round the seam of a closed chain, too."""
    n = len(missing)
    count = n - 1 if closed else n  # the last one of a closed chain is the first
    start = int(np.flatnonzero(~missing[:count])[0])
    order = (start + np.arange(count + closed)) % count
    order = order[: np.flatnonzero(~missing[order])[-1] + 1]
    runs = np.flatnonzero(np.diff(missing[order].astype(int)))
    for first, last in zip(runs[::2], runs[1::2], strict=True):
        gap = order[first + 1 : last + 1]
        yield np.append(gap, n - 1) if closed and 0 in gap else gap


def _patch(places: Array, charted: Array) -> tuple[Array, float] | None:
    """Nearness : (k,) at places on the chart by the skin around them, and the skin's standard deviation; None for its rim."""
    middle = (places.min(axis=0) + places.max(axis=0)) / 2
    around_mm = 4.0  # of the skin, beyond the curve's ends at the hole
    reach = np.linalg.norm(places - middle, axis=1).max() + around_mm
    off = charted[:, :2] - middle
    near = np.einsum("ij,ij->i", off, off) < reach**2
    fewest = 50  # vertices around
    if np.count_nonzero(near) < fewest:
        return None
    angles = np.sort(np.arctan2(off[near, 1], off[near, 0]))
    if np.diff(angles, append=angles[0] + 2 * np.pi).max() > OPEN:
        return None
    known = charted[near, 2]
    terms, *_ = np.linalg.lstsq(_quadratic(off[near] / reach), known, rcond=None)
    uneven = float(np.std(known - _quadratic(off[near] / reach) @ terms))
    return _quadratic((places - middle) / reach) @ terms, uneven


def _quadratic(places: Array) -> Array:
    x, y = places.T
    return np.column_stack([np.ones_like(x), x, y, x * x, x * y, y * y])
