"""Distance of the B-scan's plane from each mass, and the outline in which it cuts it."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import trimesh
from numpy.typing import NDArray

from recon.geometry import rigid
from recon.navigation.placed_scans import PlacedScan

Array = NDArray[np.float64]

OPPOSITE = np.array([[0, 1], [1, 2], [2, 0]])  # ends of a triangle's sides


@dataclass(frozen=True)
class Body:
    """A mass as it is measured against planes."""

    vertices: Array  # (n, 3) mm, in the world
    faces: NDArray[np.int64]  # (m, 3)


@dataclass(frozen=True)
class MassDistance:
    """A mass and the plane of a B-scan, which is taken as endless."""

    name: str
    distance_mm: float  # of the plane from the mass; where it cuts it negative, by how far it would have to move to leave it
    middle_mm: float  # from the plane to the middle of the mass, along the image's normal, x cross y
    outline: Array  # (k, 2, 3) mm, pieces of the line in which it cuts it; k = 0 where it doesn't
    in_image: bool  # whether some of the outline lies in the image itself

    @property
    def cut(self) -> bool:
        """Whether the plane cuts the mass."""
        return self.distance_mm < 0


def bodies_of(masses: Mapping[str, trimesh.Trimesh]) -> dict[str, Body]:
    """Masses, ready to be measured."""
    return {name: Body(np.asarray(mesh.vertices, float), np.asarray(mesh.faces, np.int64)) for name, mesh in masses.items()}


def distances(bodies: Mapping[str, Body], scan: PlacedScan) -> tuple[MassDistance, ...]:
    """Distance of a B-scan's plane from each body."""
    x, y = scan.world_from_pixel[:3, 0], scan.world_from_pixel[:3, 1]
    normal = np.cross(x, y)
    normal /= np.linalg.norm(normal)
    pixel_from_world = np.linalg.inv(scan.world_from_pixel)
    return tuple(_distance(name, body, normal, scan, pixel_from_world) for name, body in bodies.items())


def _distance(name: str, body: Body, normal: Array, scan: PlacedScan, pixel_from_world: Array) -> MassDistance:
    heights = (body.vertices - scan.world_from_pixel[:3, 3]) @ normal
    low, high = float(heights.min()), float(heights.max())
    outline = _outline_of(body, heights)
    places = rigid.apply(pixel_from_world, outline.reshape(-1, 3))[:, :2]
    within = (places >= -0.5) & (places <= np.array(scan.image.shape[::-1]) - 0.5)
    return MassDistance(name, max(low, -high), (low + high) / 2, outline, bool(within.all(axis=1).any()))


def _outline_of(body: Body, heights: Array) -> Array:
    """Pieces : (k, 2, 3) mm of the line in which a plane cuts a body, from its vertices' heights : (n,) mm over the plane.

    A triangle with vertices on both sides gives one piece, between the two of its sides that the plane cuts.
    """
    above = heights[body.faces] >= 0
    crossed = above.any(axis=1) & ~above.all(axis=1)
    faces = body.faces[crossed]
    if not len(faces):
        return np.empty((0, 2, 3))
    ends = faces[:, OPPOSITE]  # (k, 3, 2)
    tops = heights[ends]
    cut = (tops[..., 0] >= 0) != (tops[..., 1] >= 0)  # two sides of each triangle
    first, last = ends[cut].T
    share = heights[first] / (heights[first] - heights[last])
    points = body.vertices[first] + share[:, None] * (body.vertices[last] - body.vertices[first])
    return points.reshape(-1, 2, 3)
