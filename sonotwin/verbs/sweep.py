"""Render a freehand ultrasound sweep of a scene, as scanner and tracking cameras would have recorded it, with its ground truth.

Reads the rig, the scene, the transducer and the probe's path from conf/. Writes OUT/capture/, which calibrate-probe, measure-lag
and freehand read like any hardware's: B-scans and tracked poses by their own clocks, and the probe's calibration, except with
path=wire, from which it is to be found. Writes OUT/truth/, which only evaluation opens: true poses and times, and labels of what
each pixel shows. Takes about a tenth of a second a B-scan on two cores, a quarter of a minute for the default stroke, and a
minute more when it first compiles. With `add=true` other parts of a capture in OUT stay; without it they are refused.

    sonotwin sweep out=outputs/sweep
    sonotwin sweep conditions=lifelike out=outputs/sweep
    sonotwin sweep scene=tank ultrasound=water path=bob out=outputs/bottom
    sonotwin sweep scene=crosswire ultrasound=water path=wire out=outputs/wires
"""

from collections.abc import Iterator
from pathlib import Path
from time import perf_counter
from typing import Annotated

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, field_validator, model_validator
from rich.console import Console
from rich.progress import Progress

from recon.capture.manifest import SCANNER
from recon.model.rig import Rig
from scenes.catalogue import build_scene
from twin.conditions import Conditions
from twin.session import Session
from twin.ultrasound import sweep_session
from twin.ultrasound.bscan import Scan, scans
from twin.ultrasound.echo_solids import Body, at_speeds, body
from twin.ultrasound.probe_path import WirePath
from twin.ultrasound.timed_sweep import Clocks, Plan, PoseNoise
from twin.ultrasound.transducer import Transducer


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
    seed: Annotated[int, Field(ge=0)] = 0

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


def check_scanner(rig: Rig, transducer: Transducer) -> None:
    """Check that `rig.probe` and the transducer describe one scanner; ValueError if they don't."""
    for name in ("image_size", "scale_mm_per_px"):
        design, found = getattr(rig.probe, name), getattr(transducer, name)
        if design != found:
            raise ValueError(f"ultrasound.{name}: expected rig.probe's {list(design)}, found {list(found)}")


def run(config: Config) -> None:
    """Render, and say what was written.

    Raises
    ------
    InputError
        If the scene has no acoustics or not what the path is about, or `out` can't be written to.
    """
    console = Console(soft_wrap=True, highlight=False)
    settings = config.model_dump(mode="json", exclude={"out", "add"})
    session = Session(config.out, "sweep", settings, config.add, (SCANNER,))
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
            config.seed,
            config.conditions.motion,
        )
    count = len(planned.times)
    console.print(f"path        {config.path.kind}, {count} B-scans, {len(planned.track.times)} poses")
    probe = None if isinstance(config.path, WirePath) else sweep_session.calibration_of(config.rig, config.ultrasound)
    start = perf_counter()
    taken = shown(scanned, config, planned, console)
    sweep_session.write_session(session, scene, scanned, config.ultrasound, planned, taken, probe)
    seconds = perf_counter() - start
    width, height = config.ultrasound.image_size
    console.print(f"render      {count} B-scans, {width}x{height}, {seconds:.1f} s")
    console.print(f"wrote       {config.out}/{{capture,truth}}", markup=False)


def shown(scanned: Body, config: Config, planned: Plan, console: Console) -> Iterator[Scan]:
    """Take the images, in order, and show how far it is."""
    scan_seed = int(np.random.SeedSequence([config.seed, 1]).generate_state(1)[0])
    with Progress(console=console, transient=True, disable=not console.is_terminal) as progress:
        taken = scans(scanned, config.ultrasound, planned.truth.poses, scan_seed)
        yield from progress.track(taken, total=len(planned.times), description="rendering B-scans")
