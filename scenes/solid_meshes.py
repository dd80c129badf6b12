"""Closed meshes from a few numbers: slabs, rods and spheres, fine enough that the facets don't show.

Slabs are built in their own frame: the front face at z = 0, looking towards -z (to the camera), the body behind it.
"""

import numpy as np
import trimesh
from numpy.typing import ArrayLike, NDArray

from recon.geometry import rigid

Array = NDArray[np.float64]
Faces = NDArray[np.int64]

TOLERANCE_MM = 0.001  # largest distance between a facet and the true curve; a thirtieth of the rig's noise


def moved(mesh: trimesh.Trimesh, to_from: Array) -> trimesh.Trimesh:
    """A copy of a mesh, moved by a 4x4 transform."""
    return trimesh.Trimesh(rigid.apply(to_from, mesh.vertices), mesh.faces, process=False)


def grid(size: tuple[float, float], cells: tuple[int, int]) -> tuple[Array, Faces]:
    """Triangulate a rectangle about the origin: points : ((nx+1)(ny+1), 2) mm, triangles : (2 nx ny, 3) anticlockwise."""
    nx, ny = cells
    x, y = np.linspace(-0.5, 0.5, nx + 1) * size[0], np.linspace(-0.5, 0.5, ny + 1) * size[1]
    points = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    corner = (np.arange(ny)[:, None] * (nx + 1) + np.arange(nx)).ravel()
    right, below, across = corner + 1, corner + nx + 1, corner + nx + 2
    return points, np.concatenate([np.stack([corner, right, across], 1), np.stack([corner, across, below], 1)])


def slab(points: Array, triangles: Faces, thickness: float, height: ArrayLike = 0.0) -> trimesh.Trimesh:
    """Extrude a planar triangulation away from the camera into a closed body.

    Parameters
    ----------
    points : (n, 2) float, mm
    triangles : (m, 3) int
        Anticlockwise in (x, y). Holes and separate pieces are allowed; borders become walls.
    thickness : float, mm
    height : float or (n,) float, mm
        z of the front face at the points.
    """
    z = np.broadcast_to(np.asarray(height, float), len(points))
    vertices = np.concatenate([np.column_stack([points, z]), np.column_stack([points, z + thickness])])
    n = len(points)
    edges = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
    start, end = edges[~np.isin(edges @ [n, 1], edges @ [1, n])].T  # edges whose reverse belongs to no triangle
    walls = np.concatenate([np.stack([start, end, end + n], 1), np.stack([start, end + n, start + n], 1)])
    return trimesh.Trimesh(vertices, np.concatenate([triangles[:, ::-1], triangles + n, walls]), process=False)


def plate(size: tuple[float, float], thickness: float) -> trimesh.Trimesh:
    """A rectangular plate, width x height mm, its front face centred on the origin and facing -z."""
    return slab(*grid(size, (1, 1)), thickness)


def rod(radius: float, length: float) -> trimesh.Trimesh:
    """A circular cylinder along x, centred on the origin, within `TOLERANCE_MM` of the true one."""
    sections = int(np.ceil(np.pi / np.arccos(1 - min(TOLERANCE_MM / radius, 0.01))))
    support_mm = 0.02  # width of the band beside a sharp rim, which keeps interpolated normals true up to the rim
    band, half = support_mm, length / 2
    outline = [(0, -half), (radius - band, -half), (radius, -half), (radius, band - half)]
    outline += [(r, -z) for r, z in reversed(outline)]
    mesh = trimesh.creation.revolve(outline, sections=sections)
    return trimesh.Trimesh(mesh.vertices[:, [2, 0, 1]], mesh.faces, process=False)


def ball(radius: float) -> trimesh.Trimesh:
    """A sphere about the origin, within `TOLERANCE_MM` of the true one."""
    edge = 1.26 * 1.0515 * radius  # of the icosahedron, times the spread of edge lengths under subdivision
    sag = edge**2 / (6 * radius)  # of an equilateral facet below its circumscribed sphere
    subdivisions = max(3, int(np.ceil(0.5 * np.log2(sag / TOLERANCE_MM))))
    return trimesh.creation.icosphere(subdivisions=subdivisions, radius=radius)
