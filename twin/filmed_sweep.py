"""A freehand sweep of a scene that both cameras may film: its settings, the probe's way, its B-scans, and the cameras' frames."""

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, field_validator, model_validator

from recon.capture.manifest import SweepNameOrNone
from recon.geometry import rigid
from recon.model.rig import PROBE, Part, Rig, Vector
from recon.model.tracks import Track
from scenes.catalogue import build_scene
from scenes.scene_types import Scene
from twin import swept_bodies
from twin.conditions import Conditions, in_use
from twin.displacement import NOWHERE, Displacement
from twin.living.living_body import Living, LivingBody, LivingSweep, living_body
from twin.session import Session
from twin.shooting import FrameShooting
from twin.swept_bodies import SweptBody
from twin.tracking.led_bodies import LedBodies, check_names
from twin.tracking.sampling_ranges import DataRanges
from twin.ultrasound import sweep_session
from twin.ultrasound.bscan import Scan, scans
from twin.ultrasound.echo_solids import Body, at_speeds, body
from twin.ultrasound.timed_sweep import Clocks, Plan, PoseNoise
from twin.ultrasound.tool_echoes import Tool
from twin.ultrasound.transducer import Transducer, check_scanner

if TYPE_CHECKING:
    from twin.tracking.rendered_views import Frames
    from twin.tracking.scene_frames import SceneFilm

Array = NDArray[np.float64]
MOST_PRESSED_MM = 15.0  # by which the face may get into a solid that yields
SKIN_MM = 1.0  # the same of grown tissue that keeps its form: within its skin
Shown = Callable[[Iterable["Frames"], int], Iterable["Frames"]]


class Moved(Part):
    """A rigid step of the patient since the fringes: of the scene, and of all that is led over it and stands beside it."""

    turn_deg: Vector = (0.0, 0.0, 0.0)
    """deg, rotation vector in the world, about the middle of the scene's first thing"""
    shift_mm: Vector = (0.0, 0.0, 0.0)
    """mm, of that middle"""

    def matrix(self, scene: Scene) -> Array:
        """`world_from_reference` : (4, 4), the reference being the world as it was under the fringes."""
        middle = scene.things[0].mesh.bounds.mean(axis=0) if scene.things else np.zeros(3)
        turn = rigid.from_rotation_vector(np.deg2rad(self.turn_deg), np.zeros(3))
        return rigid.transform(turn[:3, :3], middle + self.shift_mm - turn[:3, :3] @ middle)


class SweepSettings(LedBodies):
    """All that a sweep is made from; as in `conf/sweep.yaml`."""

    rig: Rig
    scene: dict
    ultrasound: Transducer
    path: sweep_session.AnyPath
    conditions: Conditions = Conditions()
    clocks: Clocks = Clocks()
    pose_noise: PoseNoise = PoseNoise()
    name: SweepNameOrNone = ""
    filmed: bool = False
    moved: Moved = Moved()
    living: Living = Living()
    frames: FrameShooting = FrameShooting()
    seed: Annotated[int, Field(ge=0)] = 0

    @property
    def own_seed(self) -> int:
        """Of hand, clocks and frames: one for each of several sweeps, which share tissue, prints, drift and speeds by `seed`."""
        letters = self.name.encode()
        return int(np.random.SeedSequence([self.seed, *letters]).generate_state(1)[0]) if letters else self.seed

    @model_validator(mode="after")
    def _frames_one_after_the_other(self) -> "SweepSettings":
        if self.filmed and self.frames.exposure_s * self.clocks.camera_hz > 1:
            expected = f"at most 1 / clocks.camera_hz = {1 / self.clocks.camera_hz:.4g}"
            raise ValueError(f"frames.exposure_s: expected {expected}, found {self.frames.exposure_s:g}")
        if self.filmed and self.seed >= 2**32:
            raise ValueError(f"seed: expected less than 2^32 with filmed=true, found {self.seed}")
        return self

    @model_validator(mode="after")
    def _moved_before_cameras(self) -> "SweepSettings":
        if self.moved != Moved() and not self.filmed:
            raise ValueError(
                "moved: expected filmed=true with it, found filmed=false: `sonotwin track` takes it out of the poses "
                "that it finds in frames, and nothing takes it out of given ones"
            )
        return self

    @model_validator(mode="after")
    def _lives_on_a_surface(self) -> "SweepSettings":
        if self.living.lives and self.path.kind not in ("stroke", "hold"):
            raise ValueError(f"living: expected a path over a surface, such as stroke, found {self.path.kind}; give living=still")
        return self

    @model_validator(mode="after")
    def _of_the_rig(self) -> "SweepSettings":
        check_names(self.bodies, self.rig)
        return self

    @field_validator("path", mode="before")
    @classmethod
    def _leads_somewhere(cls, value: object) -> object:
        if value is None:
            raise ValueError("expected one that leads the probe, found none, which is for demonstrations without a sweep")
        return value

    @model_validator(mode="after")
    def _one_scanner(self) -> "SweepSettings":
        check_scanner(self.rig, self.ultrasound)
        return self


@dataclass(frozen=True)
class PlannedSweep:
    """A sweep before anything is rendered.

    What the scanner sees is told in the reference, where nothing has moved, and what the cameras see in their world.
    """

    settings: SweepSettings
    scene: Scene
    scanned: Body  # the scene by sound
    plan: Plan
    bodies: Mapping[str, SweptBody]  # of the rig, besides the probe
    world_from_reference: Array  # (4, 4) mm, by which the patient has moved
    living: LivingSweep | None = None  # a body that lives; images and tracks are then told in the world

    @property
    def body_from_image(self) -> Array:
        """Poses : (n, 4, 4) of the images in the body's frame, in which it rests."""
        truth = self.plan.truth
        return truth.poses if self.living is None else self.living.body_from_image(truth.times, truth.poses)

    def field(self, number: int) -> Displacement:
        """Displacement of the body from its rest, in its own frame, when an image is taken."""
        if self.living is None:
            return NOWHERE
        return self.living.field(int(self.plan.truth.times[number]), self.body_from_image[number])

    def truth(self) -> dict[str, Array]:
        """Truth of a body that lives; see `LivingSweep.truth`."""
        assert self.living is not None
        return self.living.truth(self.plan.truth.times, self.plan.truth.poses)

    def write(self, session: Session, taken: Iterable[Scan], film: "SceneFilm | None" = None) -> None:
        """Write the sweep and its truth, taking the B-scans, of `scans`, one by one, and then the frames."""
        settings = self.settings
        known = sweep_session.PURPOSES[settings.path.kind] != "probe"  # else the probe is still to be calibrated by it
        sweep_session.write_session(
            session,
            self.scene,
            self.scanned,
            settings.ultrasound,
            self.plan,
            taken,
            sweep_session.calibration_of(settings.rig, settings.ultrasound) if known else None,
            film,
            self.bodies,
            self.truth if self.living else None,
            self.body_from_image,
        )

    def scans(self) -> Iterator[Scan]:
        """Render the B-scans, one by one."""
        seed = int(np.random.SeedSequence([self.settings.seed, 1]).generate_state(1)[0])
        shafts = [(shaft, body.scanned.poses) for body in self.bodies.values() if (shaft := body.shaft) is not None]
        tools = [[Tool(shaft.moved(poses[k])) for shaft, poses in shafts] for k in range(len(self.plan.times))]
        poses, times = self.body_from_image, self.plan.truth.times.tolist()
        living = self.living
        if living is not None and living.patient.living.yields:
            assert living.patient.soft  # before threads ask for it
        field = None if living is None else (lambda k: living.under_image(times[k], poses[k]))
        return scans(self.scanned, self.settings.ultrasound, poses, seed, tools, field)

    def film(self, ranges: DataRanges, shown: Shown = lambda frames, _: frames) -> "SceneFilm":
        """The film of the sweep: light, body and motion of its frames, and their rendering.

        Parameters
        ----------
        ranges : of body, surroundings and light
        shown : passes on so many frames as they are rendered, and may show the progress
        """
        from twin.tracking import film_session, scene_frames  # load the ray tracer, which B-scans do without

        settings, target, moved = self.settings, self.plan.target, self.world_from_reference
        rig = in_use(settings.rig, settings.conditions, settings.seed)
        exposure_s = settings.frames.exposure_s
        own = scene_frames.motions(target.poses(), target.poses(-exposure_s / 2), target.poses(exposure_s / 2))
        led = {PROBE: own}
        for name, one in self.bodies.items():
            led[name] = [one.way.motion(time * 1e-9, exposure_s) for time in target.times.tolist()]
            if self.living is not None and not one.look.IN_A_HAND:
                along = self.living.patient.world_from_body(target.times)
                led[name] = [motion.carried(chest) for motion, chest in zip(led[name], along, strict=True)]
        led = {name: [motion.carried(moved) for motion in motions] for name, motions in led.items()}
        stage = scene_frames.SceneStage(self.scene, moved, led, {name: one.look for name, one in self.bodies.items()})
        bank = scene_frames.make_bank(stage, rig, settings.seed)
        made = scene_frames.takes(stage, bank, rig, ranges, settings.frames, settings.own_seed, settings.conditions.motion)

        def frames() -> Iterable["Frames"]:
            quality, living = settings.frames.quality, self.living
            if living is None:
                return shown(film_session.shoot(bank, rig, made, quality, settings.own_seed), len(made))
            moments = (scene_frames.parts_of(living.scene_at(self.scene, time), self.scene) for time in target.times.tolist())
            return shown(film_session.shoot_moving(bank, rig, made, quality, settings.own_seed, moments), len(made))

        return scene_frames.SceneFilm(rig, settings.rig, settings.frames, self.plan.track.times, made, frames, stage.looks)


def plan_sweep(settings: SweepSettings) -> PlannedSweep:
    """Set up the scene, and lead the probe and all further bodies along their paths.

    Raises
    ------
    InputError
        As `twin.ultrasound.sweep_session.plan_sweep` and `twin.swept_bodies.lead`, or if the scene has no acoustics.
    """
    scene = build_scene(settings.scene)
    scanned = at_speeds(body(scene), settings.conditions.sound, settings.seed)
    living = None
    if settings.living.lives:
        living = living_body(settings.living, scanned, getattr(settings.path, "surface", ""), settings.own_seed)
    rigid_mm = sweep_session.GIVES_MM if scanned.grown is None else SKIN_MM
    most_mm = MOST_PRESSED_MM if settings.living.yields else rigid_mm
    plan = sweep_session.plan_sweep(
        settings.path,
        settings.rig,
        scanned,
        settings.ultrasound,
        settings.clocks,
        settings.pose_noise,
        settings.own_seed,
        settings.conditions.motion,
        None if living is None else partial(living.world_from_body, share=settings.living.follows),
        most_mm,
    )
    bodies = swept_bodies.lead(
        settings,
        settings.rig,
        settings.ultrasound,
        plan,
        settings.pose_noise,
        settings.own_seed,
        settings.conditions.motion,
        settings.filmed,
    )
    if living is not None:
        bodies = {name: _beside(one, living) for name, one in bodies.items()}
    moved = settings.moved.matrix(scene)
    plan = replace(plan, track=_carried(plan.track, moved))
    bodies = {
        name: replace(one, track=_carried(one.track, moved), truth=_carried(one.truth, moved)) for name, one in bodies.items()
    }
    swept = None
    if living is not None:
        swept = LivingSweep(living, settings.ultrasound, plan.target.path)
        met = replace(swept.path, poses=swept.body_from_image(swept.path.times, swept.path.poses))
        sweep_session.refuse_inside(met, scanned, settings.ultrasound, most_mm)
    return PlannedSweep(settings, scene, scanned, plan, bodies, moved, swept)


def _beside(one: SweptBody, living: LivingBody) -> SweptBody:
    """A body beside a patient who lives: what stands goes along with her chest, under what a hand holds she moves."""
    if one.look.IN_A_HAND:
        return replace(one, scanned=_carried(one.scanned, np.linalg.inv(living.world_from_body(one.scanned.times))))
    chest = living.world_from_body(one.truth.times)
    return replace(one, track=_carried(one.track, chest), truth=_carried(one.truth, chest))


def _carried(track: Track, world_from_reference: Array) -> Track:
    return replace(track, poses=world_from_reference @ track.poses)
