"""What a mass does to the lines of sound through it, so that pixels can be put where they belong and made as bright as they were.

In a mass sound has another speed: what lies behind is shown at a wrong depth, and lines that meet it aslant are bent. It absorbs
more, and borders met at a glancing angle reflect all, so shadows lie behind it and below its flanks. With a rough surface of the
mass all of this can be followed along each line.
"""

from dataclasses import dataclass

import numpy as np
from numba import prange
from numpy.typing import NDArray

from recon.compiled import njit
from recon.files.volumes import Volume
from recon.model.probe import SCANNER_SPEED

Array = NDArray[np.float64]
Map = NDArray[np.float32]

STEP_MM = 0.1  # along a line
STEEPEST = 3.0  # tangent of incidence beyond which a border counts as glancing, where it doesn't reflect all before


@dataclass(frozen=True)
class Sound:
    """Speeds of sound, m/s."""

    tissue: float = SCANNER_SPEED
    mass: float = SCANNER_SPEED  # the mean of soft tissues; masses of the breast have 1510 to 1570


@dataclass(frozen=True)
class Lines:
    """Where the pixels (h, w) of a B-scan lie in truth, and what is left of the sound there."""

    u: Map  # px
    v: Map  # px, of the depth in tissue
    within: Map  # mm of mass on the way
    passed: Map  # power that came through the borders, there and back; 0 behind one that reflects all


def follow(inside: Volume, pixel_mm: tuple[float, float], world_from_pixel: Array, shape: tuple[int, int], sound: Sound) -> Lines:
    """Follow the lines of a B-scan.

    Parameters
    ----------
    inside : Volume
        Signed distance to the masses' surface, mm, negative inside.
    pixel_mm : along the array and, in tissue, into the depth
    """
    voxel_from_pixel = np.linalg.inv(inside.world_from_voxel) @ world_from_pixel
    return Lines(*_follow(inside.voxels, voxel_from_pixel, *pixel_mm, shape[0], shape[1], sound.mass / sound.tissue))


@njit(inline="always")
def _at(field, m, u, v):
    """Signed distance at a pixel, by trilinear interpolation; far away outside of the field."""
    x = m[0, 0] * u + m[0, 1] * v + m[0, 3]
    y = m[1, 0] * u + m[1, 1] * v + m[1, 3]
    z = m[2, 0] * u + m[2, 1] * v + m[2, 3]
    i, j, k = int(np.floor(x)), int(np.floor(y)), int(np.floor(z))
    nz, ny, nx = field.shape
    if i < 0 or j < 0 or k < 0 or i + 1 >= nx or j + 1 >= ny or k + 1 >= nz:
        return 1e3
    x, y, z = x - i, y - j, z - k
    near = (field[k, j, i] * (1 - x) + field[k, j, i + 1] * x) * (1 - y)
    near += (field[k, j + 1, i] * (1 - x) + field[k, j + 1, i + 1] * x) * y
    far = (field[k + 1, j, i] * (1 - x) + field[k + 1, j, i + 1] * x) * (1 - y)
    far += (field[k + 1, j + 1, i] * (1 - x) + field[k + 1, j + 1, i + 1] * x) * y
    return near * (1 - z) + far * z


@njit(inline="always")
def _reflection(ratio, cosine):
    """Reflected over incident pressure where the speed grows by `ratio` at the same density; 1 beyond the critical angle."""
    sine2 = ratio * ratio * (1 - cosine * cosine)
    if sine2 >= 1:
        return 1.0
    onwards = np.sqrt(1 - sine2)
    return (ratio * cosine - onwards) / (ratio * cosine + onwards)


@njit(parallel=True)
def _follow(field, m, sx, sy, height, width, ratio):
    us = np.empty((height, width), np.float32)
    vs = np.empty((height, width), np.float32)
    within = np.empty((height, width), np.float32)
    passed = np.empty((height, width), np.float32)
    h = 0.3  # mm, over which a normal is taken
    for column in prange(width):
        u, true, shown, slope, through, left = float(column), 0.0, 0.0, 0.0, 0.0, 1.0
        before = _at(field, m, u, 0.0) < 0
        for row in range(height):
            while shown < row * sy:
                step = STEP_MM / ratio if before else STEP_MM
                share = min(1.0, (row * sy - shown) / step) + 1e-9
                true += share * STEP_MM
                shown += share * step
                u += share * STEP_MM * slope / sx
                if before:
                    through += share * STEP_MM
                now = _at(field, m, u, true / sy) < 0
                if now != before:
                    nx = (_at(field, m, u + h / sx, true / sy) - _at(field, m, u - h / sx, true / sy)) / (2 * h)
                    ny = (_at(field, m, u, (true + h) / sy) - _at(field, m, u, (true - h) / sy)) / (2 * h)
                    cosine = min(1.0, abs(ny))  # of a distance, whose gradient is 1 long, in space
                    speeds = ratio if now else 1 / ratio
                    reflected = _reflection(speeds, cosine)
                    left *= (1 - reflected * reflected) ** 2
                    if cosine * STEEPEST < np.sqrt(1 - cosine * cosine) + 1e-12:
                        left = 0.0
                    else:
                        slope -= (speeds - 1) * nx / ny  # Snell's law, to first order in the change of speed
                    before = now
            us[row, column], vs[row, column] = u, true / sy
            within[row, column], passed[row, column] = through, left
    return us, vs, within, passed
