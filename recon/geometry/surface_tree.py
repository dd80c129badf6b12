"""Distances to surfaces, by search trees for the nearest of their points."""

import numpy as np
import trimesh
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import KDTree

LEAF = 32  # points, among which a search ends


def surface_tree(points: NDArray[np.float64]) -> KDTree:
    """A search tree of points : (n, 3) on a surface, for queries from beside it.

    Its cells divide space without gaps. SciPy's default, boxes as tight as the points, takes 16 times as long for places 10 mm
    from a surface of 1.3 million points: nearly all of its boxes seem as near as the nearest.
    """
    return KDTree(points, leafsize=LEAF, compact_nodes=False, balanced_tree=False)


def signed_distances(points: ArrayLike, mesh: trimesh.Trimesh) -> NDArray[np.float64]:
    """Distance : (n,) mm of points : (n, 3) to the tangent plane at a dense closed mesh's nearest vertex, positive outside."""
    points = np.asarray(points, float)
    _, nearest = surface_tree(mesh.vertices).query(points)
    return ((points - mesh.vertices[nearest]) * mesh.vertex_normals[nearest]).sum(axis=1)
