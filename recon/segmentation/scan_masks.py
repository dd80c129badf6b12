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
    inside = np.zeros((size[1], size[0]), bool)
    to_pixels = np.linalg.inv(world_from_pixel)
    for mesh in meshes:
        vertices = np.asarray(mesh.vertices) @ to_pixels[:3, :3].T + to_pixels[:3, 3]
        placed = trimesh.Trimesh(vertices, mesh.faces, process=False)
        lines = trimesh.intersections.mesh_plane(placed, (0.0, 0.0, 1.0), (0.0, 0.0, 0.0))
        inside |= _filled(np.asarray(lines).reshape(-1, 2, 3)[..., :2], size)
    return inside


def _filled(segments: Array, size: tuple[int, int]) -> NDArray[np.bool_]:
    """Pixels inside the closed lines that segments : (n, 2, 2) px make."""
    crossings = np.zeros((size[1], size[0] + 1), np.int64)
    low, high = np.sort(segments[..., 1], axis=1).T[..., None]
    number, row = np.nonzero((low <= np.arange(size[1])) & (np.arange(size[1]) < high))
    start, end = segments[number, 0], segments[number, 1]
    at = start[:, 0] + (row - start[:, 1]) / (end[:, 1] - start[:, 1]) * (end[:, 0] - start[:, 0])
    np.add.at(crossings, (row, np.clip(np.ceil(at), 0, size[0]).astype(int)), 1)
    return crossings[:, :-1].cumsum(axis=1) % 2 == 1
