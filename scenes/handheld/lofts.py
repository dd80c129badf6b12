"""Closed bodies strung from rings of points: boxes, rods, tubes and tapered shapes with rounded edges.

A loft joins rings that follow each other and closes both ends. Edges are rounded by a few close rings, so that interpolated
normals stay true beside them.
"""

from collections.abc import Sequence

import numpy as np
import trimesh
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import CubicSpline

from recon.geometry import rigid

Array = NDArray[np.float64]

BEVEL = np.array([[1.0, 0.0], [0.62, 0.08], [0.29, 0.29], [0.08, 0.62], [0.0, 1.0]])  # inset and height along a rounded edge


def loft(rings: ArrayLike) -> trimesh.Trimesh:
    """Join rings : (k, n, 3) mm into a closed body, its ends fanned from their middles."""
    rings = np.asarray(rings, float)
    k, n = rings.shape[:2]
    here = np.arange(n)
    there = np.roll(here, -1)
    start = n * np.arange(k - 1)[:, None]
    a, b, c, d = start + here, start + there, start + n + there, start + n + here
    walls = np.concatenate([np.stack([a, b, c], -1).reshape(-1, 3), np.stack([a, c, d], -1).reshape(-1, 3)])
    first, last = np.full(n, k * n), np.full(n, k * n + 1)
    top = (k - 1) * n
    caps = np.concatenate([np.stack([there, here, first], -1), np.stack([top + here, top + there, last], -1)])
    vertices = np.concatenate([rings.reshape(-1, 3), rings[[0, -1]].mean(axis=1)])
    mesh = trimesh.Trimesh(vertices, np.concatenate([walls, caps]), process=False)
    if mesh.volume < 0:
        mesh = trimesh.Trimesh(vertices, mesh.faces[:, ::-1], process=False)
    return mesh


def placed(mesh: trimesh.Trimesh, to_from: Array) -> trimesh.Trimesh:
    """A copy of a mesh, moved by a 4x4 transform."""
    return trimesh.Trimesh(rigid.apply(to_from, mesh.vertices), mesh.faces, process=False)


def joined(meshes: Sequence[trimesh.Trimesh]) -> trimesh.Trimesh:
    """Meshes side by side in one."""
    offsets = np.cumsum([0, *[len(mesh.vertices) for mesh in meshes]])
    faces = np.concatenate([mesh.faces + offset for mesh, offset in zip(meshes, offsets[:-1], strict=True)])
    return trimesh.Trimesh(np.concatenate([mesh.vertices for mesh in meshes]), faces, process=False)


def frame(origin: ArrayLike, z: ArrayLike, x: ArrayLike = (1.0, 0.3, 0.2)) -> Array:
    """Transform : (4, 4) of a frame at `origin` with the given z axis, and its x axis as near to `x` as can be."""
    z = unit(z)
    across = np.asarray(x, float) - (np.asarray(x, float) @ z) * z
    if np.linalg.norm(across) < 1e-6:
        across = np.roll(z, 1) - (np.roll(z, 1) @ z) * z
    across = unit(across)
    return rigid.transform(np.column_stack([across, np.cross(z, across), z]), origin)


def unit(vector: ArrayLike) -> Array:
    """The vector's direction."""
    return np.asarray(vector, float) / np.linalg.norm(vector)


def superellipse(half: ArrayLike, exponent: float, sides: int) -> Array:
    """Outline : (sides, 2) mm with half axes `half` : (2,); exponent 2 is an ellipse, a large one nearly a rectangle."""
    turn = 2 * np.pi * (np.arange(sides) + 0.5) / sides
    directions = np.stack([np.cos(turn), np.sin(turn)], axis=-1)
    return np.asarray(half) * np.sign(directions) * np.abs(directions) ** (2 / exponent)


def rounded(size: ArrayLike, radius: float, steps: int = 4) -> Array:
    """Outline : (4 (steps + 1), 2) mm of a rectangle `size` about the origin, with rounded corners."""
    half = np.asarray(size, float) / 2
    radius = min(radius, 0.98 * half.min())
    turn = np.linspace(0, np.pi / 2, steps + 1)
    corners = []
    for k, (x, y) in enumerate([(1, 1), (-1, 1), (-1, -1), (1, -1)]):
        angle = turn + k * np.pi / 2
        corners.append((half - radius) * (x, y) + radius * np.stack([np.cos(angle), np.sin(angle)], axis=-1))
    return np.concatenate(corners)


def prism(outline: Array, height: float, bevel: float = 0.0) -> trimesh.Trimesh:
    """An outline : (n, 2) about the origin, raised from z = 0 to `height`, its edges rounded by `bevel` mm."""
    bevel = min(bevel, 0.45 * height)
    if bevel <= 0:
        levels, insets = np.array([0.0, height]), np.zeros(2)
    else:
        insets = bevel * np.concatenate([BEVEL[:, 0], BEVEL[::-1, 0]])
        levels = np.concatenate([bevel * BEVEL[:, 1], height - bevel * BEVEL[::-1, 1]])
    half = np.abs(outline).max(axis=0)
    scale = 1 - insets[:, None] / half
    rings = [np.column_stack([outline * s, np.full(len(outline), z)]) for s, z in zip(scale, levels, strict=True)]
    return loft(rings)


def box(size: ArrayLike, centre: ArrayLike = (0.0, 0.0, 0.0)) -> trimesh.Trimesh:
    """A box with sharp edges."""
    half = np.asarray(size, float) / 2
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * half[:2]
    rings = [np.column_stack([corners, np.full(4, z)]) for z in (-half[2], half[2])]
    return loft(np.asarray(rings) + np.asarray(centre, float))


def rod(radius: float, length: float, sides: int = 32, bevel: float = 0.6) -> trimesh.Trimesh:
    """A cylinder along z, from 0 to `length`."""
    return prism(superellipse((radius, radius), 2, sides), length, min(bevel, 0.5 * radius))


def turned(profile: ArrayLike, sides: int = 40) -> trimesh.Trimesh:
    """A body of revolution about z from a profile : (k, 2) of radius and height, mm."""
    circle = superellipse((1, 1), 2, sides)
    return loft([np.column_stack([max(r, 0.05) * circle, np.full(sides, z)]) for r, z in np.asarray(profile, float)])


def strut(start: ArrayLike, end: ArrayLike, radius: float, sides: int = 24) -> trimesh.Trimesh:
    """A rod between two points."""
    along = np.subtract(end, start)
    return placed(rod(radius, float(np.linalg.norm(along)), sides), frame(start, along))


def curve(points: ArrayLike, count: int) -> Array:
    """A smooth path : (count, 3) mm through points : (k, 3), evenly spaced along its length."""
    points = np.asarray(points, float)
    knots = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    fine = CubicSpline(knots, points)(np.linspace(0, knots[-1], 20 * len(points)))
    length = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(fine, axis=0), axis=1))])
    even = np.linspace(0, length[-1], count)
    return np.stack([np.interp(even, length, fine[:, k]) for k in range(3)], axis=-1)


def tube(path: Array, outline: Array, scale: ArrayLike = 1.0) -> trimesh.Trimesh:
    """An outline : (n, 2) swept along a path : (k, 3) without twist, scaled by one number or one each point."""
    tangents = np.gradient(path, axis=0)
    tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
    across = frame(path[0], tangents[0])[:3, 0]
    scale = np.broadcast_to(np.asarray(scale, float), len(path))
    rings = []
    for point, tangent, size in zip(path, tangents, scale, strict=True):
        across = unit(across - (across @ tangent) * tangent)
        rings.append(point + size * (outline[:, :1] * across + outline[:, 1:] * np.cross(tangent, across)))
    return loft(rings)


def cord(path: Array, radius: float, sides: int = 12) -> trimesh.Trimesh:
    """A round cable along a path : (k, 3)."""
    return tube(path, superellipse((radius, radius), 2, sides))
