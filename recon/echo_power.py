"""Mean echo power of tissue on a grid along the beams, from tracked B-scans.

Speckle's power averages to the tissue's backscatter, its grey levels don't: they are logarithms, in which a dark mass seems
smaller than it is by what pulse and beam spill into it. So grey levels are turned back into power before they are averaged.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from recon import freehand
from recon.errors import InputError
from recon.freehand import Clip, Grid
from recon.volumes import Volume

Array = NDArray[np.float64]

TISSUE_LEVEL = 40  # of 255 that tissue has on average: what is brighter than 8 dB above it counts as 8 dB
MEDIAN_OF_MEAN = np.log(2)  # of the power of speckle, which is exponentially distributed


@dataclass(frozen=True)
class EchoPower:
    """Mean power, relative to the tissue's typical one, and where a pixel fell."""

    volume: Volume  # voxels (nz, ny, nx) float32; x along the array, y into the depth, z across the images
    seen: NDArray[np.bool_]  # (nz, ny, nx)


def typical_grey(images: NDArray, rows: slice) -> float:
    """Median grey level of some rows of images : (n, h, w): that of tissue, where most of what they show is tissue."""
    return float(np.median(images[:, rows]))


def beam_grid(world_from_pixel: Array, shape: tuple[int, int], spacing_mm: float, clip: Clip | None = None) -> Grid:
    """The grid along the mean array (x) and beam (y) of images (h, w) with poses : (n, 4, 4), that takes in all of them."""
    around = freehand.corners(world_from_pixel, shape, clip)
    found = world_from_pixel[np.isfinite(world_from_pixel).all(axis=(1, 2))]
    axes = found[:, :3, :2] / np.linalg.norm(found[:, :3, :2], axis=1, keepdims=True)
    array, beam = axes.mean(axis=0).T
    beam = beam / np.linalg.norm(beam)
    array = array - beam * (array @ beam)
    if np.linalg.norm(array) < 0.5:
        raise InputError("poses: expected arrays that point about one way, found them all round")
    array = array / np.linalg.norm(array)
    directions = np.column_stack([array, beam, np.cross(array, beam)])
    low, high = (around @ directions).min(axis=0), (around @ directions).max(axis=0)
    nx, ny, nz = np.ceil((high - low) / spacing_mm).astype(int) + 1
    return Grid((int(nx), int(ny), int(nz)), directions @ low, np.full(3, float(spacing_mm)), directions)


def averaged(
    images: Iterable[NDArray],
    world_from_pixel: Array,
    grid: Grid,
    tissue_grey: float,
    dynamic_range_db: float = 60.0,
    clip: Clip | None = None,
) -> EchoPower:
    """Average the power of B-scans : n times (h, w) uint8, log-compressed, on a grid; see `recon.freehand.reconstruct`.

    `tissue_grey` is the median level of tissue, which gets a mean power of 1. A `clip` should leave out the ringing at the face.
    """
    decibels = (np.arange(256) - tissue_grey) * dynamic_range_db / 255
    power = TISSUE_LEVEL * MEDIAN_OF_MEAN * 10 ** (decibels / 10)
    table = np.rint(np.clip(power, 0, 255)).astype(np.uint8)
    table[0] = 0
    result = freehand.reconstruct((table[image] for image in images), world_from_pixel, grid, "mean", "linear", clip)
    volume = result.volume
    relative = volume.voxels.astype(np.float32) / TISSUE_LEVEL
    return EchoPower(Volume(relative, volume.origin, volume.spacing, volume.directions), result.filled)
