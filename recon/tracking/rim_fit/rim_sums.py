"""Sums over the pixels about a rim: normal equations of the fit by sector, first levels and the level of the middle; compiled."""

import math
from typing import NamedTuple

import numpy as np

from recon.compiled import njit
from recon.geometry.order_statistics import count, quantile_of
from recon.tracking.rim_fit.edge_profile import blurred_step
from recon.tracking.rim_fit.rim_parameters import Rim, Shape, inverse_shape, shortest_axis, window, with_levels
from recon.tracking.rim_fit.sectors import (
    BRIGHT,
    DARK,
    EDGE,
    GROWTH,
    INNERMOST,
    LEAST_SECTORS,
    OUTERMOST,
    ROUNDING,
    SCATTER,
    SECTORS,
    UNKNOWNS,
    VARIANCE,
    SideNoise,
    geometry,
    sector,
    steep,
)

SQUARE, AWAY, AT, DISTANCE, SLOPE = range(5)  # of a row's pixels: of `away`; see `Place`; the sector and the share of it before
FAST = {"reassoc", "contract", "arcp", "nsz"}  # all but what is not finite


class Place(NamedTuple):
    """A pixel about the rim."""

    x: float  # from the rim's centre, in mean radii
    y: float
    aside: float  # sectors, from the middle of its own
    away: float  # from the centre, in radii along its direction
    slope: float  # of `away` across the rim, 1/px
    distance: float  # px outwards from the edge


class Light(NamedTuple):
    """The model at a pixel."""

    residual: float  # DN, measured less modelled
    step: float  # DN, from dark to bright
    share: float  # of the bright side
    peak: float  # derivative of the share by the distance, 1/px
    growth: float  # px, derivative of the grey level by the gradient outwards


@njit(error_model="numpy", fastmath=FAST)
def add_up(image, rim: Rim, own, noise: SideNoise, sectors, stride, hole, sums):
    """Fill the sums of all sectors, over every `stride`-th pixel of every `stride`-th row."""
    _clear(sums)
    shape = inverse_shape(rim)
    radius = (rim.a + rim.c) / 2
    shortest = shortest_axis(rim)
    inner, outer = _widest(sectors)
    lowest = max(1 - inner * 1.2 / shortest, 1 - INNERMOST * (1 - hole)) ** 2
    highest = min(1 + outer * 1.2 / shortest, 1 + OUTERMOST)
    left, right, top, bottom = window(rim, highest, image.shape)
    highest = highest * highest
    row = np.empty((SLOPE + 1, max(right - left, 1)))
    for v in range(top, bottom, stride):
        y = v - rim.y
        middle, half, empty = _chords(shape, y, lowest, highest)
        middle += rim.x
        if not half >= 0:
            continue
        u = max(left, int(middle - half) + 1)
        last = min(right - 1, int(middle + half))
        hollow = min(int(middle - empty) + 1, last) if empty > 1 else last
        while u <= last:  # before the hollow, then past it
            count = max((hollow - u) // stride + 1, 0)
            _survey(shape, rim.x, u, y, stride, count, row)
            for i in range(count):
                if row[SQUARE, i] < lowest or row[SQUARE, i] > highest:
                    continue
                at, distance = row[AT, i], row[DISTANCE, i]
                j = int(at)
                if distance < -sectors[j].inner or distance > sectors[j].outer:
                    continue
                x = u + i * stride - rim.x
                place = Place(x / radius, y / radius, at - j - 0.5, row[AWAY, i], row[SLOPE, i], distance + sectors[j].pull)
                light = _light(image[v, u + i * stride], rim, own[j], sectors[j], place, hole)
                _accumulate(sums[j], light, place.distance, sectors[j].wide, noise)
            u += count * stride
            u += max(int((middle + empty - 1 - u) / stride), 0) * stride
            hollow = last
    _mirror(sums)


@njit(inline="always", error_model="numpy")
def _survey(shape: Shape, centre, first, y, stride, count, row):
    """Fill a row's places relative to the ellipse, without branches, so that pixels share vector instructions."""
    for i in range(count):
        x = first + i * stride - centre
        p, q = shape.a * x + shape.b * y, shape.b * x + shape.c * y
        square = p * p + q * q
        away = math.sqrt(square)
        p, q = p / away, q / away
        distance, slope = _distance(shape, p, q, away)
        row[SQUARE, i], row[AWAY, i], row[AT, i], row[DISTANCE, i], row[SLOPE, i] = square, away, sector(p, q), distance, slope


@njit(inline="always")
def _clear(sums):
    for j in range(SECTORS):
        normal, right = sums[j].normal, sums[j].right
        for m in range(UNKNOWNS):
            for n in range(UNKNOWNS):
                normal[m, n] = 0.0
            right[m] = 0.0
        sums[j].squares = sums[j].count = 0.0
        sums[j].dark2 = sums[j].mixed = sums[j].bright2 = 0.0
        sums[j].dark_squares = sums[j].bright_squares = 0.0


@njit(inline="always")
def _widest(sectors):
    """The largest extents of the band inwards and outwards, px."""
    inner, outer = 0.0, 0.0
    for j in range(SECTORS):
        inner, outer = max(inner, sectors[j].inner), max(outer, sectors[j].outer)
    return inner, outer


@njit(inline="always", error_model="numpy")
def _chords(shape: Shape, y, lowest, highest):
    """Middle, half length and empty half length, px, of a row's chord of the band between two squared radii; half -1 off it."""
    flat, lean = shape.a * shape.a + shape.b * shape.b, shape.b * (shape.a + shape.c)
    rest = shape.b * shape.b + shape.c * shape.c
    beyond = (rest - lean * lean / flat) * y * y
    half = math.sqrt((highest - beyond) / flat) if beyond < highest else -1.0
    empty = math.sqrt((lowest - beyond) / flat) if beyond < lowest else 0.0
    return -lean * y / flat, half, empty


@njit(inline="always", error_model="numpy")
def _distance(shape: Shape, p, q, away):
    """Distance from the ellipse, px, to second order, of a point `away` radii along unit (p, q); and its slope, 1/px."""
    sx, sy = shape.a * p + shape.b * q, shape.b * p + shape.c * q
    slope2 = sx * sx + sy * sy
    slope = math.sqrt(slope2)
    distance = (away - 1) / slope
    turn = p * (shape.b * sx + shape.c * sy) - q * (shape.a * sx + shape.b * sy)
    distance += turn * turn * distance * distance / (away * slope2 * 2 * slope)
    return distance, slope


@njit(inline="always", error_model="numpy")
def _light(measured, rim: Rim, own, sector, place: Place, hole):
    """Compare a pixel with the blurred edge between the light of its sector inside and outside."""
    wide, box, blur, distance = sector.wide, sector.box, sector.blur, place.distance
    share, peak = blurred_step(distance, box, blur, wide)
    bright = share
    within = (place.away - hole) / place.slope
    if hole > 0 and within * within < 16 * wide + box**2 / 4:
        bright += 1 - blurred_step(within, box, blur, wide)[0]
    inside = rim.dark + rim.dark_x * place.x + rim.dark_y * place.y + own.dark
    outside = rim.bright + rim.bright_x * place.x + rim.bright_y * place.y + own.bright
    step = outside - inside
    ratio = min(max(rim.dark / max(rim.bright, 1.0), 0.0), 1.0)  # of light on ink and on paper
    bent = wide * peak  # px, blur of a gradient by the edge
    even = ratio + (1 - ratio) * bright
    growth = distance * even + bent * (1 - ratio)
    residual = measured - inside - step * bright - own.growth * growth - own.leaning * place.aside * even
    across = (rim.bright_x - rim.dark_x) * sector.nx + (rim.bright_y - rim.dark_y) * sector.ny
    residual -= bent * across / ((rim.a + rim.c) / 2)
    return Light(residual, step, bright, peak, growth)


@njit(inline="always", error_model="numpy")
def _accumulate(sums, light: Light, distance, wide, noise: SideNoise):
    """Add a pixel to its sector's normal equations, upper triangle, and to the sums for the noise."""
    share, residual = min(light.share, 1.0), light.residual
    expected = noise.dark + (noise.bright - noise.dark) * share
    squared = residual * residual
    robust = 1 / (1 + squared / (SCATTER * SCATTER * expected)) ** 2
    w = robust / expected
    edge, dark, bright, growth = -light.step * light.peak, 1 - light.share, light.share, light.growth
    variance = edge * distance / (2 * wide)
    normal, right = sums.normal, sums.right
    normal[EDGE, EDGE] += w * edge * edge
    normal[EDGE, DARK] += w * edge * dark
    normal[EDGE, BRIGHT] += w * edge * bright
    normal[EDGE, VARIANCE] += w * edge * variance
    normal[EDGE, GROWTH] += w * edge * growth
    normal[DARK, DARK] += w * dark * dark
    normal[DARK, BRIGHT] += w * dark * bright
    normal[DARK, VARIANCE] += w * dark * variance
    normal[DARK, GROWTH] += w * dark * growth
    normal[BRIGHT, BRIGHT] += w * bright * bright
    normal[BRIGHT, VARIANCE] += w * bright * variance
    normal[BRIGHT, GROWTH] += w * bright * growth
    normal[VARIANCE, VARIANCE] += w * variance * variance
    normal[VARIANCE, GROWTH] += w * variance * growth
    normal[GROWTH, GROWTH] += w * growth * growth
    right[EDGE] += w * edge * residual
    right[DARK] += w * dark * residual
    right[BRIGHT] += w * bright * residual
    right[VARIANCE] += w * variance * residual
    right[GROWTH] += w * growth * residual
    sums.squares += w * squared
    sums.count += robust
    sums.dark2 += robust * (1 - share) * (1 - share)
    sums.mixed += robust * (1 - share) * share
    sums.bright2 += robust * share * share
    sums.dark_squares += robust * (1 - share) * squared
    sums.bright_squares += robust * share * squared


@njit(inline="always")
def _mirror(sums):
    """Copy the upper triangles of the normal matrices to the lower ones."""
    for j in range(SECTORS):
        normal = sums[j].normal
        for m in range(UNKNOWNS):
            for n in range(m):
                normal[m, n] = normal[n, m]


@njit(error_model="numpy")
def first_levels(image, rim: Rim, reach, hole):
    """Medians of the levels over the sectors with ring-like contrast.

    Returns whether there is a dark ring on bright ground, the rim with these levels, and the noise to start with.
    """
    dark_count, dark_sum = np.zeros(SECTORS), np.zeros(SECTORS)
    bright_count, bright_sum = np.zeros(SECTORS), np.zeros(SECTORS)
    sectors, shape = geometry(rim, reach, hole), inverse_shape(rim)
    inner, outer = _widest(sectors)
    shortest = shortest_axis(rim)
    lowest = max(1 - inner * 1.2 / shortest, hole) ** 2
    highest = min(1 + outer * 1.2 / shortest, 1 + OUTERMOST)
    left, right, top, bottom = window(rim, highest, image.shape)
    highest = highest * highest
    for v in range(top, bottom):
        y = v - rim.y
        middle, half, empty = _chords(shape, y, lowest, highest)
        if not half >= 0:
            continue
        middle += rim.x
        u = max(left, int(middle - half) + 1) - 1
        last = min(right - 1, int(middle + half))
        while u < last:
            u += 1
            if abs(u - middle) < empty - 1:
                u += int(middle + empty - 1 - u)
            x = u - rim.x
            p, q = shape.a * x + shape.b * y, shape.b * x + shape.c * y
            away = math.sqrt(p * p + q * q)
            if away < hole or away > 1 + OUTERMOST:
                continue
            j = int(sector(p, q))
            sx, sy = shape.a * p + shape.b * q, shape.b * p + shape.c * q
            distance = (away - 1) * away / math.sqrt(sx * sx + sy * sy)
            if -sectors[j].inner < distance < -0.35 * sectors[j].inner:
                dark_count[j] += 1
                dark_sum[j] += image[v, u]
            elif 0.35 * sectors[j].outer < distance < sectors[j].outer:
                bright_count[j] += 1
                bright_sum[j] += image[v, u]
    none = SideNoise(1.0, 1.0)
    seen, dark, bright = np.empty(SECTORS, np.bool_), np.empty(SECTORS), np.empty(SECTORS)
    for j in range(SECTORS):
        seen[j] = min(dark_count[j], bright_count[j]) > 0
        dark[j], bright[j] = dark_sum[j] / max(dark_count[j], 1), bright_sum[j] / max(bright_count[j], 1)
    if count(seen) < LEAST_SECTORS:
        return False, rim, none
    ring_like = steep(dark, bright, seen)
    if count(ring_like) < LEAST_SECTORS:
        return False, rim, none
    low, high = quantile_of(dark, ring_like, 0.5), quantile_of(bright, ring_like, 0.5)
    noise = max((0.1 * (high - low)) ** 2, ROUNDING)
    return high > low, with_levels(rim, low, high), SideNoise(noise, noise)


@njit(error_model="numpy")
def middle_level(image, rim: Rim, hole):
    """Mean of the white middle's inner half, DN; NaN without pixels."""
    shape = inverse_shape(rim)
    size = 0.5 * hole
    left, right, top, bottom = window(rim, size, image.shape)
    number, total = 0, 0.0
    for v in range(top, bottom):
        for u in range(left, right):
            x, y = u - rim.x, v - rim.y
            if (shape.a * x + shape.b * y) ** 2 + (shape.b * x + shape.c * y) ** 2 <= size * size:
                number += 1
                total += image[v, u]
    return total / number if number else np.nan
