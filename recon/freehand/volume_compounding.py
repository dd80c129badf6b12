"""Freehand 3-D ultrasound: B-scans with poses become points, and a volume around all of them.

Frames pass one by one; in memory are the volume and one image. `world_from_pixel` is a matrix (4, 4) that takes the pixel
[u, v, 0, 1] to mm, the poses times the probe's calibration (`recon.freehand.sequences.target_from_pixel`).
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import repeat
from typing import Annotated, Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import Field

from recon import arguments
from recon.compiled import njit
from recon.errors import InputError, brief
from recon.files.volumes import Volume
from recon.freehand import plus_arithmetic
from recon.freehand.plus_arithmetic import LATEST, LEAST_SHARE, MAXIMUM, MEAN, WEIGHTED, Arithmetic, Slice
from recon.geometry import rigid

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Compounding = Literal["mean", "maximum", "latest", "weighted"]
Interpolation = Literal["nearest", "linear"]
Length = Annotated[int, Field(gt=0)]
Rectangle = tuple[int, int, Length, Length]  # u, v, width, height of a clip, px; of a setting

RULES = {"mean": MEAN, "maximum": MAXIMUM, "latest": LATEST, "weighted": WEIGHTED}
MOST_BYTES = 4 << 30


@dataclass(frozen=True)
class Clip:
    """The part of a B-scan that is used: `width` columns from u on, `height` rows from v on, as far as the image goes."""

    u: int
    v: int
    width: int
    height: int

    def bounds(self, shape: tuple[int, int]) -> tuple[int, int, int, int]:
        """First and last column, first and last row, of an image (h, w)."""
        left, top = self.corner
        right, bottom = min(self.u + self.width, shape[1]) - 1, min(self.v + self.height, shape[0]) - 1
        if left > right or top > bottom:
            raise InputError(f"clip: expected a part of an image of {shape[1]}x{shape[0]}, found {self}")
        return left, right, top, bottom

    @property
    def corner(self) -> tuple[int, int]:
        """Column and row, px, of its first pixel in the whole image."""
        return max(self.u, 0), max(self.v, 0)

    def cut(self, image: NDArray) -> NDArray:
        """The part of an image : (h, w)."""
        left, right, top, bottom = self.bounds((image.shape[0], image.shape[1]))
        return image[top : bottom + 1, left : right + 1]


@dataclass(frozen=True)
class Grid:
    """The voxels of a volume in space; see `Volume`."""

    size: tuple[int, int, int]  # nx, ny, nz
    origin: Array  # (3,) mm
    spacing: Array  # (3,) mm
    directions: Array  # (3, 3), columns


def grid_over(points: Array, directions: Array, spacing: Array, margin_mm: float = 0.0) -> Grid:
    """The grid along some axes, the columns of `directions`, that holds points : (n, 3) and a margin around them."""
    along = points @ directions
    low, high = along.min(axis=0) - margin_mm, along.max(axis=0) + margin_mm
    nx, ny, nz = (np.ceil((high - low) / spacing).astype(int) + 1).tolist()
    return Grid((nx, ny, nz), directions @ low, spacing, directions)


def grid_of(volume: Volume) -> Grid:
    """The voxels of a volume."""
    nz, ny, nx = volume.voxels.shape
    return Grid((nx, ny, nz), volume.origin, volume.spacing, volume.directions)


@dataclass(frozen=True)
class Reconstruction:
    """A volume, and those of its voxels that pixels fell into."""

    volume: Volume
    filled: Mask  # (nz, ny, nx)


def points(
    world_from_pixel: Array, shape: tuple[int, int], mask: Mask | None = None, clip: Clip | None = None
) -> tuple[Array, NDArray[np.int64]]:
    """Points of a B-scan's pixels.

    Parameters
    ----------
    shape : (h, w)
    mask : (h, w) bool, optional
        Pixels to take, such as those that were segmented; all of them without it.
    clip : Clip, optional

    Returns
    -------
    points : (n, 3) mm, in the world
    pixels : (n, 2) u, v
        With these, `image[pixels[:, 1], pixels[:, 0]]` are the points' grey values.
    """
    left, right, top, bottom = (clip or Clip(0, 0, shape[1], shape[0])).bounds(shape)
    inside = np.zeros(shape, bool)
    inside[top : bottom + 1, left : right + 1] = True
    v, u = np.nonzero(inside if mask is None else inside & mask)
    pixels = np.column_stack([u, v])
    return rigid.apply(world_from_pixel, np.column_stack([pixels, np.zeros(len(pixels))])), pixels


def corners(world_from_pixel: Array, shape: tuple[int, int], clip: Clip | None = None) -> Array:
    """Centres (m, 3) mm of the corner pixels of all B-scans that have a pose: `world_from_pixel` (n, 4, 4), NaN where not."""
    left, right, top, bottom = (clip or Clip(0, 0, shape[1], shape[0])).bounds(shape)
    found = world_from_pixel[np.isfinite(world_from_pixel).all(axis=(1, 2))]
    if not len(found):
        raise InputError(f"poses: expected at least one that is valid, found none in {len(world_from_pixel)}")
    pixels = np.array([[u, v, 0, 1] for u in (left, right) for v in (top, bottom)], float)
    return (pixels @ found.transpose(0, 2, 1))[..., :3].reshape(-1, 3)


def aligned_grid(around: Array, spacing_mm: ArrayLike) -> Grid:
    """The grid along the world's axes that holds points (n, 3), from the least coordinates on.

    It ends with the voxel of the greatest coordinates, as the volumes of the PLUS toolkit do.
    """
    return _grid(_points(around), spacing_mm, np.eye(3))


def principal_grid(around: Array, spacing_mm: ArrayLike) -> Grid:
    """The grid along the principal axes of points (n, 3), longest first.

    It is much smaller than the other where the sweep runs across the world's axes.
    """
    around = _points(around)
    apart = around - around.mean(axis=0)
    _, _, rows = np.linalg.svd(np.pad(apart, ((0, max(0, 3 - len(apart))), (0, 0))), full_matrices=False)
    rows *= np.sign(rows[np.arange(3), np.abs(rows).argmax(axis=1)])[:, None]  # along the world's axes, not against
    rows[2] *= np.sign(np.linalg.det(rows))
    return _grid(around, spacing_mm, rows.T)


def reconstruct(
    images: Iterable[NDArray],
    world_from_pixel: Array,
    grid: Grid,
    compounding: Compounding = "mean",
    interpolation: Interpolation = "nearest",
    clip: Clip | None = None,
    masks: Iterable[Mask | None] | None = None,
    most_bytes: int = MOST_BYTES,
    arithmetic: Arithmetic = "floating",
    weights: NDArray[np.uint8] | None = None,
) -> Reconstruction:
    """Put B-scans into a volume.

    Parameters
    ----------
    images : n times (h, w) uint8
        Taken one by one; may come from `recon.freehand.sequences.stream_images`.
    world_from_pixel : (n, 4, 4)
        Frames with a NaN are left out.
    grid : Grid
        Pixels outside are left out.
    compounding
        Rule for the pixels in a voxel: their mean, the greatest, the latest, or their mean by `weights`.
    interpolation
        A pixel counts for the nearest voxel or, by its distance, for the eight around it.
    masks : n times (h, w) bool, optional
        Pixels to take.
    most_bytes : int
        Largest memory of the volume, 10 bytes a voxel.
    arithmetic
        Other than floating: that of the PLUS toolkit, see `recon.freehand.plus_arithmetic`.
    weights : (h, w) uint8, optional
        Of the pixels of each image, for the weighted compounding; those of weight 0 don't count.

    Raises
    ------
    InputError
        If the volume would be larger than that, or the numbers of images and poses differ, or an image or mask is no such array.
    """
    arguments.of_kind("grid", grid, Grid, way="sonotwin.principal_grid makes one")
    arguments.of_kind("images", images, Iterable)
    world_from_pixel = arguments.places_of_pixels("world_from_pixel", world_from_pixel)
    if compounding not in RULES or interpolation not in ("nearest", "linear"):
        raise ValueError(f"no compounding {compounding!r} or interpolation {interpolation!r}")
    if arithmetic not in get_args(Arithmetic):
        raise InputError(f"arithmetic: expected one of {', '.join(get_args(Arithmetic))}, found {brief(arithmetic)}")
    arguments.of_kind("weights", weights, np.ndarray, type(None))
    if (weights is None) != (compounding != "weighted"):
        found = f"{'none' if weights is None else 'some'} with {compounding}"
        raise InputError(f"weights: expected with the weighted compounding, and only then, found {found}")
    own = np.empty((0, 0), np.uint8) if weights is None else np.ascontiguousarray(weights)
    shape = grid.size[::-1]
    bytes_per_voxel = 10  # sum and weight in float32; the grey value, and whether it is filled
    if np.prod(grid.size, dtype=float) * bytes_per_voxel > most_bytes:
        needed = np.prod(grid.size, dtype=float) * bytes_per_voxel / 2**30
        found = f"{needed:.1f} GiB for {' x '.join(map(str, grid.size))} voxels; take a larger spacing or clip"
        raise InputError(f"volume: expected at most {most_bytes / 2**30:.1f} GiB, found {found}")
    as_plus = arithmetic != "floating"
    sums = None if as_plus else Sums(np.zeros(shape, np.float32), np.zeros(shape, np.float32))
    voxels, weight = np.zeros(shape, np.uint8), np.zeros(shape if as_plus else (0, 0, 0), np.uint16)
    voxel_from_world = np.linalg.inv(Volume(voxels, grid.origin, grid.spacing, grid.directions).world_from_voxel)
    count = 0
    left: Iterator[Mask | None] = repeat(None) if masks is None else iter(masks)
    for image in images:
        arguments.of_kind(f"image {count}", image, np.ndarray)
        if count == len(world_from_pixel):
            raise InputError(f"images: expected as many as poses, {count}, found more")
        try:
            mask = next(left)
        except StopIteration:
            raise InputError(f"masks: expected one for each image, found {count}") from None
        matrix = voxel_from_world @ world_from_pixel[count]
        count += 1
        if np.isfinite(matrix).all():
            taken = np.ones(image.shape, bool) if mask is None else np.asarray(mask, bool)
            if image.ndim != 2 or image.dtype != np.uint8 or taken.shape != image.shape:
                found = f"{image.shape} of {image.dtype}, mask {taken.shape}"
                raise InputError(f"image {count - 1}: expected height x width of uint8 and a mask like it, found {found}")
            bounds = (clip or Clip(0, 0, image.shape[1], image.shape[0])).bounds(image.shape)
            if weights is not None:
                if own.shape != image.shape or own.dtype != np.uint8:
                    raise InputError(f"weights: expected {image.shape} of uint8 as the image, found {own.shape} of {own.dtype}")
                taken = taken & (own > 0)
            rule, linear = RULES[compounding], interpolation == "linear"
            plain = Slice(np.ascontiguousarray(image), np.ascontiguousarray(taken), own, bounds)
            if sums is not None:
                (_paste_linear if linear else _paste_nearest)(plain, matrix, sums, rule)
            else:
                levels, fixed = plus_arithmetic.Levels(voxels, weight), arithmetic == "plus_full"
                plus_arithmetic.paste(plain, matrix, levels, rule, linear, fixed)
    if count < len(world_from_pixel):
        raise InputError(f"images: expected as many as poses, {len(world_from_pixel)}, found {count}")
    if masks is not None and next(left, left) is not left:
        raise InputError(f"masks: expected one for each image, {count}, found more")
    if sums is not None:
        _finish(sums, compounding in ("mean", "weighted"), voxels)
    filled = (weight if sums is None else sums.weight) > 0
    return Reconstruction(Volume(voxels, grid.origin, grid.spacing, grid.directions), filled)


def _points(around: Array) -> Array:
    """Points : (n, 3) that a grid is to hold, n >= 1, as floats."""
    points = np.asarray(arguments.numbers("around", around, ("n", 3)), float)
    if not len(points):
        raise InputError("around: expected points, mm, found none")
    return points


def _grid(around: Array, spacing_mm: ArrayLike, directions: Array) -> Grid:
    given = np.asarray(arguments.numbers("spacing_mm", spacing_mm), float)
    if given.shape not in ((), (1,), (3,)) or not given.min() > 0:
        raise InputError(f"spacing_mm: expected lengths above 0 mm, one or three, found {spacing_mm}")
    spacing = np.broadcast_to(given, (3,)).copy()
    along = around @ directions
    low, high = along.min(axis=0), along.max(axis=0)
    nx, ny, nz = np.floor((high - low) / spacing + 0.5).astype(int) + 1
    return Grid((int(nx), int(ny), int(nz)), directions @ low, spacing, directions)


class Sums(NamedTuple):
    """Grey levels of the voxels before `_finish`, (nz, ny, nx) float32."""

    value: NDArray[np.float32]  # their sum, or the greatest or latest
    weight: NDArray[np.float32]  # of all pixels so far, 0 where there is none


@njit
def _paste_nearest(image: Slice, voxel_from_pixel, sums: Sums, rule):
    m = voxel_from_pixel
    left, right, top, bottom = image.bounds
    nz, ny, nx = sums.value.shape
    for v in range(top, bottom + 1):
        for u in range(left, right + 1):
            if not image.mask[v, u]:
                continue
            part = np.float32(image.weight[v, u]) if rule == WEIGHTED else np.float32(1.0)
            i = int(np.floor(m[0, 0] * u + m[0, 1] * v + m[0, 3] + 0.5))
            j = int(np.floor(m[1, 0] * u + m[1, 1] * v + m[1, 3] + 0.5))
            k = int(np.floor(m[2, 0] * u + m[2, 1] * v + m[2, 3] + 0.5))
            if 0 <= i < nx and 0 <= j < ny and 0 <= k < nz:
                _compound(sums, k, j, i, image.grey[v, u], part, rule)


@njit
def _paste_linear(image: Slice, voxel_from_pixel, sums: Sums, rule):
    m = voxel_from_pixel
    left, right, top, bottom = image.bounds
    for v in range(top, bottom + 1):
        for u in range(left, right + 1):
            if not image.mask[v, u]:
                continue
            part = np.float32(image.weight[v, u]) if rule == WEIGHTED else np.float32(1.0)
            x = m[0, 0] * u + m[0, 1] * v + m[0, 3]
            y = m[1, 0] * u + m[1, 1] * v + m[1, 3]
            z = m[2, 0] * u + m[2, 1] * v + m[2, 3]
            _share_out(sums, x, y, z, image.grey[v, u], part, rule)


@njit(inline="always")
def _share_out(sums: Sums, x, y, z, grey, part, rule):
    """Share a pixel out to the eight voxels around it, by its distance from each."""
    nz, ny, nx = sums.value.shape
    i0, j0, k0 = int(np.floor(x)), int(np.floor(y)), int(np.floor(z))
    for k in range(max(k0, 0), min(k0 + 2, nz)):
        for j in range(max(j0, 0), min(j0 + 2, ny)):
            for i in range(max(i0, 0), min(i0 + 2, nx)):
                share = np.float32((1 - abs(x - i)) * (1 - abs(y - j)) * (1 - abs(z - k)))
                if share >= LEAST_SHARE or (rule in (MEAN, WEIGHTED) and share > 0):
                    _compound(sums, k, j, i, grey, part * share, rule)


@njit(inline="always")
def _compound(sums: Sums, k, j, i, grey, share, rule):
    value, weight = sums.value, sums.weight
    if rule in (MEAN, WEIGHTED):
        value[k, j, i] += share * grey
        weight[k, j, i] += share
    elif rule == MAXIMUM:
        value[k, j, i] = max(value[k, j, i], np.float32(grey))
        weight[k, j, i] = 1
    else:
        value[k, j, i] = grey
        weight[k, j, i] = 1


@njit
def _finish(sums: Sums, divide, voxels):
    value, weight = sums.value, sums.weight
    for k in range(value.shape[0]):
        for j in range(value.shape[1]):
            for i in range(value.shape[2]):
                if weight[k, j, i] > 0:
                    mean = value[k, j, i] / weight[k, j, i] if divide else value[k, j, i]
                    voxels[k, j, i] = np.uint8(mean + np.float32(0.5))
                else:
                    voxels[k, j, i] = 0
