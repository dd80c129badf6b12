"""Echo power without the masses' shadows: pixels put back to their true places, and as bright as without the masses.

Tissue some mm around the masses has one backscatter, so the mean brightness there, by depth and by length of the way through
masses, gives the loss of both.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from recon import threads
from recon.files.volumes import Volume
from recon.freehand.volume_compounding import Clip, Grid
from recon.geometry import rigid
from recon.segmentation import echo_power
from recon.segmentation.echo_power import EchoPower, Placed, pixel_mm
from recon.segmentation.mass_surface import FAR_MM, Mass, distances
from recon.segmentation.refraction import Sound, follow

Array = NDArray[np.float64]
Map = NDArray[np.float32]

DEPTH_BINS, PATH_BINS = 60, 40  # of 1 mm


@dataclass(frozen=True)
class Recording:
    """B-scans in space, with the power of their grey levels."""

    images: Callable[[], Iterator[NDArray[np.uint8]]]  # n of (h, w), one by one, from the first at each call
    world_from_pixel: Array  # (n, 4, 4), NaN where there is no pose
    table: Map  # (256,) power of each grey level
    clip: Clip
    spread_mm: float  # sigma of an echo's power along the array; shadows have no sharper edges
    brightening: Map  # (n, w) factor by which gel brightens each column, as of `recon.segmentation.gel`


def cleared(recording: Recording, grid: Grid, masses: Sequence[Mass], sound: Sound) -> EchoPower:
    """Average power anew, with each pixel at the place of its echo, and as bright as without the masses' shadows."""
    inside, scale = distances(masses, grid), pixel_mm(recording.world_from_pixel)
    by_depth, by_path = _losses(recording, inside, sound)
    table, top = recording.table, recording.clip.v

    most_loss = 0.05  # of power left: darker pixels are left out

    def place(image: NDArray[np.uint8], matrix: Array, brightening: Map) -> Placed:
        if not np.isfinite(matrix).all():
            return Placed(*4 * (table[image],))  # counts nothing
        lines = follow(inside, scale, matrix, image.shape, sound)
        rows = np.arange(image.shape[0], dtype=np.float32)[:, None] * scale[1]
        light = ndimage.gaussian_filter(lines.passed * np.exp(-by_path * lines.within), (0, recording.spread_mm / scale[0]))
        power = np.where(light > most_loss, table[image] / brightening * np.exp(by_depth * rows), np.nan)
        return Placed(*(field[top:].astype(np.float32) for field in (power, light, lines.u, lines.v)))

    placed = threads.mapped(place, recording.images(), recording.world_from_pixel, recording.brightening)
    return echo_power.accumulated(placed, recording.world_from_pixel, grid)


def _losses(recording: Recording, inside: Volume, sound: Sound) -> tuple[float, float]:
    """Loss of power, nepers a mm: of tissue with depth, beyond the scanner's gain; and of masses, beyond that of tissue.

    Fitted to the mean power of tissue some mm around the masses, by depth and length of the way through masses.
    """
    scale, table = pixel_mm(recording.world_from_pixel), recording.table
    thinned = 4  # pixels, columns and rows, of which one counts for the losses
    rows = slice(recording.clip.v, None, thinned)

    clear_mm = 2.0  # from a border, where pixels show one tissue only

    def binned(scan: tuple[NDArray[np.uint8], Array, Map]) -> tuple[NDArray[np.int64], Array]:
        image, matrix, brightening = scan
        lines = follow(inside, scale, matrix, image.shape, sound, thinned)
        u, v, within, passed = (a[rows] for a in (lines.u, lines.v, lines.within, lines.passed))
        power = table[image[rows, ::thinned]] / brightening[::thinned]
        away = _sample(inside, matrix, u, v)
        used = (away > clear_mm) & (away < FAR_MM - 0.2) & (passed > 0.5)
        bins = np.minimum(v[used] * scale[1], DEPTH_BINS - 1).astype(int) * PATH_BINS
        return bins + np.minimum(within[used], PATH_BINS - 1).astype(int), power[used] / passed[used]

    total, count = np.zeros((2, DEPTH_BINS * PATH_BINS))
    scans = zip(recording.images(), recording.world_from_pixel, recording.brightening, strict=True)
    placed = (scan for scan in scans if np.isfinite(scan[1]).all())
    for bins, power in threads.mapped(binned, placed):
        total += np.bincount(bins, power, len(total))
        count += np.bincount(bins, minlength=len(count))
    return _fitted_losses(total, count)


def passed(recording: Recording, grid: Grid, masses: Sequence[Mass], number: int, sound: Sound) -> float:
    """Mean power of tissue close behind one of the masses, in the B-scans that it shadows, over that beside it.

    Tissue near other masses doesn't count; infinite if none is seen behind or beside it.
    """
    inside, others = distances([masses[number]], grid), distances([*masses[:number], *masses[number + 1 :]], grid)
    scale, table = pixel_mm(recording.world_from_pixel), recording.table
    thinned, near_mm, least_mm = 4, (1.5, 4.5), 3.0  # pixels of which one counts; from the border; of the way through the mass
    rows = slice(recording.clip.v, None, thinned)

    def near(scan: tuple[NDArray[np.uint8], Array, Map]) -> Array:
        image, matrix, brightening = scan
        lines = follow(inside, scale, matrix, image.shape, sound, thinned)
        away, apart = (_sample(field, matrix, lines.u[rows], lines.v[rows]) for field in (inside, others))
        power, around = table[image[rows, ::thinned]] / brightening[::thinned], (away > near_mm[0]) & (away < near_mm[1])
        around &= apart > near_mm[0]
        behind, beside = around & (lines.within[rows] > least_mm), around & (lines.within[rows] == 0)
        return np.stack([field.sum(axis=1) for field in (power * behind, behind, power * beside, beside)])

    scans = zip(recording.images(), recording.world_from_pixel, recording.brightening, strict=True)
    sums = sum(threads.mapped(near, (scan for scan in scans if np.isfinite(scan[1]).all())), np.zeros(1))
    behind, count, beside, free = sums[:, (sums[1] > 0) & (sums[2] > 0)]  # rows with both
    return float(behind.sum() / (count * beside / free).sum()) if len(count) else np.inf


def _fitted_losses(total: Array, count: Array) -> tuple[float, float]:
    """Slopes of the log mean power by depth and by path, each bin weighed by its number of pixels; 0 if bins are too few."""
    enough = (count > 20) & (total > 0)
    if enough.sum() < 4:
        return 0.0, 0.0
    depth, path = np.divmod(np.flatnonzero(enough), PATH_BINS)
    path = np.where(path > 0, path + 0.5, 0.0)
    design = np.column_stack([np.ones(enough.sum()), -(depth + 0.5), -path]) * np.sqrt(count[enough])[:, None]
    level = np.log(total[enough] / count[enough]) * np.sqrt(count[enough])
    _, by_depth, by_path = np.linalg.lstsq(design, level)[0]
    most_by_path = 0.25  # nepers a mm: 11 dB/cm more than tissue, there and back
    return float(max(by_depth, 0.0)), float(np.clip(by_path, 0.0, most_by_path))


def _sample(inside: Volume, world_from_pixel: Array, u: NDArray, v: NDArray) -> Array:
    """Signed distance at pixels, mm."""
    voxel_from_pixel = np.linalg.inv(inside.world_from_voxel) @ world_from_pixel
    i, j, k = np.moveaxis(rigid.apply(voxel_from_pixel, np.stack([u, v, 0 * u], axis=-1)), -1, 0)
    return ndimage.map_coordinates(inside.voxels, [k, j, i], order=1, mode="nearest")
