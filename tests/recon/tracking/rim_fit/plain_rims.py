"""Slow, plain versions of the rim fit's kernels: NumPy over whole images, one quantity a line."""

import numpy as np
from scipy.special import ndtr

from recon.tracking.rim_fit import sectors as fast
from recon.tracking.rim_fit.edge_profile import NARROW
from recon.tracking.rim_fit.sectors import OUTERMOST, SECTORS

ANGLES = np.linspace(0, 2 * np.pi, 20_001)[:-1]


def shape_of(rim):
    return np.array([[rim.a, rim.b], [rim.b, rim.c]])


def sector_number(directions):
    """Sector of directions : (..., 2), the diamond's edge cut into equal parts, plus the part before the direction."""
    x, y = np.moveaxis(directions, -1, 0) / np.abs(directions).sum(axis=-1)
    quadrant = np.where(y >= 0, np.where(x >= 0, 0, 1), np.where(x < 0, 2, 3))
    past = np.choose(quadrant, [y, -x, -y, x])
    return (quadrant + past) * SECTORS / 4


def geometry(rim, reach, hole):
    """`sectors.geometry` from points and normals of the outline and the angle of each normal."""
    diamond = (np.arange(SECTORS) + 0.5) * 4 / SECTORS
    corners = np.array([[1, 0], [0, 1], [-1, 0], [0, -1], [1, 0]])
    u = np.array([corners[int(k)] * (1 - k % 1) + corners[int(k) + 1] * (k % 1) for k in diamond])
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    shape = shape_of(rim)
    gradient = u @ np.linalg.inv(shape)
    slope = np.linalg.norm(gradient, axis=1)
    normal = gradient / slope[:, None]
    phi = np.arctan2(normal[:, 1], normal[:, 0])
    strength, turn = np.hypot(rim.variance_cos, rim.variance_sin), np.arctan2(rim.variance_sin, rim.variance_cos) / 2
    path, blur = np.sqrt(24 * strength), np.sqrt(max(rim.variance - strength, fast.LEAST_VARIANCE))
    box = path * np.abs(np.cos(phi - turn))
    turned = np.stack([-u[:, 1], u[:, 0]], axis=1)  # derivative of u by its angle
    velocity, acceleration = turned @ shape, -u @ shape
    curvature = np.abs(velocity[:, 0] * acceleration[:, 1] - velocity[:, 1] * acceleration[:, 0])
    curvature /= np.linalg.norm(velocity, axis=1) ** 3
    far = np.maximum(box / 2 + 3 * blur + 1.5, 1.3 * reach + 1)
    place = u @ shape / (np.trace(shape) / 2)
    sectors = np.recarray(SECTORS, fast.SECTOR)
    sectors.ux, sectors.uy, sectors.nx, sectors.ny = *u.T, *normal.T
    sectors.wide, sectors.box, sectors.blur = blur**2 + box**2 / 12, box, blur
    sectors.pull = curvature * (path * np.sin(phi - turn)) ** 2 / 24
    sectors.inner, sectors.outer = np.minimum(far, 0.75 * (1 - hole) / slope), np.minimum(far, OUTERMOST / slope)
    sectors.cos, sectors.sin = np.cos(2 * phi), np.sin(2 * phi)
    sectors.x, sectors.y = place.T
    return sectors


def profile(distance, box, blur):
    """Share of the bright side, and its derivative, at distances from an edge that a box and a Gaussian blur."""
    sigma = np.sqrt(blur**2 + box**2 / 12)
    narrow = ndtr(distance / sigma), np.exp(-0.5 * (distance / sigma) ** 2) / np.sqrt(2 * np.pi) / sigma
    steps = (np.arange(200) + 0.5) / 200 - 0.5
    shifted = (distance[..., None] + box[..., None] * steps) / blur[..., None]
    wide = ndtr(shifted).mean(axis=-1), (np.exp(-0.5 * shifted**2) / np.sqrt(2 * np.pi) / blur[..., None]).mean(axis=-1)
    far = np.abs(distance) > box / 2 + 4.5 * blur
    share, peak = (np.where(box < NARROW * blur, a, b) for a, b in zip(narrow, wide, strict=True))
    return np.where(far, distance > 0, share), np.where(far, 0, peak)


def pixels_about(rim, image, stride=1):
    """Pixels : (n, 2) v, u within OUTERMOST of the rim, and their places : (n, 2) in the unit circle's frame."""
    left, right, top, bottom = box_of(rim, 1 + OUTERMOST, image.shape)
    v, u = np.mgrid[top:bottom:stride, left:right].reshape(2, -1)
    places = np.stack([u - rim.x, v - rim.y], axis=1) @ np.linalg.inv(shape_of(rim))
    inside = np.linalg.norm(places, axis=1) <= 1 + OUTERMOST
    return np.stack([v, u], axis=1)[inside], places[inside]


def box_of(rim, beyond, size):
    half = beyond * np.linalg.norm(shape_of(rim), axis=0)
    low = np.maximum(np.trunc([rim.x - half[0], rim.y - half[1]]).astype(int), 0)
    high = np.minimum(np.trunc([rim.x + half[0], rim.y + half[1]]).astype(int) + 2, size[::-1])
    return low[0], high[0], low[1], high[1]


def distance_of(rim, places):
    """Distances from the ellipse, px, to second order, and the slope of the distance in radii, 1/px."""
    inverse = np.linalg.inv(shape_of(rim))
    away = np.linalg.norm(places, axis=1)
    unit = places / away[:, None]
    gradient = unit @ inverse
    slope = np.linalg.norm(gradient, axis=1)
    first = (away - 1) / slope
    back = gradient @ inverse
    turn = unit[:, 0] * back[:, 1] - unit[:, 1] * back[:, 0]
    return first + turn**2 * first**2 / (2 * away * slope**3), slope, away


def add_up(image, rim, own, noise, sectors, hole):
    """`rim_sums.add_up` of all pixels: the model's slopes as a matrix, and its products sector by sector."""
    own, sectors = own.view(np.recarray), sectors.view(np.recarray)
    pixels, places = pixels_about(rim, image)
    distance, slope, away = distance_of(rim, places)
    at = sector_number(places)
    j = at.astype(int)
    near = (distance >= -sectors.inner[j]) & (distance <= sectors.outer[j]) & (away >= 1 - fast.INNERMOST * (1 - hole))
    pixels, distance, slope, away, at, j = (each[near] for each in (pixels, distance, slope, away, at, j))
    measured = image[pixels[:, 0], pixels[:, 1]].astype(float)
    radius = (rim.a + rim.c) / 2
    x, y = (pixels[:, 1] - rim.x) / radius, (pixels[:, 0] - rim.y) / radius
    distance = distance + sectors.pull[j]
    share, peak = profile(distance, sectors.box[j], sectors.blur[j])
    within = (away - hole) / slope
    far = within**2 >= 16 * sectors.wide[j] + sectors.box[j] ** 2 / 4
    bright = share + np.where(far, 0, 1 - profile(within, sectors.box[j], sectors.blur[j])[0])
    dark_level = rim.dark + rim.dark_x * x + rim.dark_y * y + own.dark[j]
    bright_level = rim.bright + rim.bright_x * x + rim.bright_y * y + own.bright[j]
    ratio = np.clip(rim.dark / max(rim.bright, 1), 0, 1)
    light = ratio + (1 - ratio) * bright  # on ink and paper
    growth = distance * light + sectors.wide[j] * peak * (1 - ratio)
    model = dark_level + (bright_level - dark_level) * bright + own.growth[j] * growth
    model += own.leaning[j] * (at - j - 0.5) * light
    steeper = (rim.bright_x - rim.dark_x) * sectors.nx[j] + (rim.bright_y - rim.dark_y) * sectors.ny[j]
    residual = measured - model - sectors.wide[j] * peak * steeper / radius
    edge = -(bright_level - dark_level) * peak
    slopes = np.stack([edge, 1 - bright, bright, edge * distance / (2 * sectors.wide[j]), growth], axis=1)
    share = np.minimum(bright, 1)
    expected = noise.dark * (1 - share) + noise.bright * share
    robust = (1 + residual**2 / (fast.SCATTER**2 * expected)) ** -2.0
    sums = np.zeros(SECTORS, fast.SUMS).view(np.recarray)
    np.add.at(sums.normal, j, (robust / expected)[:, None, None] * slopes[:, :, None] * slopes[:, None])
    np.add.at(sums.right, j, (robust / expected * residual)[:, None] * slopes)
    for name, each in (
        ("squares", residual**2 / expected),
        ("count", np.ones_like(share)),
        ("dark2", (1 - share) ** 2),
        ("mixed", (1 - share) * share),
        ("bright2", share**2),
        ("dark_squares", (1 - share) * residual**2),
        ("bright_squares", share * residual**2),
    ):
        sums[name] = np.bincount(j, robust * each, SECTORS)
    return sums
