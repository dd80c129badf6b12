"""Light from lamps, surroundings and projector, by held bodies that move and a scene that stands still, to camera pixels.

Bodies and scene are two worlds of the ray tracer. Each ray has its own time within the exposure: it is taken into each body's
frame at that time and into the scene's, meets all, and the nearest is what it sees; its shadow is tested in all. So the blur of
motion is exact, no world is ever rebuilt, and frames of different poses are traced in one launch. The kernel is unrolled over the
bodies.

Each of a ray's few shadow rays stands for all sources: what they would give without shadows is summed up, and counts if the one
that is followed is seen, chosen in proportion to what it would give. Where nothing is in shadow there is next to no noise.

A ray costs little beside what it takes to fetch a take's parameters, so each thread follows several pixels of one camera.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from recon.model.circle_layout import circle_centres
from recon.model.rig import MOST_CIRCLES, Rig, Target
from scenes.handheld.mesh_parts import SLOTS
from twin.optics.sampling import PairedPoints
from twin.tracking.mesh_bank import Bank
from twin.tracking.parameter_table import Rows, Turn, camera_columns, take_columns
from twin.tracking.samples import LAMPS, Take
from twin.tracking.surface_prints import BitGrid, Face, grid_cover, poster_reflectance, relief, ring_cover, textured

Floats = NDArray[np.float32]

RAYS = 8  # that a thread follows, about
SHADOWS = 2  # shadow rays a ray, a power of two
UNDISTORTIONS = 8  # fixed-point steps; each leaves a tenth of the error, which starts at a few px
LIFT_MM = 0.05  # of a shadow ray's start off the surface, more than the coordinates' rounding
ROOM_MM = 300.0  # things farther than this don't keep a point from the light that comes from all around
FRESNEL = 0.04  # of a glossy coat at right angles
TARGET, POSTER = SLOTS.index("target"), SLOTS.index("poster")
NO_CIRCLE = 0xFFFFFFFF


@dataclass(frozen=True)
class Lanes:
    """Camera pixels to render, of several takes: n lanes."""

    take: NDArray[np.uint32]  # (n,) which take of the batch
    camera: NDArray[np.uint32]  # (n,) 0 or 1
    u: NDArray[np.float32]  # (n,) px
    v: NDArray[np.float32]
    samples: NDArray[np.uint32]  # (n,) rays
    set: NDArray[np.uint32]  # (n,) number of the set of sample points, one of its own for each pixel that is looked at
    first: NDArray[np.uint32]  # (n,) of the set's points that are the lane's
    circle: NDArray[np.uint32]  # (n,) `circle_number` of the circle whose visible part is computed, or NO_CIRCLE


@dataclass(frozen=True)
class Light:
    """Values received by the lanes, n each."""

    radiance: Floats  # mean over the rays; the target's white is about 1 / pi times its irradiance
    plain: Floats  # the same without shadows
    disc: Floats  # rays towards the lane's circle, its outline filled, whatever stands before it
    seen: Floats  # of these, rays that reach it
    white: Floats  # rays that end on the paper of the target that has the lane's circle, or of the probe's
    white_radiance: Floats  # sum over these
    held: Floats  # rays that meet a held body first
    held_radiance: Floats  # mean over all rays, of what these receive
    held_plain: Floats  # the same without shadows
    unheld_radiance: Floats  # mean over all rays, of what the others receive if held bodies throw no shadow

    def part(self, lanes: slice) -> "Light":
        """Values of some lanes."""
        return Light(*(getattr(self, name)[lanes] for name in Light.__dataclass_fields__))


def circle_number(body: int, circle: int) -> int:
    """Number that lanes have for a circle of a body, which is counted as in `Take.held`."""
    return body * MOST_CIRCLES + circle


def render(
    bank: Bank,
    rig: Rig,
    takes: Sequence[Take],
    lanes: Lanes,
    most_samples: int,
    seed: int,
    grid: BitGrid | None = None,
    shadows: int = SHADOWS,
) -> Light:
    """Trace the lanes' rays.

    Parameters
    ----------
    takes : of the same bodies, each
    most_samples : int
        Points of the largest set, a power of two.
    grid : BitGrid or None
        Print on the face of the probe's target instead of the circles.
    shadows : int
        Shadow rays a ray, a power of two; of 0 all light arrives, at half the cost.

    Raises
    ------
    ValueError
        If the takes have different bodies.
    """
    names = list(takes[0].held)
    if any(list(one.held) != names for one in takes):
        raise ValueError(f"takes: expected the bodies {', '.join(names)} in each, found others")
    if not len(lanes.u):
        return Light(*np.zeros((len(Light.__dataclass_fields__), 0), np.float32))
    first, step, end = _shares(lanes)
    take, camera = dr.gather(mi.UInt32, mi.UInt32(lanes.take), first), dr.gather(mi.UInt32, mi.UInt32(lanes.camera), first)
    rows = Rows.of(take_columns(takes, rig, bank.body_at, bank.scene_at), take)
    cameras = Rows.of(camera_columns(takes), take * 2 + camera)
    bodies = [_Body(k, name, rig.targets[name], rows, None if k else grid) for k, name in enumerate(names)]
    path = _Path(bank, bodies, rows, cameras, shadows)
    key = dr.gather(mi.UInt32, mi.UInt32([one.k for one in takes]), take) * 4 + camera
    seeds = mi.sample_tea_32(key, dr.opaque(mi.UInt32, seed), 4)[0]
    u, v, sets, circles = mi.Float(lanes.u), mi.Float(lanes.v), mi.UInt32(lanes.set), mi.UInt32(lanes.circle)
    firsts, counts = mi.UInt32(lanes.first), mi.UInt32(lanes.samples)
    results = [dr.zeros(mi.Float, len(lanes.u)) for _ in range(10)]

    def body(pixel, k, *sums):
        """Ray k of a pixel; after the last one its sums are stored, and the next pixel's begin."""

        def its(column):
            return dr.gather(type(column), column, pixel)

        points = PairedPoints(its(sets), its(firsts) + k, most_samples, seeds)
        radiance, plain, unheld, held, aims, reaches, on_paper = path.follow(its(u), its(v), its(circles), points)
        flags = (dr.select(one, 1.0, 0.0) for one in (aims, reaches, on_paper))
        of_held = (dr.select(held, one, 0.0) for one in (1.0, radiance, plain))
        values = radiance, plain, *flags, dr.select(on_paper, radiance, 0.0), *of_held, dr.select(held, 0.0, unheld)
        sums = [total + value for total, value in zip(sums, values, strict=True)]
        done = k + 1 >= its(counts)
        for result, total in zip(results, sums, strict=True):
            dr.scatter(result, total, pixel, done)
        return dr.select(done, pixel + step, pixel), dr.select(done, 0, k + 1), *(dr.select(done, 0, total) for total in sums)

    state = (first, mi.UInt32(0), *(mi.Float(0) for _ in results))
    dr.while_loop(state, lambda pixel, *_: pixel < end, body, label="rays")
    radiance, plain, *sums, held_radiance, held_plain, unheld = (np.array(result) for result in results)
    means = (total / lanes.samples for total in (radiance, plain, held_radiance, held_plain, unheld))
    return Light(next(means), next(means), *sums, *means)


def _shares(lanes: Lanes) -> mi.Vector3u:
    """Which pixels each thread of the launch follows one after the other: the first, the step to the next, and the end.

    A thread keeps to one camera of one take, whose parameters it fetches once; neighbours have neighbouring pixels at a time.
    """
    starts = np.flatnonzero(np.diff(lanes.take * 2 + lanes.camera, prepend=np.uint32(2**32 - 1)))
    ends = np.append(starts[1:], len(lanes.u))
    steps = -(-(ends - starts) // max(1, round(RAYS / float(lanes.samples.mean()))))
    first = np.concatenate([start + np.arange(step) for start, step in zip(starts, steps, strict=True)])
    table = mi.UInt32(np.uint32(np.column_stack([first, np.repeat(steps, steps), np.repeat(ends, steps)])).ravel())
    # fetched by number: what is read in order is compiled anew for each alignment in memory, which NumPy leaves to chance
    return dr.gather(mi.Vector3u, table, dr.arange(mi.UInt32, len(first)))


class _Source(NamedTuple):
    """A lamp or the projector, relative to a place."""

    value: mi.Float  # radiance towards the viewer by it, without shadows
    way: mi.Vector3f  # to a point of it


class _Meeting(NamedTuple):
    """Where a ray meets a held body first, if it does."""

    valid: mi.Bool
    distance: mi.Float  # mm, infinite where it meets none
    normal: mi.Vector3f  # in the world
    uv: mi.Point2f  # slot and albedo
    place: mi.Vector3f  # in the bank
    body: mi.UInt32  # number


class _Body:
    """A held body of the same takes; fetches constant parameters once."""

    def __init__(self, number: int, name: str, target: Target, rows: Rows, grid: BitGrid | None) -> None:
        self.number, self.target, self.grid = number, target, grid
        self.target_from_world = Turn.of(rows, f"{name} target_from_world")
        self.origin, self.shift = rows.vector(f"{name} origin"), rows.vector(f"{name} shift")
        self.axis, self.angle = rows.vector(f"{name} axis"), rows.number(f"{name} angle")
        self.body_at, self.present = rows.vector(f"{name} body_at"), rows.number(f"{name} present") > 0
        self.face = Face.of(rows, name)

    def _untwisted(self, d: mi.Vector3f, time: mi.Float) -> mi.Vector3f:
        """A direction of the world, turned back by the target's rotation since the middle of the exposure [Rodrigues]."""
        s, c = dr.sincos(-self.angle * time)
        return d * c + dr.cross(self.axis, d) * s + self.axis * (dr.dot(self.axis, d) * (1 - c))

    def _twisted(self, d: mi.Vector3f, time: mi.Float) -> mi.Vector3f:
        return self._untwisted(d, -time)

    def ray(self, ray: mi.Ray3f, time: mi.Float) -> mi.Ray3f:
        """The ray in the target's frame at its time."""
        from_origin = mi.Vector3f(ray.o) - self.origin - self.shift * time
        start = self.target_from_world.rotate(self._untwisted(from_origin, time))
        return mi.Ray3f(mi.Point3f(start), self.target_from_world.rotate(self._untwisted(ray.d, time)))

    def banked(self, turned: mi.Ray3f) -> mi.Ray3f:
        """A ray of the target's frame where the body's variant stands in the bank."""
        return mi.Ray3f(turned.o + self.body_at, turned.d)

    def on_face(self, turned: mi.Ray3f) -> tuple[mi.Float, mi.Float, mi.Bool]:
        """Where a ray of the target's frame passes the face's plane, and whether it comes from the front."""
        distance = -turned.o.z / turned.d.z
        place = mi.Vector3f(turned.o) + turned.d * distance
        return place.x, place.y, self.present & (turned.d.z < 0) & (distance > 0)

    def within_circle(self, x, y, circle) -> mi.Bool:
        """Whether a place on the face lies in the lane's circle, its outline filled."""
        cx, cy, own = mi.Float(0), mi.Float(0), mi.Bool(False)
        for k, (there_x, there_y, _) in enumerate(circle_centres(self.target).tolist()):
            this = circle == circle_number(self.number, k)
            cx, cy, own = dr.select(this, there_x, cx), dr.select(this, there_y, cy), own | this
        return own & ((x - cx) ** 2 + (y - cy) ** 2 < (self.target.outer_diameter_mm / 2) ** 2)

    def meet(self, bank: Bank, turned: mi.Ray3f, time: mi.Float, nearer: _Meeting | None) -> _Meeting:
        """Where a ray of the target's frame meets the body, if no other was met nearer."""
        ray = self.banked(turned)
        if nearer is not None:
            ray.maxt = nearer.distance
        here = bank.bodies.ray_intersect(ray, mi.RayFlags.UV | mi.RayFlags.ShadingFrame, True, self.present)
        normal = self._twisted(self.target_from_world.rotate_back(mi.Vector3f(here.sh_frame.n)), time)
        met = _Meeting(here.is_valid(), here.t, normal, here.uv, mi.Vector3f(ray(here.t)), mi.UInt32(self.number))
        if nearer is None:
            return met
        return _Meeting(
            met.valid | nearer.valid, *(dr.select(met.valid, *both) for both in zip(met[1:], nearer[1:], strict=True))
        )

    def reflectance(self, x, y, texture) -> mi.Float:
        """Of the face, at a place on it."""
        covered = ring_cover(self.target, x, y, self.face.paint[3]) if self.grid is None else grid_cover(self.grid, x, y)
        return self.face.reflectance(covered, texture, x, y)

    def is_paper(self, reflectance) -> mi.Bool:
        """Whether the face is white where it reflects so much."""
        paper = self.face.paint[1]
        return (reflectance > 0.8 * paper) & (reflectance < 1.25 * paper)


class _Path:
    """Rays through the same takes, one after another; fetches constant parameters once."""

    def __init__(self, bank: Bank, bodies: Sequence[_Body], rows: Rows, cameras: Rows, shadows: int) -> None:
        self.bank, self.bodies, self.rows, self.shadows = bank, bodies, rows, shadows
        self.world_from_camera = Turn.of(cameras, "world_from_camera")
        self.fx, self.fy, self.cx, self.cy = cameras.all("pinhole")
        self.k1, self.k2, self.p1, self.p2, self.k3 = cameras.all("distortion")
        self.pupil, self.focus, self.blur, self.vignetting, self.mid_u, self.mid_v, self.corner = cameras.all("lens")
        self.late = cameras.number("late")
        self.scene_from_world = Turn.of(rows, "scene_from_world")
        self.ambient, self.gradient = rows.number("ambient"), rows.vector("gradient")
        self.texture_shift = rows.vector("texture_shift")
        self.lamps = rows.all("lamps")
        self.projector_from_world = Turn.of(rows, "projector_from_world")
        self.projector, self.projector_matrix = rows.all("projector"), rows.all("projector_matrix")

    def follow(self, u, v, circle, points: PairedPoints) -> tuple:
        """Radiance of one ray, with shadows, without any, and without held bodies'; whether it meets a held body, and whether it
        aims at the circle, reaches it, and ends on its paper.
        """
        ray, cosine = self._ray(u, v, points)
        time = points.square().x - 0.5 + self.late  # not mirrored: a long blur wants as many times as there are rays
        turned = [body.ray(ray, time) for body in self.bodies]
        crossed = [body.on_face(its) for body, its in zip(self.bodies, turned, strict=True)]
        place, normal, surface, on_faces, held, nothing = self._nearest(ray, turned, time, crossed)
        lights = self._reflected(place, normal, -ray.d, surface, time, points)
        away = ((u - self.mid_u) ** 2 + (v - self.mid_v) ** 2) * self.corner
        falls = (1 - self.vignetting * away) * cosine**4
        around = self.ambient * self._share_from(ray.d)
        radiances = (dr.select(nothing, around, value) * falls for value in lights)
        aims, reaches, on_paper = mi.Bool(False), mi.Bool(False), mi.Bool(False)
        for body, (x, y, faces), on_face in zip(self.bodies, crossed, on_faces, strict=True):
            towards = faces & body.within_circle(x, y, circle)
            aims, reaches = aims | towards, reaches | (towards & on_face)
            on_paper |= self._is_asked(body, circle) & on_face & body.is_paper(surface[0])
        return *radiances, held, aims, reaches, on_paper

    def _is_asked(self, body: _Body, circle) -> mi.Bool:
        """Whether the lane's circle is one of the body's; a lane without a circle is the first body's."""
        if len(self.bodies) == 1:
            return mi.Bool(True)
        return circle // MOST_CIRCLES == body.number if body.number else (circle < MOST_CIRCLES) | (circle == NO_CIRCLE)

    def _ray(self, u, v, points: PairedPoints) -> tuple[mi.Ray3f, mi.Float]:
        """Through a point of the pixel, spread by the lens, and a point of the pupil; and its cosine with the optical axis.

        The distortion is undone by fixed-point steps.
        """
        offset = points.mirrored_square() + points.mirrored_normal() * self.blur
        xd, yd = (u + offset.x - self.cx) / self.fx, (v + offset.y - self.cy) / self.fy
        x, y = mi.Float(xd), mi.Float(yd)
        for _ in range(UNDISTORTIONS):
            r2 = x * x + y * y
            radial = 1 + r2 * (self.k1 + r2 * (self.k2 + r2 * self.k3))
            x, y = (
                (xd - 2 * self.p1 * x * y - self.p2 * (r2 + 2 * x * x)) / radial,
                (yd - self.p1 * (r2 + 2 * y * y) - 2 * self.p2 * x * y) / radial,
            )
        disc = points.mirrored_disc() * self.pupil
        start = mi.Vector3f(disc.x, disc.y, 0)
        direction = dr.normalize(mi.Vector3f(x, y, 1) * self.focus - start)
        start, way = self.world_from_camera.apply(start), self.world_from_camera.rotate(direction)
        return mi.Ray3f(mi.Point3f(start), way), dr.rsqrt(1 + x * x + y * y)

    def _scene_ray(self, ray: mi.Ray3f) -> mi.Ray3f:
        return mi.Ray3f(mi.Point3f(self.scene_from_world.apply(mi.Vector3f(ray.o))), self.scene_from_world.rotate(ray.d))

    def _nearest(self, ray: mi.Ray3f, turned: Sequence[mi.Ray3f], time, crossed: Sequence[tuple]) -> tuple:
        """Intersection of a ray: place and normal in the world, surface, of each body whether it is its target's face, and
        whether it is a held body at all; or none.

        turned, crossed : the ray in each target's frame, and where it crosses the face's plane.
        """
        met = self.bodies[0].meet(self.bank, turned[0], time, None)
        for body, its in zip(self.bodies[1:], turned[1:], strict=True):
            met = body.meet(self.bank, its, time, met)
        in_scene = self._scene_ray(ray)
        in_scene.maxt = mi.Float(met.distance)  # infinite where all bodies are missed
        flags = mi.RayFlags.UV | mi.RayFlags.ShadingFrame
        scene = self.bank.scenes.ray_intersect(in_scene, flags, True, mi.Bool(True))
        held = met.valid & (met.distance < scene.t)
        nothing = ~met.valid & ~scene.is_valid()
        distance = dr.minimum(met.distance, scene.t)
        from_scene = self.scene_from_world.rotate_back(mi.Vector3f(scene.sh_frame.n))
        normal = dr.select(held, met.normal, from_scene)
        normal = dr.select(dr.dot(normal, ray.d) > 0, -normal, normal)
        poster = scene.is_valid() & ~held & (scene.shape == self.bank.posters)
        uv = dr.select(held, met.uv.x, dr.select(poster, float(POSTER), scene.uv.x))
        albedo = dr.select(held, met.uv.y, dr.select(poster, 0, scene.uv.y))
        slot = mi.UInt32(dr.clip(dr.select(nothing, 0, dr.floor(uv + 0.5)), 0, len(SLOTS) - 1))
        on_faces = [held & (slot == TARGET) & (met.body == body.number) for body in self.bodies]
        row = self.rows.chosen("surfaces", slot, 6)
        place = dr.select(held, met.place, mi.Vector3f(in_scene(scene.t))) + self.texture_shift
        seed = mi.UInt32(slot) * 77 + mi.UInt32(self.texture_shift.x * 100 + 1e6)
        texture = relief(row, place, seed)
        reflectance = dr.select(albedo > 0, albedo, textured(row, texture))
        for body, (x, y, _), on_face in zip(self.bodies, crossed, on_faces, strict=True):
            reflectance = dr.select(on_face, body.reflectance(x, y, texture), reflectance)
        sheet = poster_reflectance(
            self.bodies[0].target, reflectance, scene.uv.x, scene.uv.y, mi.UInt32(self.texture_shift.y * 100 + 1e6)
        )
        reflectance = dr.select(poster, sheet, reflectance)
        return mi.Vector3f(ray(distance)), normal, (reflectance, row[4], row[5]), on_faces, held, nothing

    def _share_from(self, direction: mi.Vector3f) -> mi.Float:
        """Light that comes from a direction, over the mean of all."""
        return 1 + dr.dot(self.gradient, direction)

    def _reflected(self, place, normal, view, surface, time, points: PairedPoints) -> tuple[mi.Float, mi.Float, mi.Float]:
        """Radiance towards the viewer: of all sources without shadows, if one of them is seen, mean of the shadow rays; in any
        case, the lamps' by their middles, which is what a ball that shines evenly gives a matte surface; of gloss on what is
        curved it is sharper; and if one of them is seen past the scene.
        """
        around, sources = self._sources(place, normal, view, surface, mi.Vector3f(0))
        plain = around + sum(source.value for source in sources)
        if not self.shadows:
            return plain, plain, plain
        radiance, unheld = mi.Float(0), mi.Float(0)
        for light in points.split(self.shadows):
            ball = mi.Vector3f(mi.warp.square_to_uniform_sphere(light.square()))
            around, sources = self._sources(place, normal, view, surface, ball)
            total = around + sum(source.value for source in sources)
            way, weight = self._towards_one(around, sources, light.square().x * total, normal, light.square())
            by_scene, blocked = self._blocked(place + normal * LIFT_MM, way, time, total > 0)
            radiance += dr.select(blocked, 0, total * weight)
            unheld += dr.select(by_scene, 0, total * weight)
        return radiance / self.shadows, plain, unheld / self.shadows

    def _sources(self, place, normal, view, surface, ball: mi.Vector3f) -> tuple[mi.Float, list["_Source"]]:
        """Unshadowed radiance from the surroundings' light, the lamps' points at `ball`, in radii, and the projector."""
        around = surface[0] * self.ambient * self._share_from(2 / 3 * normal)  # mean of all directions by their cosines
        sources = []
        for k in range(LAMPS):
            px, py, pz, radius, intensity = self.lamps[5 * k : 5 * k + 5]
            way = mi.Vector3f(px, py, pz) + ball * radius - place
            sources.append(_Source(self._lit(way, intensity, normal, view, *surface), way))
        way = self._projector_way(place)
        sources.append(_Source(self._lit(way, self._projected(place), normal, view, *surface), way))
        return around, sources

    def _towards_one(self, around, sources: Sequence["_Source"], pick, normal, where) -> tuple[mi.Vector3f, mi.Float]:
        """The way to the source in whose share `pick` falls, or in any direction; and what comes from there, over the mean.

        A direction is turned over about the normal as often as makes it as likely as it is bright.
        """
        straight = mi.Vector3f(mi.Frame3f(mi.Normal3f(normal)).to_world(mi.warp.square_to_cosine_hemisphere(where)))
        opposite = 2 * dr.dot(normal, straight) * normal - straight
        here, there = self._share_from(straight), self._share_from(opposite)
        way = dr.select(pick * (here + there) < around * (there - here), opposite, straight) * ROOM_MM
        weight = (here + there) / (2 * self._share_from(2 / 3 * normal))
        for source in sources:
            chosen = (pick >= around) & (source.value > 0)
            way, weight = dr.select(chosen, source.way, way), dr.select(chosen, 1, weight)
            around = around + source.value
        return way, weight

    def _lit(self, way, intensity, normal, view, reflectance, gloss, roughness) -> mi.Float:
        """Radiance by a source of an intensity, at the end of a way."""
        direction = dr.normalize(way)
        cosine = dr.maximum(dr.dot(normal, direction), 0)
        irradiance = intensity * cosine / dr.squared_norm(way)
        return irradiance * self._brdf(normal, view, direction, cosine, reflectance, gloss, roughness)

    @staticmethod
    def _brdf(normal, view, direction, cosine, reflectance, gloss, roughness) -> mi.Float:
        """Lambert's, and a coat with the GGX distribution of facets [Walter et al. 2007], its shadowing simplified."""
        half = dr.normalize(view + direction)
        a2 = roughness**4
        n_h, n_v = dr.dot(normal, half), dr.abs(dr.dot(normal, view))
        facets = a2 / (dr.pi * (n_h * n_h * (a2 - 1) + 1) ** 2)
        return reflectance / dr.pi + gloss * FRESNEL * facets / (4 * dr.maximum(dr.maximum(cosine, n_v), 0.1))

    def _projector_way(self, place) -> mi.Vector3f:
        return -self.projector_from_world.rotate_back(self.projector_from_world.shift) - place

    def _projected(self, place) -> mi.Float:
        """The projector's intensity towards a place: fringes along its columns or rows, within its raster."""
        intensity, mean, modulation, period, along_rows = self.projector
        fx, fy, cx, cy, width, height = self.projector_matrix
        local = self.projector_from_world.apply(place)
        u, v = fx * local.x / local.z + cx, fy * local.y / local.z + cy
        within = (local.z > 0) & (u > -0.5) & (u < width - 0.5) & (v > -0.5) & (v < height - 0.5)
        value = mean + modulation * dr.cos(2 * dr.pi * dr.select(along_rows > 0, v, u) / period)
        return dr.select(within, intensity * value, 0)

    def _blocked(self, place, way, time, active) -> tuple[mi.Bool, mi.Bool]:
        """Whether the scene stands in a shadow ray's way, and whether anything does."""
        reach = dr.norm(way)
        ray = mi.Ray3f(mi.Point3f(place), way / reach)
        in_scene = self._scene_ray(ray)
        in_scene.maxt = mi.Float(reach)
        by_scene = blocked = self.bank.scenes.ray_test(in_scene, active)
        for body in self.bodies:
            in_body = body.banked(body.ray(ray, time))
            in_body.maxt = mi.Float(reach)
            blocked = blocked | self.bank.bodies.ray_test(in_body, active & body.present & ~blocked)
        return by_scene, blocked
