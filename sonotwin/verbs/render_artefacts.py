"""Render the artefacts of an acceptance test in the prescribed places, as `sonotwin certify` reads them.

Ten spheres, seven ball bars and six planes over the volume of the certificates, each a capture with its ground truth:
OUT/sphere/00/capture, OUT/bar/00/capture, OUT/plane/00/capture and so on. Sizes are drawn within the certificates, and the room's
temperature within its limits, from the seed; the artefacts' form and paint are perfect. Nothing stands behind them. Takes about
five seconds a place on two cores for the usual rig's megapixel; with few rays a pixel, such as two, the rims of balls are noisy.
A place that is there already is rendered again. Of a phantom with filaments five B-scans are rendered, OUT/filaments/00/0000.png
and so on.

    sonotwin render-artefacts out=outputs/acceptance
    sonotwin render-artefacts conditions=lifelike out=outputs/acceptance
    sonotwin render-artefacts artefacts=filaments out=outputs/scanner
"""

from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from recon.acceptance import prescribed_places
from recon.acceptance.certificates import Artefacts
from recon.capture.images import write_images
from recon.capture.manifest import image_name
from recon.model.part import Part
from recon.model.patterns import Patterns
from recon.model.rig import Rig
from sonotwin.console_watch import LineConsole
from sonotwin.verbs import render
from twin.conditions import Conditions
from twin.experiments import drawn_artefacts, filament_scans
from twin.optics import surface_session
from twin.optics.light_transport import Tracing
from twin.ultrasound.transducer import Transducer


class Config(Part):
    """Fields of `conf/render-artefacts.yaml`."""

    rig: Rig
    artefacts: Artefacts
    patterns: Patterns
    tracing: Tracing
    conditions: Conditions
    out: Path
    cameras: Annotated[list[surface_session.CameraName], Field(min_length=1)]
    seed: Annotated[int, Field(ge=0)]
    shooting: surface_session.Shooting
    ultrasound: Transducer


def run(config: Config) -> None:
    """Render, and say what was written."""
    console = LineConsole()
    for name, scene in scenes(config.artefacts, config.seed).items():
        console.print(f"place       {name}", markup=False)
        fields = config.model_dump(exclude={"artefacts", "out", "ultrasound"})
        render.run(render.Config(**fields, scene=scene, out=config.out / name))
    if config.artefacts.filaments is not None:
        images = np.stack(filament_scans.render(config.artefacts.filaments, config.ultrasound, config.seed))
        place = config.out / "filaments/00"
        console.print(f"place       {place.relative_to(config.out)}", markup=False)
        place.mkdir(parents=True, exist_ok=True)
        write_images([place / image_name(number) for number in range(len(images))], images)
    console.print(f"wrote       {config.out}", markup=False)


def scenes(artefacts: Artefacts, seed: int) -> dict[str, dict[str, Any]]:
    """Fields of a scene for each place, by the place's name."""
    actual, volume, found = drawn_artefacts.draw(artefacts, np.random.default_rng(seed)), artefacts.volume, {}
    if artefacts.sphere is not None:
        for k, centre in enumerate(prescribed_places.spheres(volume, artefacts.sphere.diameter.mm).tolist()):
            sphere = {"kind": "sphere", "radius_mm": actual.radius_mm, "centre_mm": centre, "background_mm": None}
            found[f"sphere/{k:02d}"] = sphere
    if artefacts.bar is not None:
        ball = max(one.mm for one in artefacts.bar.diameters)
        for k, (middle, along) in enumerate(zip(*prescribed_places.bars(volume, artefacts.bar.length.mm, ball), strict=True)):
            found[f"bar/{k:02d}"] = {
                "kind": "ball_bar",
                "length_mm": actual.length_mm,
                "ball_mm": 2 * actual.ball_radius_mm,
                "rod_mm": artefacts.bar.rod_mm,
                "middle_mm": middle.tolist(),
                "turn_deg": float(np.rad2deg(np.arctan2(along[1], along[0]))),
                "rise_deg": float(np.rad2deg(np.arcsin(along[2]))),
                "background_mm": None,
            }
    if artefacts.plane is not None:
        for k, (middle, tilt) in enumerate(zip(*prescribed_places.planes(volume), strict=True)):
            size = artefacts.plane.size_mm
            found[f"plane/{k:02d}"] = {"kind": "plane", "centre_mm": middle.tolist(), "tilt_deg": tilt.tolist(), "size_mm": size}
    return found
