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

from recon.compiled import njit
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
    places: NDArray[np.int64]  # (h, w) of the second: the first one's pixel at each of its points, flat; -1 outside
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
        return Fused(first.raw, second.raw, none, none, its.places, bias)
    gone, its_gone = mine.verdicts == THROUGH, its.verdicts == THROUGH
    gone, its_gone = gone | _about(its.places[its_gone], gone.shape), its_gone | _about(mine.places[gone], its_gone.shape)
    shared = (mine.verdicts == AGREES) & ~gone
    mine.points[gone] = mine.sigma[gone] = np.nan
    apart = gone & np.isfinite(first.raw.points[..., 0])
    return Fused(PointMap(mine.points, mine.sigma), second.less(its_gone).raw, shared, apart, its.places, bias)


def _about(places: NDArray[np.int64], shape: tuple[int, ...]) -> Mask:
    """Pixels at flat places and those about them, between which a map is read, as an image."""
    image = np.zeros(shape, bool)
    image.ravel()[places] = True
    return ndimage.binary_dilation(image, np.ones((3, 3), bool))


class _Compared(NamedTuple):
    """What a second camera says of the points of a first, in the first one's pixels."""

    verdicts: NDArray[np.uint8]  # (h, w)
    places: NDArray[np.int64]  # (h, w) the nearest pixel of the second, flat; -1 outside
    points: NDArray[np.float32]  # (h, w, 3) mm, improved where both agree
    sigma: NDArray[np.float32]  # (h, w) mm, of these
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
    rules = _Rules(limits.reach_mm, limits.apart_sigma, limits.apart_px)
    unknown = np.full((2, *shape), np.nan, np.float32)
    verdicts, places = np.zeros(shape, np.uint8), np.full(shape, -1, np.int64)
    found = _Compared(verdicts, places, points.copy(), sigma.copy(), *unknown)
    in_threads(_compare_rows, len(points), points, sigma, second.raw.points, eyes, *devices, tuple(maps), rules, *found)
    return found


@njit(nogil=True, noalias=True, error_model="numpy")
def _compare_rows(
    first, end, points, sigma, others, eyes, camera, projector, maps, rules, verdicts, places, made, noises, misses, expected
):
    """Rows `first` to `end` (not included)."""
    columns, sigma_columns, rows, sigma_rows = maps
    width, (its_height, its_width) = points.shape[1], others.shape[:2]
    along, seen, lit = np.empty((3, width)), np.empty((3, 2, width)), np.empty((3, 2, width))
    for j in range(first, end):
        for k in range(3):  # before the points of a row, at them, and behind
            for i in range(width):
                x, y, z = np.float64(points[j, i, 0]), np.float64(points[j, i, 1]), np.float64(points[j, i, 2])
                dx, dy, dz = x - eyes[0, 0], y - eyes[0, 1], z - eyes[0, 2]
                reach = (k - 1) * rules.reach_mm / np.sqrt(dx * dx + dy * dy + dz * dz)
                along[0, i], along[1, i], along[2, i] = x + reach * dx, y + reach * dy, z + reach * dz
            _project(along, camera, seen[k])
            _project(along, projector, lit[k])
        for i in range(width):
            u, v = seen[1, 0, i], seen[1, 1, i]
            if not (u >= -0.5 and v >= -0.5 and u < its_width - 0.5 and v < its_height - 0.5):
                continue
            row, column = int(v + 0.5), int(u + 0.5)
            places[j, i] = row * its_width + column
            doubt = np.float64(sigma[j, i])
            slope = (lit[2, 0, i] - lit[0, 0, i]) / (2 * rules.reach_mm)
            own = 1 / max(doubt, EXACT) ** 2 if doubt >= 0 else slope**2  # of 1 px, as unknown
            information, right, miss, alike = own, 0.0, np.nan, True
            for axis in range(2):
                image, noise = (columns, sigma_columns) if axis == 0 else (rows, sigma_rows)
                left = _read(image, u, v) - lit[1, axis, i]
                after = _read(image, seen[2, 0, i], seen[2, 1, i]) - lit[2, axis, i]
                before = _read(image, seen[0, 0, i], seen[0, 1, i]) - lit[0, axis, i]
                slope = (after - before) / (2 * rules.reach_mm)
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
            x, y, z = points[j, i]
            if alike:
                verdicts[j, i] = AGREES
                step = right / information / _distance(x, y, z, eyes[0])
                made[j, i, 0] = x + step * (x - eyes[0, 0])
                made[j, i, 1] = y + step * (y - eyes[0, 1])
                made[j, i, 2] = z + step * (z - eyes[0, 2])
                noises[j, i] = np.nan if np.isnan(doubt) else 1 / np.sqrt(information)
                continue
            xs, ys, zs = others[row, column]
            if not np.isnan(xs):
                hidden = _distance(xs, ys, zs, eyes[1]) < _distance(x, y, z, eyes[1])
                verdicts[j, i] = HIDDEN if hidden else THROUGH


@njit(inline="always", error_model="numpy")
def _distance(x, y, z, eye):
    """Of a point from an eye, in mm."""
    return np.sqrt((x - eye[0]) ** 2 + (y - eye[1]) ** 2 + (z - eye[2]) ** 2)


@njit(inline="always", error_model="numpy")
def _project(points, device, pixels):
    """A device's pixels : (2, n) of points : (3, n); NaN behind the device or past its lens's turn.

    Without branches, so that points share vector instructions.
    """
    place, matrix, coefficients = device
    for i in range(points.shape[1]):
        x, y, z = points[0, i], points[1, i], points[2, i]
        a = place[0, 0] * x + place[0, 1] * y + place[0, 2] * z + place[0, 3]
        b = place[1, 0] * x + place[1, 1] * y + place[1, 2] * z + place[1, 3]
        c = place[2, 0] * x + place[2, 1] * y + place[2, 2] * z + place[2, 3]
        c = c if (c > 0) & (a * a + b * b <= coefficients[FARTHEST] * c * c) else np.nan
        xd, yd = distort_side_by_side(a / c, b / c, coefficients)
        pixels[0, i], pixels[1, i] = matrix[0, 0] * xd + matrix[0, 1] * yd + matrix[0, 2], matrix[1, 1] * yd + matrix[1, 2]


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


def alone(second: View, places: NDArray[np.int64], points: PointMap, limits: FusionLimits = LIMITS) -> PointMap:
    """Points of a second camera that the first one has none of, and one pixel more for the meshes to meet.

    places : (h, w) of the second, as in `Fused`
    points : of the first
    """
    apart = np.linalg.norm(points.points.reshape(-1, 3)[places] - second.raw.points, axis=-1)
    covered = (places >= 0) & (apart < limits.beside_mm)
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
