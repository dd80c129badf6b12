"""From projector coordinates to points: where each camera ray meets the projector's plane, exact for both lenses.

A camera pixel's ray is `centre + t * direction`. The projector sees the point at t at a distorted pixel (u(t), v(t)); t is
solved for so that this is the decoded coordinate: one axis determines it, two do in the least-squares sense.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from recon import arguments
from recon.compiled import njit
from recon.errors import Implausible, InputError, refuse_or_warn
from recon.geometry.camera import FARTHEST, Camera, distort_side_by_side
from recon.structured_light.decode import ProjectorMap
from recon.threads import in_threads

Float32 = NDArray[np.float32]

MAX_STEPS = 15
TOLERANCE = 1e-6  # projector px, of the solution
LAST_STEP = 1e-3  # projector px: a secant step after one so short leaves far less than the tolerance
SECANT = 1e-4  # mm: below it, two projections are too close to each other for their difference to give a slope
MISSED_PX = 10.0  # projector px by which columns and rows may contradict each other in the median; a device that moved: some px
CHECKED, FEWEST = 5000, 50  # pixels that tell that median, at most and at least
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
        arguments.of_kind("triangulate: camera", camera, Camera)
        arguments.of_kind("triangulate: projector", projector, Camera)
        if camera is projector or (camera.name and camera.name == projector.name):
            raise InputError(
                f"triangulate: projector: expected another device than the camera, found {camera.name or 'the same'}"
            )
        self.camera, self.projector = camera, projector
        self._rays = camera.pixel_rays()  # (h, w, 3), unit, in the world
        self._matrix = projector.matrix[:2].ravel()

    def __call__(self, projector_map: ProjectorMap, implausible: Implausible = "refuse") -> PointMap:
        """Triangulate a map of the camera's size; see `triangulate`."""
        shape = self._rays.shape[:2]
        _check_devices(projector_map, self.camera, self.projector)
        decoded = (
            *_axis("columns", projector_map.columns, projector_map.sigma_columns, shape),
            *_axis("rows", projector_map.rows, projector_map.sigma_rows, shape),
        )
        kind = np.result_type(*decoded)  # one for all: each mix would be compiled by itself
        decoded = tuple(np.ascontiguousarray(image, kind) for image in decoded)
        points = np.empty((*shape, 3), np.float32)
        sigma = np.empty(shape, np.float32)
        projector = (self.projector.camera_from_world, self._matrix, self.projector.coefficients)
        centre = np.ascontiguousarray(self.camera.centre)
        in_threads(_triangulate, shape[0], self._rays, centre, projector, decoded, points, sigma)
        _check_rows(projector_map, points, self.projector, implausible)
        return PointMap(points, sigma)


def triangulate(projector_map: ProjectorMap, camera: Camera, projector: Camera, implausible: Implausible = "refuse") -> PointMap:
    """Triangulate the decoded projector coordinates of every camera pixel.

    Parameters
    ----------
    projector_map : ProjectorMap
        Projector columns, rows or both, in px, and their standard deviations. Where both are known they are weighted by the
        inverse variance. One axis with no sigma counts with a sigma of 1 px in the solution and leaves sigma NaN.
    camera, projector : Camera
        In a common world. Columns alone, or rows, agree with any camera: only both show that it is another than took the
        images, else the name that `decode` was given.
    implausible : "refuse" or "take"
        What to do about columns and rows that contradict each other: `take` warns, and solves in the least-squares sense.

    Returns
    -------
    PointMap
        Points solved to 1e-6 projector px. sigma is the standard deviation of the position along the camera's ray that the
        map's sigma causes, `1 / sqrt((du/dt / sigma_u)^2 + (dv/dt / sigma_v)^2)`, in mm. NaN where nothing was decoded, where
        the solution lies behind a device or past its lens's turn, or where there is none.

    Raises
    ------
    InputError
        If a coordinate or a sigma has another size than the camera; if the images were taken by another camera, or the patterns
        have another size than the projector; if columns and rows contradict each other by these devices.
    """
    return Triangulator(camera, projector)(projector_map, implausible)


def _check_devices(found: ProjectorMap, camera: Camera, projector: Camera) -> None:
    """Refuse a map of another camera's images, or of patterns of another size than the projector's."""
    arguments.of_kind("triangulate: projector_map", found, ProjectorMap, way="sonotwin.decode makes one of images")
    taken_by, size = found.camera, found.projector_size
    if taken_by and camera.name and taken_by != camera.name:
        raise InputError(f"triangulate: camera: expected {taken_by}, which took the images, found {camera.name}")
    if size is not None and size != projector.size:
        expected, size = ("x".join(map(str, size)) for size in (size, projector.size))
        raise InputError(f"triangulate: projector: expected {expected} px, as of the patterns, found {size}: another device?")


def _check_rows(found: ProjectorMap, points: Float32, projector: Camera, implausible: Implausible) -> None:
    """Refuse devices by which columns and rows contradict each other, or warn of them: the points lie on rays that miss."""
    if found.columns is None or found.rows is None:
        return
    rows, columns = np.nonzero(np.isfinite(points[..., 0]) & np.isfinite(found.columns) & np.isfinite(found.rows))
    if len(rows) < FEWEST:
        return
    chosen = slice(None, None, max(1, len(rows) // CHECKED))
    pixels = rows[chosen], columns[chosen]
    missed = projector.project(points[pixels]) - np.column_stack([found.columns[pixels], found.rows[pixels]])
    typical = float(np.nanmedian(np.linalg.norm(missed, axis=1)))
    if typical > MISSED_PX:
        cause = "another camera's calibration or images, images mirrored or turned, or devices that moved since"
        expected = f"columns and rows that agree to {MISSED_PX:g} projector px"
        refuse_or_warn("triangulate: camera", f"expected {expected}, found {typical:.3g} px in the median: {cause}?", implausible)


def _axis(name: str, coordinate: NDArray | None, sigma: NDArray | None, shape: tuple[int, ...]) -> tuple[NDArray, NDArray]:
    """One axis and its sigma: empty where the axis is not known, NaN where only the sigma isn't."""
    if coordinate is None:
        nothing = np.empty((0, 0), np.float32)
        return nothing, nothing
    if sigma is None:
        sigma = np.full(shape, np.nan, np.float32)
    for part, found in ((name, coordinate.shape), (f"sigma_{name}", sigma.shape)):
        if found != shape:
            expected = f"expected an image of shape {shape}, as the camera's"
            raise InputError(f"triangulate: projector_map.{part}: {expected}, found {found}: another camera's?")
    return coordinate, sigma


@njit(nogil=True, noalias=True, error_model="numpy")
def _triangulate(first, end, rays, centre, projector, decoded, points, sigma):
    """Solve rows `first` to `end` (not included), a row's pixels without branches, so that they share vector instructions."""
    projector_from_world, matrix, coefficients = projector
    columns, sigma_columns, rows, sigma_rows = decoded
    height, width, _ = rays.shape
    rotation, origin = projector_from_world[:3, :3].copy(), np.empty(3)
    for k in range(3):
        turned = rotation[k, 0] * centre[0] + rotation[k, 1] * centre[1] + rotation[k, 2] * centre[2]
        origin[k] = turned + projector_from_world[k, 3]
    ox, oy, oz = origin
    has_columns, has_rows = columns.shape == (height, width), rows.shape == (height, width)
    for j in range(first, end):
        ex, ey, ez, t, u, v, su, sv, wu, wv, column, row = np.empty((12, width))
        certain = np.ones(width, np.bool_)
        for i in range(width):
            dx, dy, dz = rays[j, i, 0], rays[j, i, 1], rays[j, i, 2]
            ex[i] = rotation[0, 0] * dx + rotation[0, 1] * dy + rotation[0, 2] * dz
            ey[i] = rotation[1, 0] * dx + rotation[1, 1] * dy + rotation[1, 2] * dz
            ez[i] = rotation[2, 0] * dx + rotation[2, 1] * dy + rotation[2, 2] * dz
            column[i] = wu[i] = row[i] = wv[i] = 0.0
        if has_columns:
            _weigh(columns[j], sigma_columns[j], column, wu, certain)
        if has_rows:
            _weigh(rows[j], sigma_rows[j], row, wv, certain)
        for i in range(width):
            # start: where the ray meets the plane of the projector's column (or row), lens distortion left out
            along_u, along_v = ex[i] * oz - ox * ez[i], ey[i] * oz - oy * ez[i]
            x, y = (column[i] - matrix[2]) / matrix[0], (row[i] - matrix[5]) / matrix[4]
            by_column, by_row = (x * oz - ox) / (ex[i] - x * ez[i]), (y * oz - oy) / (ey[i] - y * ez[i])
            t[i] = by_column if wu[i] * (matrix[0] * along_u) ** 2 >= wv[i] * (matrix[4] * along_v) ** 2 else by_row
            nearness = 1 / (oz + t[i] * ez[i])
            su[i] = (matrix[0] * along_u + matrix[1] * along_v) * nearness * nearness
            sv[i] = (matrix[3] * along_u + matrix[4] * along_v) * nearness * nearness
            xd, yd = distort_side_by_side((ox + t[i] * ex[i]) * nearness, (oy + t[i] * ey[i]) * nearness, coefficients)
            u[i], v[i] = matrix[0] * xd + matrix[1] * yd + matrix[2], matrix[3] * xd + matrix[4] * yd + matrix[5]
        # Gauss-Newton; the slopes of the distorted projection come from its last two values
        for _ in range(MAX_STEPS):
            unsolved = 0
            for i in range(width):
                gradient = wu[i] * su[i] * (column[i] - u[i]) + wv[i] * sv[i] * (row[i] - v[i])
                step = gradient / (wu[i] * su[i] * su[i] + wv[i] * sv[i] * sv[i])
                t[i] += step
                nearness = 1 / (oz + t[i] * ez[i])
                xd, yd = distort_side_by_side((ox + t[i] * ex[i]) * nearness, (oy + t[i] * ey[i]) * nearness, coefficients)
                un, vn = matrix[0] * xd + matrix[1] * yd + matrix[2], matrix[3] * xd + matrix[4] * yd + matrix[5]
                far = abs(step) > SECANT
                su[i] = (un - u[i]) / step if far else su[i]
                sv[i] = (vn - v[i]) / step if far else sv[i]
                u[i], v[i] = un, vn
                unsolved += abs(step) * (abs(su[i]) + abs(sv[i])) > LAST_STEP
            if unsolved == 0:
                break
        for i in range(width):
            curvature = wu[i] * su[i] * su[i] + wv[i] * sv[i] * sv[i]
            missing = (wu[i] * su[i] * (column[i] - u[i]) + wv[i] * sv[i] * (row[i] - v[i])) / curvature
            x, y, z = ox + t[i] * ex[i], oy + t[i] * ey[i], oz + t[i] * ez[i]
            solved = abs(missing) * (abs(su[i]) + abs(sv[i])) < TOLERANCE and t[i] > 0 and z > 0
            solved &= x * x + y * y <= coefficients[FARTHEST] * z * z  # past the lens's turn others than the ray's point are seen
            distance = t[i] if solved else np.nan
            points[j, i, 0] = centre[0] + distance * rays[j, i, 0]
            points[j, i, 1] = centre[1] + distance * rays[j, i, 1]
            points[j, i, 2] = centre[2] + distance * rays[j, i, 2]
            sigma[j, i] = 1 / np.sqrt(curvature) if solved and certain[i] else np.nan


@njit(inline="always", error_model="numpy")
def _weigh(values, sigmas, value, weight, certain):
    """One axis of an image row, ready for sums: weight 0 where it is unknown, 1 and not certain where it has no sigma."""
    for i in range(value.size):
        known, measured = np.isfinite(values[i]), sigmas[i] >= 0
        value[i] = values[i] if known else 0.0
        inverse = 1 / max(float(sigmas[i]), SIGMA_FLOOR) if measured else 1.0
        weight[i] = inverse * inverse if known else 0.0
        certain[i] &= measured or not known
