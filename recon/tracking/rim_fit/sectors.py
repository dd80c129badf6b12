"""Sectors of a rim: their geometry, their contrast and their weights in the fit; compiled."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from recon.compiled import njit
from recon.geometry.order_statistics import count, quantile_of
from recon.tracking.rim_fit.rim_parameters import LEAST_VARIANCE, Rim

Array = NDArray[np.float64]

SECTORS = 48
LEAST_SECTORS = 16
INNERMOST = 0.85  # of the ring's width inwards from the rim, where the summed pixels end at the latest
OUTERMOST = 0.37  # radii beyond the rim: half way to the neighbour
SCATTER = 10.0  # standard deviations beyond which a pixel counts less
KEPT = (1 - 6 / SCATTER**2) / (1 - 2 / SCATTER**2)  # share of normal noise's variance that such weights leave
STEEP = 0.6  # of the upper quartile of the sectors' contrasts (bright - dark) / (bright + dark): with less it isn't a rim
STRANGE = 4.0  # times the usual mean square at which a sector has lost three quarters of its weight
ROUNDING = 1 / 12  # DN^2

# unknowns of a sector, by index
EDGE, DARK, BRIGHT, VARIANCE, GROWTH = range(5)
UNKNOWNS = 5


SECTOR = np.dtype([(name, float) for name in (
    "ux", "uy",  # direction on the unit circle that the shape maps to the rim
    "nx", "ny",  # unit normal, outwards
    "wide",  # px^2, variance of the profile across the edge
    "box",  # px, the path of the motion across the edge
    "blur",  # px, standard deviation of the lens's blur
    "pull",  # px inwards, shift of the edge by motion along it
    "inner", "outer",  # px, extent of the fitted band inwards and outwards
    "cos", "sin",  # of twice the normal's angle
    "x", "y",  # place on the rim from its centre, in mean radii
)])  # fmt: skip
"""Geometry and profile in the middle of a sector."""

LEVELS = np.dtype([(name, float) for name in (
    "dark", "bright",  # DN, offsets inside and outside
    "growth",  # DN/px, gradient outwards
    "leaning",  # DN a sector, gradient along the rim
)])  # fmt: skip
"""A sector's own light, in addition to the planes inside and outside."""

SUMS = np.dtype([
    ("normal", float, (UNKNOWNS, UNKNOWNS)),  # products of slopes
    ("right", float, UNKNOWNS),  # slopes times residuals
    ("squares", float),  # squared residuals over their expected variance
    ("count", float),  # robust weights, as are those below
    ("dark2", float), ("mixed", float), ("bright2", float),  # products of the shares of both sides
    ("dark_squares", float), ("bright_squares", float),  # DN^2, squared residuals by the shares of both sides
])  # fmt: skip
"""Weighted sums over the pixels of a sector."""


class SideNoise(NamedTuple):
    """Variance of the noise, DN^2."""

    dark: float
    bright: float


class Sums(NamedTuple):
    """Weighted sums over the pixels of each sector."""

    normal: Array  # (SECTORS, UNKNOWNS, UNKNOWNS) products of slopes
    right: Array  # (SECTORS, UNKNOWNS) slopes times residuals
    squares: Array  # (SECTORS,) squared residuals over their expected variance
    count: Array  # (SECTORS,) robust weights, as are those below
    dark2: Array  # (SECTORS,) squared shares of the dark side
    mixed: Array  # (SECTORS,) products of the shares of both sides
    bright2: Array  # (SECTORS,) squared shares of the bright side
    dark_squares: Array  # (SECTORS,) DN^2, squared residuals by the share of the dark side
    bright_squares: Array  # (SECTORS,) DN^2, and of the bright side


class Free(NamedTuple):
    """Steps of a sector's two levels by its own pixels alone, with the edge fixed. All (SECTORS,)."""

    dark: Array  # DN
    bright: Array  # DN
    dark_variance: Array  # DN^2, 0 of a sector without pixels on both sides
    bright_variance: Array  # DN^2


@njit(error_model="numpy")
def geometry(rim: Rim, reach, hole):
    """Geometry of the sectors : (SECTORS,) SECTOR, for a rim that may be off by `reach` px, and the ratio `hole` of diameters."""
    sectors = np.empty(SECTORS, SECTOR)
    a, b, c = rim.a, rim.b, rim.c
    determinant = a * c - b * b
    radius = (a + c) / 2
    strength = math.hypot(rim.variance_cos, rim.variance_sin)
    blur = math.sqrt(max(rim.variance - strength, LEAST_VARIANCE))
    path = math.sqrt(24 * strength)
    psi = 0.5 * math.atan2(rim.variance_sin, rim.variance_cos)
    for j in range(SECTORS):
        sector = sectors[j]
        x, y = _direction(j)
        nx, ny = (c * x - b * y) / determinant, (a * y - b * x) / determinant
        slope = math.hypot(nx, ny)
        nx, ny = nx / slope, ny / slope
        across = path * abs(nx * math.cos(psi) + ny * math.sin(psi))
        along = path * (ny * math.cos(psi) - nx * math.sin(psi))
        curvature = determinant / math.hypot(b * x - a * y, c * x - b * y) ** 3
        far = max(across / 2 + 3 * blur + 1.5, 1.3 * reach + 1)
        sector.ux, sector.uy, sector.nx, sector.ny = x, y, nx, ny
        sector.box, sector.blur = across, blur
        sector.wide = blur * blur + across * across / 12
        sector.pull = curvature * along * along / 24
        sector.inner = min(far, 0.75 * (1 - hole) / slope)
        sector.outer = min(far, OUTERMOST / slope)
        sector.cos, sector.sin = nx * nx - ny * ny, 2 * nx * ny
        sector.x, sector.y = (a * x + b * y) / radius, (b * x + c * y) / radius
    return sectors


@njit(inline="always", error_model="numpy")
def _direction(j):
    """Unit vector to the middle of a sector; the inverse of `sector`."""
    at = (j + 0.5) * 4 / SECTORS
    quadrant = int(at)
    y = at - quadrant
    x = 1 - y
    length = math.hypot(x, y)
    x, y = x / length, y / length
    for _ in range(quadrant):
        x, y = -y, x
    return x, y


@njit(inline="always", error_model="numpy")
def sector(x, y):
    """Number of the sector of a direction, plus the share of it that lies before the direction."""
    right, below = x >= 0, y >= 0
    along = y if right == below else x
    quadrant = (0.0 if below else 3.0) if right else (1.0 if below else 2.0)
    at = quadrant + (along if right else -along) / (abs(x) + abs(y))
    return min(at * (SECTORS / 4), SECTORS - 1e-9)


@njit(error_model="numpy")
def steep(dark, bright, seen):
    """Sectors with ring-like Michelson contrast : (SECTORS,) bool, of those with pixels, by their levels in any light."""
    depth, likely = np.empty(SECTORS), np.empty(SECTORS, np.bool_)
    for j in range(SECTORS):
        depth[j] = (bright[j] - dark[j]) / max(abs(bright[j]) + abs(dark[j]), 1e-9)
    least = STEEP * quantile_of(depth, seen, 0.75)
    for j in range(SECTORS):
        likely[j] = seen[j] and depth[j] > least
    return likely


@njit(error_model="numpy")
def free_levels(sums):
    """Solve each sector's normal equations for its two levels alone."""
    dark, bright, dark_variance, bright_variance = np.zeros(SECTORS), np.zeros(SECTORS), np.zeros(SECTORS), np.zeros(SECTORS)
    for j in range(SECTORS):
        normal, right = sums[j].normal, sums[j].right
        a, b, c = normal[DARK, DARK] * 1.001, normal[DARK, BRIGHT], normal[BRIGHT, BRIGHT] * 1.001
        p, q = right[DARK], right[BRIGHT]
        determinant = a * c - b * b
        if determinant > 0:
            dark[j], bright[j] = (c * p - b * q) / determinant, (a * q - b * p) / determinant
            dark_variance[j], bright_variance[j] = c / determinant, a / determinant
    return Free(dark, bright, dark_variance, bright_variance)


@njit(error_model="numpy")
def weigh(sums, sectors, rim: Rim, own, fewest, weights):
    """Weigh the sectors by contrast and fit, in place; returns the usual mean square, 0 if too few sectors have such contrast.

    Sectors with less than `fewest` pixels don't count.
    """
    seen, mean, dark, bright = np.empty(SECTORS, np.bool_), np.empty(SECTORS), np.empty(SECTORS), np.empty(SECTORS)
    free = free_levels(sums)
    for j in range(SECTORS):
        seen[j] = sums[j].count >= fewest
        mean[j] = sums[j].squares / max(sums[j].count, 1e-9)
        x, y = sectors[j].x, sectors[j].y
        dark[j] = rim.dark + rim.dark_x * x + rim.dark_y * y + own[j].dark + free.dark[j]
        bright[j] = rim.bright + rim.bright_x * x + rim.bright_y * y + own[j].bright + free.bright[j]
    if count(seen) < LEAST_SECTORS:
        return 0.0
    likely = steep(dark, bright, seen)
    if count(likely) < LEAST_SECTORS:
        return 0.0
    usual = quantile_of(mean, likely, 0.5)
    if not usual > 0:
        usual = 1.0
    for j in range(SECTORS):
        weights[j] = 1 / (1 + (mean[j] / (STRANGE * usual)) ** 2) ** 2 if likely[j] else 0.0
    return usual


@njit(error_model="numpy")
def even_noise(noise: SideNoise, usual):
    """The same noise on both sides, by the usual mean square of residuals over the noise before."""
    level = max((noise.dark + noise.bright) / 2 * usual, ROUNDING)
    return SideNoise(level, level)


@njit(error_model="numpy")
def side_noise(sums, weights, noise: SideNoise):
    """Noise of the dark and of the bright side, by least squares from the weighted residuals; the one before if undetermined."""
    a, b, c, p, q = 0.0, 0.0, 0.0, 0.0, 0.0
    for j in range(SECTORS):
        a += weights[j] * sums[j].dark2
        b += weights[j] * sums[j].mixed
        c += weights[j] * sums[j].bright2
        p += weights[j] * sums[j].dark_squares
        q += weights[j] * sums[j].bright_squares
    p, q = p / KEPT, q / KEPT
    dark, bright = noise.dark, noise.bright
    determinant = a * c - b * b
    if determinant > 1e-6 * a * c:
        dark, bright = (c * p - b * q) / determinant, (a * q - b * p) / determinant
    if dark < ROUNDING:
        dark, bright = ROUNDING, (q - b * ROUNDING) / c
    if bright < ROUNDING:
        bright, dark = ROUNDING, max((p - b * ROUNDING) / a, ROUNDING)
    return SideNoise(dark, bright)
