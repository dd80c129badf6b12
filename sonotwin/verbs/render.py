"""Render a capture of a scene, as the rig's cameras would have taken it, with its ground truth.

Reads the rig, the scene, the patterns and settings of light from conf/. Writes OUT/capture/, which the pipeline reads like
any hardware's, and OUT/truth/, which only evaluation opens: points, normals, projector coordinates, the true calibration.
Takes about five seconds a camera for nine patterns on two cores, and once ten seconds more to compile.

With `add=true` other parts of a capture in OUT stay, such as a board, a sweep; without it they are refused.

With a rig that has a body `patient`, or others that stand, such as three_bodies, their boards stand beside the scene, so that
`sonotwin track` knows where the patient was under the fringes: render both cameras.

With `living=patient` she breathes and her heart beats while the images are taken, one after the other; the truth is that of her
rest. Takes as long for each image as for all of a scene that is still.

With `poses` the scene is the calibration board, held in many poses: lit for each camera, and under the patterns for camera 1.
Takes about eight seconds a pose on two cores. A run that was stopped goes on where it was when given the same fields again.

    sonotwin render scene=sphere patterns=gray_surface out=outputs/sphere
    sonotwin render scene=patient living=patient out=outputs/breathing
    sonotwin render scene=board poses=paper patterns=paper_calibration cameras=[cam1,cam2] out=outputs/board
"""

from pathlib import Path
from time import perf_counter
from typing import Annotated

import numpy as np
from pydantic import Field, model_validator
from rich.console import Console
from rich.progress import Progress

from recon.capture.manifest import axes_not_encoded
from recon.files import atomic
from recon.geometry.rigid import Array
from recon.model.patterns import Patterns
from recon.model.rig import Rig
from scenes.board_poses import Config as BoardPoses
from scenes.catalogue import build_scene, parse_scene
from scenes.scene_types import Scene
from sonotwin.console_watch import LineConsole
from twin import board_session
from twin.conditions import IDEAL, Conditions, check_board, in_use
from twin.living.living_body import STILL, Living, living_body, scenes_at
from twin.optics import surface_session
from twin.optics.light_transport import Tracing
from twin.session import Session
from twin.standing_bodies import with_standing
from twin.tracking.led_bodies import LedBodies, check_names
from twin.ultrasound.echo_solids import body
from twin.working_range import working_range


class Config(LedBodies):
    """Fields of `conf/render.yaml`."""

    rig: Rig
    scene: dict
    patterns: Patterns
    tracing: Tracing
    out: Path
    add: bool = False
    cameras: Annotated[list[surface_session.CameraName], Field(min_length=1)]
    seed: Annotated[int, Field(ge=0)]
    shooting: surface_session.Shooting
    poses: BoardPoses | None = None
    conditions: Conditions = IDEAL
    living: Living = STILL
    images_hz: Annotated[float, Field(gt=0, le=10_000)] = 20.0

    @model_validator(mode="after")
    def _fits(self) -> "Config":
        raster, shown = self.rig.projector.optics.size, self.patterns.projector_size
        if shown != raster:
            raise ValueError(f"patterns.projector_size: expected the rig's {list(raster)}, found {list(shown)}")
        for camera in self.cameras:
            if self.cameras.count(camera) > 1:
                raise ValueError(f"cameras: expected each once, found {camera} {self.cameras.count(camera)} times")
            adc = getattr(self.rig, camera).sensor.adc_bits
            if self.shooting.bits > adc:
                raise ValueError(f"shooting.bits: expected at most the {adc} of {camera}'s ADC, found {self.shooting.bits}")
        return self

    @model_validator(mode="after")
    def _of_the_rig(self) -> "Config":
        check_names(self.bodies, self.rig)
        return self

    @model_validator(mode="after")
    def _fits_poses(self) -> "Config":
        if self.poses is None:
            return self
        if self.living.lives:
            raise ValueError("living: expected none of it with poses of a board, found some; give living=still")
        if self.scene.get("kind") != "board":
            raise ValueError(f"poses: expected scene=board with them, found scene.kind {self.scene.get('kind')}")
        check_board(parse_scene(self.scene)[1], self.conditions.board)
        if lacking := axes_not_encoded(self.patterns):
            found = f"none along {' and '.join(lacking)}"
            raise ValueError(f"patterns: expected fringes or Gray code along both axes with poses, found {found}")
        if board_session.FRINGE_CAMERA not in self.cameras:
            found = ", ".join(self.cameras)
            raise ValueError(f"cameras: expected {board_session.FRINGE_CAMERA}, which sees the fringes of poses, found {found}")
        return self


def run(config: Config) -> None:
    """Render, and say what was written."""
    console = LineConsole()
    config = in_working_range(config)
    if config.poses is None:
        render_surface(config, part_of(config), console)
    else:
        render_board(config, config.poses, part_of(config), console)
    console.print(f"wrote       {config.out}/{{capture,truth}}", markup=False)


def in_working_range(config: Config) -> Config:
    """The same, with a board's depths where the rig works, unless they were given."""
    return config if config.poses is None else config.model_copy(update={"poses": working_range(config.rig).poses(config.poses)})


def part_of(config: Config) -> Session:
    """The part of a capture that is rendered by some settings."""
    settings = in_working_range(config).model_dump(mode="json", exclude={"out", "add"})
    return Session(config.out, "surface" if config.poses is None else "board", settings, config.add)


def render_board(config: Config, chosen: BoardPoses, session: Session, console: Console) -> None:
    """The calibration board in all poses, going on where an earlier run with the same fields was stopped."""
    if board_session.is_finished(session):
        console.print(f"keep        {chosen.count} poses, which are there already")
        return
    settings = board_session.Settings(
        config.rig,
        parse_scene(config.scene)[1],
        chosen,
        config.patterns,
        tuple(dict.fromkeys(config.cameras)),
        config.tracing,
        config.shooting,
        config.seed,
        config.conditions,
    )
    placed = board_session.place_all(settings)
    session.check()
    with atomic.alone(session.out / "board"):
        if not board_session.is_finished(session):  # as it may be after a wait for another run
            render_poses(settings, placed, session, console)


def render_poses(settings: board_session.Settings, placed: Array, session: Session, console: Console) -> None:
    """The board in those of the poses : (p, 4, 4) that no earlier run has left."""
    missing = board_session.missing_poses(session, settings)
    if len(missing) < len(placed):
        console.print(f"continue    {len(placed) - len(missing)} of {len(placed)} poses are there already")
    start = perf_counter()
    with console.status("setting up the board"):
        stage = board_session.set_up(settings)
        exposures = board_session.set_exposures(stage, settings)
    for camera, exposure in exposures.items():
        console.print(f"exposure    {camera}, {exposure.time_s * 1e3:.2f} ms")
    with Progress(console=console, transient=True, disable=not console.is_terminal) as progress:
        for number in progress.track(missing, description=f"rendering {settings.patterns.count} patterns a pose"):
            images = board_session.shoot_pose(stage, settings, exposures, number, placed[number])
            board_session.write_pose(session, number, *images)
    board_session.finish(session, settings, exposures, placed)
    seconds = perf_counter() - start
    patterns, samples = settings.patterns.count, settings.tracing.samples
    console.print(f"render      {len(missing)} poses, {patterns} patterns, {samples} samples/px, {seconds:.1f} s")


def set_up(config: Config) -> tuple[Rig, Scene, dict[str, Array]]:
    """The rig as it is in use, the scene with what stands beside it, and the poses `world_from_target` of that by name."""
    rig = in_use(config.rig, config.conditions, config.seed)
    return rig, *with_standing(build_scene(config.scene), rig, config.rig, config, config.seed)


def render_surface(config: Config, session: Session, console: Console) -> None:
    """Render each camera's images of the scene under the patterns."""
    session.check()
    rig, scene, standing = set_up(config)
    views, moments = {}, []
    if config.living.lives:
        with console.status("moving the scene"):
            times = np.rint(np.arange(config.patterns.count) * 1e9 / config.images_hz).astype(np.int64)
            moments = scenes_at(scene, living_body(config.living, body(build_scene(config.scene)), "", config.seed), times)
    for camera in dict.fromkeys(config.cameras):
        start = perf_counter()
        with console.status(f"rendering {config.patterns.count} patterns for {camera}"):
            view = surface_session.shoot(
                rig, scene, config.patterns, camera, config.tracing, config.shooting, config.seed, config.conditions, moments
            )
        views[camera] = view
        console.print(
            f"render      {camera}, {config.patterns.count} patterns, {config.tracing.samples} samples/px, "
            f"exposure {view.exposure.time_s * 1e3:.2f} ms, {perf_counter() - start:.1f} s"
        )
    surface_session.write_session(session, rig, config.rig, scene, config.patterns, views, standing)
