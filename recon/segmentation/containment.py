"""Containment of masses, found by ultrasound, in the outer surface that the cameras measured."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import ArrayLike, NDArray

from recon.files import meshes as mesh_files
from recon.geometry.surface_tree import nearest, surface_tree

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Containment:
    """Depths of a closed mesh under an open surface."""

    depths: Array  # (n,) mm of the mesh's vertices, NaN where the nearest part of the surface is its rim
    normals: Array  # (n, 3) of the surface over them, towards the camera
    sigmas_mm: Array  # (n,) of the surface there; NaN where it isn't known

    @property
    def covered(self) -> float:
        """Share of the vertices with surface over them."""
        return float(np.isfinite(self.depths).mean())

    @property
    def least_mm(self) -> float:
        """Depth of the vertex nearest to the surface, or farthest outside; NaN if nothing is covered."""
        return float(np.nanmin(self.depths)) if self.covered > 0 else float("nan")

    @property
    def nearest(self) -> int:
        """Number of that vertex."""
        return int(np.nanargmin(self.depths))

    @property
    def normal(self) -> Array:
        """The surface's normal : (3,) over that vertex."""
        return self.normals[self.nearest]

    @property
    def sigma_mm(self) -> float:
        """Standard deviation of the surface over that vertex; NaN where it isn't known."""
        return float(self.sigmas_mm[self.nearest]) if self.covered > 0 else float("nan")

    @property
    def inside(self) -> bool | None:
        """Whether every vertex lies inside: False if a covered one doesn't, None (unknown) if not more than half are covered."""
        if self.least_mm <= 0:
            return False
        least_covered = 0.5  # of a mesh's vertices, to call it inside
        return True if self.covered > least_covered else None


def read_skin(path: Path) -> trimesh.Trimesh:
    """Read a surface of triangles, PLY.

    Raises
    ------
    InputError
        If the file is missing or damaged, of another kind, or holds no triangles.
    """
    return mesh_files.read_ply(path, "a surface")


def contain(
    meshes: Sequence[trimesh.Trimesh], surface: trimesh.Trimesh, camera: ArrayLike = (0.0, 0.0, 0.0)
) -> list[Containment]:
    """Containment of each mesh in a surface as of `recon.structured_light.surface_mesh`, in the same world."""
    if not meshes:
        return []
    found = below(np.concatenate([mesh.vertices for mesh in meshes]), surface, camera)
    ends = np.cumsum([len(mesh.vertices) for mesh in meshes])[:-1]
    return [Containment(*parts) for parts in zip(*(np.split(values, ends) for values in found), strict=True)]


def below(points: Array, surface: trimesh.Trimesh, camera: ArrayLike = (0.0, 0.0, 0.0)) -> tuple[Array, Array, Array]:
    """Depths : (n,) mm of points : (n, 3) under an open surface, positive behind it, as seen from the camera that measured it.

    Returns
    -------
    depths, normals, sigmas : (n,), (n, 3), (n,)
        As of `Containment`.
    """
    points = np.asarray(points, float)
    _, chosen = nearest(surface_tree(surface.vertices), points)
    vertices, normals = np.asarray(surface.vertices[chosen]), np.asarray(surface.vertex_normals[chosen])
    away = vertices - np.asarray(camera, float)
    normals = normals * np.where((normals * away).sum(axis=1) > 0, -1, 1)[:, None]  # towards the camera
    behind = -((points - vertices) * normals).sum(axis=1)  # from the tangent plane there
    sigmas = np.asarray(surface.vertex_attributes.get("sigma_mm", np.full(len(surface.vertices), np.nan)), float).ravel()
    return np.where(_on_rim(surface, chosen), np.nan, behind), normals, sigmas[chosen]


def _on_rim(surface: trimesh.Trimesh, chosen: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Whether chosen vertices : (n,) end edges of one triangle only : (n,)."""
    near = np.zeros(len(surface.vertices), bool)
    near[chosen] = True
    about = surface.faces[near[surface.faces].any(axis=1)]  # all triangles at edges of the chosen
    edges = np.sort(about[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    rim = np.zeros(len(surface.vertices), bool)
    rim[edges[trimesh.grouping.group_rows(edges, require_count=1)]] = True
    return rim[chosen]
