"""Which pixels of B-scans lie inside closed surfaces."""

from collections.abc import Sequence

import numpy as np
import trimesh
from numpy.typing import NDArray

Array = NDArray[np.float64]


def mask_of(meshes: Sequence[trimesh.Trimesh], world_from_pixel: Array, size: tuple[int, int]) -> NDArray[np.bool_]:
    """Pixels : (h, w) of a B-scan inside any of some closed meshes, mm in the world, by how often a row enters and leaves.

    Parameters
    ----------
    world_from_pixel : (4, 4)
        From px to mm; its third axis need not be of unit length.
    size : width, height, px
    """
    u, v = np.arange(size[0], dtype=float), np.arange(size[1], dtype=float)
    inside = np.zeros((len(v), len(u)), bool)
    to_pixels = np.linalg.inv(world_from_pixel)
    for mesh in meshes:
        vertices = np.asarray(mesh.vertices) @ to_pixels[:3, :3].T + to_pixels[:3, 3]
        placed = trimesh.Trimesh(vertices, mesh.faces, process=False)
        lines = trimesh.intersections.mesh_plane(placed, (0.0, 0.0, 1.0), (0.0, 0.0, 0.0))
        inside |= within_lines(np.asarray(lines).reshape(-1, 2, 3)[..., :2], u, v)
    return inside


def within_lines(segments: Array, x: Array, y: Array) -> NDArray[np.bool_]:
    """Places (x, y) of a grid : (ny, nx) inside the closed lines that segments : (n, 2, 2) make; x and y increase."""
    crossings = np.zeros((len(y), len(x) + 1), np.int64)
    low, high = np.sort(segments[..., 1], axis=1).T[..., None]
    number, row = np.nonzero((low <= y) & (y < high))
    start, end = segments[number, 0], segments[number, 1]
    at = start[:, 0] + (y[row] - start[:, 1]) / (end[:, 1] - start[:, 1]) * (end[:, 0] - start[:, 0])
    np.add.at(crossings, (row, np.searchsorted(x, at)), 1)
    return crossings[:, :-1].cumsum(axis=1) % 2 == 1
