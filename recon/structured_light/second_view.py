"""A surface by three devices: points of one camera, improved by another that sees the same fringes, and what that sees alone.

A point of the first camera lies where its ray meets the projector's column. There the second camera sees that column, too, if
nothing hides the point: then the point is moved along the ray to where both measurements, weighed by their noise, agree best. If
it sees a nearer point, that hides the first one, which stays as it is. If it sees a farther one, it sees through the point: one
was deceived, by gloss, light from elsewhere, an edge or a wrong fringe order, and nobody knows which. Both cameras' points there
are left out.
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
UNSEEN, AGREES, HIDDEN, THROUGH = range(4)  # what the second camera says of a point
EXACT = 1e-6  # mm and projector px: standard deviation of what claims to be perfect


class View(NamedTuple):
    """A camera's share: what it decoded, and the points of it."""

    camera: Camera
    found: ProjectorMap
    raw: PointMap  # not cleaned

    def less(self, gone: Mask) -> "View":
        """The same without some of its points."""
        points, sigma = self.raw.points.copy(), self.raw.sigma.copy()
        points[gone] = sigma[gone] = np.nan
        return self._replace(raw=PointMap(points, sigma))


@dataclass(frozen=True)
class FusionLimits:
    """When two cameras see the same."""

    apart_sigma: float = 5.0  # beyond which, and
    apart_px: float = 0.1  # projector px, beyond which both see different points
    block: int = 32  # px of camera 1, over which errors of the calibration are alike
    least: int = 64  # points of a block that count
    far_px: float = 2.0  # projector px: beyond, it isn't the calibration that parts both
    bias_px: float = 0.05  # projector px, in one block of ten, from which on calibrations contradict each other
    reach_mm: float = 0.5  # along a ray, to both sides, over which slopes are taken: some pixels, so that noise hardly turns them
    beside_mm: float = 2.0  # from a point to another camera's in the same pixel, within which they are one surface's


LIMITS = FusionLimits()


@dataclass(frozen=True)
class Fused:
    """Points of both cameras."""

    first: PointMap  # improved, less those that are seen through
    second: PointMap  # as it was, less the same
    shared: Mask  # (h, w) of the first, that both cameras measured alike
    apart: Mask  # (h, w) of the first, left out
    bias_px: float  # projector px by which calibrations part both in one block of ten; NaN of too few points


def fuse(first: View, second: View, projector: Camera, limits: FusionLimits = LIMITS) -> Fused:
    """Improve the points of a camera by another's view of the same fringes.

    Linear least squares along the camera's ray: the projector's column holds the point to its sigma; the second camera's map,
    less the projector's column of the point, is to be zero there. Nothing is changed where calibrations part both by more than
    `limits.bias_px`, beyond noise.
    """
    mine, its = _compare(first, second, projector, limits), _compare(second, first, projector, limits)
    bias = _bias(mine.misses, mine.expected, limits)
    if not bias <= limits.bias_px:
        none = np.zeros(mine.verdicts.shape, bool)
        return Fused(first.raw, second.raw, none, none, bias)
    gone, its_gone = mine.verdicts == THROUGH, its.verdicts == THROUGH
    gone, its_gone = gone | _about(its.places[its_gone], gone.shape), its_gone | _about(mine.places[gone], its_gone.shape)
    shared = (mine.verdicts == AGREES) & ~gone
    points = np.where(shared[..., None], mine.points, first.raw.points)
    better = View(first.camera, first.found, PointMap(points, np.where(shared, mine.sigma, first.raw.sigma))).less(gone)
    return Fused(better.raw, second.less(its_gone).raw, shared, gone & np.isfinite(first.raw.points[..., 0]), bias)


def _about(places: NDArray[np.int64], shape: tuple[int, ...]) -> Mask:
    """Pixels at flat places and those about them, between which a map is read, as an image."""
    image = np.zeros(shape, bool)
    image.ravel()[places] = True
    return ndimage.binary_dilation(image, np.ones((3, 3), bool))


class _Compared(NamedTuple):
    """What a second camera says of the points of a first, in the first one's pixels."""

    verdicts: NDArray[np.uint8]  # (h, w)
    places: NDArray[np.int64]  # (h, w) the nearest pixel of the second, flat
    points: NDArray[np.float32]  # (h, w, 3) mm, improved
    sigma: NDArray[np.float32]  # (h, w) mm
    misses: NDArray[np.float32]  # (h, w) projector px that the second's map is off, of the first axis that both have
    expected: NDArray[np.float32]  # (h, w) projector px, standard deviation of these


class _Rules(NamedTuple):
    """Of `FusionLimits`, for compiled code."""

    reach_mm: float
    apart_sigma: float
    apart_px: float


def _compare(first: View, second: View, projector: Camera, limits: FusionLimits) -> _Compared:
    points, sigma = first.raw.points, first.raw.sigma
    shape = sigma.shape
    maps = []
    for mine, (image, noise) in zip(_axes(first.found), _axes(second.found), strict=True):
        known = mine[0] is not None and image is not None
        maps += [np.float32(image if known else NOTHING), np.float32(NOTHING if noise is None or not known else noise)]
    devices = [(camera.camera_from_world, camera.matrix, camera.coefficients) for camera in (second.camera, projector)]
    eyes = np.stack([first.camera.centre, second.camera.centre])
    away = np.linalg.norm(second.raw.points - second.camera.centre.astype(np.float32), axis=-1)
    rules = _Rules(limits.reach_mm, limits.apart_sigma, limits.apart_px)
    unknown = np.full((2, *shape), np.nan, np.float32)
    found = _Compared(np.zeros(shape, np.uint8), np.zeros(shape, np.int64), points.copy(), sigma.copy(), *unknown)
    in_threads(_compare_rows, len(points), points, sigma, away, eyes, *devices, tuple(maps), rules, *found)
    return found


@kernel
def _compare_rows(
    first, end, points, sigma, away, eyes, camera, projector, maps, rules, verdicts, places, made, noises, misses, expected
):
    """Rows `first` to `end` (not included)."""
    columns, sigma_columns, rows, sigma_rows = maps
    for j in range(first, end):
        for i in range(points.shape[1]):
            x, y, z = np.float64(points[j, i, 0]), np.float64(points[j, i, 1]), np.float64(points[j, i, 2])
            if not np.isfinite(x):
                continue
            dx, dy, dz = x - eyes[0, 0], y - eyes[0, 1], z - eyes[0, 2]
            reach = rules.reach_mm / np.sqrt(dx * dx + dy * dy + dz * dz)
            dx, dy, dz = reach * dx, reach * dy, reach * dz
            u0, v0 = _pixel(x - dx, y - dy, z - dz, camera)
            u, v = _pixel(x, y, z, camera)
            u1, v1 = _pixel(x + dx, y + dy, z + dz, camera)
            s0, t0 = _pixel(x - dx, y - dy, z - dz, projector)
            s, t = _pixel(x, y, z, projector)
            s1, t1 = _pixel(x + dx, y + dy, z + dz, projector)
            doubt = np.float64(sigma[j, i])
            own = 1 / max(doubt, EXACT) ** 2 if doubt >= 0 else (s1 - s0) ** 2 / (2 * rules.reach_mm) ** 2  # of 1 px, as unknown
            information, right, miss, alike = own, 0.0, np.nan, True
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
                variance = max(its * its * _averaged(u) * _averaged(v), EXACT**2) if np.isfinite(its) else 1.0
                information += slope * slope / variance
                right -= slope * left / variance
                usual = np.sqrt(variance + slope * slope / own)
                if np.isnan(miss):
                    miss = left
                    expected[j, i] = usual
                alike = alike and abs(left) <= rules.apart_px + rules.apart_sigma * usual
            if np.isnan(miss):
                continue
            misses[j, i] = miss
            row, column = int(v + 0.5), int(u + 0.5)
            places[j, i] = row * away.shape[1] + column
            if not alike and np.isnan(away[row, column]):
                continue
            if not alike:
                distance = np.sqrt((x - eyes[1, 0]) ** 2 + (y - eyes[1, 1]) ** 2 + (z - eyes[1, 2]) ** 2)
                verdicts[j, i] = HIDDEN if away[row, column] < distance else THROUGH
                continue
            verdicts[j, i] = AGREES
            step = right / information / rules.reach_mm
            made[j, i, 0], made[j, i, 1], made[j, i, 2] = x + step * dx, y + step * dy, z + step * dz
            noises[j, i] = np.nan if np.isnan(doubt) else 1 / np.sqrt(information)


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
        covered = np.zeros(second.raw.sigma.shape, bool)
        covered[rows, columns] = inside & (np.linalg.norm(points.points[v, u] - places, axis=1) < limits.beside_mm)
    return second.less(ndimage.binary_erosion(covered, np.ones((3, 3), bool))).raw


def _axes(found: ProjectorMap) -> tuple[tuple[NDArray | None, NDArray | None], ...]:
    """Columns and rows, each with its sigma."""
    return (found.columns, found.sigma_columns), (found.rows, found.sigma_rows)


def _bias(misses: NDArray[np.float32], expected: NDArray[np.float32], limits: FusionLimits) -> float:
    """Absolute median in blocks of the image, less three of its standard deviations, exceeded in one of ten; NaN of too few."""
    height, width = (length // limits.block * limits.block for length in misses.shape)
    if not height or not width:
        return np.nan
    blocks = []
    for image in (np.where(np.abs(misses) < limits.far_px, misses, np.nan), expected):
        cut = image[:height, :width].reshape(height // limits.block, limits.block, width // limits.block, limits.block)
        blocks.append(cut.swapaxes(1, 2).reshape(-1, limits.block**2))
    count = np.isfinite(blocks[0]).sum(axis=1)
    used = count >= limits.least
    if not used.any():
        return np.nan
    medians, noise = np.abs(np.nanmedian(blocks[0][used], axis=1)), np.nanmedian(blocks[1][used], axis=1)
    shared_px = 4  # pixels of the second camera between which a map is read: so many misses share their noise
    sigma = np.sqrt(np.pi / 2) * noise / np.sqrt(count[used] / shared_px)
    return float(np.quantile(np.fmax(medians - 3 * sigma, 0), 0.9))
