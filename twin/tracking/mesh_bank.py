"""Variants of held bodies and of surroundings, each kind side by side in one world of the ray tracer.

A sample picks its variants by their places; nothing is built or torn down between samples, so memory stays flat.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from recon.geometry import rigid
from recon.model.rig import Target
from scenes.handheld.handheld_assembly import held
from scenes.handheld.mesh_parts import Merged, Part, merged
from scenes.handheld.surroundings import surroundings
from twin.tracking.surface_prints import STRIDE_MM

Array = NDArray[np.float64]

BODY_PITCH_MM = 2500.0  # more than a body's size and ROOM_MM beyond it, so that variants don't see each other
SCENE_PITCH_MM = 14000.0


@dataclass(frozen=True)
class Bank:
    """Two worlds, and where each variant stands in them."""

    bodies: mi.Scene
    scenes: mi.Scene
    posters: mi.ShapePtr  # the shape of all sheets with prints, if any; its texture coordinates are mm on the sheet
    body_at: Array  # (n, 3) mm
    scene_at: Array


def build_bank(target: Target, variants: int, seed: int) -> Bank:
    """Make the variants of a data set, by its seed alone."""
    streams = [np.random.default_rng([seed, 1 << 32, kind]) for kind in (0, 1)]
    body_at, scene_at = _places(variants, BODY_PITCH_MM), _places(variants, SCENE_PITCH_MM)
    body_parts = [held(streams[0], target) for _ in range(variants)]
    around = [surroundings(streams[1]) for _ in range(variants)]
    body = _shifted_mesh("bodies", [merged(parts) for parts in body_parts], body_at)
    plain = [merged([part for part in one.parts if part.slot != "poster"]) for one in around]
    scene = _shifted_mesh("scenes", plain, scene_at)
    sheets = [
        (part, from_poster, place)
        for one, place in zip(around, scene_at, strict=True)
        for part, from_poster in zip([p for p in one.parts if p.slot == "poster"], one.posters, strict=True)
    ]
    posters = _poster_mesh(sheets) if sheets else None
    scenes = mi.load_dict({"type": "scene", "a": scene} | ({} if posters is None else {"b": posters}))
    # on a GPU one kernel can trace rays in two worlds only if one is loaded as the other's child: OptiX has one table of shaders
    bodies = mi.load_dict({"type": "scene", "a": body, "parent_scene": scenes})
    return Bank(bodies, scenes, mi.ShapePtr(posters), body_at, scene_at)


def _places(count: int, pitch: float) -> Array:
    """Places on a square lattice about the origin : (count, 3) mm."""
    side = int(np.ceil(np.sqrt(count)))
    number = np.arange(count)
    return np.column_stack([number % side, number // side, np.zeros(count)]) * pitch - [side * pitch / 2, side * pitch / 2, 0]


def _shifted_mesh(name: str, variants: Sequence[Merged], places: Array) -> mi.Mesh:
    """One mesh of all variants, at their places; the number of a vertex's surface is its first texture coordinate."""
    first = np.cumsum([0, *(len(one.vertices) for one in variants)])[:-1]
    vertices = np.concatenate([one.vertices + place for one, place in zip(variants, places, strict=True)])
    faces = np.concatenate([one.faces + start for one, start in zip(variants, first, strict=True)])
    normals = np.concatenate([one.normals for one in variants])
    slots = np.concatenate([one.slot for one in variants])
    return _mesh(name, vertices, faces, normals, np.column_stack([slots, np.zeros(len(slots))]))


def _poster_mesh(sheets: Sequence[tuple[Part, Array, Array]]) -> mi.Mesh:
    """All sheets; texture coordinates are the print's, those of sheet k shifted by k strides."""
    vertices, faces, normals, prints, first = [], [], [], [], 0
    for k, (part, from_poster, place) in enumerate(sheets):
        one = merged([part])
        local = rigid.apply(rigid.invert(from_poster.scene_from_poster), one.vertices)
        vertices.append(one.vertices + place)
        faces.append(one.faces + first)
        normals.append(one.normals)
        prints.append(local[:, :2] + [k * STRIDE_MM, 0])
        first += len(one.vertices)
    return _mesh("posters", *(np.concatenate(block) for block in (vertices, faces, normals, prints)))


def _mesh(name: str, vertices: Array, faces: Array, normals: Array, texture: Array) -> mi.Mesh:
    mesh = mi.Mesh(name, len(vertices), len(faces), mi.Properties(), True, True)
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = np.float32(vertices).ravel()
    parameters["vertex_normals"] = np.float32(normals).ravel()
    parameters["vertex_texcoords"] = np.float32(texture).ravel()
    parameters["faces"] = np.uint32(faces).ravel()
    parameters.update()
    return mesh
