"""The skin in a measured surface: parted from table and background by a mask, or by the plane that things stand on.

The plane is that of the most points (RANSAC), if much of the surface lies on it and nearly all the rest before it, as seen from
the camera; the skin is the largest connected piece before it. Where the foot of a body rises gently from the table its last
millimetres count as table.
"""

from typing import NamedTuple

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse import csgraph

from recon.files import meshes
from recon.geometry.camera import Camera
from recon.geometry.primitives import Plane, fit_plane

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

TRIALS = 2000  # triples of them; a plane of 0.15 of the points is missed with a chance of 0.001
STANDS_MM = 2.0  # before the plane: not the plane any more


class Parted(NamedTuple):
    """A surface in two, as far as there is one."""

    skin: trimesh.Trimesh | None
    rest: trimesh.Trimesh | None  # table and background; None without


def by_mask(surface: trimesh.Trimesh, mask: Mask, camera: Camera) -> Parted:
    """Part by a mask : (h, w) of the camera's image, true on the skin; what lies beside the image isn't skin."""
    pixels = np.rint(camera.project(np.asarray(surface.vertices)))
    within = ((pixels >= 0) & (pixels < mask.shape[::-1])).all(axis=1)  # not where it isn't a number
    u, v = np.where(within[:, None], pixels, 0).astype(int).T
    return _parted(surface, within & mask[v, u])


def by_plane(surface: trimesh.Trimesh, seed: int = 0) -> Parted:
    """Part by the plane that things stand on; all of the surface is skin where there is none."""
    plane = _standing_plane(np.asarray(surface.vertices, float), seed)
    if plane is None:
        return Parted(surface, None)
    before = plane.distance(np.asarray(surface.vertices, float)) > STANDS_MM
    return _parted(surface, _largest_piece(surface, before))


def _standing_plane(points: Array, seed: int = 0) -> Plane | None:
    """The plane that things stand on, its normal towards the camera at the origin; None where there is none.

    points : (n, 3) mm
    """
    rng = np.random.default_rng(seed)
    sample = 20_000  # points that the plane is sought with
    some = points[rng.choice(len(points), min(sample, len(points)), replace=False)]
    a, b, c = some[rng.integers(len(some), size=(3, TRIALS))]
    normals = np.cross(b - a, c - a)
    length = np.linalg.norm(normals, axis=1)
    normals = normals[length > 0] / length[length > 0, None]
    offsets = (normals * a[length > 0]).sum(axis=1)
    if not len(normals):
        return None
    near_mm = 1.0  # of the plane: a point on it
    on = [np.count_nonzero(np.abs(some @ normal - offset) < near_mm) for normal, offset in zip(normals, offsets, strict=True)]
    best = int(np.argmax(on))
    near = some[np.abs(some @ normals[best] - offsets[best]) < near_mm]
    least_on = 0.15  # of the points, on a plane that things stand on
    if len(near) < max(4, least_on * len(some)):
        return None
    plane = fit_plane(near).shape
    away = plane.distance(some)
    behind, before = np.mean(away < -STANDS_MM), np.mean(away > STANDS_MM)
    most_behind = 0.03  # of the points, behind it
    least_before = 0.02  # of the points, before it: else there is nothing but the plane
    return plane if behind < most_behind and before > least_before else None


def _largest_piece(surface: trimesh.Trimesh, chosen: Mask) -> Mask:
    """Of chosen vertices : (n,) those of the largest piece that is joined by triangles."""
    corners = surface.faces[chosen[surface.faces].all(axis=1)]
    if not len(corners):
        return np.zeros_like(chosen)
    ends = np.concatenate([corners[:, :2], corners[:, 1:]]).T  # two sides join all three
    joined = sparse.coo_matrix((np.ones(ends.shape[1], bool), tuple(ends)), shape=2 * (len(chosen),))
    _, labels = csgraph.connected_components(joined, directed=False)
    return chosen & (labels == np.bincount(labels[chosen]).argmax())


def _parted(surface: trimesh.Trimesh, chosen: Mask) -> Parted:
    of_skin = chosen[surface.faces].all(axis=1)
    skin, rest = (piece(surface, faces) if faces.any() else None for faces in (of_skin, ~of_skin))
    return Parted(skin, rest)


def piece(surface: trimesh.Trimesh, faces: Mask) -> trimesh.Trimesh:
    """Some triangles of a surface with their vertices, their normals and what is known of them."""
    used = np.zeros(len(surface.vertices), bool)
    kept = surface.faces[faces]
    used[kept] = True
    part = trimesh.Trimesh(
        surface.vertices[used],
        (np.cumsum(used) - 1)[kept],
        vertex_normals=surface.vertex_normals[used],
        process=False,
        validate=False,
    )
    for name, values in surface.vertex_attributes.items():
        part.vertex_attributes[name] = np.asarray(values)[used]
    if (greys := meshes.greys_of(surface)) is not None:
        meshes.set_greys(part, greys[used])
    return part
