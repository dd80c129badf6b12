"""Render a freehand ultrasound sweep of a scene, as scanner and tracking cameras would have recorded it, with its ground truth.

Reads the rig, the scene, the transducer and the probe's path from conf/. Writes OUT/capture/, which calibrate-probe, measure-lag
and freehand read like any hardware's: B-scans and tracked poses by their own clocks, and the probe's calibration, except with
path=wire alone, from which it is to be found. Writes OUT/truth/, which only evaluation opens: true poses and times, and labels
of what each pixel shows. Takes about a tenth of a second a B-scan on two cores, a quarter of a minute for the default stroke,
and a minute more when it first compiles. With `add=true` other parts of a capture in OUT stay; without it they are refused. A
capture holds several sweeps if each has a `name`.

With `filmed=true` both cameras film the sweep, too: the rig's board, bracket and probe in a hand, over the very scene. The poses
are then in these frames, for `sonotwin track`, and nowhere else. Takes about a second a pair of frames more.

    sonotwin sweep out=outputs/sweep
    sonotwin sweep conditions=lifelike out=outputs/sweep
    sonotwin sweep filmed=true clocks.camera_hz=20 out=outputs/filmed
    sonotwin sweep scene=tank ultrasound=water path=bob out=outputs/bottom
    sonotwin sweep scene=crosswire ultrasound=water path=wire out=outputs/wires
"""

from collections.abc import Iterator
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Annotated

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, field_validator, model_validator
from rich.console import Console
from rich.progress import Progress

from recon.capture.manifest import CAMERAS, SCANNER, SweepNameOrNone, sweep_part
from recon.model.rig import Rig
from scenes.catalogue import build_scene
from scenes.scene_types import Scene
from twin.conditions import Conditions, drifted, printed
from twin.session import Session
from twin.shooting import FrameShooting
from twin.ultrasound import sweep_session
from twin.ultrasound.bscan import Scan, scans
from twin.ultrasound.echo_solids import Body, at_speeds, body
from twin.ultrasound.probe_path import WirePath
from twin.ultrasound.timed_sweep import Clocks, Plan, PoseNoise
from twin.ultrasound.transducer import Transducer, check_scanner

if TYPE_CHECKING:
    from twin.tracking.rendered_views import Frames
    from twin.tracking.scene_frames import SceneFilm


class Config(BaseModel):
    """Fields of `conf/sweep.yaml`."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    rig: Rig
    scene: dict
    ultrasound: Transducer
    path: sweep_session.AnyPath
    out: Path
    add: bool = False
    conditions: Conditions = Conditions()
    clocks: Clocks = Clocks()
    pose_noise: PoseNoise = PoseNoise()
    name: SweepNameOrNone = ""
    filmed: bool = False
    frames: FrameShooting = FrameShooting()
    seed: Annotated[int, Field(ge=0)] = 0

    @property
    def own_seed(self) -> int:
        """Of hand, clocks and frames: one for each of several sweeps, which share tissue, prints, drift and speeds by `seed`."""
        letters = self.name.encode()
        return int(np.random.SeedSequence([self.seed, *letters]).generate_state(1)[0]) if letters else self.seed

    @model_validator(mode="after")
    def _frames_one_after_the_other(self) -> "Config":
        if self.filmed and self.frames.exposure_s * self.clocks.camera_hz > 1:
            expected = f"at most 1 / clocks.camera_hz = {1 / self.clocks.camera_hz:.4g}"
            raise ValueError(f"frames.exposure_s: expected {expected}, found {self.frames.exposure_s:g}")
        if self.filmed and self.seed >= 2**32:
            raise ValueError(f"seed: expected less than 2^32 with filmed=true, found {self.seed}")
        return self

    @field_validator("path", mode="before")
    @classmethod
    def _leads_somewhere(cls, value: object) -> object:
        if value is None:
            raise ValueError("expected one that leads the probe, found none, which is for demonstrations without a sweep")
        return value

    @model_validator(mode="after")
    def _one_scanner(self) -> "Config":
        check_scanner(self.rig, self.ultrasound)
        return self


def run(config: Config) -> None:
    """Render, and say what was written.

    Raises
    ------
    InputError
        If the scene has no acoustics or not what the path is about, or `out` can't be written to.
    """
    console = Console(soft_wrap=True, highlight=False)
    settings = config.model_dump(mode="json", exclude={"out", "add"})
    devices = (SCANNER, *(CAMERAS if config.filmed else ()))
    purpose = sweep_session.PURPOSES[config.path.kind] if config.name or config.filmed else None
    session = Session(config.out, sweep_part(config.name), settings, config.add, devices, purpose)
    session.check()
    with console.status("setting up the scene"):
        scene = build_scene(config.scene)
        scanned = at_speeds(body(scene), config.conditions.sound, config.seed)
        planned = sweep_session.plan_sweep(
            config.path,
            config.rig,
            scanned,
            config.ultrasound,
            config.clocks,
            config.pose_noise,
            config.own_seed,
            config.conditions.motion,
        )
        film = filming(config, scene, planned, console) if config.filmed else None
    count, moments = len(planned.times), len(planned.track.times)
    console.print(f"path        {config.path.kind}, {count} B-scans, {moments} {'pairs of frames' if film else 'poses'}")
    probe = None if isinstance(config.path, WirePath) else sweep_session.calibration_of(config.rig, config.ultrasound)
    start = perf_counter()
    taken = shown(scanned, config, planned, console)
    sweep_session.write_session(session, scene, scanned, config.ultrasound, planned, taken, probe, film)
    seconds = perf_counter() - start
    width, height = config.ultrasound.image_size
    filmed = f", {moments} pairs of frames" if film else ""
    console.print(f"render      {count} B-scans, {width}x{height}{filmed}, {seconds:.1f} s")
    console.print(f"wrote       {config.out}/{{capture,truth}}", markup=False)


def filming(config: Config, scene: Scene, planned: Plan, console: Console) -> "SceneFilm":
    """The film of the sweep: light, body and motion of its frames, and their rendering."""
    from sonotwin.verbs.film import ranges  # load the ray tracer, which B-scans do without
    from twin.tracking import film_session, scene_frames

    rig = drifted(config.rig, config.conditions.drift, config.seed)
    rig = rig.model_copy(update={"target": printed(rig.target, config.conditions.target, config.seed)})
    target, half = planned.target, config.frames.exposure_s / 2
    led = scene_frames.motions(target.poses(), target.poses(-half), target.poses(half))
    bank = scene_frames.make_bank(scene, rig, led, config.seed)
    motion = config.conditions.motion
    made = scene_frames.takes(bank, rig, ranges(), config.frames, led, config.own_seed, motion)

    def frames() -> Iterator["Frames"]:
        with Progress(console=console, transient=True, disable=not console.is_terminal) as progress:
            shot = film_session.shoot(bank, rig, made, config.frames.quality, config.own_seed)
            yield from progress.track(shot, total=len(made), description="rendering frames")

    return scene_frames.SceneFilm(rig, config.rig, config.frames, planned.track.times, made, frames)


def shown(scanned: Body, config: Config, planned: Plan, console: Console) -> Iterator[Scan]:
    """Take the images, in order, and show how far it is."""
    scan_seed = int(np.random.SeedSequence([config.seed, 1]).generate_state(1)[0])
    with Progress(console=console, transient=True, disable=not console.is_terminal) as progress:
        taken = scans(scanned, config.ultrasound, planned.truth.poses, scan_seed)
        yield from progress.track(taken, total=len(planned.times), description="rendering B-scans")
