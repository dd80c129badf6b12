"""From an organised point map to a surface: cleaning, and a triangle mesh over the camera's pixel grid.

A neighbouring pair of pixels is *torn* where the surface can't be continuous between them: the step along the ray is steeper
than a surface seen at a grazing angle, or far steeper than the steps before and after it. Skin at a grazing angle has large
steps too, but each is like its neighbours.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, NamedTuple

import cv2
import numpy as np
import trimesh
from numpy.typing import ArrayLike, NDArray
from pydantic import Field

from recon import arguments
from recon.compiled import kernel, njit
from recon.files import meshes
from recon.geometry.camera import Camera
from recon.structured_light.triangulate import Float32, PointMap
from recon.threads import in_threads

Mask = NDArray[np.bool_]
Positive = Annotated[float, Field(gt=0)]
Fraction = Annotated[float, Field(ge=0, le=1)]

BRIGHTEST, WHITE = 99.5, 240  # percentile of the brightness, and the grey of 255 that it gets
NOISE = 6.0  # standard deviations that the difference of two points has at most by noise


@dataclass(frozen=True)
class Limits:
    """Limits of the surface. A *sampling step* is the width of a pixel at the point: distance / focal length.

    Raises
    ------
    InputError
        If one is out of its own limits.
    """

    max_slope: Positive = 12.0  # sampling steps along the ray a pixel; 12 is a surface seen at 85 deg from its normal
    max_bend: Positive = 3.0  # of a step, over its neighbours': beyond, and longer than the next, it is torn
    min_tear: Positive = 3.0  # sampling steps, in addition
    max_sigma: Positive = 3.0  # predicted standard deviation along the ray, in sampling steps
    outlier_steps: Positive = 1.0  # distance from the local plane, in sampling steps, beyond the noise
    min_modulation: Fraction = 0.5  # at an edge: fringe modulation, as a fraction of the strongest within two pixels
    min_island_px: Annotated[int, Field(ge=1)] = 400  # smaller connected pieces are left out

    def __post_init__(self) -> None:
        for name in ("max_slope", "max_bend", "min_tear", "max_sigma", "outlier_steps"):
            arguments.number(name, getattr(self, name), above=True)
        arguments.number("min_modulation", self.min_modulation, most=1)
        arguments.whole("min_island_px", self.min_island_px, 1, 10**10)


class Tears(NamedTuple):
    """Limits of a step between neighbours, for compiled code; as in `Limits`."""

    slope: float
    bend: float
    least: float


def clean(point_map: PointMap, camera: Camera, modulation: ArrayLike | None = None, limits: Limits | None = None) -> PointMap:
    """Remove mixed pixels at depth steps, isolated points, small islands and points of large predicted sigma.

    Parameters
    ----------
    point_map : PointMap
        Points (h, w, 3) mm and sigma (h, w) mm. A sigma of NaN counts as zero.
    camera : Camera
        The camera whose pixels the map is organised by.
    modulation : (h, w), digital numbers
        Fringe modulation. A pixel across two surfaces has less than both: if given, pixels at an edge are dropped by it,
        too.

    Returns
    -------
    PointMap
        The same, with NaN in place of removed points.
    """
    arguments.of_kind("clean_surface: limits", limits, Limits, type(None))
    _check("clean_surface", point_map, camera, {"modulation": modulation})
    limits = limits or Limits()
    distance, step = _distances(point_map.points, camera)
    noise = _difference(point_map.sigma)
    distance[point_map.sigma > limits.max_sigma * step] = np.nan
    distance[_bump(distance) > noise + limits.outlier_steps * step] = np.nan
    distance[_torn(distance, noise, step, limits)] = np.nan
    if modulation is not None:
        distance[_mixed(distance, np.asarray(modulation, np.float32), limits.min_modulation)] = np.nan
    gone = ~_without_islands(np.isfinite(distance), limits.min_island_px)
    points, sigma = point_map.points.copy(), point_map.sigma.copy()
    points[gone] = np.nan
    sigma[gone] = np.nan
    return PointMap(points, sigma)


def mesh(
    point_map: PointMap, camera: Camera, max_slope: float = Limits.max_slope, grey: ArrayLike | None = None
) -> trimesh.Trimesh:
    """Join neighbouring pixels to triangles, two a square of four points, oriented towards the camera.

    Parameters
    ----------
    point_map : PointMap
        Points (h, w, 3) mm and sigma (h, w) mm.
    camera : Camera
        The camera whose pixels the map is organised by.
    max_slope : float
        Longest step along the ray that an edge may span, in sampling steps a pixel, beyond the noise.
    grey : (h, w), any unit
        Brightness under even light, such as the fringes' offset: the vertices get its grey, the brightest nearly white.

    Returns
    -------
    trimesh.Trimesh
        Points of the map, in mm, as far as they are in a triangle; area-weighted normals as `vertex_normals`; sigma in mm
        as `vertex_attributes["sigma_mm"]`.
    """
    _check("mesh_surface", point_map, camera, {"grey": grey})
    arguments.number("mesh_surface: max_slope", max_slope, above=True)
    distance, step = _distances(point_map.points, camera)
    faces = _triangles(distance, max_slope * step + _difference(point_map.sigma))
    used = np.zeros(distance.size, bool)
    used[faces] = True
    faces = (np.cumsum(used) - 1)[faces]
    vertices = point_map.points.reshape(-1, 3)[used].astype(float)
    result = trimesh.Trimesh(vertices, faces, vertex_normals=_normals(vertices, faces), process=False, validate=False)
    result.vertex_attributes["sigma_mm"] = point_map.sigma.ravel()[used]
    if grey is not None and used.any():
        shown = np.asarray(grey, np.float32).ravel()[used]
        full = max(float(np.percentile(shown, BRIGHTEST)), 1e-6)
        meshes.set_greys(result, np.uint8(np.clip(np.rint(WHITE * shown / full), 0, 255)))
    return result


def _check(name: str, point_map: PointMap, camera: Camera, images: Mapping[str, ArrayLike | None]) -> None:
    """Refuse a map, or images beside it, of another size than the camera's."""
    arguments.of_kind(f"{name}: point_map", point_map, PointMap, way="sonotwin.triangulate makes one")
    arguments.of_kind(f"{name}: camera", camera, Camera)
    shape = camera.size[::-1]
    arguments.numbers(f"{name}: point_map.points", point_map.points, (*shape, 3), finite=False)
    arguments.numbers(f"{name}: point_map.sigma", point_map.sigma, shape, finite=False)
    for field, image in images.items():
        if image is not None:
            arguments.numbers(f"{name}: {field}", image, shape, finite=False)


def _distances(points: Float32, camera: Camera) -> tuple[Float32, Float32]:
    """Distance of each point from the camera's centre, and its sampling step : (h, w) mm each."""
    centre, distance = camera.centre.astype(np.float32), np.empty(points.shape[:2], np.float32)
    in_threads(_fill_norms, len(points), points, centre, distance)
    return distance, distance * np.float32(2 / (camera.matrix[0, 0] + camera.matrix[1, 1]))


def _difference(sigma: Float32) -> Float32:
    """Largest difference by noise alone : (h, w) mm, of the distances of two points of sigma : (h, w) mm; 0 where it is NaN."""
    return np.nan_to_num(NOISE * np.sqrt(np.float32(2)) * sigma)


@kernel
def _fill_norms(first, end, points, centre, norms):
    for j in range(first, end):
        for i in range(points.shape[1]):
            x, y, z = points[j, i, 0] - centre[0], points[j, i, 1] - centre[1], points[j, i, 2] - centre[2]
            norms[j, i] = np.sqrt(x * x + y * y + z * z)


def _bump(distance: Float32) -> Float32:
    """Distance of each point from the local plane : (h, w) mm.

    Two pixels on opposite sides of a point predict its distance, exactly so on a plane and near enough on skin. Of the eight
    such pairs within two pixels the second best counts: beside a depth step the pairs along it still agree, and a lone
    outlier agrees with none. Zero where there are fewer than two pairs.
    """
    bump = np.zeros(distance.shape, np.float32)
    in_threads(_fill_bump, len(distance), distance, bump)
    return bump


@kernel
def _fill_bump(first, end, distance, bump):
    for j in range(first, end):
        for i in range(distance.shape[1]):
            if not np.isfinite(distance[j, i]):
                continue
            second = _second_best(distance, j, i)
            if np.isfinite(second):
                bump[j, i] = second


@njit(inline="always")
def _second_best(distance, j, i):
    """The second smallest difference of a point from the mean of two on opposite sides, mm; inf of fewer than two pairs."""
    height, width = distance.shape
    here = distance[j, i]
    best = second = np.float32(np.inf)
    for reach in (1, 2):
        for dj, di in ((0, 1), (1, 0), (1, 1), (1, -1)):
            j0, j1, i0, i1 = j - reach * dj, j + reach * dj, i - reach * di, i + reach * di
            if j0 < 0 or j1 >= height or min(i0, i1) < 0 or max(i0, i1) >= width:
                continue
            residual = abs(here - (distance[j0, i0] + distance[j1, i1]) / 2)
            if residual < best:
                best, second = residual, best
            elif residual < second:
                second = residual
    return second


def _torn(distance: Float32, noise: Float32, step: Float32, limits: Limits) -> Mask:
    """Pixels on either side of a tear : (h, w) bool."""
    torn, tears = np.zeros(distance.shape, np.bool_), Tears(limits.max_slope, limits.max_bend, limits.min_tear)
    in_threads(_fill_torn, len(distance), distance, noise, step, tears, torn)
    return torn


@kernel
def _fill_torn(first, end, distance, noise, step, tears, torn):
    height, width = distance.shape
    for j in range(first, end):
        for i in range(width):
            if not np.isfinite(distance[j, i]):
                continue
            for dj, di in ((0, 1), (0, -1), (1, 0), (-1, 0)):
                j1, i1 = j + dj, i + di
                if j1 < 0 or j1 >= height or i1 < 0 or i1 >= width or not np.isfinite(distance[j1, i1]):
                    continue
                jump = abs(distance[j1, i1] - distance[j, i]) - max(noise[j, i], noise[j1, i1])
                if jump <= tears.least * step[j, i]:
                    continue
                # the gentler of the steps before and after this one; unknown ones don't count
                gentler = np.float32(np.inf)
                j0, i0, j2, i2 = j - dj, i - di, j1 + dj, i1 + di
                if 0 <= j0 < height and 0 <= i0 < width and np.isfinite(distance[j0, i0]):
                    gentler = abs(distance[j, i] - distance[j0, i0])
                if 0 <= j2 < height and 0 <= i2 < width and np.isfinite(distance[j2, i2]):
                    gentler = min(gentler, abs(distance[j2, i2] - distance[j1, i1]))
                if jump > tears.slope * step[j, i] or jump > tears.bend * gentler + tears.least * step[j, i]:
                    torn[j, i] = True


def _mixed(distance: Float32, modulation: Float32, fraction: float) -> Mask:
    """Pixels beside a hole whose modulation is below a fraction of the strongest within two pixels : (h, w) bool."""
    missing = np.isnan(distance)
    beside = cv2.dilate(missing.astype(np.uint8), np.ones((3, 3), np.uint8)).astype(bool) & ~missing
    strongest = cv2.dilate(np.where(missing, 0, modulation).astype(np.float32), np.ones((5, 5), np.uint8))
    return beside & (modulation < fraction * strongest)


def _without_islands(mask: Mask, smallest: int) -> Mask:
    """The mask less its pieces, connected along rows and columns, of fewer than `smallest` px."""
    _, labels, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=4)
    large = stats[:, cv2.CC_STAT_AREA] >= smallest
    large[0] = False  # label 0 is the background
    return large[labels]


@njit
def _triangles(distance, longest):
    """Corner triples : (n, 3) flat pixel indices. A square is split along the diagonal that is shorter in depth."""
    height, width = distance.shape
    faces = np.empty((2 * (height - 1) * (width - 1), 3), np.int64)
    n = 0
    for j in range(height - 1):
        for i in range(width - 1):
            a, b, c, d = distance[j, i], distance[j, i + 1], distance[j + 1, i], distance[j + 1, i + 1]
            ia = j * width + i
            ib, ic, id_ = ia + 1, ia + width, ia + width + 1
            limit = longest[j, i] if np.isfinite(a) else longest[j + 1, i + 1]
            # a comparison with NaN is false: an edge to a missing point doesn't hold
            ab, ac, bd, cd = abs(a - b) <= limit, abs(a - c) <= limit, abs(b - d) <= limit, abs(c - d) <= limit
            ad, bc = abs(a - d) <= 1.5 * limit, abs(b - c) <= 1.5 * limit
            along_ad = ad and (not bc or abs(a - d) <= abs(b - c))
            along_bc = bc and not along_ad
            if along_ad and ac and cd:
                faces[n] = ia, ic, id_
                n += 1
            if along_ad and ab and bd:
                faces[n] = ia, id_, ib
                n += 1
            if along_bc and ab and ac:
                faces[n] = ia, ic, ib
                n += 1
            if along_bc and bd and cd:
                faces[n] = ib, ic, id_
                n += 1
    return faces[:n]


@njit
def _normals(vertices, faces):
    """Unit normals : (n, 3), the mean of the adjoining triangles' weighted by area."""
    result = np.zeros_like(vertices)
    for a, b, c in faces:
        p, q = vertices[b] - vertices[a], vertices[c] - vertices[a]
        x, y, z = p[1] * q[2] - p[2] * q[1], p[2] * q[0] - p[0] * q[2], p[0] * q[1] - p[1] * q[0]
        for corner in (a, b, c):
            result[corner, 0] += x
            result[corner, 1] += y
            result[corner, 2] += z
    for i in range(result.shape[0]):
        length = np.sqrt(result[i, 0] ** 2 + result[i, 1] ** 2 + result[i, 2] ** 2)
        if length > 0:
            result[i] /= length
    return result
