"""Variants of held bodies and of surroundings, each kind side by side in one world of the ray tracer.

A sample picks its variants by their places; nothing is built or torn down between samples, so memory stays flat.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from recon.geometry import rigid
from recon.model.circle_layout import circle_centres
from recon.model.rig import Rig, Target
from scenes.handheld.body_look import Stand, any_stand, look_of
from scenes.handheld.handheld_assembly import held
from scenes.handheld.mesh_parts import Merged, Part, merged
from scenes.handheld.surroundings import Surroundings, surroundings
from twin.tracking.samples import Take
from twin.tracking.surface_prints import STRIDE_MM
from twin.tracking.target_truth import outline

Array = NDArray[np.float64]

BODY_PITCH_MM = 2500.0  # more than a body's size and ROOM_MM beyond it, so that variants don't see each other
SCENE_PITCH_MM = 14000.0
LIFT_MM = 0.2  # of the rays off the target's face


@dataclass(frozen=True)
class Bank:
    """Two worlds, and the place of each variant in them."""

    bodies: mi.Scene
    scenes: mi.Scene
    posters: mi.ShapePtr  # the shape of all sheets with prints, if any; its texture coordinates are mm on the sheet
    body_at: Array  # (n, 3) mm
    scene_at: Array
    stands: Mapping[str, Sequence[Stand]] = field(default_factory=dict)  # of each variant of further bodies, by their names


@lru_cache(maxsize=4)
def build_bank(target: Target, variants: int, seed: int) -> Bank:
    """Make the variants of a data set, by its seed alone; once in a process."""
    streams = [np.random.default_rng([seed, 1 << 32, kind]) for kind in (0, 1)]
    bodies = [held(streams[0], target) for _ in range(variants)]
    return bank_of(bodies, [surroundings(streams[1]) for _ in range(variants)])


@lru_cache(maxsize=2)
def build_bodies(rig: Rig, variants: int, seed: int) -> Bank:
    """Make variants of all of a rig's bodies : body n's are those from n times their number on; once in a process."""
    streams = [np.random.default_rng([seed, 1 << 32, kind]) for kind in range(2 + len(rig.bodies))]
    bodies, stands = [held(streams[0], rig.target) for _ in range(variants)], {}
    for stream, (name, target) in zip(streams[2:], rig.bodies.items(), strict=True):
        stands[name] = []
        for _ in range(variants):
            stands[name].append(any_stand(stream))
            bodies.append(look_of(name).parts(stream, target, stands[name][-1]))
    return replace(bank_of(bodies, [surroundings(streams[1]) for _ in range(variants)]), stands=stands)


def bank_of(bodies: Sequence[Sequence[Part]], around: Sequence[Surroundings]) -> Bank:
    """Set up bodies, each of the parts that move with the target, and surroundings."""
    body_at, scene_at = _places(len(bodies), BODY_PITCH_MM), _places(len(around), SCENE_PITCH_MM)
    body = _shifted_mesh("bodies", [merged(parts) for parts in bodies], body_at)
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
    loaded = mi.load_dict({"type": "scene", "a": body, "parent_scene": scenes})
    return Bank(loaded, scenes, mi.ShapePtr(posters), body_at, scene_at)


def reshape_scene(bank: Bank, parts: Sequence[Part]) -> None:
    """Give the one surroundings of a bank the form that its parts have at another moment."""
    found, parameters = merged(parts), mi.traverse(bank.scenes)
    parameters["a.vertex_positions"] = np.float32(found.vertices + bank.scene_at[0]).ravel()
    parameters["a.vertex_normals"] = np.float32(found.normals).ravel()
    parameters.update()


def uncovered(bank: Bank, body: int, target: Target, eyes: Array) -> float:
    """Share of the circles' rims that eyes : (n, 3) mm in the target's frame see past a body."""
    rims = outline(circle_centres(target) + np.array([0, 0, LIFT_MM]), target.outer_diameter_mm / 2).reshape(-1, 3)
    start = np.tile(rims, (len(eyes), 1))
    ways = np.repeat(eyes, len(rims), axis=0) - start
    distance = np.linalg.norm(ways, axis=1)
    ray = mi.Ray3f(mi.Point3f(*np.float32(start + bank.body_at[body]).T), mi.Vector3f(*np.float32(ways / distance[:, None]).T))
    ray.maxt = mi.Float(np.float32(distance))
    return 1 - float(np.mean(np.array(bank.bodies.ray_test(ray, dr.full(mi.Bool, True, len(start))))))


def uncovered_share(bank: Bank, take: Take, targets: Mapping[str, Target], eyes: Array) -> float:
    """Share of all circles' rims that eyes : (n, 3) mm in the world see past all bodies and surroundings, in mid-exposure."""
    poses = {name: held.motion.world_from_target for name, held in take.held.items()}
    rims = []
    for name, pose in poses.items():
        lifted = circle_centres(targets[name]) + np.array([0, 0, LIFT_MM])
        rims.append(rigid.apply(pose, outline(lifted, targets[name].outer_diameter_mm / 2).reshape(-1, 3)))
    rim = np.concatenate(rims)
    start = np.tile(rim, (len(eyes), 1))
    ways = np.repeat(eyes, len(rim), axis=0) - start
    distance = np.linalg.norm(ways, axis=1, keepdims=True)
    worlds = [(bank.bodies, rigid.invert(poses[name]), bank.body_at[held.body]) for name, held in take.held.items()]
    covered = np.zeros(len(start), bool)
    for world, into, at in (*worlds, (bank.scenes, take.scene_from_world, bank.scene_at[take.surroundings])):
        place, way = rigid.apply(into, start) + at, rigid.rotate(into, ways / distance)
        ray = mi.Ray3f(mi.Point3f(*np.float32(place).T), mi.Vector3f(*np.float32(way).T))
        ray.maxt = mi.Float(np.float32(distance.ravel()))
        covered |= np.array(world.ray_test(ray, dr.full(mi.Bool, True, len(start))))
    return 1 - float(covered.mean())


def _places(count: int, pitch: float) -> Array:
    """Places on a square lattice about the origin : (count, 3) mm."""
    side = int(np.ceil(np.sqrt(count)))
    number = np.arange(count)
    return np.column_stack([number % side, number // side, np.zeros(count)]) * pitch - [side * pitch / 2, side * pitch / 2, 0]


def _shifted_mesh(name: str, variants: Sequence[Merged], places: Array) -> mi.Mesh:
    """One mesh of all variants, at their places; a vertex's texture coordinates are the number of its surface and its albedo."""
    first = np.cumsum([0, *(len(one.vertices) for one in variants)])[:-1]
    vertices = np.concatenate([one.vertices + place for one, place in zip(variants, places, strict=True)])
    faces = np.concatenate([one.faces + start for one, start in zip(variants, first, strict=True)])
    normals = np.concatenate([one.normals for one in variants])
    texture = np.concatenate([np.column_stack([one.slot, one.albedo]) for one in variants])
    return _mesh(name, vertices, faces, normals, texture)


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
