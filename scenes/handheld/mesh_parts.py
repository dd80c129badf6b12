"""Parts of tracking scenes: meshes with named kinds of surface, and many of them joined into one.

A slot is a kind of surface. Its texture and reflectance are drawn per rendered sample, so a part carries geometry alone.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import trimesh
from numpy.typing import NDArray

SLOTS = (
    "target",
    "board",
    "probe",
    "bracket",
    "skin",
    "sleeve",
    "cable",
    "marking",
    "table",
    "bench",
    "phantom",
    "thing_a",
    "thing_b",
    "thing_c",
    "poster",
    "metal",
)  # the order is the number


@dataclass(frozen=True, eq=False)
class Part:
    """A mesh of one kind of surface.

    Raises
    ------
    ValueError
        If the slot is unknown.
    """

    slot: str
    mesh: trimesh.Trimesh  # mm, normals outwards
    smooth: bool  # interpolated vertex normals (curved), or flat faces
    albedo: NDArray[np.float32] | None = None  # (vertices,) its reflectance, where that isn't drawn by its slot

    def __post_init__(self) -> None:
        if self.slot not in SLOTS:
            raise ValueError(f"slot: expected one of {', '.join(SLOTS)}, found {self.slot}")


@dataclass(frozen=True, eq=False)
class Merged:
    """Parts joined into one triangle mesh, as a ray tracer takes it."""

    vertices: NDArray[np.float32]  # (n, 3), mm
    normals: NDArray[np.float32]  # (n, 3), unit, outwards
    faces: NDArray[np.uint32]  # (m, 3)
    slot: NDArray[np.uint8]  # (n,), index into SLOTS; the three vertices of a face agree
    albedo: NDArray[np.float32]  # (n,), 0 where the slot's reflectance holds


def merged(parts: Sequence[Part]) -> Merged:
    """Join parts: smooth ones keep their vertices, flat ones get three of their own a face, with the face's normal."""
    vertices, normals, faces, slots, albedos, count = [], [], [], [], [], 0
    for part in parts:
        mesh = part.mesh
        albedo = np.zeros(len(mesh.vertices)) if part.albedo is None else part.albedo
        if part.smooth:
            points, directions, triangles = mesh.vertices, mesh.vertex_normals, mesh.faces
        else:
            points, albedo = mesh.vertices[mesh.faces].reshape(-1, 3), albedo[mesh.faces].ravel()
            directions = np.repeat(face_normals(mesh), 3, axis=0)
            triangles = np.arange(len(points)).reshape(-1, 3)
        vertices.append(np.asarray(points, np.float32))
        normals.append(np.asarray(directions, np.float32))
        faces.append(np.asarray(triangles + count, np.uint32))
        slots.append(np.full(len(points), SLOTS.index(part.slot), np.uint8))
        albedos.append(np.asarray(albedo, np.float32))
        count += len(points)
    if not parts:
        none = np.zeros((0, 3), np.float32)
        return Merged(none, none, np.zeros((0, 3), np.uint32), np.zeros(0, np.uint8), np.zeros(0, np.float32))
    return Merged(*(np.concatenate(blocks) for blocks in (vertices, normals, faces, slots, albedos)))


def face_normals(mesh: trimesh.Trimesh) -> NDArray[np.float64]:
    """Unit normals : (m, 3) of all faces; zero for a face without area, which trimesh's own list leaves out."""
    corners = mesh.vertices[mesh.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
