"""Skin by light and B-scans, masses and the probe's path by ultrasound, with the devices, as layers of one scene in the world."""

from collections.abc import Sequence

import numpy as np
import trimesh
from numpy.typing import NDArray

from recon.files.layers import painted, pictured
from recon.geometry import rigid
from recon.geometry.camera import Camera

Array = NDArray[np.float64]

SKIN, MASS, PATH, DEVICE = (224, 187, 165, 150), (200, 60, 60, 255), (60, 140, 220, 255), (90, 90, 90, 255)  # colours
STEP_MM = 1.0  # of the skin's vertices, which are merged to that
PATH_MM = 0.6  # radius of the path's tube
DEVICE_MM = 40.0  # length of a device's pyramid


def skin_layer(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """The skin, coarser and translucent, so that what lies below is seen."""
    return painted(merged(mesh, STEP_MM), SKIN)


def mass_layer(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """A mass."""
    return painted(mesh, MASS)


def scan_layer(image: NDArray[np.uint8], world_from_pixel: Array) -> trimesh.Trimesh:
    """A B-scan : (h, w) where it was taken, to the borders of its outer pixels."""
    height, width = image.shape
    u, v = np.array([-0.5, width - 0.5, width - 0.5, -0.5]), np.array([-0.5, -0.5, height - 0.5, height - 0.5])
    corners = np.column_stack([u, v, np.zeros(4), np.ones(4)]) @ world_from_pixel.T
    return pictured(corners[:, :3], image)


def path_layer(places: Array) -> trimesh.Trimesh:
    """A tube along places : (n, 3) mm, n >= 2; where two coincide there is no piece."""
    moved = np.linalg.norm(np.diff(places, axis=0), axis=1) > 1e-6
    ends = zip(places[:-1][moved], places[1:][moved], strict=True)
    pieces = [trimesh.creation.cylinder(PATH_MM, segment=both, sections=6) for both in ends]
    whole = trimesh.util.concatenate(pieces)
    assert isinstance(whole, trimesh.Trimesh)
    return painted(whole, PATH)


def device_layer(camera: Camera) -> trimesh.Trimesh:
    """A camera or the projector as a pyramid: its centre, and its view some centimetres away."""
    width, height = camera.size
    corners = np.array([[0, 0], [width - 1, 0], [width - 1, height - 1], [0, height - 1]], float)
    vertices = np.vstack([camera.centre, camera.centre + DEVICE_MM * camera.rays(corners)])
    faces = [[0, 2, 1], [0, 3, 2], [0, 4, 3], [0, 1, 4], [1, 2, 3], [1, 3, 4]]
    return painted(trimesh.Trimesh(vertices, faces, process=False), DEVICE)


def merged(mesh: trimesh.Trimesh, step_mm: float) -> trimesh.Trimesh:
    """A mesh whose vertices in the same cell of a grid are merged to their mean, for pictures."""
    vertices = np.asarray(mesh.vertices, float)
    _, cell, count = np.unique(np.floor(vertices / step_mm).astype(np.int64), axis=0, return_inverse=True, return_counts=True)
    cell = cell.ravel()
    means = np.column_stack([np.bincount(cell, vertices[:, axis]) for axis in range(3)]) / count[:, None]
    faces = cell[np.asarray(mesh.faces)]
    faces = faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)]
    _, first = np.unique(np.sort(faces, axis=1), axis=0, return_index=True)
    return trimesh.Trimesh(means, faces[np.sort(first)], process=False)


def chosen(placed: NDArray[np.bool_], count: int) -> list[int]:
    """Numbers of `count` B-scans with a pose, evenly through the sweep."""
    numbers = np.flatnonzero(placed)
    return numbers[np.linspace(0, len(numbers) - 1, min(count, len(numbers))).astype(int)].tolist() if len(numbers) else []


def faces_middle(world_from_pixel: Sequence[Array] | Array, width: int) -> Array:
    """Middles of the array's face : (n, 3) mm, from matrices : (n, 4, 4) of B-scans as wide as some px."""
    return np.array([rigid.apply(matrix, [(width - 1) / 2, 0.0, 0.0]) for matrix in world_from_pixel])
