"""Render a freehand ultrasound sweep of a scene, as scanner and tracking cameras would have recorded it, with its ground truth.

Reads the rig, the scene, the transducer and the probe's path from conf/. Writes OUT/capture/, which calibrate-probe, measure-lag
and freehand read like any hardware's: B-scans and tracked poses by their own clocks, and the probe's calibration, except with
path=wire, rows and tilts, from which it is to be found. Writes OUT/truth/, which only evaluation opens: true poses and times,
and labels of what each pixel shows. Takes about a tenth of a second a B-scan on two cores, a quarter of a minute for the
default stroke, and a minute more when it first compiles. With `add=true` other parts of a capture in OUT stay; without it
they are refused. A capture holds several sweeps if each has a `name`.

With `filmed=true` both cameras film the sweep, too: the rig's board, bracket and probe in a hand, over the very scene. The poses
are then in these frames, for `sonotwin track`, and nowhere else. Takes about a second a pair of frames more. Frames show further
bodies of the rig, too. With `moved` the patient, the scene and all over it, has moved by a rigid step since the fringes.

With `living=patient` she breathes, her heart beats, and soft tissue yields to the probe; her position at rest, at the end of an
expiration, is that of the fringes. OUT/truth/sweep/living.npz says where chest and masses were at each image, and where the
points that its pixels show rest. Elasticity takes a quarter of a minute to set up and 2 GB of memory, for each worker.

With `count` there are as many sweeps, in OUT/000000 and so on, of the seeds from `seed` on, each of another patient: of
`scene.seed` plus the sweep's seed, with masses drawn by it unless `scene.masses` are given; OUT/*/truth/scene.json has them. A
run that was stopped goes on where it was, and one of other settings is refused; any engine gives the same bytes.

With a rig that has further bodies, such as three_bodies, their poses are written, too, and needles and styluses are in the
B-scans that they are led to. Poses are found where both cameras have the body's target in view: a line for each body says in how
many, and warns of none.

    sonotwin sweep out=outputs/sweep
    sonotwin sweep conditions=lifelike out=outputs/sweep
    sonotwin sweep filmed=true clocks.camera_hz=20 out=outputs/filmed
    sonotwin sweep scene=patient ultrasound=clinic out=outputs/patient
    sonotwin sweep scene=patient ultrasound=clinic living=patient path.standoff_mm=-2 out=outputs/pressed
    sonotwin sweep scene=patient ultrasound=clinic living=patient path.standoff_mm=-2 count=100 engine=dask out=outputs/patients
    sonotwin sweep scene=tank ultrasound=water path=bob out=outputs/bottom
    sonotwin sweep scene=crosswire ultrasound=water path=wire out=outputs/wires
    sonotwin sweep scene=n_wires ultrasound=water path=rows out=outputs/rows
    sonotwin sweep scene=plane ultrasound=water path=tilts out=outputs/wall
    sonotwin sweep scene=sphere ultrasound=water path=tilts out=outputs/ball
    sonotwin sweep rig=three_bodies path=hold 'bodies.needle={path: {kind: insertion, depth_mm: 18}}' out=outputs/needle
"""

from collections.abc import Iterable, Iterator
from contextlib import closing
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Annotated

from pydantic import Field, model_validator
from rich.console import Console
from rich.progress import Progress

from recon.capture.manifest import CAMERAS, SCANNER, sweep_part
from recon.model.rig import PROBE
from scenes.catalogue import parse_scene
from sonotwin.console_watch import ConsoleWatch, LineConsole
from twin import sweep_data
from twin.engine import Engine
from twin.filmed_sweep import PlannedSweep, SweepSettings, plan_sweep
from twin.session import Session
from twin.ultrasound import sweep_session
from twin.ultrasound.bscan import Scan
from twin.ultrasound.probe_path import SurfacePath
from twin.ultrasound.sweep_session import AnyPath

if TYPE_CHECKING:
    from twin.tracking.rendered_views import Frames
    from twin.tracking.scene_frames import SceneFilm


class Config(SweepSettings):
    """Fields of `conf/sweep.yaml`."""

    out: Path
    add: bool = False
    count: Annotated[int, Field(ge=1, le=1_000_000)] = 1
    engine: Engine = Engine()

    @model_validator(mode="after")
    def _many_of_one_kind(self) -> "Config":
        if self.count > 1 and (self.filmed or self.add):
            raise ValueError(f"count: expected 1 with {'filmed' if self.filmed else 'add'}=true, found {self.count}")
        return self

    def settings(self) -> SweepSettings:
        """Settings that the bytes depend on."""
        return SweepSettings(**{name: getattr(self, name) for name in SweepSettings.model_fields})


def run(config: Config) -> None:
    """Render, and say what was written.

    Raises
    ------
    InputError
        If the scene has no acoustics or not what the path is about, or `out` can't be written to.
    """
    console = LineConsole()
    if config.count > 1:
        render_many(config, console)
        return
    sweep_data.check_alone(config.out)
    settings = config.settings().model_dump(mode="json")
    devices = (SCANNER, *(CAMERAS if config.filmed else ()))
    purpose = sweep_session.PURPOSES[config.path.kind] if config.name or config.filmed else None
    session = Session(config.out, sweep_part(config.name), settings, config.add, devices, purpose)
    session.check()
    parse_scene(config.scene)
    console.print(f"scene       {config.scene['kind']}, setting it up")
    with console.status("setting up the scene"):
        planned = plan_sweep(config)
        film = filming(planned, console) if config.filmed else None
    count, moments = len(planned.plan.times), len(planned.plan.track.times)
    console.print(f"path        {led_along(config.path)}, {count} B-scans, {moments} {'pairs of frames' if film else 'poses'}")
    for line, seen in places(planned):
        if seen:
            console.print(line)
        else:
            ConsoleWatch().warn(line)
    start = perf_counter()
    planned.write(session, shown(planned, console), film)
    seconds = perf_counter() - start
    width, height = config.ultrasound.image_size
    filmed = f", {moments} pairs of frames" if film else ""
    console.print(f"render      {count} B-scans, {width}x{height}{filmed}, {seconds:.1f} s")
    console.print(f"wrote       {config.out}/{{capture,truth}}", markup=False)


def render_many(config: Config, console: Console) -> None:
    """Render the sweeps that aren't there yet, each into a folder of its own."""
    settings, start = config.settings(), perf_counter()
    numbers = sweep_data.missing(config.out, settings, config.count)
    if len(numbers) < config.count:
        console.print(f"found       {config.count - len(numbers)} sweeps")
    if numbers:
        console.print(f"scene       {config.scene['kind']}, setting it up for each of {len(numbers)} sweeps")
    total = 0
    with (
        Progress(console=console, transient=True, disable=not console.is_terminal) as progress,
        closing(sweep_data.make(config.out, settings, numbers, config.engine)) as made,
    ):
        for images in progress.track(made, total=len(numbers), description="rendering sweeps"):
            total += images
    console.print(f"render      {len(numbers)} sweeps, {total} B-scans, {perf_counter() - start:.1f} s")
    console.print(f"wrote       {config.out}/000000 to {config.count - 1:06d}/{{capture,truth}}", markup=False)


def filming(planned: PlannedSweep, console: Console) -> "SceneFilm":
    """The film of the sweep, which shows how far it is."""
    from sonotwin.verbs.film import ranges  # loads the ray tracer, which B-scans do without

    def progress(frames: Iterable["Frames"], total: int) -> Iterator["Frames"]:
        with Progress(console=console, transient=True, disable=not console.is_terminal) as bar:
            yield from bar.track(frames, total=total, description="rendering frames")

    return planned.film(ranges(), progress)


def shown(planned: PlannedSweep, console: Console) -> Iterator[Scan]:
    """Take the images, in order, and show how far it is."""
    with Progress(console=console, transient=True, disable=not console.is_terminal) as progress:
        yield from progress.track(planned.scans(), total=len(planned.plan.times), description="rendering B-scans")


def places(planned: PlannedSweep) -> Iterator[tuple[str, bool]]:
    """A line for each further body, where cameras and scanner see it, and whether each of them does at all."""
    rig, filmed = planned.settings.rig, planned.settings.filmed
    before = [(PROBE, rig.target, planned.world_from_reference @ planned.plan.target.poses())]
    for name, body in planned.bodies.items():
        viewed, tip = body.in_view(rig), body.in_slice(planned.body_from_image, rig)
        line = f"{name:<11} target in view of both cameras at {viewed.sum()} of {len(viewed)} poses"
        if tip is not None:
            line += f"; tip in the slice in {tip.sum()} of {len(tip)} B-scans"
        covered = {other: int(body.covers(target, poses, rig).sum()) for other, target, poses in before if filmed}
        line += "".join(f"; one of it and the {other} may hide the other at {count}" for other, count in covered.items() if count)
        seen = bool(viewed.any() and (tip is None or tip.any()) and max(covered.values(), default=0) < len(viewed))
        yield line if seen else f"{line}; change bodies.{name}.path, or the probe's path", seen
        before.append((name, body.target, body.truth.poses))


def led_along(path: AnyPath) -> str:
    """How the probe is led, for the console; a raster is several strokes."""
    if isinstance(path, SurfacePath):
        return f"{path.strokes} strokes side by side" if path.strokes > 1 else "1 stroke"
    return path.kind
