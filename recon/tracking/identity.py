"""Which of the circles in a view are the target's, and which is which: by the network's word, and by geometry.

A view of the target is nearly affine: it takes (25, 0) and (0, 40) mm to the distances in the image, and a disc to its ellipse.
Scale and tilt must be possible, the front must face the camera (the cross product of c1 - c0 and c2 - c0 is negative there),
and the ellipses must be those that the distances ask for; that alone tells the three names that turn the same way round.
"""

from dataclasses import dataclass
from functools import cache
from itertools import permutations

import numpy as np
from numpy.typing import NDArray

from recon.ellipses import Ellipses, root
from recon.rig import Target
from recon.tracking.detection import Candidates

Array = NDArray[np.float64]

TILTED = 0.36  # least ratio of scales across and along the tilt: 69 degrees
DISC = (0.03, 0.19)  # diameter of a disc, of the image's width
UNNAMED = 1e-3  # no identity is less likely than that: a network may be wrong
ALIKE = 0.15  # of a disc's size, by which an ellipse may differ from what the distances ask for
KEPT = 6  # triples a view


@dataclass(frozen=True)
class Triple:
    """Three candidates as c0, c1, c2."""

    chosen: NDArray[np.int64]  # (3,) numbers of the candidates
    points: Array  # (3, 2) px
    score: float  # logarithm of its probability, but for a constant


def triples(candidates: Candidates, target: Target, width: int) -> list[Triple]:
    """Triples that can be the target in an image of this width (px), the likeliest first."""
    if len(candidates.points) < 3:
        return []
    order = _orders(len(candidates.points))
    points = candidates.points[order]
    affine = affinity(points, target)
    scales = np.linalg.svd(affine, compute_uv=False)
    size = scales[:, 0] * target.outer_diameter_mm / width
    possible = (np.linalg.det(affine) < 0) & (scales[:, 1] > TILTED * scales[:, 0]) & (size > DISC[0]) & (size < DISC[1])
    likely = np.log(np.maximum(candidates.identity[order, [0, 1, 2]], UNNAMED)).sum(axis=1)
    likely += np.log(candidates.scores[order]).sum(axis=1)
    best = [k for k in np.argsort(-likely, kind="stable") if possible[k]][:KEPT]
    return [Triple(order[k], points[k], float(likely[k])) for k in best]


def affinity(points: Array, target: Target) -> Array:
    """Of the target's plane to the image, from views : (..., 3, 2) px of the circles: (..., 2, 2) px/mm."""
    sides = points[..., 1:, :] - points[..., :1, :]
    return np.swapaxes(sides, -1, -2) / np.array([target.c1_mm, target.c2_mm])


def disagreement(ellipses: Ellipses, target: Target) -> float:
    """By how much, as a share of their size, three ellipses differ from those that their distances ask for; inf if mirrored."""
    affine = affinity(ellipses.centre, target)
    if not np.isfinite(affine).all() or np.linalg.det(affine) >= 0:
        return np.inf
    expected = root((affine @ affine.T)[None] * (target.outer_diameter_mm / 2) ** 2)[0]
    return float(np.abs(ellipses.shape - expected).max() / (np.trace(expected) / 2))


def named(ellipses: Ellipses, target: Target) -> tuple[NDArray[np.int64], float]:
    """The order in which three ellipses are c0, c1, c2 by their geometry, and their disagreement then."""
    orders = _orders(3)
    off = [disagreement(ellipses[order], target) for order in orders]
    best = int(np.argmin(off))
    return orders[best], off[best]


@cache
def _orders(count: int) -> NDArray[np.int64]:
    return np.array(list(permutations(range(count), 3)), np.int64)
