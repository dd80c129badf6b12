"""From projector coordinates to points: where each camera ray meets the projector's plane, exact for both lenses.

A camera pixel's ray is `centre + t * direction`. The projector sees the point at t at a distorted pixel (u(t), v(t)); t is
solved for so that this is the decoded coordinate: one axis determines it, two do in the least-squares sense.
"""

from dataclasses import dataclass

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from recon.camera import Camera, distort
from recon.decode import ProjectorMap

Float32 = NDArray[np.float32]

MAX_STEPS = 15
TOLERANCE = 1e-6  # projector px
CURVATURE = 0.02  # 1/px: how much the slope may change a projector px; a secant step leaves the last two times this
SECANT = 1e-4  # mm: below it, two projections are too close to each other for their difference to give a slope
SIGMA_FLOOR = 1e-6  # projector px: keeps weights finite where a map claims to be perfect


@dataclass(frozen=True)
class PointMap:
    """An organised point cloud: one point a camera pixel, NaN where there is none."""

    points: Float32  # (h, w, 3), mm, in the world
    sigma: Float32  # (h, w), mm, standard deviation of the point's position along the camera's ray


class Triangulator:
    """A camera and a projector with the table of the camera's rays, for many maps of one rig.

    Parameters
    ----------
    camera, projector : Camera
        In a common world.
    """

    def __init__(self, camera: Camera, projector: Camera) -> None:
        self.camera, self.projector = camera, projector
        self._rays = camera.rays(camera.pixel_grid())  # (h, w, 3), unit, in the world
        self._matrix = projector.matrix[:2].ravel()

    def __call__(self, projector_map: ProjectorMap) -> PointMap:
        """Triangulate a map of the camera's size; see `triangulate`."""
        height, width, _ = self._rays.shape
        nothing = np.full((1, 1), np.nan, np.float32)
        columns, sigma_columns, rows, sigma_rows = (
            nothing if axis is None else axis
            for axis in (projector_map.columns, projector_map.sigma_columns, projector_map.rows, projector_map.sigma_rows)
        )
        for axis in (columns, rows):
            if axis is not nothing and axis.shape != (height, width):
                raise ValueError(f"projector map: expected {width}x{height}, found {axis.shape[1]}x{axis.shape[0]}")
        points = np.empty((height, width, 3), np.float32)
        sigma = np.empty((height, width), np.float32)
        projector = (self.projector.camera_from_world, self._matrix, self.projector.coefficients)
        decoded = (columns, sigma_columns, rows, sigma_rows)
        _triangulate(self._rays, np.ascontiguousarray(self.camera.centre), projector, decoded, points, sigma)
        return PointMap(points, sigma)


def triangulate(projector_map: ProjectorMap, camera: Camera, projector: Camera) -> PointMap:
    """Triangulate the decoded projector coordinates of every camera pixel.

    Parameters
    ----------
    projector_map : ProjectorMap
        Projector columns, rows or both, in px, and their standard deviations. Where both are known they are weighted by the
        inverse variance. One axis with no sigma counts with a sigma of 1 px in the solution and leaves sigma NaN.
    camera, projector : Camera
        In a common world.

    Returns
    -------
    PointMap
        Points solved to 1e-6 projector px. sigma is the standard deviation of the position along the camera's ray that the
        map's sigma causes, `1 / sqrt((du/dt / sigma_u)^2 + (dv/dt / sigma_v)^2)`, in mm. NaN where nothing was decoded, where
        the solution lies behind a device, or where there is none.

    Raises
    ------
    ValueError
        If the map has another size than the camera.
    """
    return Triangulator(camera, projector)(projector_map)


@njit(cache=True, inline="always", error_model="numpy")
def _project(t, ox, oy, oz, ex, ey, ez, matrix, coefficients):
    """Projector pixel of the ray's point at t."""
    nearness = 1 / (oz + t * ez)
    x, y = distort((ox + t * ex) * nearness, (oy + t * ey) * nearness, coefficients)
    return matrix[0] * x + matrix[1] * y + matrix[2], matrix[3] * x + matrix[4] * y + matrix[5]


@njit(cache=True, parallel=True, error_model="numpy")
def _triangulate(rays, centre, projector, decoded, points, sigma):
    projector_from_world, matrix, coefficients = projector
    columns, sigma_columns, rows, sigma_rows = decoded
    height, width, _ = rays.shape
    rotation, translation = projector_from_world[:3, :3].copy(), projector_from_world[:3, 3].copy()
    ox, oy, oz = rotation @ centre + translation
    has_columns, has_rows = columns.shape[0] == height, rows.shape[0] == height
    for j in prange(height):
        for i in range(width):
            points[j, i, 0] = points[j, i, 1] = points[j, i, 2] = sigma[j, i] = np.nan
            column = float(columns[j, i]) if has_columns else np.nan
            row = float(rows[j, i]) if has_rows else np.nan
            dx, dy, dz = rays[j, i, 0], rays[j, i, 1], rays[j, i, 2]
            by_column, by_row = np.isfinite(column), np.isfinite(row)
            if not (by_column or by_row) or not np.isfinite(dx):
                continue
            ex = rotation[0, 0] * dx + rotation[0, 1] * dy + rotation[0, 2] * dz
            ey = rotation[1, 0] * dx + rotation[1, 1] * dy + rotation[1, 2] * dz
            ez = rotation[2, 0] * dx + rotation[2, 1] * dy + rotation[2, 2] * dz

            # weights of the two axes: the inverse variances
            wu = wv = 0.0
            known = True
            if by_column:
                s = float(sigma_columns[j, i])
                known = s >= 0
                wu = 1 / max(s, SIGMA_FLOOR) ** 2 if s >= 0 else 1.0
            if by_row:
                s = float(sigma_rows[j, i])
                known = known and s >= 0
                wv = 1 / max(s, SIGMA_FLOOR) ** 2 if s >= 0 else 1.0

            # start: where the ray meets the plane of the projector's column (or row), lens distortion left out
            if wu * (matrix[0] * (ex * oz - ox * ez)) ** 2 >= wv * (matrix[4] * (ey * oz - oy * ez)) ** 2:
                x = (column - matrix[2]) / matrix[0]
                t = (x * oz - ox) / (ex - x * ez)
            else:
                y = (row - matrix[5]) / matrix[4]
                t = (y * oz - oy) / (ey - y * ez)
            z = oz + t * ez
            if not (t > 0 and z > 0):
                continue
            su = (matrix[0] * (ex * oz - ox * ez) + matrix[1] * (ey * oz - oy * ez)) / (z * z)
            sv = (matrix[3] * (ex * oz - ox * ez) + matrix[4] * (ey * oz - oy * ez)) / (z * z)

            # Gauss-Newton; the slopes of the distorted projection come from its last two values
            u, v = _project(t, ox, oy, oz, ex, ey, ez, matrix, coefficients)
            converged = False
            previous = 1.0  # px
            for _ in range(MAX_STEPS):
                gradient = 0.0
                if by_column:
                    gradient += wu * su * (column - u)
                if by_row:
                    gradient += wv * sv * (row - v)
                step = gradient / (wu * su * su + wv * sv * sv)
                size = abs(step) * max(abs(su) * by_column, abs(sv) * by_row)
                t += step
                if size * min(previous, 1.0) * CURVATURE < TOLERANCE:
                    converged = True
                    break
                previous = size
                u_new, v_new = _project(t, ox, oy, oz, ex, ey, ez, matrix, coefficients)
                if abs(step) > SECANT:
                    su, sv = (u_new - u) / step, (v_new - v) / step
                u, v = u_new, v_new
            if not (converged and t > 0 and oz + t * ez > 0):
                continue
            points[j, i, 0] = centre[0] + t * dx
            points[j, i, 1] = centre[1] + t * dy
            points[j, i, 2] = centre[2] + t * dz
            if known:
                sigma[j, i] = 1 / np.sqrt(wu * su * su + wv * sv * sv)
