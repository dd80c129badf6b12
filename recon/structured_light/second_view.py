"""A surface by three devices: points of one camera, improved by another that sees the same fringes, and what that sees alone.

A point of the first camera lies where its ray meets the projector's column. There the second camera must see that column, too.
Where it does, the point is moved along the ray to where both measurements, weighed by their noise, agree best. Where it doesn't,
beyond noise, one of the three was deceived: by gloss, light from elsewhere, an edge or a wrong fringe order. The point is left
out.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from recon.compiled import kernel, njit
from recon.geometry.camera import FARTHEST, Camera, distort_side_by_side
from recon.structured_light.decode import ProjectorMap
from recon.structured_light.triangulate import PointMap
from recon.threads import in_threads

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

NOTHING = np.empty((0, 0), np.float32)  # in place of an axis that isn't decoded


class View(NamedTuple):
    """A camera's share: what it decoded, and the points of it."""

    camera: Camera
    found: ProjectorMap
    raw: PointMap  # not cleaned


@dataclass(frozen=True)
class FusionLimits:
    """When two cameras see the same."""

    apart_sigma: float = 5.0  # beyond which, and
    apart_px: float = 0.1  # projector px, beyond which a point is left out
    block: int = 32  # px of camera 1, over which errors of the calibration are alike
    least: int = 64  # points of a block that count
    bias_px: float = 0.05  # projector px, in one block of ten, from which on calibrations contradict each other
    reach_mm: float = 0.5  # along a ray, to both sides, over which slopes are taken: some pixels, so that noise hardly turns them
    beside_mm: float = 2.0  # from a point to another camera's in the same pixel, within which they are one surface's


LIMITS = FusionLimits()


@dataclass(frozen=True)
class Fused:
    """Points of the first camera."""

    points: PointMap  # improved, less those that disagree
    shared: Mask  # (h, w) that both cameras measured alike
    apart: Mask  # (h, w) that they measured differently, left out
    bias_px: (
        float  # projector px by which calibrations contradict each other, exceeded in one block of ten; NaN of too few points
    )


def fuse(first: View, second: View, projector: Camera, limits: FusionLimits = LIMITS) -> Fused:
    """Improve the points of a camera by another's view of the same fringes.

    Linear least squares along the camera's ray: the projector's column holds the point to its sigma; the second camera's map,
    less the projector's column of the point, is to be zero there. Nothing is changed where calibrations contradict each other by
    more than `limits.bias_px`.
    """
    points, sigma = first.raw.points, first.raw.sigma
    made, noises = points.copy(), sigma.copy()
    misses, apart = np.full(sigma.shape, np.nan, np.float32), np.zeros(sigma.shape, np.bool_)
    maps = []
    for mine, (image, noise) in zip(_axes(first.found), _axes(second.found), strict=True):
        known = mine[0] is not None and image is not None
        maps += [np.float32(image if known else NOTHING), np.float32(NOTHING if noise is None or not known else noise)]
    devices = [(camera.camera_from_world, camera.matrix, camera.coefficients) for camera in (second.camera, projector)]
    rules = Rules(limits.reach_mm, limits.apart_sigma, limits.apart_px)
    centre = np.ascontiguousarray(first.camera.centre)
    in_threads(_fuse, len(points), points, sigma, centre, *devices, tuple(maps), rules, made, noises, misses, apart)
    bias = _bias(misses, limits)
    if not bias <= limits.bias_px:
        none = np.zeros(sigma.shape, bool)
        return Fused(first.raw, none, none, bias)
    return Fused(PointMap(made, noises), np.isfinite(misses) & ~apart, apart, bias)


class Rules(NamedTuple):
    """Of `FusionLimits`, for compiled code."""

    reach_mm: float
    apart_sigma: float
    apart_px: float


@kernel
def _fuse(first, end, points, sigma, centre, camera, projector, maps, rules, made, noises, misses, apart):
    """Rows `first` to `end` (not included)."""
    columns, sigma_columns, rows, sigma_rows = maps
    for j in range(first, end):
        for i in range(points.shape[1]):
            x, y, z = np.float64(points[j, i, 0]), np.float64(points[j, i, 1]), np.float64(points[j, i, 2])
            if not np.isfinite(x):
                continue
            dx, dy, dz = x - centre[0], y - centre[1], z - centre[2]
            reach = rules.reach_mm / np.sqrt(dx * dx + dy * dy + dz * dz)
            dx, dy, dz = reach * dx, reach * dy, reach * dz
            u0, v0 = _pixel(x - dx, y - dy, z - dz, camera)
            u, v = _pixel(x, y, z, camera)
            u1, v1 = _pixel(x + dx, y + dy, z + dz, camera)
            s0, t0 = _pixel(x - dx, y - dy, z - dz, projector)
            s, t = _pixel(x, y, z, projector)
            s1, t1 = _pixel(x + dx, y + dy, z + dz, projector)
            doubt = np.float64(sigma[j, i])
            own = 1 / (doubt * doubt) if doubt > 0 else (1.0 if np.isnan(doubt) else 1e18)
            information, right, miss = own, 0.0, np.nan
            for axis in range(2):
                if axis == 0:
                    image, noise, before, here, after = columns, sigma_columns, s0, s, s1
                else:
                    image, noise, before, here, after = rows, sigma_rows, t0, t, t1
                left = _read(image, u, v) - here
                slope = (_read(image, u1, v1) - after - _read(image, u0, v0) + before) / (2 * rules.reach_mm)
                its = _read(noise, u, v)
                if np.isnan(left) or np.isnan(slope):
                    continue
                variance = max(its * its * _averaged(u) * _averaged(v), 1e-12) if np.isfinite(its) else 1.0
                information += slope * slope / variance
                right -= slope * left / variance
                if np.isnan(miss):
                    miss = left
                most = rules.apart_px + rules.apart_sigma * np.sqrt(variance + slope * slope / own)
                apart[j, i] = apart[j, i] or abs(left) > most
            misses[j, i] = miss
            if np.isnan(miss):
                continue
            step = right / information / rules.reach_mm
            bad = apart[j, i]
            made[j, i, 0] = np.nan if bad else x + step * dx
            made[j, i, 1] = np.nan if bad else y + step * dy
            made[j, i, 2] = np.nan if bad else z + step * dz
            noises[j, i] = np.nan if bad or np.isnan(doubt) else 1 / np.sqrt(information)


@njit(inline="always", error_model="numpy")
def _pixel(x, y, z, device):
    """The pixel of a point; NaN behind the device or past its lens's turn."""
    place, matrix, coefficients = device
    a = place[0, 0] * x + place[0, 1] * y + place[0, 2] * z + place[0, 3]
    b = place[1, 0] * x + place[1, 1] * y + place[1, 2] * z + place[1, 3]
    c = place[2, 0] * x + place[2, 1] * y + place[2, 2] * z + place[2, 3]
    if c <= 0 or a * a + b * b > coefficients[FARTHEST] * c * c:
        return np.nan, np.nan
    xd, yd = distort_side_by_side(a / c, b / c, coefficients)
    return matrix[0, 0] * xd + matrix[0, 1] * yd + matrix[0, 2], matrix[1, 1] * yd + matrix[1, 2]


@njit(inline="always")
def _averaged(u):
    """Variance of noise between two neighbours, over that of one."""
    a = u - np.floor(u)
    return a * a + (1 - a) * (1 - a)


@njit(inline="always", error_model="numpy")
def _read(image, u, v):
    """An image between its pixels; NaN outside and beside unknown ones."""
    height, width = image.shape
    if not (u >= 0 and v >= 0 and u < width - 1 and v < height - 1):
        return np.nan
    i, j = int(u), int(v)
    a, b = u - i, v - j
    upper = (1 - a) * image[j, i] + a * image[j, i + 1]
    return (1 - b) * upper + b * ((1 - a) * image[j + 1, i] + a * image[j + 1, i + 1])


def alone(second: View, points: PointMap, camera: Camera, limits: FusionLimits = LIMITS) -> PointMap:
    """Points of a second camera, of its size, that the first one has none of, and one pixel more for the meshes to meet.

    points : of the first, whose camera is given
    """
    rows, columns = np.nonzero(np.isfinite(second.raw.points[..., 0]))
    places = second.raw.points[rows, columns].astype(float)
    height, width = points.points.shape[:2]
    with np.errstate(invalid="ignore"):
        at = np.rint(camera.project(places))
        inside = ((at >= 0) & (at < [width, height])).all(axis=1)
    u, v = np.where(inside[:, None], at, 0).astype(int).T
    with np.errstate(invalid="ignore"):
        covered = inside & (np.linalg.norm(points.points[v, u] - places, axis=1) < limits.beside_mm)
    kept = _image(covered, rows, columns, second.raw.points.shape[:2])
    inner = ndimage.binary_erosion(kept, np.ones((3, 3), bool))
    made, noises = second.raw.points.copy(), second.raw.sigma.copy()
    made[inner] = noises[inner] = np.nan
    return PointMap(made, noises)


def _axes(found: ProjectorMap) -> tuple[tuple[NDArray | None, NDArray | None], ...]:
    """Columns and rows, each with its sigma."""
    return (found.columns, found.sigma_columns), (found.rows, found.sigma_rows)


def _bias(misses: NDArray[np.float32], limits: FusionLimits) -> float:
    """Absolute median in blocks of the image, exceeded in one of ten; NaN of too few points."""
    height, width = (length // limits.block * limits.block for length in misses.shape)
    blocks = misses[:height, :width].reshape(height // limits.block, limits.block, width // limits.block, limits.block)
    blocks = blocks.swapaxes(1, 2).reshape(-1, limits.block**2)
    blocks = blocks[np.isfinite(blocks).sum(axis=1) >= limits.least]
    return float(np.quantile(np.abs(np.nanmedian(blocks, axis=1)), 0.9)) if len(blocks) else np.nan


def _image(mask: Mask, rows: NDArray, columns: NDArray, shape: tuple[int, ...]) -> Mask:
    """A mask of pixels as an image."""
    image = np.zeros(shape[:2], bool)
    image[rows, columns] = mask
    return image
