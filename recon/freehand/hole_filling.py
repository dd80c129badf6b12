"""Holes of a reconstructed volume, between one B-scan and the next, filled from the voxels around them."""

import numpy as np
from numpy.typing import NDArray

from recon.compiled import njit
from recon.files.volumes import Volume
from recon.freehand.volume_compounding import Reconstruction

Array = NDArray[np.float64]

STICKS = np.array(  # x, y, z; one of each pair of opposite directions to the 26 neighbours, in PLUS's order of sums
    [
        *((1, 0, 0), (0, 1, 0), (0, 0, 1)),
        *((1, 1, 0), (1, 0, 1), (0, 1, 1), (1, -1, 0), (1, 0, -1), (0, 1, -1)),
        *((1, 1, 1), (-1, 1, 1), (1, -1, 1), (-1, -1, 1)),
    ],
    np.int64,
)
MOST_VOXELS = 9  # of a stick, both ends included


def fill_holes(
    reconstruction: Reconstruction, most_voxels: int = MOST_VOXELS, sticks: int = 1, as_plus: bool = False
) -> Reconstruction:
    """Fill empty voxels by linear interpolation along sticks.

    A stick is a straight line through the empty voxel, in one of 13 directions, from one filled voxel to another. The value is
    the mean, weighted by 1/length, over the `sticks` shortest ones and all as short as these. Voxels without a stick of at most
    `most_voxels` stay empty, so the volume does not grow past the scan. Filled voxels keep their values.

    Source: sticks and their limit are those of the PLUS toolkit's hole filling (vtkIGSIOFillHolesInVolume), which weights the two
    ends slightly otherwise and rounds down; with `as_plus` both are done as there.
    """
    volume = reconstruction.volume
    voxels, filled = volume.voxels.copy(), reconstruction.filled.copy()
    if as_plus:
        _fill_as_plus(volume.voxels, reconstruction.filled, most_voxels, sticks, voxels, filled)
        return Reconstruction(Volume(voxels, volume.origin, volume.spacing, volume.directions), filled)
    lengths = np.linalg.norm(STICKS * volume.spacing, axis=1)
    _fill(volume.voxels, reconstruction.filled, lengths, most_voxels, sticks, voxels, filled)
    return Reconstruction(Volume(voxels, volume.origin, volume.spacing, volume.directions), filled)


def spacing_that_fills(world_from_pixel: Array, corners: Array, most_voxels: int = MOST_VOXELS) -> float:
    """Spacing of voxels, mm, from which on sticks reach from most B-scans to the next, and between pixels; 0 of a single one.

    Parameters
    ----------
    world_from_pixel : (n, 4, 4)
        Of B-scans one after the other; those with a NaN are left out.
    corners : (m, 2) px
    most_voxels : int
        Of a stick, both ends included.
    """
    placed = world_from_pixel[np.isfinite(world_from_pixel).all(axis=(1, 2))]
    if len(placed) < 2:
        return 0.0
    pixels = np.column_stack([corners, np.zeros(len(corners)), np.ones(len(corners))])
    steps = np.diff((placed @ pixels.T)[:, :3], axis=0)
    normals = np.cross(placed[:-1, :3, 0], placed[:-1, :3, 1])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    gaps = np.abs(np.einsum("nik,ni->nk", steps, normals)).max(axis=1)
    mostly = 90  # percentile of the gaps between B-scans that are to be filled
    widest = max(float(np.percentile(gaps, mostly)), float(np.linalg.norm(placed[0, :3, :2], axis=0).max()))
    return widest / max(most_voxels - 1, 1)


@njit
def _fill(before, known, step_mm, most_voxels, sticks, voxels, filled):
    nz, ny, nx = before.shape
    length, grey = np.empty(len(step_mm)), np.empty(len(step_mm))
    for k in range(nz):
        for j in range(ny):
            for i in range(nx):
                if known[k, j, i]:
                    continue
                _measure(before, known, (k, j, i), step_mm, most_voxels, length, grey)
                mean = _mean_of_shortest(length, grey, sticks)
                if mean >= 0:
                    voxels[k, j, i] = np.uint8(mean + 0.5)
                    filled[k, j, i] = True


@njit(inline="always")
def _measure(before, known, voxel, step_mm, most_voxels, length, grey):
    """Lengths in mm of all sticks through an empty voxel, inf where there is none, and its grey level by each."""
    k, j, i = voxel
    for s in range(len(step_mm)):
        di, dj, dk = STICKS[s]
        length[s] = np.inf
        forth = _reach(known, k, j, i, dk, dj, di, most_voxels - 2)
        if forth == 0:
            continue
        back = _reach(known, k, j, i, -dk, -dj, -di, most_voxels - 1 - forth)
        if back > 0:
            ahead = before[k + forth * dk, j + forth * dj, i + forth * di]
            behind = before[k - back * dk, j - back * dj, i - back * di]
            length[s] = (forth + back) * step_mm[s]
            grey[s] = (back * ahead + forth * behind) / (forth + back)


@njit(inline="always")
def _mean_of_shortest(length, grey, sticks):
    """Mean grey level, weighted by 1/length, of the `sticks` shortest and all as short as these; -1 without any.

    Lengths of used sticks become inf.
    """
    total, weights, used = 0.0, 0.0, 0
    while used < sticks and length.min() < np.inf:
        shortest = length.min()
        for s in range(len(length)):
            if length[s] <= shortest * (1 + 1e-9):
                total += grey[s] / length[s]
                weights += 1 / length[s]
                length[s] = np.inf
                used += 1
    return total / weights if used > 0 else -1.0


@njit
def _fill_as_plus(before, known, most_voxels, sticks, voxels, filled):
    """The same as the PLUS toolkit does it: for whole levels, rounded down, and with other weights.

    A stick is longer by one than its ends are apart, and each end counts by one step more than the other's distance; spacings
    don't count.
    """
    nz, ny, nx = before.shape
    weight, grey = np.empty(len(STICKS)), np.empty(len(STICKS))
    for k in range(nz):
        for j in range(ny):
            for i in range(nx):
                if known[k, j, i]:
                    continue
                for s in range(len(STICKS)):
                    di, dj, dk = STICKS[s]
                    weight[s] = 0.0
                    forth = _reach(known, k, j, i, dk, dj, di, most_voxels - 1)
                    back = _reach(known, k, j, i, -dk, -dj, -di, most_voxels - 1 - forth) if forth else 0
                    if back:
                        ahead = before[k + forth * dk, j + forth * dj, i + forth * di]
                        behind = before[k - back * dk, j - back * dj, i - back * di]
                        length = np.float64(forth + back + 1)
                        part = (back + 1) / length
                        grey[s] = np.floor((1.0 - part) * behind + part * ahead)
                        weight[s] = 1.0 / (length * np.sqrt(np.float64(di * di + dj * dj + dk * dk)))
                total, weights, used = 0.0, 0.0, 0
                while used < sticks and weight.max() > 0:
                    most = weight.max()
                    for s in range(len(STICKS)):
                        if weight[s] == most:
                            total += grey[s] * weight[s]
                            weights += weight[s]
                            weight[s] = 0.0
                            used += 1
                voxels[k, j, i] = 0  # though a share below 1/512 may have left a level there
                if used:
                    voxels[k, j, i] = np.uint8(total / weights)
                    filled[k, j, i] = True


@njit
def _reach(filled, k, j, i, dk, dj, di, most):
    """Steps to the next filled voxel, 0 if there is none within `most`."""
    nz, ny, nx = filled.shape
    for step in range(1, most + 1):
        k, j, i = k + dk, j + dj, i + di
        if not (0 <= k < nz and 0 <= j < ny and 0 <= i < nx):
            return 0
        if filled[k, j, i]:
            return step
    return 0
