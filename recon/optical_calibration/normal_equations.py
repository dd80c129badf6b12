"""The bundle adjustment's normal equations, added up point by point.

A sighting depends on its own device's parameters, on its own pose and, if the board is adjusted, on its own point: most of the
derivatives are zero. Added up as they come, the equations need none of these, and no matrix of all derivatives.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from recon.compiled import njit

Array = NDArray[np.float64]

POINT, POSE = 3, 6  # unknowns of a point and of a pose: its place, and a turn and a shift


class Sightings(NamedTuple):
    """Residuals of d devices in p poses of n points, and their derivatives; each device by itself."""

    residuals: Array  # (p, n, d, 2) px, observed less predicted
    by_parameter: Array  # (d, p, n, 2, k) px, of each device's prediction by its own parameters, as many as it has
    by_point: Array  # (d, p, n, 2, 3) px/mm, by the point in the world
    arms: Array  # (p, n, 3) mm, in the world, from the poses' origins to the points
    turns: Array  # (p, 3, 3) from the board's axes to the world's
    first: NDArray[np.int64]  # (d + 1,) of each device's parameters among all, and the number of all
    whitening: Array  # (p, n, d, 2, 2) 1/px, to standard normal numbers; zero where nothing was seen
    projector: int  # its place among the devices; 0 if there is none beside the first


class Equations(NamedTuple):
    """The normal equations. Shared unknowns g: devices' parameters, then the points' 3n if they are adjusted."""

    shared: Array  # (g, g)
    cross: Array  # (p, g, 6)
    corner: Array  # (p, 6, 6)
    right: Array  # (g,) the shared unknowns' right-hand side
    pose_right: Array  # (p, 6) the poses'


def added_up(sightings: Sightings, gradient: Array, shaped: bool, robust: float) -> tuple[Equations, Array]:
    """Normal equations, and lengths : (p, n, d) of the whitened residuals.

    Parameters
    ----------
    gradient : (p, n, 2, 2)
        Projector px / first device's px: the projector is read where the first device sees the point.
    shaped : bool
        Whether the points are unknowns.
    robust : float
        Length of a residual beyond which it loses weight (Huber).
    """
    p, n, d = sightings.residuals.shape[:3]
    g = int(sightings.first[-1]) + (POINT * n if shaped else 0)
    equations = Equations(np.zeros((g, g)), np.zeros((p, g, POSE)), np.zeros((p, POSE, POSE)), np.zeros(g), np.zeros((p, POSE)))
    lengths = np.zeros((p, n, d))
    _add_up(sightings, gradient, shaped, robust, equations, lengths)
    return equations, lengths


@njit(error_model="numpy")
def _add_up(sightings, gradient, shaped, robust, equations, lengths):
    poses, points, devices = lengths.shape
    own = sightings.first[devices]
    rows, left = np.empty((devices, 2, own + POINT + POSE)), np.empty((devices, 2))  # columns: parameters, point, pose
    for p in range(poses):
        for n in range(points):
            _fill(sightings, p, n, rows, left)
            if sightings.projector > 0:
                _take_error_along(gradient[p, n], rows, left, sightings.projector)
            for d in range(devices):
                whitening = sightings.whitening[p, n, d]
                if whitening[0, 0] > 0 and math.isfinite(left[d, 0] + left[d, 1]):  # seen
                    lengths[p, n, d] = _whiten(whitening, robust, rows[d], left[d])
                    _add(rows[d], left[d], (own, sightings.first[d + 1]), equations, p)
                    if shaped:
                        _add_point(rows[d], left[d], own, equations, (p, n))
    for a in range(len(equations.shared)):
        for b in range(a):
            equations.shared[a, b] = equations.shared[b, a]


@njit(error_model="numpy")
def _fill(sightings, p, n, rows, left):
    """Derivatives of one point's sightings : (d, 2, own + 9), and their residuals : (d, 2), in place."""
    turn, devices = sightings.turns[p], len(left)
    own = sightings.first[devices]
    x, y, z = sightings.arms[p, n, 0], sightings.arms[p, n, 1], sightings.arms[p, n, 2]
    for d in range(devices):
        start = sightings.first[d]
        for axis in range(2):
            left[d, axis] = sightings.residuals[p, n, d, axis]
            row = rows[d, axis]
            for k in range(own):
                row[k] = 0.0
            for k in range(sightings.first[d + 1] - start):
                row[start + k] = sightings.by_parameter[d, p, n, axis, k]
            slope = sightings.by_point[d, p, n, axis]
            a, b, c = slope[0], slope[1], slope[2]
            for k in range(3):
                row[own + k] = a * turn[0, k] + b * turn[1, k] + c * turn[2, k]
            row[own + 3], row[own + 4], row[own + 5] = y * c - z * b, z * a - x * c, x * b - y * a
            row[own + 6], row[own + 7], row[own + 8] = a, b, c


@njit(error_model="numpy")
def _take_error_along(gradient, rows, left, projector):
    """Take the first device's error out of the projector's rows: the fringes are read where the first device sees the point."""
    for axis in range(2):
        u, v = gradient[axis, 0], gradient[axis, 1]
        left[projector, axis] -= u * left[0, 0] + v * left[0, 1]
        for k in range(rows.shape[2]):
            rows[projector, axis, k] -= u * rows[0, 0, k] + v * rows[0, 1, k]


@njit(error_model="numpy")
def _whiten(whitening, robust, rows, left):
    """Whiten two rows, with the weight of Huber's loss, in place, and return the residual's length."""
    a, b, c, d = whitening[0, 0], whitening[0, 1], whitening[1, 0], whitening[1, 1]
    u, v = a * left[0] + b * left[1], c * left[0] + d * left[1]
    length = math.sqrt(u * u + v * v)
    root = math.sqrt(robust / max(length, robust))
    left[0], left[1] = root * u, root * v
    a, b, c, d = root * a, root * b, root * c, root * d
    for k in range(rows.shape[1]):
        first, second = rows[0, k], rows[1, k]
        rows[0, k], rows[1, k] = a * first + b * second, c * first + d * second
    return length


@njit(error_model="numpy")
def _add(rows, left, columns, equations, p):
    """Add a sighting's two equations, `row @ unknowns = left`, for parameters and pose; above the diagonal alone.

    columns : number of all parameters, and the first beyond those that the sighting depends on.
    """
    own, end = columns
    shared, cross, corner = equations.shared, equations.cross[p], equations.corner[p]
    right, pose_right = equations.right, equations.pose_right[p]
    first, second, pose = rows[0], rows[1], own + POINT
    for a in range(end):
        u, v = first[a], second[a]
        if u != 0 or v != 0:
            right[a] += u * left[0] + v * left[1]
            for b in range(a, end):
                shared[a, b] += u * first[b] + v * second[b]
            for b in range(POSE):
                cross[a, b] += u * first[pose + b] + v * second[pose + b]
    for a in range(POSE):
        u, v = first[pose + a], second[pose + a]
        pose_right[a] += u * left[0] + v * left[1]
        for b in range(POSE):
            corner[a, b] += u * first[pose + b] + v * second[pose + b]


@njit(error_model="numpy")
def _add_point(rows, left, own, equations, place):
    """Add the same equations' part for the point's place."""
    p, n = place
    shared, cross, right, at = equations.shared, equations.cross[p], equations.right, own + POINT * n
    first, second = rows[0], rows[1]
    for b in range(POINT):
        u, v = first[own + b], second[own + b]
        right[at + b] += u * left[0] + v * left[1]
        for a in range(own):
            shared[a, at + b] += u * first[a] + v * second[a]
        for a in range(b + 1):
            shared[at + a, at + b] += u * first[own + a] + v * second[own + a]
        for a in range(POSE):
            cross[at + b, a] += u * first[own + POINT + a] + v * second[own + POINT + a]
