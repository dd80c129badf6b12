"""Sectors of a rim: where they lie, and which of them look like the rim of a ring, compiled."""

import math

import numpy as np

from recon.compiled import njit

SECTORS = 48
LEAST_SECTORS = 16
OUTERMOST = 0.37  # radii beyond the rim: half way to the neighbour
LEAST_VARIANCE = 0.06  # px^2: a pixel's own extent is 1/12
SCATTER = 10.0  # standard deviations beyond which a pixel counts less
KEPT = (1 - 6 / SCATTER**2) / (1 - 2 / SCATTER**2)  # of normal noise's variance, seen with pixels counting by their residuals
STEEP = 0.6  # of the contrast (bright - dark) / (bright + dark) that a quarter of the sectors exceeds: with less it isn't a rim
STRANGE = 4.0  # times the usual mean square at which a sector has lost three quarters of its weight
ROUNDING = 1 / 12  # DN^2

# of a sector, by column
UX, UY, NX, NY, WIDE, BOX, BLUR, PULL, INNER, OUTER, COS, SIN, X, Y = range(14)
# a sector's own levels: by how much it is off the planes inside and outside (DN), how light grows outwards there (DN/px), and how
# it leans along the rim (DN)
DARK, BRIGHT, GROWTH, LEANING, OWN = range(5)
# sums of a sector: the upper triangle of 5x5 for edge, dark, bright, variance, growth, then the right side, squares, count, and
# five for the noise
UNKNOWNS, RIGHT = 5, 15
SQUARES, COUNT, DARK2, MIXED, BRIGHT2, DARK_SQUARES, BRIGHT_SQUARES, LOCAL = range(20, 28)


@njit(error_model="numpy")
def geometry(ellipse, variance, reach, hole):
    """Of each sector's middle : (SECTORS, 14): its place, the normal, the profile there, and how far to look."""
    sectors = np.empty((SECTORS, 14))
    a, b, c = ellipse[2], ellipse[3], ellipse[4]
    determinant = a * c - b * b
    radius = (a + c) / 2
    strength = math.hypot(variance[1], variance[2])
    blur = math.sqrt(max(variance[0] - strength, LEAST_VARIANCE))
    path = math.sqrt(24 * strength)
    psi = 0.5 * math.atan2(variance[2], variance[1])
    for j in range(SECTORS):
        at = (j + 0.5) * 4 / SECTORS
        quadrant = int(at)
        y = at - quadrant
        x = 1 - y
        length = math.hypot(x, y)
        x, y = x / length, y / length
        for _ in range(quadrant):
            x, y = -y, x
        nx, ny = (c * x - b * y) / determinant, (a * y - b * x) / determinant
        slope = math.hypot(nx, ny)
        nx, ny = nx / slope, ny / slope
        across = path * abs(nx * math.cos(psi) + ny * math.sin(psi))
        along = path * (ny * math.cos(psi) - nx * math.sin(psi))
        curvature = determinant / math.hypot(b * x - a * y, c * x - b * y) ** 3
        far = max(across / 2 + 3 * blur + 1.5, 1.3 * reach + 1)
        sectors[j, UX], sectors[j, UY], sectors[j, NX], sectors[j, NY] = x, y, nx, ny
        sectors[j, BOX], sectors[j, BLUR] = across, blur
        sectors[j, WIDE] = blur * blur + across * across / 12
        sectors[j, PULL] = curvature * along * along / 24
        sectors[j, INNER] = min(far, 0.75 * (1 - hole) / slope)
        sectors[j, OUTER] = min(far, OUTERMOST / slope)
        sectors[j, COS], sectors[j, SIN] = nx * nx - ny * ny, 2 * nx * ny
        sectors[j, X], sectors[j, Y] = (a * x + b * y) / radius, (b * x + c * y) / radius
    return sectors


@njit(inline="always", error_model="numpy")
def sector(x, y):
    """Number of the sector of a direction, and how far into it, as one number."""
    total = abs(x) + abs(y)
    if x >= 0:
        at = y / total if y >= 0 else 3 + x / total
    else:
        at = 1 - x / total if y >= 0 else 2 - y / total
    return min(at * (SECTORS / 4), SECTORS - 1e-9)


@njit(error_model="numpy")
def steep(dark, bright, seen):
    """Sectors : (SECTORS,) bool whose levels are ink's beside paper's, in whatever light: as deep as others."""
    depth = (bright - dark) / np.maximum(np.abs(bright) + np.abs(dark), 1e-9)
    return seen & (depth > STEEP * np.quantile(depth[seen], 0.75))


@njit(error_model="numpy")
def alone(sums):
    """What each sector's pixels alone say, where its edge stays: steps of its dark and its bright level, DN, and their variances.

    Two of (SECTORS, 2); 0 of one without pixels on both sides.
    """
    free, variance = np.zeros((SECTORS, 2)), np.zeros((SECTORS, 2))
    for j in range(SECTORS):
        a, b, c, p, q = sums[j, 5] * 1.001, sums[j, 6], sums[j, 9] * 1.001, sums[j, RIGHT + 1], sums[j, RIGHT + 2]
        determinant = a * c - b * b
        if determinant > 0:
            free[j, DARK], free[j, BRIGHT] = (c * p - b * q) / determinant, (a * q - b * p) / determinant
            variance[j, DARK], variance[j, BRIGHT] = c / determinant, a / determinant
    return free, variance


@njit(error_model="numpy")
def judge(sums, sectors, planes, own, weights, noise, capture, fewest):
    """Weigh the sectors by how well they fit and follow the noise; False if too little of the rim is in the image."""
    seen = sums[:, COUNT] >= fewest
    if seen.sum() < LEAST_SECTORS:
        return False
    mean = sums[:, SQUARES] / np.maximum(sums[:, COUNT], 1e-9)
    free, _ = alone(sums)
    dark = planes[0] + planes[1] * sectors[:, X] + planes[2] * sectors[:, Y] + own[:, DARK] + free[:, DARK]
    bright = planes[3] + planes[4] * sectors[:, X] + planes[5] * sectors[:, Y] + own[:, BRIGHT] + free[:, BRIGHT]
    likely = steep(dark, bright, seen)
    if likely.sum() < LEAST_SECTORS:
        return False
    usual = np.median(mean[likely])
    if not usual > 0:
        usual = 1.0
    for j in range(SECTORS):
        weights[j] = 1 / (1 + (mean[j] / (STRANGE * usual)) ** 2) ** 2 if likely[j] else 0.0
    if capture:
        noise[:] = np.maximum(noise.mean() * usual, ROUNDING)
        return True
    a, b, c = (weights * sums[:, DARK2]).sum(), (weights * sums[:, MIXED]).sum(), (weights * sums[:, BRIGHT2]).sum()
    p, q = (weights * sums[:, DARK_SQUARES]).sum() / KEPT, (weights * sums[:, BRIGHT_SQUARES]).sum() / KEPT
    determinant = a * c - b * b
    if determinant > 1e-6 * a * c:
        noise[0], noise[1] = (c * p - b * q) / determinant, (a * q - b * p) / determinant
    if noise[0] < ROUNDING:
        noise[0], noise[1] = ROUNDING, (q - b * ROUNDING) / c
    if noise[1] < ROUNDING:
        noise[1], noise[0] = ROUNDING, max((p - b * ROUNDING) / a, ROUNDING)
    return True
