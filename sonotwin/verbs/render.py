"""Render a capture of a scene, as the rig's cameras would have taken it, with its ground truth.

Reads the rig, the scene, the patterns and the engine's settings from conf/. Writes OUT/capture/, which the pipeline reads like
any hardware's, and OUT/truth/, which only evaluation opens: points, normals, projector coordinates, the true calibration.
Takes about five seconds a camera for nine patterns on two cores, and once ten seconds more to compile.

    sonotwin render scene=sphere patterns=gray_surface out=outputs/sphere
"""

from pathlib import Path
from time import perf_counter
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field, model_validator
from rich.console import Console

from recon import atomic, capture
from recon.patterns import Patterns
from recon.rig import Rig
from scenes.catalogue import build_scene
from twin import session
from twin.optics.transport import Engine


class Config(BaseModel):
    """Fields of `conf/render.yaml`."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    rig: Rig
    scene: dict
    patterns: Patterns
    engine: Engine
    out: Path
    cameras: Annotated[list[session.CameraName], Field(min_length=1)]
    seed: Annotated[int, Field(ge=0)]
    shooting: session.Shooting

    @model_validator(mode="after")
    def _fits(self) -> "Config":
        raster, shown = self.rig.projector.optics.size, self.patterns.projector_size
        if shown != raster:
            raise ValueError(f"patterns.projector_size: expected the rig's {list(raster)}, found {list(shown)}")
        for camera in self.cameras:
            adc = getattr(self.rig, camera).sensor.adc_bits
            if self.shooting.bits > adc:
                raise ValueError(f"shooting.bits: expected at most the {adc} of {camera}'s ADC, found {self.shooting.bits}")
        return self


def run(config: Config) -> None:
    """Render, and say what was written."""
    console = Console(soft_wrap=True, highlight=False)
    for folder, marker in (("truth", session.TRUTH_MARKER), ("capture", capture.MANIFEST)):
        atomic.check_folder(config.out / folder, marker)
    scene = build_scene(config.scene)
    views = {}
    for camera in dict.fromkeys(config.cameras):
        start = perf_counter()
        with console.status(f"rendering {config.patterns.count} patterns for {camera}"):
            view = session.shoot(config.rig, scene, config.patterns, camera, config.engine, config.shooting, config.seed)
        views[camera] = view
        console.print(
            f"render      {camera}, {config.patterns.count} patterns, {config.engine.samples} samples/px, "
            f"exposure {view.exposure.time_s * 1e3:.2f} ms, {perf_counter() - start:.1f} s"
        )
    session.write_session(config.out, config.rig, scene, config.patterns, views, config.model_dump(mode="json", exclude={"out"}))
    console.print(f"wrote       {config.out}/{{capture,truth}}", markup=False)
