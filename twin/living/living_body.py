"""A patient who breathes, whose heart beats, who shifts, and whose breast yields to the probe: where each point is at any moment.

A point that rests at X, at the end of an expiration, is at time t at

    x = B(t) (X + u(X, t)),

with the rigid motion B of the chest by breath and shift, and the displacement u of soft tissue by heart and probe. What the
scanner sees is worked out in the body's own frame, before B; cameras see the world.
Sources: Lujan et al. 1999, Med. Phys. 26(5), for the breath's course in time.
"""

from dataclasses import dataclass, replace
from dataclasses import field as dataclass_field
from functools import cached_property
from typing import Annotated, NamedTuple

import numpy as np
import trimesh
from numpy.typing import NDArray
from pydantic import Field

from recon.errors import InputError
from recon.geometry import rigid
from recon.model import tracks
from recon.model.rig import Fraction, Part, Positive, Vector
from recon.model.tracks import Track
from scenes.scene_types import Scene
from twin.displacement import LEAST_STRETCH, NOWHERE, Displacement, led_through, moved_to, rested_at
from twin.living import elastic_body
from twin.living.elastic_body import ElasticBody
from twin.ultrasound.echo_solids import Body, Solid
from twin.ultrasound.probe_path import FOOT
from twin.ultrasound.scan_lines import lines_of, middle_of_face, world_from_face, world_from_lines
from twin.ultrasound.sweep_session import SUPPORTS, surface_of
from twin.ultrasound.transducer import Transducer

Array = NDArray[np.float64]
Moments = NDArray[np.int64]

STREAM = 17  # of random numbers, apart from others of a session
FOOT_POINTS = (17, 7)  # of the probe's foot, along and across, that may touch the skin
BEATING_MM = 35.0  # standard deviation of the place over which the chest's wall beats; assumed
PULSE = 0.12  # of a beat, over which the wall goes out and comes back; assumed
STRIDE = 8  # pixels, of the truth that is kept
SHIFT_S = 1.0  # in which a patient shifts; assumed


class Living(Part):
    """What a patient does while she is scanned or lies under the fringes; nothing, by default, as a phantom."""

    yields: bool = False
    """whether soft tissue gives way to the probe's face; else the face stands in it"""
    drag_mm: Annotated[float, Field(ge=0, le=10)] = 0.0
    """mm, by which a moving face draws the skin along before it slides, at most; of tissue that yields"""
    breathing_mm: Annotated[float, Field(ge=0, le=50)] = 0.0
    """mm, by which the chest rises towards the cameras from the end of an expiration on"""
    breathing_deg: Annotated[float, Field(ge=-20, le=20)] = 0.0
    """deg, by which it tilts meanwhile, about a line along the world's x at the body's lower end"""
    breathing_s: Positive = 4.0
    """s, a breath"""
    heartbeat_mm: Annotated[float, Field(ge=0, le=5)] = 0.0
    """mm, by which the chest's wall beats towards the cameras under the breast's middle, at most"""
    heartbeat_s: Positive = 0.9
    """s, a beat"""
    shift_mm: Vector = (0.0, 0.0, 0.0)
    """mm, by which she shifts in the world, once"""
    turn_deg: Vector = (0.0, 0.0, 0.0)
    """deg, rotation vector by which she turns meanwhile, about the breast's middle"""
    shift_at_s: Annotated[float, Field(ge=0, le=3600)] = 2.0
    """s, when"""
    follows: Fraction = 1.0
    """share of the chest's motion that the hand which leads the probe goes along with"""
    element_mm: Annotated[float, Field(ge=2, le=10)] = 3.0
    """mm along x and y, of elastic elements; displacements by 3 are within 2 % of those by 2.5; 5 is faster, for many patients"""

    @property
    def lives(self) -> bool:
        """Whether anything moves or yields."""
        moves = self.breathing_mm or self.breathing_deg or any(self.shift_mm) or any(self.turn_deg)
        return bool(self.yields or self.heartbeat_mm or moves)


STILL = Living()


def breath(time_s: Array, period_s: float, phase: float) -> Array:
    """Depth of a breath at times, 0 at the end of an expiration and 1 at that of an inspiration [Lujan et al. 1999, n = 2]."""
    return np.sin(np.pi * (np.asarray(time_s) / period_s + phase)) ** 4


def pulse(time_s: Array, period_s: float, phase: float) -> Array:
    """Excursion of the chest's wall by the heart at times, 0 to 1: a hump a beat."""
    share = (np.asarray(time_s) / period_s + phase) % 1
    return np.where(share < 2 * PULSE, np.sin(np.pi * share / (2 * PULSE)) ** 2, 0.0)


@dataclass(frozen=True, eq=False)
class LivingBody:
    """A body that lives, from a session's start on."""

    living: Living
    body: Body  # at rest
    surface: Solid  # the skin that faces the cameras
    phases: tuple[float, float]  # of breath and heart at the session's start

    def world_from_body(self, times: Moments, share: float = 1.0) -> Array:
        """Rigid motion of the chest, or a share of it : (n, 4, 4), at moments : (n,) ns."""
        living, seconds = self.living, np.asarray(times) * 1e-9
        risen = share * breath(seconds, living.breathing_s, self.phases[0])
        shifted = share * np.clip((seconds - living.shift_at_s) / SHIFT_S, 0, 1)
        low, high = self.surface.mesh.bounds
        middle, hip = (low + high) / 2, np.array([0.0, high[1], high[2]])
        found = np.tile(np.eye(4), (len(seconds), 1, 1))
        for pose, up, aside in zip(found, risen, shifted, strict=True):
            tilt = _about(hip, np.array([np.deg2rad(living.breathing_deg) * up, 0.0, 0.0]))
            turn = _about(middle, np.deg2rad(living.turn_deg) * aside)
            pose[:] = turn @ tilt
            pose[:3, 3] += np.array(living.shift_mm) * aside + [0.0, 0.0, -living.breathing_mm * up]
        return found

    @cached_property
    def soft(self) -> ElasticBody:
        """The body's elasticity; takes seconds."""
        support = next((one for one in self.body.solids if one.name in SUPPORTS), None)
        return elastic_body.elastic_body(self.body, self.surface, support, self.living.element_mm)

    @cached_property
    def _beat(self) -> Array:
        """Displacements of the nodes at the height of a beat : (nx, ny, nz, 3) mm."""
        mesh = self.soft.mesh
        x, y = np.meshgrid(mesh.x, mesh.y, indexing="ij")
        middle = self.surface.mesh.bounds.mean(axis=0)
        bump = np.exp(-((x - middle[0]) ** 2 + (y - middle[1]) ** 2) / (2 * BEATING_MM**2))
        return self.soft.moved_base(-self.living.heartbeat_mm * bump[..., None] * np.array([0.0, 0.0, 1.0]))

    def beaten(self, time: int) -> Array | None:
        """Displacements of the nodes of `soft` by the heart at a moment, ns : (nx, ny, nz, 3) mm; None between beats."""
        out = float(pulse(np.array(time * 1e-9), self.living.heartbeat_s, self.phases[1]))
        return self._beat * out if self.living.heartbeat_mm * out > 0 else None

    def field(self, time: int) -> Displacement:
        """Displacement of soft tissue at a moment, ns, in the body's frame, with no probe on it."""
        by_heart = self.beaten(time)
        return NOWHERE if by_heart is None else led_through(elastic_body.spread(self.soft, by_heart))


class Met(NamedTuple):
    """Points of the body when an image is taken, in its own frame."""

    rested: NDArray[np.float32]  # (h, w, 3) mm, where each STRIDE-th pixel rests, by its true depth
    centres: Array  # (k, 3) mm, of what is hidden


@dataclass(frozen=True, eq=False)
class LivingSweep:
    """A living body under a probe that is led over it."""

    patient: LivingBody
    transducer: Transducer
    path: Track  # world_from_image over all of the sweep
    met: dict[tuple[int, bytes], Met] = dataclass_field(init=False, default_factory=dict)  # by moment and pose of images taken

    def body_from_image(self, times: Moments, world_from_image: Array) -> Array:
        """Poses : (n, 4, 4) of images in the body's frame, in which it rests."""
        return np.linalg.inv(self.patient.world_from_body(times)) @ world_from_image

    def field(self, time: int, body_from_image: Array) -> Displacement:
        """Displacement of soft tissue at a moment, ns, in the body's frame, under a probe at a pose (4, 4) in it."""
        if not self.patient.living.yields:
            return self.patient.field(time)
        face, normal = _foot(self.transducer, body_from_image)
        found = elastic_body.press(self.patient.soft, face, normal, self.patient.beaten(time), self._drag_at(time, normal))
        if found.stretch <= LEAST_STRETCH:
            raise InputError(
                f"path.standoff_mm: expected pressure that shrinks no length to less than {LEAST_STRETCH:g} of it, found more "
                f"after {time * 1e-9:.2f} s; press less, or choose another place"
            )
        return found

    def under_image(self, time: int, body_from_image: Array) -> Displacement:
        """`field` when an image is taken, of which the truth is kept, so that no field is worked out twice."""
        found = self.field(time, body_from_image)
        self.met[time, body_from_image.tobytes()] = self._met(found, body_from_image)
        return found

    def scene_at(self, scene: Scene, time: int) -> Scene:
        """The scene at a moment, ns, as cameras see it under the probe."""
        moment = np.array([time], np.int64)
        poses, carried = self.body_from_image(moment, tracks.at(self.path, moment)), self.patient.world_from_body(moment)
        return moved_scene(scene, self.patient, carried[0], self.field(time, poses[0]))

    def truth(self, times: Moments, world_from_image: Array) -> dict[str, Array]:
        """Truth of some images : where the chest stood, and where points of the body and middles of masses were and rest.

        Of those that were taken, see `under_image`, no field is worked out again.

        Returns
        -------
        dict
            world_from_body (n, 4, 4) mm; rested_mm (n, h, w, 3): where in the body each STRIDE-th pixel rests, by its true depth;
            centres_mm (n, k, 3): in the world, of what is hidden; resting_centres_mm (k, 3) in the body, and names (k,).
        """
        poses, motion = self.body_from_image(times, world_from_image), self.patient.world_from_body(times)
        moments = zip(times.tolist(), poses, strict=True)
        met = [self.met.get((time, pose.tobytes())) or self._met(self.field(time, pose), pose) for time, pose in moments]
        centres = [rigid.apply(carried, one.centres) for carried, one in zip(motion, met, strict=True)]
        return {
            "world_from_body": motion,
            "rested_mm": np.array([one.rested for one in met]),
            "centres_mm": np.array(centres).reshape(len(times), len(self._hidden), 3),
            "resting_centres_mm": np.array([mesh.center_mass for mesh in self._hidden.values()]).reshape(-1, 3),
            "names": np.array(list(self._hidden)),
        }

    @cached_property
    def _hidden(self) -> dict[str, trimesh.Trimesh]:
        """What lies in the body, by name."""
        solids = [one for one in self.patient.body.solids if not one.is_layer and one.name not in SUPPORTS]
        return {one.name: one.mesh for one in solids if one is not self.patient.surface}

    def _met(self, found: Displacement, body_from_image: Array) -> Met:
        (width, height), (sx, sy) = self.transducer.image_size, self.transducer.scale_mm_per_px
        x, y = np.meshgrid(sx * np.arange(0, width, STRIDE), sy * np.arange(0, height, STRIDE))
        pixels = np.stack([x, y, np.zeros_like(x)], axis=-1)
        centres = [moved_mesh(mesh, np.eye(4), found).center_mass for mesh in self._hidden.values()]
        return Met(np.float32(rested_at(found, rigid.apply(body_from_image, pixels))), np.array(centres).reshape(-1, 3))

    def _drag_at(self, time: int, normal: Array) -> Array | None:
        if not self.patient.living.drag_mm:
            return None
        drag = np.array([np.interp(time, self.path.times, self._drags[:, axis]) for axis in range(3)])
        return drag - normal * (drag @ normal)

    @cached_property
    def _drags(self) -> Array:
        """Displacement of the skin : (m, 3) mm by the face that slides over it, at the path's moments.

        Skin follows the face until it is drawn out: a way ds adds `ds - |ds| d / most` to its displacement d.
        """
        poses = self.body_from_image(self.path.times, self.path.poses)
        middle = (world_from_face(self.transducer, poses) @ middle_of_face(self.transducer))[:, :3, 3]
        steps = np.diff(middle, axis=0, prepend=middle[:1])
        steps -= poses[:, :3, 1] * (steps * poses[:, :3, 1]).sum(axis=1, keepdims=True)
        drags, drawn = np.zeros_like(steps), np.zeros(3)
        for n, step in enumerate(np.nan_to_num(steps)):
            way = float(np.linalg.norm(step)) / self.patient.living.drag_mm
            drawn = drawn * np.exp(-way) + step * (-np.expm1(-way) / max(way, 1e-12))
            drags[n] = drawn
        return drags


def living_body(living: Living, body: Body, surface: str, seed: int) -> LivingBody:
    """A body that lives; breath and heart start anywhere, the same for the same seed.

    Raises
    ------
    InputError
        If the scene has no solid that may live, see `surface_of`, or a hard one is to yield.
    """
    solid = surface_of(surface, body)
    if living.yields and not solid.tissue.soft:
        raise InputError(f"living.yields: expected a surface of soft tissue, found {solid.name}; give living.yields=false")
    phases = np.random.default_rng([seed, STREAM]).uniform(size=2)
    return LivingBody(living, body, solid, (float(phases[0]), float(phases[1])))


def scenes_at(scene: Scene, patient: LivingBody, times: Moments) -> list[Scene]:
    """A scene at moments : (n,) ns, with no probe on it."""
    places = zip(times.tolist(), patient.world_from_body(times), strict=True)
    return [moved_scene(scene, patient, carried, patient.field(time)) for time, carried in places]


def moved_scene(scene: Scene, patient: LivingBody, world_from_body: Array, field: Displacement) -> Scene:
    """A scene of which all but a hard support goes along with the chest, and yields."""
    stays = {solid.name for solid in patient.body.solids if solid.name in SUPPORTS and not solid.tissue.soft}
    things = [
        one if one.name in stays else replace(one, mesh=moved_mesh(one.mesh, world_from_body, field), primitive=None)
        for one in scene.things
    ]
    return replace(scene, things=tuple(things), shapes=())


def moved_mesh(mesh: trimesh.Trimesh, world_from_body: Array, field: Displacement) -> trimesh.Trimesh:
    """A mesh where its points have moved."""
    places = rigid.apply(world_from_body, moved_to(field, np.asarray(mesh.vertices)))
    return trimesh.Trimesh(places, mesh.faces, process=False)


def _about(point: Array, rotation: Array) -> Array:
    """A turn : (4, 4) by a rotation vector, rad, about a point."""
    turn = rigid.from_rotation_vector(rotation, np.zeros(3))
    turn[:3, 3] = point - turn[:3, :3] @ point
    return turn


def _foot(transducer: Transducer, body_from_image: Array) -> tuple[Array, Array]:
    """Points of the probe's foot : (m, 3) mm, rounded across the array and at its ends, and the face's normal : (3,)."""
    lines = lines_of(transducer)
    places = np.linspace(-FOOT.ends_mm, 2 * lines.middle_mm + FOOT.ends_mm, FOOT_POINTS[0])
    across = FOOT.across_mm * np.linspace(-0.5, 0.5, FOOT_POINTS[1])
    beyond = np.maximum(np.abs(places - lines.middle_mm) - lines.middle_mm, 0)
    back = beyond[:, None] ** 2 / (2 * FOOT.end_radius_mm) + across**2 / (2 * FOOT.lens_radius_mm)
    poses = world_from_lines(lines, world_from_face(transducer, body_from_image), places)[:, None]
    points = poses[..., :3, 3] + across[:, None] * poses[..., :3, 2] - back[..., None] * poses[..., :3, 1]
    return points.reshape(-1, 3), body_from_image[:3, 1]
