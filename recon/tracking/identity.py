"""Which of the circles in a view are the target's, and which is which: by the network's word, and by geometry.

A view of the target is nearly affine: it takes the distances of circles to those in the image, and a disc to its ellipse.
Scale and tilt must be possible, the front must face the camera (the cross product of c1 - c0 and c2 - c0 is negative there),
and the ellipses must be those that the distances ask for; of three circles that alone tells names that turn the same way round.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, lru_cache
from itertools import permutations

import numpy as np
from numpy.typing import NDArray

from recon.errors import InputError
from recon.geometry.ellipses import Ellipses, root
from recon.geometry.pose_hypotheses import POINTS
from recon.model import circle_layout
from recon.model.circle_layout import circle_centres
from recon.model.rig import Target
from recon.tracking.circle_detector import LEAST_SCORE, Candidates
from recon.tracking.pose import distances

Array = NDArray[np.float64]

TILTED = 0.36  # least ratio of scales across and along the tilt: 69 degrees
DISC = (0.027, 0.25)  # diameter of a disc, of the width of the detector's window
UNNAMED = 1e-3  # no identity is less likely than that: a network may be wrong
ALIKE = 0.15  # of a disc's size, by which an ellipse may differ from what the distances ask for
FIRST = 4  # circles that are tried in all orders
LINE = 0.25  # of the spread of circles along a line, that across which they lie nearly in it
KEPT = 6  # namings a view
HALVES = 3  # with one circle unseen
ASTRAY = 1.0  # of a disc's radius, by which one of more than three circles may be off where an affine view has it: perspective


@dataclass(frozen=True)
class Naming:
    """Where c0, c1 and on may be."""

    points: Array  # (n, 2) px; NaN of one that isn't among the candidates
    score: float  # logarithm of its probability, but for a constant

    def within(self, other: "Naming") -> bool:
        """Whether all its candidates are the other's, under whatever names."""
        return {tuple(point) for point in self.points if np.isfinite(point).all()} <= {tuple(point) for point in other.points}


def namings(candidates: Candidates, target: Target, width: float) -> list[Naming]:
    """Hypotheses of the target in a window of this width (px), the likeliest first: a candidate each circle, or one unseen.

    Raises
    ------
    InputError
        If the detector names another number of circles than the target has.
    """
    circles, known = circle_layout.count(target), candidates.identity.shape[1] - 1
    if known != circles:
        expected = f"expected a detector of {circles} circles, as rig.target of {target.kind} has, found one of {known}"
        way = f"load networks with kind={target.kind}, and by_geometry=True where they were trained for another target"
        raise InputError(f"networks: {expected}: {way}")
    points = np.vstack([candidates.points.reshape(-1, 2), np.full(2, np.nan)])
    scores = np.append(candidates.scores, LEAST_SCORE)
    names = np.vstack([candidates.identity[:, :-1], np.full(circles, 1 / (circles + 1))])

    def possible(order: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Whether candidates : (m, k) can be the first k circles."""
        seen, fit = order < len(points) - 1, np.empty(len(order), bool)
        for some in (np.ones(order.shape[1], bool), *~np.eye(order.shape[1], dtype=bool)):
            rows = (seen == some).all(axis=1)
            fit[rows] = _possible(points[order[rows]], some, target, width)
        return fit

    order = _rows(len(points), circles, possible)
    likely = np.log(np.maximum(names[order, range(circles)], UNNAMED)).sum(axis=1) + np.log(scores[order]).sum(axis=1)
    seen = order < len(points) - 1
    whole, fit = seen.all(axis=1), possible(order)
    ranked = np.argsort(-likely, kind="stable")
    best = np.concatenate([ranked[(fit & whole)[ranked]][:KEPT], ranked[(fit & ~whole)[ranked]][:HALVES]])
    return [Naming(points[order[k]], float(likely[k])) for k in sorted(best, key=lambda k: -likely[k])]


def _possible(points: Array, seen: NDArray[np.bool_], target: Target, width: float) -> NDArray[np.bool_]:
    """Whether points : (m, k, 2) px, of which those of `seen` : (k,) count, can be the first k circles: by scale, tilt, places.

    Of two circles the distance alone counts; of the first ones of more, nothing does where these lie nearly in a line.
    """
    if seen.sum() < POINTS:
        size = stretch(points, target) * target.outer_diameter_mm / width
        return (size > TILTED * DISC[0]) & (size < DISC[1])
    places = circle_centres(target)[: len(seen)][seen, :2]
    if len(seen) < circle_layout.count(target) and _in_line(places):
        return np.ones(len(points), bool)
    affine = affinity_of(points[:, seen], places)
    scales = np.linalg.svd(affine, compute_uv=False)
    size = scales[:, 0] * target.outer_diameter_mm / width
    near = _astray(points[:, seen], places, affine) < ASTRAY * scales[:, 0] * target.outer_diameter_mm / 2
    return near & (np.linalg.det(affine) < 0) & (scales[:, 1] > TILTED * scales[:, 0]) & (size > DISC[0]) & (size < DISC[1])


def stretch(points: Array, target: Target) -> Array:
    """The largest ratio, px/mm, of two circles' distances in the image and on the target, from views : (..., n, 2) px."""
    return np.fmax.reduce(distances(points) / distances(circle_centres(target)), axis=-1)


def affinity(points: Array, target: Target) -> Array:
    """Of the target's plane to the image, from views : (..., n, 2) px of the circles: (..., 2, 2) px/mm."""
    return affinity_of(points, circle_centres(target)[:, :2])


def affinity_of(points: Array, places: Array) -> Array:
    """The affinity : (..., 2, 2) px/mm that takes places : (..., n, 2) mm to points : (..., n, 2) px with least squares."""
    from_middle = points - points.mean(axis=-2, keepdims=True)
    inverse = _inverse_arms(places) if places.ndim > 2 else _kept_inverse_arms(*map(tuple, places.tolist()))
    return np.swapaxes(from_middle, -1, -2) @ inverse


def _inverse_arms(places: Array) -> Array:
    """Pseudoinverses : (..., n, 2) of the arms from the middle of places : (..., n, 2)."""
    return np.linalg.pinv(np.swapaxes(places - places.mean(axis=-2, keepdims=True), -1, -2))


@lru_cache
def _kept_inverse_arms(*places: tuple[float, float]) -> Array:
    """The same of a target's circles, of which each pair of frames asks anew."""
    return _inverse_arms(np.array(places))


def _in_line(places: Array) -> NDArray[np.bool_]:
    """Whether places : (..., n, 2) lie nearly in a line, so that their affinity isn't known across it."""
    across = np.linalg.svd(places - places.mean(axis=-2, keepdims=True), compute_uv=False)
    return across[..., 1] < LINE * across[..., 0]


def _astray(points: Array, places: Array, affine: Array) -> Array:
    """Largest distances : (...) px of points : (..., n, 2) from where their affinities have them."""
    from_middle, arms = (each - each.mean(axis=-2, keepdims=True) for each in (points, places))
    return np.linalg.norm(from_middle - arms @ np.swapaxes(affine, -1, -2), axis=-1).max(axis=-1)


def disagreement(ellipses: Ellipses, target: Target) -> float:
    """Misfit of n ellipses to the target's distances, of shapes and places, as a share of their size; NaN is one that isn't seen.

    Infinite if mirrored, or of fewer than three.
    """
    seen = np.isfinite(ellipses.centre).all(axis=1)
    if seen.sum() < POINTS:
        return np.inf
    centres, places = ellipses.centre[seen], circle_centres(target)[seen, :2]
    affine = affinity_of(centres, places)
    if np.linalg.det(affine) >= 0:
        return np.inf
    expected = root((affine @ affine.T)[None] * (target.outer_diameter_mm / 2) ** 2)[0]
    return float(max(np.abs(ellipses.shape[seen] - expected).max(), _astray(centres, places, affine)) / (np.trace(expected) / 2))


def named(ellipses: Ellipses, target: Target) -> tuple[NDArray[np.int64], float]:
    """The order in which n ellipses are c0, c1 and on by their geometry, and their disagreement then."""
    seen, places = np.flatnonzero(np.isfinite(ellipses.centre).all(axis=1)), circle_centres(target)[:, :2]
    circles = len(places)

    def possible(names: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Whether the first k that are seen can be the circles of `names` : (m, k)."""
        points, there = ellipses.centre[seen[: names.shape[1]]], places[names]
        affine = affinity_of(points, there)
        size = np.linalg.svd(affine, compute_uv=False)[:, 0] * target.outer_diameter_mm / 2
        return _in_line(there) | ((np.linalg.det(affine) < 0) & (_astray(points, there, affine) < ASTRAY * size))

    as_they_are = np.arange(circles)
    orders = [as_they_are, *(_order(seen, names, circles) for names in _rows(circles, len(seen), possible))]
    off = [disagreement(ellipses[order], target) for order in orders]
    best = int(np.argmin(off))
    return orders[best], off[best]


def _order(seen: NDArray[np.int64], names: NDArray[np.int64], circles: int) -> NDArray[np.int64]:
    """The order of n circles with those that are seen : (k,) under names : (k,)."""
    order = np.empty(circles, np.int64)
    order[names] = seen
    order[np.setdiff1d(np.arange(circles), names)] = np.setdiff1d(np.arange(circles), seen)
    return order


def _rows(count: int, length: int, possible: Callable[[NDArray[np.int64]], NDArray[np.bool_]]) -> NDArray[np.int64]:
    """Rows : (m, length) of different numbers below `count`, in alphabetical order.

    Of more than FIRST numbers those alone of which the first four, five and on are `possible`: all would be too many.
    """
    rows = _orders(count, min(length, FIRST))
    while rows.shape[1] < length:
        rows = rows[possible(rows)]
        row, new = np.nonzero((rows[:, :, None] != np.arange(count)).all(axis=1))
        rows = np.column_stack([rows[row], new])
    return rows


@cache
def _orders(count: int, circles: int) -> NDArray[np.int64]:
    return np.array(list(permutations(range(count), circles)), np.int64).reshape(-1, circles)
