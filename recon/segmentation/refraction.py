"""Refraction, delay and shadows of masses along the lines of sound, from a rough surface of the masses.

In a mass sound has another speed: echoes from behind are shown at a wrong depth, and lines that meet it aslant are bent. It
absorbs more, and borders met at a glancing angle reflect all, so shadows lie behind it and below its flanks. All of this is
followed along each line, so that pixels can be put back to their places and to their brightness.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from recon.compiled import kernel, njit
from recon.files.volumes import Volume
from recon.model.probe import SCANNER_SPEED

Array = NDArray[np.float64]
Map = NDArray[np.float32]

STEP_MM = 0.1  # along a line
REACH_MM = 0.3  # on either side of a border, over which its normal is taken
MARGIN_MM = 1.0  # of the distances: nearer than this to a border each step is looked at
OUTSIDE_MM = 1e3  # distance outside of the field
STEEPEST = 3.0  # tangent of incidence from which on a border lets nothing through


@dataclass(frozen=True)
class Sound:
    """Speeds of sound, m/s."""

    tissue: float = SCANNER_SPEED
    mass: float = SCANNER_SPEED  # the mean of soft tissues; masses of the breast have 1510 to 1570


class Lines(NamedTuple):
    """True places of the pixels (h, w) of a B-scan, and the sound's power there."""

    u: Map  # px
    v: Map  # px, of the depth in tissue
    within: Map  # mm of mass on the way
    passed: Map  # power that came through the borders, there and back; 0 behind one that reflects all
    inside: NDArray[np.bool_]  # whether the place lies in a mass


class _Medium(NamedTuple):
    """Masses in tissue, in the frame of a B-scan."""

    field: Map  # (nz, ny, nx) signed distance to the masses' surface, mm, negative inside
    voxel_from_pixel: Array  # (4, 4)
    scale: tuple[float, float]  # mm/px, along the array and into the depth
    ratio: float  # speed in a mass over that in tissue


def follow(
    inside: Volume,
    pixel_mm: tuple[float, float],
    world_from_pixel: Array,
    shape: tuple[int, int],
    sound: Sound,
    every: int = 1,
) -> Lines:
    """Follow the lines of a B-scan.

    Parameters
    ----------
    inside : Volume
        Signed distance to the masses' surface, mm, negative inside.
    pixel_mm : along the array and, in tissue, into the depth
    every : int
        Stride of the columns, from the first on.
    """
    voxel_from_pixel = np.linalg.inv(inside.world_from_voxel) @ world_from_pixel
    columns = np.arange(0, shape[1], every)
    lines = Lines(*(np.empty((shape[0], len(columns)), kind) for kind in (*4 * (np.float32,), bool)))
    _follow(_Medium(inside.voxels, voxel_from_pixel, pixel_mm, sound.mass / sound.tissue), columns, lines)
    return lines


@kernel
def _follow(medium, columns, lines):
    """Step down each line. No border is nearer than the distance, so steps up to it aren't looked at, but for a margin."""
    sx, sy = medium.scale
    for n in range(len(columns)):
        u, true, shown, slope, through, left = float(columns[n]), 0.0, 0.0, 0.0, 0.0, 1.0
        distance = _distance(medium, u, 0.0)
        within, clear = distance < 0, _clear(distance)
        for row in range(lines.u.shape[0]):
            while shown < row * sy:
                step = STEP_MM / medium.ratio if within else STEP_MM
                share = min(1.0, (row * sy - shown) / step) + 1e-9
                true, shown, u = true + share * STEP_MM, shown + share * step, u + share * STEP_MM * slope / sx
                through += share * STEP_MM if within else 0.0
                if true < clear:
                    continue
                distance = _distance(medium, u, true / sy)
                clear = true + _clear(distance)
                if (distance < 0) != within:
                    within = not within
                    bend, passed = _border(medium, u, true / sy, within)
                    slope, left = slope + bend, left * passed
            lines.u[row, n], lines.v[row, n], lines.inside[row, n] = u, true / sy, within
            lines.within[row, n], lines.passed[row, n] = through, left


@njit(inline="always")
def _clear(distance):
    """Length of way, mm, certainly without a border."""
    return max(abs(distance) - MARGIN_MM, 0.0) if abs(distance) < OUTSIDE_MM else 0.0


@njit(inline="always")
def _border(medium, u, v, entering):
    """Change of slope at a border, and share of the power that it lets through, there and back; 0 at a glancing angle."""
    du, dv = REACH_MM / medium.scale[0], REACH_MM / medium.scale[1]
    across = (_distance(medium, u + du, v) - _distance(medium, u - du, v)) / (2 * REACH_MM)
    down = (_distance(medium, u, v + dv) - _distance(medium, u, v - dv)) / (2 * REACH_MM)
    cosine = min(1.0, abs(down))  # of a distance, whose gradient is 1 long, in space
    if cosine * STEEPEST < np.sqrt(1 - cosine * cosine) + 1e-12:
        return 0.0, 0.0
    faster = medium.ratio if entering else 1 / medium.ratio
    reflected = _reflection(faster, cosine)
    return -(faster - 1) * across / down, (1 - reflected * reflected) ** 2  # Snell's law, to first order in the change of speed


@njit(inline="always")
def _distance(medium, u, v):
    """Signed distance at a pixel, by trilinear interpolation; `OUTSIDE_MM` outside of the field."""
    field, m = medium.field, medium.voxel_from_pixel
    x = m[0, 0] * u + m[0, 1] * v + m[0, 3]
    y = m[1, 0] * u + m[1, 1] * v + m[1, 3]
    z = m[2, 0] * u + m[2, 1] * v + m[2, 3]
    i, j, k = int(np.floor(x)), int(np.floor(y)), int(np.floor(z))
    nz, ny, nx = field.shape
    if i < 0 or j < 0 or k < 0 or i + 1 >= nx or j + 1 >= ny or k + 1 >= nz:
        return OUTSIDE_MM
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
