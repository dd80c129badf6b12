"""Light transport: one path-traced pass carries all patterns of a sequence.

Light is linear in the projected pattern. A camera path is traced once; at each of its vertices that the projector lights, the
values of all N patterns at that projector pixel are looked up and added, each to its own image. The cost of tracing is paid
once, not N times.
"""

from typing import Annotated

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray
from pydantic import AfterValidator, Field

from recon.model.rig import NotNegative, Part
from twin.optics.instruments import CameraOptics, ProjectorOptics, light_point, sample_rays
from twin.optics.light_spread import LightSpread, Translucent
from twin.optics.projected_image import ImageLight, ImageTable
from twin.optics.raster import Light, LightTable
from twin.optics.sampling import PairedPoints

Images = NDArray[np.float32]

LUMENS_PER_WATT = 542.0  # of the room's white light, whatever the projector's colour: as of 525 nm (683 lm/W, CIE V = 0.793)


def _power_of_two(value: int) -> int:
    if value & (value - 1):
        raise ValueError(f"expected a power of two, found {value}")
    return value


Samples = Annotated[int, Field(ge=2, le=65536), AfterValidator(_power_of_two)]


class Tracing(Part):
    """Settings of the path tracer."""

    samples: Samples = 16  # paths a pixel
    bounces: int = Field(default=1, ge=1, le=16)  # reflections between projector, or room, and camera; 1 is direct light
    room_lux: NotNegative = 0.0  # illuminance on an unshadowed surface, even from all sides

    @property
    def room_radiance(self) -> float:
        """Radiance of the room, W/mm^2/sr."""
        return self.room_lux / LUMENS_PER_WATT / np.pi * 1e-6


def render(
    scene: mi.Scene,
    camera: CameraOptics,
    projector: ProjectorOptics,
    light: Light | ImageLight,
    tracing: Tracing,
    seed: int,
    translucent: Translucent = (),
) -> Images:
    """Render what a camera receives while the projector shows a sequence.

    Parameters
    ----------
    scene : mitsuba.Scene
        Shapes in the world, mm; its emitters are not used.
    light : Light or ImageLight
        The sequence of n patterns as the projector shows it, or an image, n = 1.
    seed : int
        The same seed gives the same images.
    translucent : sequence of shapes with lengths, mm
        Shapes beneath which light spreads, see `light_spread`.

    Returns
    -------
    (n, h, w) float32
        Radiance that arrives at each pixel, W/mm^2/sr, times the lens's transmission.

    Raises
    ------
    ValueError
        If an image is to spread beneath a shape, which patterns along one axis can alone.
    """
    width, height = camera.camera.size
    everywhere = np.arange(width * height, dtype=np.uint32)
    return render_pixels(scene, camera, projector, light, tracing, seed, everywhere, translucent=translucent).reshape(
        -1, height, width
    )


def render_pixels(
    scene: mi.Scene,
    camera: CameraOptics,
    projector: ProjectorOptics,
    light: Light | ImageLight,
    tracing: Tracing,
    seed: int,
    pixels: NDArray[np.uint32],
    *,
    convex: bool = False,
    translucent: Translucent = (),
) -> Images:
    """Render some pixels : (m,) numbers `v * width + u`, as `render` does all : (n, m) float32, W/mm^2/sr.

    Light that leaves a convex body meets nothing again: for a scene that is one, shadows needn't be looked for.
    """
    table, spread = _tables(light, translucent)
    pixel = mi.UInt32(pixels)
    centre, across, down = camera.tables
    tables = dr.gather(mi.Point2f, centre, pixel), dr.gather(mi.Vector2f, across, pixel), dr.gather(mi.Vector2f, down, pixel)
    seed_word = dr.opaque(mi.UInt32, seed)
    samples = dr.opaque(mi.UInt32, tracing.samples)

    def body(index: mi.UInt32, sums: list[mi.Float], room: mi.Float) -> tuple:
        points = PairedPoints(pixel, index, tracing.samples, seed_word)
        ray = sample_rays(camera, tables, _pixel_offset(camera, points), points.mirrored_disc())
        values, from_room = trace(scene, projector, (table, spread), tracing, points, ray, convex)
        return index + 1, [total + value for total, value in zip(sums, values, strict=True)], room + from_room

    state = (mi.UInt32(0), [dr.zeros(mi.Float, len(pixels)) for _ in range(table.count)], dr.zeros(mi.Float, len(pixels)))
    _, sums, room = dr.while_loop(state, lambda index, sums, room: index < samples, body, label="samples")
    dr.eval(sums, room)
    scale = camera.transmission.ravel()[pixels] / np.float32(tracing.samples)
    radiance = np.empty((table.count, len(pixels)), np.float32)
    for total, values in zip(sums, radiance, strict=True):
        np.add(np.asarray(total), np.asarray(room), out=values)
        values *= scale
    return radiance


def _tables(light: Light | ImageLight, translucent: Translucent) -> tuple[LightTable | ImageTable, LightSpread | None]:
    """A projector's light as the ray tracer reads it, and after its spread beneath translucent shapes."""
    if isinstance(light, Light):
        return LightTable.of(light), LightSpread.of(translucent, light) if translucent else None
    if translucent:
        raise ValueError("light: expected patterns along one axis, which alone spread beneath a shape, found an image")
    return light.table, None


def meets_something(scene: mi.Scene, camera: CameraOptics) -> NDArray[np.bool_]:
    """Whether the ray through the middle of each pixel : (h, w) and of the lens meets any shape."""
    middle = sample_rays(camera, camera.tables, mi.Point2f(0), mi.Point2f(0))
    return np.asarray(scene.ray_test(middle)).reshape(camera.camera.size[::-1])


def _pixel_offset(camera: CameraOptics, points: PairedPoints) -> mi.Point2f:
    """Where in the image a sample lies, in px from its pixel's centre: within the pixel, spread by the lens's blur."""
    offset = points.mirrored_square()
    return camera.spread(offset) if camera.blur_px > 0 else offset


def trace(
    scene: mi.Scene,
    projector: ProjectorOptics,
    light: tuple[LightTable | ImageTable, LightSpread | None],
    tracing: Tracing,
    points: PairedPoints,
    ray: mi.Ray3f,
    convex: bool,
) -> tuple[list[mi.Float], mi.Float]:
    """Follow camera rays: radiance of each pattern, and of the room, W/mm^2/sr."""
    (table, spread), context = light, mi.BSDFContext()
    sums = [mi.Float(0)] * table.count
    room, throughput, active = mi.Float(0), mi.Float(1), mi.Bool(True)
    for bounce in range(tracing.bounces):
        hit = scene.ray_intersect(ray, active)
        if tracing.room_radiance > 0:
            room += dr.select(active & ~hit.is_valid(), throughput * tracing.room_radiance, 0)
        active &= hit.is_valid()
        bsdf = hit.bsdf(ray)

        source, projector_pixel, irradiance = light_point(projector, hit.p, points.mirrored_disc())
        shadow_ray = hit.spawn_ray_to(source)
        lit = active & (irradiance > 0) & (dr.dot(shadow_ray.d, hit.n) > 0)
        if not convex:
            lit &= ~scene.ray_test(shadow_ray, lit)
        toward = hit.to_local(shadow_ray.d)
        reflected = bsdf.eval(context, hit, toward, lit)[0]  # BRDF times cosine
        weight = dr.select(lit, throughput * reflected * irradiance, 0)
        values = table.lookup(projector_pixel, lit)
        sums = [total + weight * value for total, value in zip(sums, values, strict=True)]
        if spread is not None:
            soft = lit & (spread.length_mm(hit.shape) > 0)
            diffuse = bsdf.eval(mi.BSDFContext(mi.TransportMode.Radiance, mi.BSDFFlags.DiffuseReflection), hit, toward, soft)[0]
            weight = dr.select(soft, throughput * diffuse * irradiance, 0)
            after = spread.lookup(projector, hit, projector_pixel, soft)
            sums = [total + weight * (late - value) for total, late, value in zip(sums, after, values, strict=True)]

        last = convex or bounce + 1 == tracing.bounces
        if last and tracing.room_radiance == 0:
            break
        sample, factor = bsdf.sample(context, hit, points.square().x, points.square(), active)
        throughput *= dr.select(active, factor[0], 0)
        ray = hit.spawn_ray(hit.to_world(sample.wo))
        active &= throughput > 0
        if last:
            free = active if convex else active & ~scene.ray_test(ray, active)
            room += dr.select(free, throughput * tracing.room_radiance, 0)
            break
    return sums, room
