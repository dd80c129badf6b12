"""Layers of tissue that have grown on one grid, point by point: a place costs one look for all of them.

What loops ask for at each place is inlined in them, as handing arrays over costs more than looking; what they ask for less
often are kernels, compiled apart from them.
"""

from collections.abc import Sequence
from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from recon.compiled import kernel, njit
from scenes.scene_types import Layer, Layers
from twin.trilinear import cell_at, nearest_cell, slope_within, within

Array = NDArray[np.float64]

NONE, MIXED = -1, -2  # of a cell: that no layer holds it, or that borders run through it
FAR_MM = 1e3  # beside the grid
STRANDS = 64, 64, 192  # values of the unevenness from strand to strand, powers of two but for the last
STRAND_STEPS_MM = 0.7, 0.7, 0.1  # between them, along and across
PATCH_MM = 0.6  # between them along all axes, where they make borders patchy


class Grown(NamedTuple):
    """The layers, for compiled code; those without one have an empty grid."""

    distance: NDArray[np.float32]  # (nx, ny, nz, layers) mm, negative inside; of a sheet, its sides have two signs
    sure: NDArray[np.int8]  # (nx - 1, ny - 1, nz - 1) the layer that holds a whole cell, NONE or MIXED
    among: NDArray[np.uint32]  # as `sure`, of a mixed cell the layers that may hold its points, a bit each; see `_bit`
    half_mm: NDArray[np.float32]  # (layers,) half the thickness of those that are sheets, 0 of others
    first: Array  # (3,) mm in the world, the first grid point
    per_mm: float  # grid points
    uneven: NDArray[np.float32]  # (nx, ny, nz) amplitude of backscatter over its tissue's
    strata: NDArray[np.float32]  # (nx, ny, nz, 1) mm across the strands of tissue
    strands: NDArray[np.float32]  # (n, n, m) unevenness from strand to strand, of unit variance, over and over


def packed(layers: Layers | None) -> Grown:
    """Layers for compiled code."""
    if layers is None:
        empty = np.zeros((0, 0, 0), np.float32)
        return Grown(
            empty[..., None],
            empty.astype(np.int8),
            empty.astype(np.uint32),
            np.zeros(0, np.float32),
            np.zeros(3),
            1.0,
            empty,
            empty[..., None],
            empty,
        )
    distance = np.stack([one.distance for one in layers.layers], axis=-1)
    half = np.array([one.half_mm for one in layers.layers], np.float32)
    uneven = np.exp(layers.uneven_db * np.float32(np.log(10) / 20))
    place = np.asarray(layers.origin, float), 1 / layers.step_mm
    return Grown(distance, *_in_cells(layers.layers), half, *place, uneven, layers.strata_mm[..., None], _strands())


@cache
def _strands() -> NDArray[np.float32]:
    """Values that go over and over : of strands some 4 mm long and 0.4 mm thick, and of bundles twice as large."""
    rng = np.random.default_rng(0)
    total = np.zeros(STRANDS, np.float32)
    for scale, share in ((1.0, 1.0), (2.2, 0.8)):
        sigma = scale * np.array([1.25, 1.25, 0.12]) / STRAND_STEPS_MM
        smooth = gaussian_filter(rng.standard_normal(STRANDS, dtype=np.float32), sigma, mode="wrap")
        total += np.float32(share) * smooth / smooth.std()
    return total / total.std()


@njit(inline="always")
def _bit(layer):
    """The bit of a layer; those from the 31st on share one."""
    return np.uint32(1) << np.uint32(min(layer, 31))


def _in_cells(layers: Sequence[Layer]) -> tuple[NDArray[np.int8], NDArray[np.uint32]]:
    """`sure` and `among` of each cell : (nx - 1, ny - 1, nz - 1); within it, distances lie between those of its corners."""
    shape = np.subtract(layers[0].distance.shape, 1)
    found, outside, partly = np.full(shape, NONE, np.int8), np.zeros(shape, bool), np.zeros(shape, bool)
    among = np.zeros(shape, np.uint32)
    for k, layer in enumerate(layers):
        low, high = (_of_corners(layer.distance, bound) for bound in (np.minimum, np.maximum))
        holds = (low >= -layer.half_mm) & (high <= layer.half_mm) if layer.half_mm else high <= 0
        lacks = (low > layer.half_mm) | (high < -layer.half_mm) if layer.half_mm else low > 0
        found[holds] = k
        found[~holds & ~lacks] = MIXED
        among[holds] = 0  # what lies below
        among[~lacks] |= _bit.py_func(k)
        if k == 0:
            outside, partly = lacks, ~holds & ~lacks
    found[outside] = NONE
    found[partly] = MIXED
    among[partly] |= _bit.py_func(0)
    return found, among


def _of_corners(values: NDArray[np.float32], bound: np.ufunc) -> NDArray[np.float32]:
    """The least or greatest of the eight corners of each cell."""
    for axis in range(3):
        before, after = (np.take(values, range(n, values.shape[axis] - 1 + n), axis=axis) for n in (0, 1))
        values = bound(before, after)
    return values


@njit(inline="always")
def layer_at(sure, among, distance, half_mm, first, per_mm, x, y, z):
    """The last layer that holds a point of the world, or NONE."""
    cell = cell_at(first, per_mm, distance.shape, x, y, z)
    if cell.i < 0:
        return NONE
    whole = sure[cell.i, cell.j, cell.k]
    if whole != MIXED:
        return whole
    some = among[cell.i, cell.j, cell.k]
    if some & _bit(0) and within(distance, cell, 0) > 0:
        return NONE
    for layer in range(len(half_mm) - 1, -1, -1):
        if some & _bit(layer):
            d, half = within(distance, cell, layer), half_mm[layer]
            if (abs(d) if half > 0 else d) <= half:
                return layer
    return NONE


@njit(inline="always")
def in_cell(distance, half_mm, cell, layer):
    """Signed distance of a layer at a place of a cell; FAR_MM beside the grid."""
    d, half = within(distance, cell, layer) if cell.i >= 0 else FAR_MM, half_mm[layer]
    return abs(d) - half if half > 0 else d


@kernel
def layer_distance(distance, half_mm, first, per_mm, layer, x, y, z):
    """Signed distance of a layer at a point of the world; FAR_MM beside the grid."""
    return in_cell(distance, half_mm, cell_at(first, per_mm, distance.shape, x, y, z), layer)


@kernel
def layer_normal(distance, half_mm, first, per_mm, layer, x, y, z, step_mm):
    """Outward normal of a layer at a point of the world, of a sheet away from its middle, from central differences."""
    h, shape = step_mm, distance.shape
    x = min(max(x, first[0] + h), first[0] + (shape[0] - 1) / per_mm - h)
    y = min(max(y, first[1] + h), first[1] + (shape[1] - 1) / per_mm - h)
    z = min(max(z, first[2] + h), first[2] + (shape[2] - 1) / per_mm - h)
    a = _side(distance, first, per_mm, layer, x + h, y, z) - _side(distance, first, per_mm, layer, x - h, y, z)
    b = _side(distance, first, per_mm, layer, x, y + h, z) - _side(distance, first, per_mm, layer, x, y - h, z)
    c = _side(distance, first, per_mm, layer, x, y, z + h) - _side(distance, first, per_mm, layer, x, y, z - h)
    size = np.sqrt(a * a + b * b + c * c) + 1e-12
    if half_mm[layer] > 0 and _side(distance, first, per_mm, layer, x, y, z) < 0:
        size = -size
    return a / size, b / size, c / size


@kernel
def layer_slope(distance, first, per_mm, layer, x, y, z):
    """Direction across a layer at a point of the world, to either side: the gradient in its cell, or in the nearest."""
    a, b, c = slope_within(distance, nearest_cell(first, per_mm, distance.shape, x, y, z), layer)
    size = np.sqrt(a * a + b * b + c * c) + 1e-12
    return a / size, b / size, c / size


@kernel
def _side(distance, first, per_mm, layer, x, y, z):
    """Distance to a layer, of a sheet to its middle, with its sides' signs."""
    cell = cell_at(first, per_mm, distance.shape, x, y, z)
    return FAR_MM if cell.i < 0 else within(distance, cell, layer)


@njit(inline="always")
def uneven_at(uneven, first, per_mm, x, y, z):
    """Amplitude of backscatter over its tissue's at a point of the world: of the nearest point of the grid."""
    i, j, k = int((x - first[0]) * per_mm + 0.5), int((y - first[1]) * per_mm + 0.5), int((z - first[2]) * per_mm + 0.5)
    if i < 0 or j < 0 or k < 0 or i >= uneven.shape[0] or j >= uneven.shape[1] or k >= uneven.shape[2]:
        return np.float32(1)
    return uneven[i, j, k]


@njit(inline="always")
def strand_at(strata, strands, first, per_mm, x, y, z):
    """Unevenness from strand to strand at a point of the world: of what lies along one face, from the same strand."""
    cell = cell_at(first, per_mm, strata.shape, x, y, z)
    if cell.i < 0:
        return np.float32(0)
    level = within(strata, cell, 0)
    return _tiled(strands, x / STRAND_STEPS_MM[0], y / STRAND_STEPS_MM[1], level / STRAND_STEPS_MM[2])


@kernel(fastmath=True)
def patch_at(strands, x, y, z):
    """Share of an even border's echo that a patch of it sends back: patches of 2 to 4 mm, some of them hardly any."""
    return np.float32(1 / (1 + np.exp(1.2 - 2.5 * _tiled(strands, x / PATCH_MM, y / PATCH_MM, z / PATCH_MM))))


@njit(inline="always")
def _tiled(values, u, v, w):
    """The nearest of values that go over and over."""
    i, j, k = int(np.floor(u + 0.5)), int(np.floor(v + 0.5)), int(np.floor(w + 0.5))
    return values[i % STRANDS[0], j % STRANDS[1], k % STRANDS[2]]
