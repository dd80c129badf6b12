"""Ground truth for each pixel's centre: the surface on its ray, and whether the projector lights it."""

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from recon.geometry.camera import Camera

NOTHING = 255  # object number where the ray meets nothing


@dataclass(frozen=True)
class SurfaceTruth:
    """Ground truth of one camera at each pixel's centre, without noise or blur."""

    points: NDArray[np.float32]  # (h, w, 3) mm, world; NaN where the ray meets nothing
    normals: NDArray[np.float32]  # (h, w, 3) outward, world; shading normals, as the surface is meant
    objects: NDArray[np.uint8]  # (h, w) number of the visible thing, NOTHING where none
    projector: NDArray[np.float32]  # (h, w, 2) projector coordinates, px
    lit: NDArray[np.bool_]  # (h, w) whether the projector's lens centre sees the point and its raster covers it


def surface_truth(world: mi.Scene, camera: Camera, projector: Camera) -> SurfaceTruth:
    """Trace one ray through each pixel's centre, through a pinhole."""
    shape = camera.size[::-1]
    directions = camera.rays(camera.pixel_grid()).reshape(-1, 3)
    ray = mi.Ray3f(mi.Point3f(camera.centre.tolist()), mi.Vector3f(*np.float32(directions.T)))
    hit = world.ray_intersect(ray)
    source = mi.Point3f(projector.centre.tolist())
    shadow_ray = hit.spawn_ray_to(source)
    lit = hit.is_valid() & (dr.dot(shadow_ray.d, hit.n) > 0)
    lit &= ~world.ray_test(shadow_ray, lit)

    distance = np.where(np.asarray(hit.is_valid()), np.asarray(hit.t, np.float64), np.nan)
    points = camera.centre + directions * distance[:, None]
    pixels = projector.project(points)
    width, height = projector.size
    with np.errstate(invalid="ignore"):
        covered = (np.abs(pixels + 0.5 - np.array([width, height]) / 2) <= np.array([width, height]) / 2).all(axis=-1)
    objects = np.full(len(points), NOTHING, np.uint8)
    for number, thing in enumerate(world.shapes()):
        objects[np.asarray(hit.shape == mi.ShapePtr(thing))] = number
    return SurfaceTruth(
        np.float32(points).reshape(*shape, 3),
        np.float32(np.asarray(hit.sh_frame.n).T).reshape(*shape, 3),
        objects.reshape(shape),
        np.float32(pixels).reshape(*shape, 2),
        (np.asarray(lit) & covered).reshape(shape),
    )
