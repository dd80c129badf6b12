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

from recon.geometry.ellipses import Ellipses, root
from recon.model.circle_layout import circle_centres
from recon.model.rig import Target
from recon.tracking.circle_detector import LEAST_SCORE, Candidates
from recon.tracking.pose import distances

Array = NDArray[np.float64]

TILTED = 0.36  # least ratio of scales across and along the tilt: 69 degrees
DISC = (0.027, 0.25)  # diameter of a disc, of the width of the detector's window
UNNAMED = 1e-3  # no identity is less likely than that: a network may be wrong
ALIKE = 0.15  # of a disc's size, by which an ellipse may differ from what the distances ask for
KEPT = 6  # triples a view
HALVES = 3  # with one unseen


@dataclass(frozen=True)
class Triple:
    """Where c0, c1, c2 may be."""

    points: Array  # (3, 2) px; NaN of one that isn't among the candidates
    score: float  # logarithm of its probability, but for a constant

    def within(self, other: "Triple") -> bool:
        """Whether all its candidates are the other's, under whatever names."""
        return {tuple(point) for point in self.points if np.isfinite(point).all()} <= {tuple(point) for point in other.points}


def triples(candidates: Candidates, target: Target, width: float) -> list[Triple]:
    """Hypotheses of the target in a window of this width (px), the likeliest first: three candidates, or two and one unseen."""
    points = np.vstack([candidates.points.reshape(-1, 2), np.full(2, np.nan)])
    scores = np.append(candidates.scores, LEAST_SCORE)
    names = np.vstack([candidates.identity[:, :3], np.full(3, 1 / 4)])
    order = _orders(len(points))
    likely = np.log(np.maximum(names[order, [0, 1, 2]], UNNAMED)).sum(axis=1) + np.log(scores[order]).sum(axis=1)
    whole = (order < len(points) - 1).all(axis=1)
    possible = np.empty(len(order), bool)
    possible[whole] = _possible(points[order[whole]], target, width)
    possible[~whole] = _half_possible(points[order[~whole]], target, width)
    ranked = np.argsort(-likely, kind="stable")
    best = np.concatenate([ranked[(possible & whole)[ranked]][:KEPT], ranked[(possible & ~whole)[ranked]][:HALVES]])
    return [Triple(points[order[k]], float(likely[k])) for k in sorted(best, key=lambda k: -likely[k])]


def _possible(points: Array, target: Target, width: float) -> NDArray[np.bool_]:
    """Whether three points : (n, 3, 2) px can be the circles, by the view's scale and tilt."""
    affine = affinity(points, target)
    scales = np.linalg.svd(affine, compute_uv=False)
    size = scales[:, 0] * target.outer_diameter_mm / width
    return (np.linalg.det(affine) < 0) & (scales[:, 1] > TILTED * scales[:, 0]) & (size > DISC[0]) & (size < DISC[1])


def _half_possible(points: Array, target: Target, width: float) -> NDArray[np.bool_]:
    """The same of points of which one is NaN, by the distance of the other two."""
    size = stretch(points, target) * target.outer_diameter_mm / width
    return (size > TILTED * DISC[0]) & (size < DISC[1])


def stretch(points: Array, target: Target) -> Array:
    """The largest ratio, px/mm, of two circles' distances in the image and on the target, from views : (..., 3, 2) px."""
    return np.fmax.reduce(distances(points) / distances(circle_centres(target)), axis=-1)


def affinity(points: Array, target: Target) -> Array:
    """Of the target's plane to the image, from views : (..., 3, 2) px of the circles: (..., 2, 2) px/mm."""
    sides = points[..., 1:, :] - points[..., :1, :]
    return np.swapaxes(sides, -1, -2) @ np.linalg.inv(circle_centres(target)[1:, :2].T)


def disagreement(ellipses: Ellipses, target: Target) -> float:
    """Misfit of three ellipses' shapes to the target's distances, as a share of their size; inf if mirrored."""
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
    return np.array(list(permutations(range(count), 3)), np.int64).reshape(-1, 3)
