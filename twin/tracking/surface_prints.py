"""Appearance of surfaces: the target's print, posters and textures, computed where a ray hits."""

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from recon.model.circle_layout import circle_centres
from recon.model.rig import Target
from twin.tracking.parameter_table import Rows
from twin.tracking.samples import SCRATCHES, SPOTS

POSTER_KINDS = 6
STRIDE_MM = 2000.0  # between the print coordinates of one poster and the next; see mesh_bank.py


@dataclass(frozen=True)
class BitGrid:
    """A face made of equal black and white cells, as fiducial boards have, instead of the circles."""

    cells: NDArray[np.uint8]  # (rows, columns): 0 is ink, 1 is paper; paper beyond them
    origin_mm: tuple[float, float]  # of the first cell's outer corner, in the target's frame
    cell_mm: tuple[float, float]  # along x and y


def _mixed(word: mi.UInt32) -> mi.UInt32:
    """A quick hash of a word, good enough for textures."""
    word = (word ^ (word >> 15)) * 0x2C1B3C6D
    word = (word ^ (word >> 12)) * 0x297A2D39
    return word ^ (word >> 15)


def value_noise(p: mi.Vector3f, seed: mi.UInt32) -> mi.Float:
    """A smooth random field from -1 to 1, independent over distances past 1: values at whole coordinates, blended."""
    corner = dr.floor(p)
    f = p - corner
    f = f * f * (3 - 2 * f)
    x, y, z = (mi.UInt32(mi.Int32(c)) for c in corner)

    def at(i: int, j: int, k: int) -> mi.Float:
        word = (x + i) * 0x8DA6B343 + (y + j) * 0xD8163841 + (z + k) * 0xCB1AB31F + seed
        return mi.Float(_mixed(word) >> 8) * 2**-23 - 1

    planes = [dr.lerp(dr.lerp(at(0, 0, k), at(1, 0, k), f.x), dr.lerp(at(0, 1, k), at(1, 1, k), f.x), f.y) for k in (0, 1)]
    return dr.lerp(planes[0], planes[1], f.z)


@dataclass(frozen=True)
class Face:
    """The target's print as the lanes fetch it, once."""

    paint: list[mi.Float]  # ink, paper, unevenness, softness in mm
    scratches: list[mi.Float]
    spots: list[mi.Float]

    @classmethod
    def of(cls, rows: Rows, name: str) -> "Face":
        """Fetch that of a body."""
        return cls(*(rows.all(f"{name} {column}") for column in ("print", "scratches", "spots")))

    def reflectance(self, covered: mi.Float, relief: mi.Float, x: mi.Float, y: mi.Float) -> mi.Float:
        """Ink coverage at x, y in mm: uneven, scratched and spotted."""
        ink, paper, unevenness, _ = self.paint
        value = dr.lerp(paper, ink, covered) * (1 + unevenness * relief)
        for k in range(SCRATCHES):
            ax, ay, bx, by, half, shade = self.scratches[6 * k : 6 * k + 6]
            along_x, along_y = bx - ax, by - ay
            part = ((x - ax) * along_x + (y - ay) * along_y) / dr.maximum(along_x**2 + along_y**2, 1e-6)
            part = dr.clip(part, 0, 1)
            away2 = (x - ax - part * along_x) ** 2 + (y - ay - part * along_y) ** 2
            value = dr.select(away2 < half * half, shade, value)
        for k in range(SPOTS):
            cx, cy, radius, shade = self.spots[4 * k : 4 * k + 4]
            inside = dr.clip(3 * (1 - ((x - cx) ** 2 + (y - cy) ** 2) / dr.maximum(radius * radius, 1e-6)), 0, 1)
            value = dr.lerp(value, shade, inside)
        return value


def textured(surface: list[mi.Float], relief: mi.Float) -> mi.Float:
    """Reflectance of a surface by its row of `draw.SURFACES` and the relief of its texture."""
    return dr.clip(surface[0] * dr.exp(surface[1] * relief), 0.01, 0.95)


def relief(surface: list[mi.Float], place: mi.Vector3f, seed: mi.UInt32) -> mi.Float:
    """A surface's texture at a place, about -1 to 1, drawn out along x by its stretch."""
    _, _, size, stretch = surface[:4]
    q = mi.Vector3f(place.x * stretch, place.y, place.z) / size
    return value_noise(q, seed) + 0.5 * value_noise(q * 2.7, seed + 1)


def ring_cover(target: Target, x: mi.Float, y: mi.Float, softness: mi.Float) -> mi.Float:
    """Share of ink on the face at x, y: three annuli."""
    covered = mi.Float(0)
    for cx, cy, _ in circle_centres(target).tolist():
        r = dr.sqrt((x - cx) ** 2 + (y - cy) ** 2)
        outer = dr.clip((target.outer_diameter_mm / 2 - r) / softness + 0.5, 0, 1)
        inner = dr.clip((r - target.inner_diameter_mm / 2) / softness + 0.5, 0, 1)
        covered = dr.maximum(covered, outer * inner)
    return covered


def grid_cover(grid: BitGrid, x: mi.Float, y: mi.Float) -> mi.Float:
    """Share of ink on the face at x, y: 1 in black cells."""
    rows, columns = grid.cells.shape
    i = dr.floor((x - grid.origin_mm[0]) / grid.cell_mm[0])
    j = dr.floor((y - grid.origin_mm[1]) / grid.cell_mm[1])
    within = (i >= 0) & (i < columns) & (j >= 0) & (j < rows)
    table = mi.Float(np.float32(grid.cells).ravel())
    paper = dr.gather(mi.Float, table, mi.UInt32(j) * columns + mi.UInt32(i), within)
    return dr.select(within, 1 - paper, 0)


def poster_reflectance(target: Target, paper: mi.Float, x: mi.Float, y: mi.Float, seed: mi.UInt32) -> mi.Float:
    """Reflectance of a poster at its print coordinates: rings, a mirrored target, stripes, squares, text, nothing."""
    number = dr.floor(x / STRIDE_MM + 0.5)
    x = x - number * STRIDE_MM
    word = _mixed(mi.UInt32(number + 1) * 0x9E3779B1 + seed)
    u, v, w = (mi.Float(_mixed(word + k) >> 8) * 2**-24 for k in (1, 2, 3))
    kind = word % POSTER_KINDS
    pitch = 6 * dr.exp(2 * u)
    column, row = dr.floor(x / pitch), dr.floor(y / pitch)
    fx, fy = x / pitch - column - 0.5, y / pitch - row - 0.5
    cell = _mixed(mi.UInt32(mi.Int32(column)) * 7919 + mi.UInt32(mi.Int32(row)) + word)
    cell_u = mi.Float(cell >> 8) * 2**-24
    r = dr.sqrt(fx**2 + fy**2)
    outer, inner = 0.2 + 0.27 * v, w * 0.95
    rings = (r < outer) & (r > outer * inner) & (cell_u < 0.6)
    mirrored = ring_cover(target, y * 1.0, x * 1.0, mi.Float(0.02)) > 0.5
    stripes = dr.abs(fx) < 0.5 * v
    squares = (mi.UInt32(mi.Int32(column + row)) & 1) == 1
    text = (dr.abs(fy) < 0.3) & (dr.abs(fx) < 0.1 + 0.5 * cell_u) & (cell_u > 0.2)
    dark = rings & (kind == 0) | mirrored & (kind == 1) | stripes & (kind == 2) | squares & (kind == 3) | text & (kind == 4)
    return dr.select(dark, 0.05 + 0.1 * w, paper)
