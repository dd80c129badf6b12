"""The ellipse of a circle's outline in an image, and its slopes; compiled, for a few circles at a time.

Points of the outline are projected, lens and all; their second moments are nearly the ellipse, and three steps of Gauss-Newton
on the orthogonal distances make it the one that `recon.geometry.ellipses.fit_ellipses` finds, in a hundredth of the time.
"""

import math

import numpy as np
from numpy.typing import NDArray

from recon.compiled import njit
from recon.geometry.camera import Camera, distort, distortion_slopes
from recon.geometry.cholesky import solve_and_invert

Array = NDArray[np.float64]

POINTS = 24  # of an outline
STEPS = 3


def ellipses_of(
    camera: Camera, world_from_target: Array, centres: Array, radius_mm: float, slopes: Array | None = None
) -> tuple[Array, Array]:
    """Centres : (n, 2) px and shapes : (n, 2, 2) px of the ellipses of circles; NaN behind the camera.

    centres : (n, 3) mm, of the circles in the target's frame.
    slopes : (n, 2) dz/dx and dz/dy, small, of the circles' planes there; None where they lie parallel to its plane z = 0.
    """
    camera_from_target = np.ascontiguousarray(camera.camera_from_world @ world_from_target)
    slopes = np.zeros((len(centres), 2)) if slopes is None else slopes
    own = np.array(centres), np.array(slopes)  # that can be written to: compiled for one kind of array alone
    rows = _ellipses(camera_from_target, *own, radius_mm, camera.matrix, camera.coefficients)
    return rows[:, :2], rows[:, [2, 3, 3, 4]].reshape(-1, 2, 2)


def slopes_at(camera: Camera, points: Array) -> Array:
    """Derivatives of the projections of points : (n, 3) mm in the world by the points, in the world's axes : (n, 2, 3) px/mm."""
    return _slopes(camera.camera_from_world, np.ascontiguousarray(points), camera.matrix, camera.coefficients)


@njit(error_model="numpy")
def _slopes(camera_from_world, points, matrix, k):
    result = np.zeros((len(points), 2, 3))
    for i in range(len(points)):
        local = np.empty(3)
        for m in range(3):
            local[m] = camera_from_world[m, 3]
            for n in range(3):
                local[m] += camera_from_world[m, n] * points[i, n]
        x, y = local[0] / local[2], local[1] / local[2]
        x_by_x, x_by_y, y_by_x, y_by_y = distortion_slopes(x, y, k)
        for n in range(3):
            dx = (camera_from_world[0, n] - x * camera_from_world[2, n]) / local[2]
            dy = (camera_from_world[1, n] - y * camera_from_world[2, n]) / local[2]
            bent_x, bent_y = x_by_x * dx + x_by_y * dy, y_by_x * dx + y_by_y * dy
            result[i, 0, n] = matrix[0, 0] * bent_x + matrix[0, 1] * bent_y
            result[i, 1, n] = matrix[1, 1] * bent_y
    return result


@njit(error_model="numpy")
def _ellipses(camera_from_target, centres, slopes, radius, matrix, k):
    result = np.empty((len(centres), 5))
    x, y, place, plane = np.empty(POINTS), np.empty(POINTS), np.empty(3), np.empty((3, 2))
    for i in range(len(centres)):
        for m in range(3):
            place[m] = camera_from_target[m, 3]
            for n in range(3):
                place[m] += camera_from_target[m, n] * centres[i, n]
            for n in range(2):
                plane[m, n] = camera_from_target[m, n] + slopes[i, n] * camera_from_target[m, 2]
        in_front = _outline(place, plane, radius, matrix, k, x, y)
        if not (in_front and _fit(x, y, result[i])):
            for m in range(5):
                result[i, m] = np.nan
    return result


@njit(inline="always", error_model="numpy")
def _outline(place, plane, radius, matrix, k, x, y):
    """Pixels of the points of a circle with its middle at a place, in its plane's two axes; whether all are in front."""
    for j in range(POINTS):
        across, along = radius * math.cos(2 * math.pi * j / POINTS), radius * math.sin(2 * math.pi * j / POINTS)
        z = place[2] + across * plane[2, 0] + along * plane[2, 1]
        if not z > 0:
            return False
        right = place[0] + across * plane[0, 0] + along * plane[0, 1]
        down = place[1] + across * plane[1, 0] + along * plane[1, 1]
        bent_x, bent_y = distort(right / z, down / z, k)
        x[j] = matrix[0, 0] * bent_x + matrix[0, 1] * bent_y + matrix[0, 2]
        y[j] = matrix[1, 1] * bent_y + matrix[1, 2]
    return True


@njit(error_model="numpy")
def _fit(x, y, ellipse):
    """The ellipse closest to evenly spread points of a closed outline, by orthogonal distances : (5,); False of a line."""
    _start(x, y, ellipse)
    normal, right, row, step, inverse = np.empty((5, 5)), np.empty(5), np.empty(5), np.empty(5), np.empty((5, 5))
    for _ in range(STEPS):
        normal[:], right[:] = 0.0, 0.0
        a, b, c = ellipse[2], ellipse[3], ellipse[4]
        determinant = a * c - b * b
        if not determinant > 1e-6 * (a + c) ** 2:  # seen from its edge
            return False
        ia, ib, ic = c / determinant, -b / determinant, a / determinant
        for j in range(len(x)):
            u, v = x[j] - ellipse[0], y[j] - ellipse[1]
            p, q = ia * u + ib * v, ib * u + ic * v
            away = math.sqrt(p * p + q * q)
            p, q = p / away, q / away
            nx, ny = ia * p + ib * q, ib * p + ic * q
            slope = math.sqrt(nx * nx + ny * ny)
            distance = (away - 1) / slope
            nx, ny = nx / slope, ny / slope
            row[0], row[1], row[2], row[3], row[4] = nx, ny, nx * p, nx * q + ny * p, ny * q
            for m in range(5):
                right[m] += row[m] * distance
                for n in range(5):
                    normal[m, n] += row[m] * row[n]
        if not solve_and_invert(normal, right, step, inverse):
            return False
        for m in range(5):
            ellipse[m] += step[m]
    return True


@njit(inline="always", error_model="numpy")
def _start(x, y, ellipse):
    """The ellipse of the same second moments as the points, in place."""
    n = len(x)
    ellipse[0], ellipse[1] = 0.0, 0.0
    for j in range(n):
        ellipse[0] += x[j] / n
        ellipse[1] += y[j] / n
    a, b, c = 0.0, 0.0, 0.0
    for j in range(n):
        u, v = x[j] - ellipse[0], y[j] - ellipse[1]
        a += 2 * u * u / n
        b += 2 * u * v / n
        c += 2 * v * v / n
    root = math.sqrt(a * c - b * b)
    scale = math.sqrt(a + c + 2 * root)
    ellipse[2], ellipse[3], ellipse[4] = (a + root) / scale, b / scale, (c + root) / scale
