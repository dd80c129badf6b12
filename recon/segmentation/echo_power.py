"""Mean echo power of tissue on a grid along the beams, from tracked B-scans.

Speckle's power averages to the tissue's backscatter, its grey levels don't: they are logarithms, in which a dark mass looks too
small, by the width of pulse and beam spilling into it. So grey levels are turned back into power before they are averaged.
"""

import itertools
import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from recon import threads
from recon.compiled import kernel, njit
from recon.errors import InputError
from recon.files.volumes import Volume
from recon.freehand import volume_compounding
from recon.freehand.volume_compounding import Clip, Grid

Array = NDArray[np.float64]
Map = NDArray[np.float32]
Spacing = tuple[float, float, float]

SPREAD_MM = (0.2, 0.063)  # sigma of an echo's power along the array and in depth, of the default array 20 mm deep
SLICE_MM = (  # the same across the image plane, at some depths: (depth, sigma)
    *((4.0, 0.91), (8.0, 0.63), (12.0, 0.37), (15.0, 0.24), (20.0, 0.24)),
    *((30.0, 0.37), (40.0, 0.56), (50.0, 0.8)),
)
MEDIAN_OF_MEAN = np.log(2)  # of the power of speckle, which is exponentially distributed


@dataclass(frozen=True)
class EchoPower:
    """Mean power, relative to the tissue's typical one, and the number of pixels in it."""

    volume: Volume  # voxels (nz, ny, nx) float32; x along the array, y into the depth, z across the images
    weight: Map  # (nz, ny, nx) pixels that a voxel is the mean of, by their light

    @property
    def seen(self) -> NDArray[np.bool_]:
        """Voxels with a pixel in them : (nz, ny, nx)."""
        return self.weight > 0


class Placed(NamedTuple):
    """Pixels of a B-scan, of one shape."""

    power: Map  # NaN where it is left out
    light: Map  # share of the sound that reaches a pixel, there and back
    u: Map  # px, the echo's place in the image plane
    v: Map


def typical_grey(images: NDArray, rows: slice) -> float:
    """Median grey level of some rows of images : (n, h, w): that of tissue, where they show mostly tissue."""
    return float(np.median(images[:, rows]))


def beam_grid(world_from_pixel: Array, shape: tuple[int, int], spacing_mm: Spacing, clip: Clip | None = None) -> Grid:
    """The grid along the mean array (x) and beam (y) around all images (h, w) with poses : (n, 4, 4).

    Raises
    ------
    InputError
        If arrays point all round, or the grid needs too much memory.
    """
    around = volume_compounding.corners(world_from_pixel, shape, clip)
    found = world_from_pixel[np.isfinite(world_from_pixel).all(axis=(1, 2))]
    axes = found[:, :3, :2] / np.linalg.norm(found[:, :3, :2], axis=1, keepdims=True)
    array, beam = axes.mean(axis=0).T
    beam = beam / np.linalg.norm(beam)
    array = array - beam * (array @ beam)
    if np.linalg.norm(array) < 0.5:
        raise InputError("poses: expected arrays that point about one way, found them all round")
    array = array / np.linalg.norm(array)
    directions = np.column_stack([array, beam, np.cross(array, beam)])
    grid = volume_compounding.grid_over(around, directions, np.array(spacing_mm))
    voxel_bytes = 48  # that finding masses takes a voxel, at most
    most, needed = volume_compounding.MOST_BYTES / 2**30, math.prod(grid.size) * voxel_bytes / 2**30
    if needed > most:
        found = f"{needed:.0f} GiB for {' x '.join(map(str, grid.size))} voxels; clip the images"
        raise InputError(f"power: expected at most {most:.0f} GiB, found {found}")
    return grid


def averaged(
    images: Iterable[NDArray],
    world_from_pixel: Array,
    grid: Grid,
    tissue_grey: float,
    dynamic_range_db: float = 60.0,
    clip: Clip | None = None,
    brightening: Map | None = None,
) -> EchoPower:
    """Average the power of B-scans : n times (h, w) uint8, log-compressed, on a grid.

    `tissue_grey` is the median level of tissue, which gets a mean power of 1. A `clip` should leave out the ringing at the face.
    `brightening` : (n, w) of each column, as of `recon.segmentation.gel`, is taken off.
    """
    table = powers(tissue_grey, dynamic_range_db)

    def place(scan: tuple[NDArray, Map | float]) -> Placed:
        image, factor = scan
        left, right, top, bottom = (clip or Clip(0, 0, image.shape[1], image.shape[0])).bounds(image.shape)
        v, u = np.mgrid[top : bottom + 1, left : right + 1].astype(np.float32)
        power = table[image[top : bottom + 1, left : right + 1]] / np.broadcast_to(factor, image.shape[1])[left : right + 1]
        return Placed(power, np.ones_like(power), u, v)

    factors = itertools.chain([] if brightening is None else brightening, itertools.repeat(np.float32(1)))
    scans = zip(images, factors, strict=False)
    return accumulated(threads.mapped(place, scans), world_from_pixel, grid)


def powers(tissue_grey: float, dynamic_range_db: float = 60.0) -> Map:
    """Power of each grey level : (256,), relative to the mean of tissue whose median level is given."""
    decibels = (np.arange(256) - tissue_grey) * dynamic_range_db / 255
    brightest = 10**0.8  # times tissue: brighter echoes count as 8 dB above it, such as those of walls square to the beam
    table = np.minimum(MEDIAN_OF_MEAN * 10 ** (decibels / 10), brightest)
    table[0] = 0
    return table.astype(np.float32)


def accumulated(parts: Iterable[Placed], world_from_pixel: Array, grid: Grid) -> EchoPower:
    """Power over light on a grid, of all pixels together, each counting for the eight voxels around it by its distance.

    A sum over a sum, as speckle scatters by its own mean: a pixel in the dark counts as little as it shows.

    Parameters
    ----------
    parts : n times
    world_from_pixel : (n, 4, 4)
        Images with a NaN are left out.

    Raises
    ------
    InputError
        If there are more or fewer images than poses.
    """
    shape = grid.size[::-1]
    value, weight = np.zeros((2, *(length + 2 for length in shape)), np.float32)  # a voxel more all round
    inner = 3 * (slice(1, -1),)
    voxel_from_world = np.linalg.inv(Volume(value[inner], grid.origin, grid.spacing, grid.directions).world_from_voxel)
    count = 0
    for part in parts:
        if count == len(world_from_pixel):
            raise InputError(f"images: expected as many as poses, {count}, found more")
        matrix = voxel_from_world @ world_from_pixel[count]
        count += 1
        if np.isfinite(matrix).all():
            _add(*(field.ravel() for field in part), matrix, value, weight)
    if count < len(world_from_pixel):
        raise InputError(f"images: expected as many as poses, {len(world_from_pixel)}, found {count}")
    value, weight = value[inner], weight[inner]
    value /= np.maximum(weight, 1e-6)
    return EchoPower(Volume(value, grid.origin, grid.spacing, grid.directions), weight)


@kernel
def _add(power, light, u, v, voxel_from_pixel, value, weight):
    """Add the finite powers of pixels and their light to the eight voxels around each, in tables with a rim of one voxel."""
    m = voxel_from_pixel
    nz, ny, nx = value.shape
    for n in range(power.size):
        x = m[0, 0] * u[n] + m[0, 1] * v[n] + m[0, 3] + 1
        y = m[1, 0] * u[n] + m[1, 1] * v[n] + m[1, 3] + 1
        z = m[2, 0] * u[n] + m[2, 1] * v[n] + m[2, 3] + 1
        if np.isfinite(power[n]) and 0 <= x < nx - 1 and 0 <= y < ny - 1 and 0 <= z < nz - 1:
            _share_out(power[n], light[n], x, y, z, value, weight)


@njit(inline="always")
def _share_out(power, light, x, y, z, value, weight):
    """Add a power and its light to the voxels around a place, in voxels, each weighed by its trilinear share."""
    i, j, k = np.uint64(x), np.uint64(y), np.uint64(z)  # unsigned, or each access would look for a negative index
    across, down, aside = np.float32(x - i), np.float32(y - j), np.float32(z - k)
    one, after = np.float32(1), i + np.uint64(1)
    for sheet in range(2):
        for row in range(2):
            share = (aside if sheet else one - aside) * (down if row else one - down)
            far = share * across
            near, at, line = share - far, k + np.uint64(sheet), j + np.uint64(row)
            value[at, line, i] += near * power
            value[at, line, after] += far * power
            weight[at, line, i] += near * light
            weight[at, line, after] += far * light


def pixel_mm(world_from_pixel: Array) -> tuple[float, float]:
    """Size of a pixel along the array and into the depth."""
    found = world_from_pixel[np.isfinite(world_from_pixel).all(axis=(1, 2))]
    if not len(found):
        raise InputError(f"poses: expected at least one that is valid, found none in {len(world_from_pixel)}")
    across, down = np.linalg.norm(found[0, :3, :2], axis=0)
    return float(across), float(down)
