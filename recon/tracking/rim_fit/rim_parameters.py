"""The parameters of a rim, and simple geometry of its ellipse; compiled."""

import math
from typing import NamedTuple

from recon.compiled import njit

LEAST_VARIANCE = 0.06  # px^2: a pixel's own extent is 1/12


class Rim(NamedTuple):
    """The fitted parameters, in the order of the unknowns of the fit."""

    x: float  # px, the centre
    y: float
    a: float  # px, the shape (a b; b c), which maps the unit circle to the ellipse about its centre
    b: float
    c: float
    dark: float  # DN, the plane inside: level at the centre, and slopes along x and y in DN a mean radius
    dark_x: float
    dark_y: float
    bright: float  # DN, the plane outside
    bright_x: float
    bright_y: float
    variance: float  # px^2, of the profile across the edge: the mean, and its cos 2phi and sin 2phi along the normals
    variance_cos: float
    variance_sin: float


class Shape(NamedTuple):
    """A symmetric matrix (a b; b c)."""

    a: float
    b: float
    c: float


@njit(inline="always", error_model="numpy")
def inverse_shape(rim: Rim):
    """The matrix that maps the ellipse about its centre to the unit circle, 1/px."""
    determinant = rim.a * rim.c - rim.b * rim.b
    return Shape(rim.c / determinant, -rim.b / determinant, rim.a / determinant)


@njit(inline="always", error_model="numpy")
def shortest_axis(rim: Rim):
    """The smaller semi-axis, px."""
    return (rim.a + rim.c) / 2 - math.hypot((rim.a - rim.c) / 2, rim.b)


@njit(error_model="numpy")
def plausible(rim: Rim, size):
    """Whether the ellipse is finite, neither too small nor too flat nor too large, and has its centre in the image."""
    if not (math.isfinite(rim.x) and math.isfinite(rim.y)):
        return False
    if not (math.isfinite(rim.a) and math.isfinite(rim.b) and math.isfinite(rim.c)):
        return False
    half, gap = (rim.a + rim.c) / 2, math.hypot((rim.a - rim.c) / 2, rim.b)
    if half - gap < 3 or half - gap < 0.2 * (half + gap) or half + gap > max(size[0], size[1]):
        return False
    return -1 < rim.x < size[1] and -1 < rim.y < size[0]


@njit(inline="always", error_model="numpy")
def window(rim: Rim, beyond, size):
    """Columns and rows, first and end, of the ellipse scaled by `beyond`, in the image."""
    half_x, half_y = beyond * math.hypot(rim.a, rim.b), beyond * math.hypot(rim.b, rim.c)
    left, right = max(int(rim.x - half_x), 0), min(int(rim.x + half_x) + 2, size[1])
    return left, right, max(int(rim.y - half_y), 0), min(int(rim.y + half_y) + 2, size[0])


@njit(inline="always")
def with_levels(rim: Rim, dark, bright):
    """The rim, with even light of these levels."""
    return Rim(
        rim.x, rim.y, rim.a, rim.b, rim.c, dark, 0.0, 0.0, bright, 0.0, 0.0, rim.variance, rim.variance_cos, rim.variance_sin
    )


@njit(inline="always", error_model="numpy")
def largest(step, first, end):
    """The largest size of some parameters' steps."""
    size = 0.0
    for k in range(first, end):
        size = max(size, abs(step[k]))
    return size


@njit(error_model="numpy")
def moved(rim: Rim, step, reach):
    """The rim after a step : (14,), which is shortened in place where it is too long for the model to hold."""
    limit = min(max(reach, 1.0), 0.3 * shortest_axis(rim))
    share = min(1.0, limit / max(largest(step, 0, 5), 1e-12))
    for k in range(5):
        step[k] *= share
    limit = 0.85 * rim.variance if step[11] < 0 else 2 * rim.variance
    share = min(1.0, limit / max(largest(step, 11, 14), 1e-12))
    variance = max(rim.variance + share * step[11], LEAST_VARIANCE)
    cos, sin = rim.variance_cos + share * step[12], rim.variance_sin + share * step[13]
    strength = math.hypot(cos, sin)
    if strength > variance - LEAST_VARIANCE:
        cos, sin = cos * ((variance - LEAST_VARIANCE) / strength), sin * ((variance - LEAST_VARIANCE) / strength)
    step[11], step[12], step[13] = variance - rim.variance, cos - rim.variance_cos, sin - rim.variance_sin
    return Rim(
        rim.x + step[0],
        rim.y + step[1],
        rim.a + step[2],
        rim.b + step[3],
        rim.c + step[4],
        rim.dark + step[5],
        rim.dark_x + step[6],
        rim.dark_y + step[7],
        rim.bright + step[8],
        rim.bright_x + step[9],
        rim.bright_y + step[10],
        variance,
        cos,
        sin,
    )
