"""Pixels at the edges of a board's discs, computed: black and white in the shares that a pixel gathers of each.

Path tracing converges slowly where a pixel is half black and half white. But where the print is known by a formula, a camera ray
needs no search to meet it, so that the shares can be sampled hundreds of times over; and black and white themselves change
slowly over the board, so that each is a plane through the pixels about that hold nothing else, as they were traced.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.stats import qmc

from recon.compiled import kernel
from recon.geometry import rigid
from recon.threads import in_threads
from scenes.kinds.board import Print
from twin.optics.instruments import CameraOptics

Array = NDArray[np.float64]
Images = NDArray[np.float32]

WINDOW = 15  # px about a pixel, in which black and white are looked for
FEWEST = 40  # pixels of either that a plane needs
BENDS = 4  # iterations to a ray's place on a bowed board, each a hundredth of the step before
OFF, WHITE, BLACK, EDGE, SIDE = range(5)  # kinds of pixels: off the board, of one brightness, at a disc's edge, at a side
FEWER = 4  # times fewer samples in the outer half of the reach, where almost all light comes from one side
DU, DV, LENS_X, LENS_Y = range(4)  # columns of the sample points


class _View(NamedTuple):
    """A board as a camera's rays meet it."""

    board_from_camera: Array  # (4, 4) mm
    lens_radius: float  # mm
    focus_mm: float
    reach_px: float  # from a pixel's centre, within which lies all its light


class _Tables(NamedTuple):
    """Ideal coordinates x/z, y/z at some pixels' centres, and their change for one px in u and one px in v. All (m, 2)."""

    centre: Array
    across: Array
    down: Array


class _Samples(NamedTuple):
    """Sample points of the pixels' light."""

    footprint: Array  # px from a pixel's centre, by even fractions of its light along one axis
    points: Array  # (n, 4)
    turns: Array  # (m, 3) of each pixel's own


class Left(NamedTuple):
    """Numbers `v * width + u` of pixels that aren't computed. Each (m,) uint32."""

    edges: NDArray[np.uint32]  # of discs too small, or too near to each other, to leave pixels about all black or all white
    sides: NDArray[np.uint32]  # at the sides of the board


def compute_edges(image: Images, optics: CameraOptics, board: Print, world_from_board: rigid.Array, seed: int) -> Left:
    """Compute the pixels at the edges of discs in a traced image of the board alone, in place.

    Parameters
    ----------
    image : (h, w) float32
        Radiance that arrives at each pixel, any unit; changed.
    seed : int
        Of the sample points.

    Returns
    -------
    Left
        Those at edges that stay as they were.
    """
    camera = optics.camera
    board_from_camera = np.ascontiguousarray(rigid.invert(world_from_board) @ rigid.invert(camera.camera_from_world))
    depths = rigid.apply(rigid.invert(board_from_camera), _corners(board))[:, 2]
    view = _View(board_from_camera, optics.aperture_mm / 2, optics.focus_mm, optics.reach_px(np.maximum(depths, 1.0)))
    tables = _Tables(*(np.ascontiguousarray(np.float64(table).T) for table in optics.tables))
    kinds = _kinds(view, board, tables).reshape(image.shape)
    edges = np.flatnonzero(kinds == EDGE)
    turns = np.random.default_rng(seed).random((len(edges), 3)) * [1, 1, 2 * np.pi]
    chosen = _Tables(*(table[edges] for table in tables))
    shares = _black_shares(view, board, chosen, _footprint(optics), _sample_points(), turns)
    transmission = optics.transmission.ravel()[edges]
    found = _mix(image / optics.transmission, kinds, edges, shares) * transmission
    known = np.isfinite(found)
    image.ravel()[edges[known]] = found[known]
    return Left(edges[~known].astype(np.uint32), np.flatnonzero(kinds == SIDE).astype(np.uint32))


def _corners(board: Print) -> Array:
    signs = np.array([(-1.0, -1.0), (-1.0, 1.0), (1.0, 1.0), (1.0, -1.0)])
    return np.column_stack([board.middle + signs * board.half, np.zeros(4)])


def _footprint(optics: CameraOptics) -> Array:
    """Places, in px from a pixel's centre, of evenly spaced fractions of the light that it gathers along one axis."""
    return np.float64(optics.footprint) if optics.blur_px > 0 else np.linspace(-0.5, 0.5, 2)


def _sample_points() -> Array:
    """Evenly spread points : (SAMPLES, 4), of the unit square for a place in the pixel and the unit disc for one on the lens."""
    samples = 256  # of a pixel's light
    du, dv, radius2, turn = qmc.Sobol(4, seed=1).random(samples).T
    radius, angle = np.sqrt(radius2), 2 * np.pi * turn
    return np.column_stack([du, dv, radius * np.cos(angle), radius * np.sin(angle)])


@kernel
def _meet(view: _View, board: Print, x, y, lens_x, lens_y):
    """Where on the board, mm, a ray ends that leaves a point of the lens for ideal coordinates (x, y) in focus."""
    to, focus = view.board_from_camera, view.focus_mm
    ox, oy = lens_x * view.lens_radius, lens_y * view.lens_radius
    dx, dy = x * focus - ox, y * focus - oy
    px = to[0, 0] * ox + to[0, 1] * oy + to[0, 3]
    py = to[1, 0] * ox + to[1, 1] * oy + to[1, 3]
    pz = to[2, 0] * ox + to[2, 1] * oy + to[2, 3]
    sx = to[0, 0] * dx + to[0, 1] * dy + to[0, 2] * focus
    sy = to[1, 0] * dx + to[1, 1] * dy + to[1, 2] * focus
    sz = to[2, 0] * dx + to[2, 1] * dy + to[2, 2] * focus
    step = -pz / sz
    if board.bow[0] != 0 or board.bow[1] != 0 or board.bow[2] != 0:
        for _ in range(BENDS):
            across = (px + step * sx - board.middle[0]) / board.half[0]
            down = (py + step * sy - board.middle[1]) / board.half[1]
            bow = board.bow[0] * across * across + board.bow[1] * across * down + board.bow[2] * down * down
            step = (bow - pz) / sz
    return px + step * sx, py + step * sy


@kernel
def _nearest_discs(board: Print, x, y):
    """Numbers of the two discs nearest to a place on the board; the same one twice if it is the only one."""
    first, second, near, next_near = 0, 0, np.inf, np.inf
    for k in range(len(board.centres)):
        away = _square(board, k, x, y)
        if away < near:
            second, next_near = first, near
            first, near = k, away
        elif away < next_near:
            second, next_near = k, away
    return first, second


@kernel
def _beyond(board: Print, disc, x, y):
    """Distance of a place from a disc's rim, mm; negative inside."""
    return math.sqrt(_square(board, disc, x, y)) - board.radius


@kernel
def _reach_mm(view: _View, board: Print, tables: _Tables, k, x, y):
    """The reach of a pixel's light on the board, from its place there : mm."""
    centre, across, down = tables.centre[k], tables.across[k], tables.down[k]
    ax, ay = _meet(view, board, centre[0] + across[0], centre[1] + across[1], 0.0, 0.0)
    bx, by = _meet(view, board, centre[0] + down[0], centre[1] + down[1], 0.0, 0.0)
    a, b, c, d = ax - x, ay - y, bx - x, by - y
    squares, area = a * a + b * b + c * c + d * d, a * d - b * c
    return view.reach_px * math.sqrt((squares + math.sqrt(max(squares * squares - 4 * area * area, 0.0))) / 2)


def _kinds(view: _View, board: Print, tables: _Tables) -> NDArray[np.uint8]:
    """Kinds of pixels : (m,), by the distance of each from the nearest rim and from the board's sides."""
    kinds = np.zeros(len(tables.centre), np.uint8)
    in_threads(_fill_kinds, len(kinds), view, board, tables, kinds)
    return kinds


@kernel
def _fill_kinds(first, end, view: _View, board: Print, tables: _Tables, kinds):
    for k in range(first, end):
        kinds[k] = _kind(view, board, tables, k)


@kernel
def _kind(view: _View, board: Print, tables: _Tables, k):
    x, y = _meet(view, board, tables.centre[k, 0], tables.centre[k, 1], 0.0, 0.0)
    aside = max(abs(x - board.middle[0]) - board.half[0], abs(y - board.middle[1]) - board.half[1])
    reach = _reach_mm(view, board, tables, k, x, y)
    if not aside <= reach:
        return OFF
    if aside > -reach:
        return SIDE
    beyond = _beyond(board, _nearest_discs(board, x, y)[0], x, y)
    if abs(beyond) <= reach:
        return EDGE
    return WHITE if beyond > 0 else BLACK


def _black_shares(view: _View, board: Print, tables: _Tables, footprint: Array, points: Array, turns: Array) -> Array:
    """Shares of pixels' light that come from discs : (m,).

    Each pixel shifts the sample points : (n, 4) round the unit square by some part, and turns them on the lens by some angle,
    of its own : (m, 3).
    """
    shares, samples = np.zeros(len(turns)), _Samples(footprint, points, turns)
    in_threads(_fill_shares, len(turns), view, board, tables, samples, shares)
    return shares


@kernel
def _fill_shares(first, end, view: _View, board: Print, tables: _Tables, samples: _Samples, shares):
    for k in range(first, end):
        shares[k] = _black_share(view, board, tables, samples, k)


@kernel
def _black_share(view: _View, board: Print, tables: _Tables, samples: _Samples, k):
    footprint, points, turn = samples.footprint, samples.points, samples.turns[k]
    cx, cy = tables.centre[k, 0], tables.centre[k, 1]
    ax, ay, bx, by = tables.across[k, 0], tables.across[k, 1], tables.down[k, 0], tables.down[k, 1]
    x, y = _meet(view, board, cx, cy, 0.0, 0.0)
    first, second = _nearest_discs(board, x, y)
    reach = _reach_mm(view, board, tables, k, x, y)
    count = len(points) if abs(_beyond(board, first, x, y)) < reach / 2 else len(points) // FEWER
    alone = _beyond(board, second, x, y) > reach
    cos, sin = math.cos(turn[LENS_X]), math.sin(turn[LENS_X])
    square, black = board.radius * board.radius, 0
    for n in range(count):
        du, dv = _at_fraction(footprint, points[n, DU] + turn[DU]), _at_fraction(footprint, points[n, DV] + turn[DV])
        lens_x = cos * points[n, LENS_X] - sin * points[n, LENS_Y]
        lens_y = sin * points[n, LENS_X] + cos * points[n, LENS_Y]
        x, y = _meet(view, board, cx + ax * du + bx * dv, cy + ay * du + by * dv, lens_x, lens_y)
        black += _square(board, first, x, y) < square or (not alone and _square(board, second, x, y) < square)
    return black / count


@kernel
def _square(board: Print, disc, x, y):
    """Squared distance of a place from a disc's centre, mm^2."""
    dx, dy = x - board.centres[disc, 0], y - board.centres[disc, 1]
    return dx * dx + dy * dy


@kernel
def _at_fraction(table, fraction):
    """The value of an evenly spaced table at a fraction of its length; whole lengths don't count."""
    position = (fraction - int(fraction)) * (len(table) - 1)
    below = min(int(position), len(table) - 2)
    return table[below] + (position - below) * (table[below + 1] - table[below])


def _mix(image: Images, kinds: NDArray[np.uint8], edges: NDArray[np.int64], shares: Array) -> Array:
    """Black and white in their shares : (m,), NaN where one of them isn't known."""
    values = np.full(len(edges), np.nan)
    in_threads(_fill_mixed, len(edges), image, kinds, edges, shares, values)
    return values


@kernel
def _fill_mixed(first, end, image, kinds, edges, shares, values):
    width = image.shape[1]
    for k in range(first, end):
        v, u = edges[k] // width, edges[k] % width
        white, black = _level_at(image, kinds, WHITE, v, u), _level_at(image, kinds, BLACK, v, u)
        values[k] = white + shares[k] * (black - white)


@kernel
def _level_at(image, kinds, kind, v, u):
    """Level at a pixel of the plane through those of a kind in the window about it; NaN if they are too few."""
    count, sx, sy, sxx, sxy, syy = 0, 0.0, 0.0, 0.0, 0.0, 0.0
    sz, sxz, syz = 0.0, 0.0, 0.0
    for row in range(max(v - WINDOW, 0), min(v + WINDOW + 1, image.shape[0])):
        for column in range(max(u - WINDOW, 0), min(u + WINDOW + 1, image.shape[1])):
            if kinds[row, column] == kind:
                x, y, z = float(column - u), float(row - v), float(image[row, column])
                count += 1
                sx, sy, sxx, sxy, syy = sx + x, sy + y, sxx + x * x, sxy + x * y, syy + y * y
                sz, sxz, syz = sz + z, sxz + x * z, syz + y * z
    first, second, third = sxx * syy - sxy * sxy, sxy * sy - sx * syy, sx * sxy - sxx * sy
    determinant = count * first + sx * second + sy * third
    if count < FEWEST or not determinant > 1e-3 * count**3:
        return np.nan
    return (sz * first + sxz * second + syz * third) / determinant
