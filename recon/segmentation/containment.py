"""Whether what ultrasound found lies inside the outer surface that the cameras measured."""

from dataclasses import dataclass

import numpy as np
import trimesh
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import KDTree

Array = NDArray[np.float64]

LEAST_COVERED = 0.5  # of a mesh's vertices, to call it inside


@dataclass(frozen=True)
class Containment:
    """How a closed mesh lies under an open surface."""

    depths: Array  # (n,) mm of the mesh's vertices, as of `depths`

    @property
    def covered(self) -> float:
        """Share of the vertices with surface over them."""
        return float(np.isfinite(self.depths).mean())

    @property
    def least_mm(self) -> float:
        """Depth of the vertex nearest to the surface, or farthest outside; NaN if nothing is covered."""
        return float(np.nanmin(self.depths)) if self.covered > 0 else float("nan")

    @property
    def inside(self) -> bool | None:
        """Whether every vertex lies inside: False if a covered one doesn't, None (unknown) if not more than half are covered."""
        if self.least_mm <= 0:
            return False
        return True if self.covered > LEAST_COVERED else None


def contain(mesh: trimesh.Trimesh, surface: trimesh.Trimesh, camera: ArrayLike = (0.0, 0.0, 0.0)) -> Containment:
    """How a mesh lies under a surface as of `recon.structured_light.surface_mesh`, in the same world."""
    return Containment(depths(mesh.vertices, surface, camera))


def depths(points: Array, surface: trimesh.Trimesh, camera: ArrayLike = (0.0, 0.0, 0.0)) -> Array:
    """Distance : (n,) mm of points : (n, 3) to an open surface, positive behind it, as the camera that measured it sees it.

    NaN where the nearest part of the surface is its rim, beyond which nothing is known.
    """
    vertices = np.asarray(surface.vertices)
    away = vertices - np.asarray(camera, float)
    normals = np.asarray(surface.vertex_normals)
    normals = normals * np.where((normals * away).sum(axis=1) > 0, -1, 1)[:, None]  # towards the camera
    _, nearest = KDTree(vertices).query(np.asarray(points, float), workers=-1)
    offset = points - vertices[nearest]
    behind = -(offset * normals[nearest]).sum(axis=1)  # of the tangent plane there: a vertex's distance would add the way to it
    return np.where(_on_rim(surface, nearest), np.nan, behind)


def _on_rim(surface: trimesh.Trimesh, chosen: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Whether chosen vertices : (n,) end edges that only one triangle has : (n,)."""
    near = np.zeros(len(surface.vertices), bool)
    near[chosen] = True
    about = surface.faces[near[surface.faces].any(axis=1)]  # all that the edges of the chosen can have
    edges = np.sort(about[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    rim = np.zeros(len(surface.vertices), bool)
    rim[edges[trimesh.grouping.group_rows(edges, require_count=1)]] = True
    return rim[chosen]
