"""B-scans put into a volume with the PLUS toolkit's arithmetic, to the last bit: to compare, and to go on with its volumes.

Its volume has whole grey levels after each pixel, and weights in steps of 1/256: the mean is a running one, rounded at each
pixel, down with the nearest voxel and to the nearest level with linear shares. So it is too dark by some levels, and shares below
half a level change nothing. Places are of 14 binary digits with full optimization, and in floating point otherwise; a pixel whose
eight voxels don't all lie in the volume is left out. From the 256th pixel of a voxel on, each counts one part in 256.

Of pixels with weights of their own (`IMPORTANCE_MASK`) those of weight 0 never count. So it is in PLUS with linear shares; with
the nearest voxel and an optimization it loses its place in the image at the first of them, which isn't followed.

Source: the arithmetic was followed in the source text of PLUS (vtkIGSIOPasteSliceIntoVolume), and its volumes are reproduced;
this is written anew.
"""

from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from recon.compiled import njit

Arithmetic = Literal["floating", "plus_full", "plus_partial", "plus_none"]  # ours, and PLUS's by its setting Optimization

DIGITS = 14  # binary ones, of a place and a share
ONE = 1 << DIGITS
WHOLE = 256  # weight of a pixel
FULL, MOST = 65535 - WHOLE, 65535  # weight from which on a voxel changes slowly, and the greatest
NEARLY = 7.62939453125e-06  # 2^-17; a place in floating point that is as near below a whole number counts for it
LEAST_SHARE = 0.125  # of a voxel that a pixel is the maximum or the latest of: that of all eight where it lies in their middle
MEAN, MAXIMUM, LATEST, WEIGHTED = range(4)  # rules


class Levels(NamedTuple):
    """Voxels as PLUS has them."""

    grey: NDArray[np.uint8]  # (nz, ny, nx)
    weight: NDArray[np.uint16]  # 256 a pixel, or the pixel's own, 0 where there is none


class Slice(NamedTuple):
    """A B-scan, and what of it counts."""

    grey: NDArray[np.uint8]  # (h, w)
    mask: NDArray[np.bool_]  # (h, w)
    weight: NDArray[np.uint8]  # (h, w) of the rule WEIGHTED, above 0 within the mask; (0, 0) else
    bounds: tuple[int, int, int, int]  # left, right, top, bottom


def paste(image: Slice, voxel_from_pixel, levels: Levels, rule: int, linear: bool, fixed: bool) -> None:
    """Put a B-scan into the volume."""
    if not fixed:
        _paste_floating(image, np.ascontiguousarray(voxel_from_pixel[:3]), levels, rule, linear)
        return
    matrix = np.rint(voxel_from_pixel[:3] * ONE).astype(np.int64)
    _paste_fixed(image, matrix, levels, rule, linear)


@njit
def _paste_fixed(image: Slice, matrix, levels: Levels, rule, linear):
    left, right, top, bottom = image.bounds
    m, half = matrix, ONE // 2
    for v in range(top, bottom + 1):
        for u in range(left, right + 1):
            if not image.mask[v, u]:
                continue
            grey = np.int64(image.grey[v, u])
            part = np.int64(image.weight[v, u]) if rule == WEIGHTED else np.int64(WHOLE)
            x = m[0, 0] * u + m[0, 1] * v + m[0, 3]
            y = m[1, 0] * u + m[1, 1] * v + m[1, 3]
            z = m[2, 0] * u + m[2, 1] * v + m[2, 3]
            if linear:
                _share_fixed(levels, x, y, z, grey, part, rule)
            else:
                _nearest(levels, (x + half) >> DIGITS, (y + half) >> DIGITS, (z + half) >> DIGITS, grey, part, rule)


@njit
def _paste_floating(image: Slice, matrix, levels: Levels, rule, linear):
    left, right, top, bottom = image.bounds
    m, half = matrix, 0.5 + NEARLY
    for v in range(top, bottom + 1):
        for u in range(left, right + 1):
            if not image.mask[v, u]:
                continue
            grey = np.int64(image.grey[v, u])
            part = np.int64(image.weight[v, u]) if rule == WEIGHTED else np.int64(WHOLE)
            x = m[0, 0] * u + m[0, 1] * v + m[0, 3]
            y = m[1, 0] * u + m[1, 1] * v + m[1, 3]
            z = m[2, 0] * u + m[2, 1] * v + m[2, 3]
            if linear:
                _share_floating(levels, x, y, z, grey, part, rule)
            else:
                i, j, k = np.int64(np.floor(x + half)), np.int64(np.floor(y + half)), np.int64(np.floor(z + half))
                _nearest(levels, i, j, k, grey, part, rule)


@njit(inline="always")
def _nearest(levels: Levels, i, j, k, grey, part, rule):
    """Count a pixel for one voxel, if that is in the volume."""
    nz, ny, nx = levels.grey.shape
    if not (0 <= i < nx and 0 <= j < ny and 0 <= k < nz):
        return
    before, weight = np.int64(levels.grey[k, j, i]), np.int64(levels.weight[k, j, i])
    if rule in (MEAN, WEIGHTED):
        if weight <= FULL:
            levels.grey[k, j, i] = (grey * part + before * weight) // (weight + part)
            levels.weight[k, j, i] = min(weight + part, MOST)
        else:
            levels.grey[k, j, i] = np.uint8(grey * (1.0 / 256) + before * (255.0 / 256))
        return
    if rule != MAXIMUM or grey > before:
        levels.grey[k, j, i] = grey
    levels.weight[k, j, i] = WHOLE


@njit(inline="always")
def _share_fixed(levels: Levels, x, y, z, grey, part, rule):
    """Share a pixel out to the eight voxels around it, if all of those with a share are in the volume."""
    nz, ny, nx = levels.grey.shape
    i, j, k = x >> DIGITS, y >> DIGITS, z >> DIGITS
    fx, fy, fz, half = x & (ONE - 1), y & (ONE - 1), z & (ONE - 1), ONE // 2
    if i < 0 or j < 0 or k < 0 or i + (fx > 0) >= nx or j + (fy > 0) >= ny or k + (fz > 0) >= nz:
        return
    for di in range(2):
        for dj in range(2):
            for dk in range(2):
                wx, wy, wz = fx if di else ONE - fx, fy if dj else ONE - fy, fz if dk else ONE - fz
                share = (wx * ((wy * wz + half) >> DIGITS) + half) >> DIGITS
                if share == 0:
                    continue
                before, weight = np.int64(levels.grey[k + dk, j + dj, i + di]), np.int64(levels.weight[k + dk, j + dj, i + di])
                if rule == MEAN:
                    known = weight * (ONE // WHOLE)
                    total = share + known
                    mean = np.int64(np.rint(ONE * ((share * grey + known * before) / total)))
                    levels.grey[k + dk, j + dj, i + di] = (mean + half) >> DIGITS
                elif rule == WEIGHTED:  # each of the two parts of the mean is rounded by itself
                    known = weight << DIGITS
                    total = part * share + known
                    own, others = np.rint(ONE * (grey * part * share / total)), np.rint(ONE * (known / total))
                    mean = np.int64(own) + np.int64(others) * before
                    levels.grey[k + dk, j + dj, i + di] = (mean + half) >> DIGITS
                    levels.weight[k + dk, j + dj, i + di] = min((total + half) >> DIGITS, MOST)
                    continue
                elif share >= ONE * LEAST_SHARE and (rule != MAXIMUM or grey > before):
                    levels.grey[k + dk, j + dj, i + di] = grey
                    total = share
                else:
                    continue
                levels.weight[k + dk, j + dj, i + di] = min((total * WHOLE + half) >> DIGITS, MOST)


@njit(inline="always")
def _share_floating(levels: Levels, x, y, z, grey, part, rule):
    """The same in floating point."""
    nz, ny, nx = levels.grey.shape
    i, j, k = np.int64(np.floor(x + NEARLY)), np.int64(np.floor(y + NEARLY)), np.int64(np.floor(z + NEARLY))
    fx, fy, fz = x - i, y - j, z - k
    if i < 0 or j < 0 or k < 0 or i + (fx != 0) >= nx or j + (fy != 0) >= ny or k + (fz != 0) >= nz:
        return
    for di in range(2):
        for dj in range(2):
            for dk in range(2):
                wx, wy, wz = fx if di else 1 - fx, fy if dj else 1 - fy, fz if dk else 1 - fz
                share = wx * (wy * wz)
                if share == 0:
                    continue
                before, weight = np.int64(levels.grey[k + dk, j + dj, i + di]), np.int64(levels.weight[k + dk, j + dj, i + di])
                if rule == MEAN:
                    known = weight / WHOLE
                    total = share + known
                    mean = (share * grey + known * before) / total
                    levels.grey[k + dk, j + dj, i + di] = np.int64(np.floor(mean + 0.5 + NEARLY))
                elif rule == WEIGHTED:
                    total = part * share + weight
                    mean = (grey * part * share + before * weight) / total
                    levels.grey[k + dk, j + dj, i + di] = np.int64(np.floor(mean + 0.5 + NEARLY))
                    levels.weight[k + dk, j + dj, i + di] = min(np.int64(np.floor(total + 0.5 + NEARLY)), MOST)
                    continue
                elif share >= LEAST_SHARE and (rule != MAXIMUM or grey > before):
                    levels.grey[k + dk, j + dj, i + di] = grey
                    total = share
                else:
                    continue
                levels.weight[k + dk, j + dj, i + di] = min(np.int64(np.floor(total * WHOLE + 0.5 + NEARLY)), MOST)
