"""Things become shapes of the ray tracer."""

from collections.abc import Sequence

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.spatial import ConvexHull

from recon.geometry import rigid
from recon.geometry.primitives import Sphere
from scenes.scene_types import Material, Scene, Thing

RAMP = 1024  # texels of the texture that turns a texture coordinate into a reflectance


def build_world(scene: Scene) -> mi.Scene:
    """Build the ray tracer's scene from the things that light can reach; shape k is visible thing k."""
    return mi.load_dict({"type": "scene", **named_shapes(scene)})


def is_convex(things: Sequence[Thing]) -> bool:
    """Whether closed things that don't overlap make up one convex body: they then fill their convex hull."""
    hull = ConvexHull(np.concatenate([thing.mesh.vertices for thing in things]))
    filled = 1e-6  # of a convex hull's volume may be missing by rounding: over a board's area 0.000003 mm
    return sum(thing.mesh.volume for thing in things) > (1 - filled) * hull.volume


def move_things(world: mi.Scene, things: Sequence[Thing], to_from: rigid.Array) -> None:
    """Put the meshes of a world, flat-faced and built from `things` in order, elsewhere: by a 4x4 transform of where these are.

    A world that stays one, with its meshes moved, leaves the ray tracer's memory and compiled code as they are.
    """
    parameters = mi.traverse(world)
    for key, thing in zip(named(things), things, strict=True):
        if thing.smooth or thing.primitive is not None:
            raise ValueError(f"{thing.name}: expected a mesh with flat faces")
        parameters[f"{key}.vertex_positions"] = np.float32(rigid.apply(to_from, thing.mesh.vertices)).ravel()
    parameters.update()


def reshape_things(world: mi.Scene, scene: Scene) -> None:
    """Give the meshes of a world, built from another moment of a scene, the form that they have in this one."""
    parameters, things = mi.traverse(world), visible(scene)
    for key, thing in zip(named(things), things, strict=True):
        parameters[f"{key}.vertex_positions"] = np.float32(thing.mesh.vertices).ravel()
        if thing.smooth:
            parameters[f"{key}.vertex_normals"] = np.float32(thing.mesh.vertex_normals).ravel()
    parameters.update()


def named_shapes(scene: Scene) -> dict[str, mi.Shape]:
    """The visible things as shapes, under names that keep their order."""
    things = visible(scene)
    return dict(zip(named(things), map(_to_shape, things), strict=True))


def named(things: Sequence[Thing]) -> list[str]:
    """Names of shapes that keep their order."""
    return [f"thing{k:03d}" for k in range(len(things))]


def visible(scene: Scene) -> list[Thing]:
    """The things that light can reach, in order."""
    return [thing for thing in scene.things if not thing.inside]


def _to_shape(thing: Thing) -> mi.Shape:
    """One thing as a shape with its material: an exact sphere where it is one, else its mesh."""
    bsdf = mi.load_dict(_to_bsdf(thing.material, thing.albedo is not None, thing.wet is not None))
    varied = thing.albedo is not None or thing.wet is not None
    if isinstance(thing.primitive, Sphere) and not varied:
        center = [float(value) for value in thing.primitive.centre]
        return mi.load_dict({"type": "sphere", "center": center, "radius": float(thing.primitive.radius), "bsdf": bsdf})
    properties = mi.Properties()
    properties["bsdf"] = bsdf
    properties["face_normals"] = not thing.smooth
    vertices, faces = np.float32(thing.mesh.vertices), np.uint32(thing.mesh.faces)
    mesh = mi.Mesh(thing.name, len(vertices), len(faces), properties, thing.smooth, varied)
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = vertices.ravel()
    parameters["faces"] = faces.ravel()
    if thing.smooth:
        parameters["vertex_normals"] = np.float32(thing.mesh.vertex_normals).ravel()
    if varied:
        values = (np.full(len(vertices), 0.5, np.float32) if one is None else one for one in (thing.albedo, thing.wet))
        parameters["vertex_texcoords"] = np.stack(tuple(values), axis=1).ravel()
    parameters.update()
    return mesh


def translucent(scene: Scene, world: mi.Scene) -> list[tuple[mi.Shape, float]]:
    """Shapes of a scene's world beneath which light spreads, and the lengths of its spread in mm."""
    shapes = zip(visible(scene), world.shapes(), strict=True)
    return [(shape, thing.material.spread_mm) for thing, shape in shapes if thing.material.spread_mm > 0]


def _to_bsdf(material: Material, has_albedo: bool, has_wet: bool = False) -> dict:
    """A material as a Mitsuba plugin: Lambertian, or a rough dielectric coat on it, which gel may cover."""
    reflectance = _ramp(0) if has_albedo else material.reflectance
    if material.roughness is None:
        dry = {"type": "diffuse", "reflectance": reflectance}
    else:
        dry = _coat(reflectance, material.roughness, material.ior)
    if not has_wet:
        return dry
    gel_roughness, gel_ior = 0.08, 1.36  # GGX alpha of gel as it levels out, assumed; its index is near water's
    same = _body_reflection(dry) / _body_reflection(_coat(reflectance, gel_roughness, gel_ior))
    under_gel = _ramp(0, same) if has_albedo else same * material.reflectance
    return {"type": "blendbsdf", "weight": _ramp(1), "dry": dry, "wet": _coat(under_gel, gel_roughness, gel_ior)}


def _body_reflection(bsdf: dict) -> float:
    """Diffuse reflection of a plugin in one direction, 30 deg off the normal, in which gel changes it by nothing."""
    hit = dr.zeros(mi.SurfaceInteraction3f)
    hit.uv, (hit.wi, wo) = mi.Point2f(0.5), (mi.Vector3f(*way) for way in ((0.5, 0, 0.866), (0, 0.5, 0.866)))
    return float(
        mi.load_dict(bsdf).eval(mi.BSDFContext(mi.TransportMode.Radiance, mi.BSDFFlags.DiffuseReflection), hit, wo)[0][0]
    )


def _coat(reflectance: dict | float, roughness: float, ior: float) -> dict:
    """A diffuse body under a rough dielectric coat."""
    return {
        "type": "roughplastic",
        "distribution": "ggx",
        "alpha": roughness,
        "int_ior": ior,
        "nonlinear": False,
        "diffuse_reflectance": reflectance,
    }


def _ramp(axis: int, scale: float = 1.0) -> dict:
    """A texture whose value is its first or second coordinate: vertices carry their reflectance, and how wet they are, in it.

    Mitsuba's own mesh attributes can't be used: its rough plastic asks a texture for its mean, which they don't have.
    """
    values = np.float32(scale) * (np.arange(RAMP, dtype=np.float32) + 0.5) / RAMP
    bitmap = mi.Bitmap(np.repeat(values[None, :, None] if axis == 0 else values[:, None, None], 2, axis=axis))
    return {"type": "bitmap", "bitmap": bitmap, "raw": True, "wrap_mode": "clamp"}
