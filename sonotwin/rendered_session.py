"""A whole session, rendered: the board, the scene by light, and filmed sweeps over crossed wires, a flat bottom and the scene.

All are parts of one capture, which `sonotwin reconstruct` takes as it is. The demonstration, the sessions of accuracy, and tests
render theirs here.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from math import inf
from pathlib import Path
from typing import Annotated

from pydantic import Field, model_validator

from recon.model.rig import Positive
from scenes.acoustics import made_of
from sonotwin import choices
from sonotwin.verbs import render, sweep
from twin.optics.light_transport import Samples
from twin.ultrasound.sweep_session import AnyPath
from twin.ultrasound.timed_sweep import Clocks
from twin.ultrasound.transducer import Transducer, check_scanner

WATER_C, WATER_SIGMA_M_S = (
    22.0,
    1.5,
)  # of the tank, as `scenes.acoustics` has it; and of water whose temperature is known to half a degree
WIRES, BOTTOM, SCAN, TUBE = "wires", "bottom", "scan", "tube"  # names of sweeps
RESTING_HZ = 5.0  # pairs of frames, while the probe is held still for each B-scan of the wires
TANK_HZ = 20.0  # pairs of frames along the inner cylinder, whose tank takes no more
HIDDEN = ("tumour", "mass")  # names of the things that ultrasound looks for
INNER_MM = (4.0, -2.0, 670.29)  # the inner cylinder's centre, where conf/scene/cylinders.yaml has it


class Settings(render.Config):
    """What a session is rendered from: the fields of `sonotwin render`, of which poses are the board's; and of its sweeps."""

    ultrasound: Transducer
    path: AnyPath | None
    clocks: Clocks = Clocks(camera_hz=16.0)
    wires: Annotated[int, Field(ge=1, le=1000)] = 30
    bottom_s: Positive = 4.0
    board_samples: Samples | None = 8  # rays a pixel of the board's images at most

    @model_validator(mode="after")
    def _fits_poses(self) -> "Settings":
        # in place of render's check of that name: here poses are of the board, rendered by itself, and the scene is another
        return self

    @model_validator(mode="after")
    def _one_scanner(self) -> "Settings":
        check_scanner(self.rig, self.ultrasound)
        return self

    @property
    def looks_inside(self) -> bool:
        """Whether the scene is swept over: a path was given, and there is something to find."""
        none = any(self.scene.get(name) in ([], ()) for name in ("tumours", "masses"))
        return self.path is not None and not none and not made_of(str(self.scene["kind"])).keys().isdisjoint(HIDDEN)


@dataclass(frozen=True)
class Rendering:
    """A part of a session, to be rendered by `sonotwin render` or `sonotwin sweep`."""

    name: str  # in one word
    does: str  # for people
    verb: str
    settings: render.Config | sweep.Config

    def run(self) -> None:
        """Render it."""
        if isinstance(self.settings, sweep.Config):
            sweep.run(self.settings)
        else:
            render.run(self.settings)


def parts(chosen: Settings, out: Path, bottom_hz: float = inf) -> Iterator[Rendering]:
    """All parts of a session, in their order: the scene first, of which there is soon something to see.

    bottom_hz : pairs of frames at most, over the flat bottom
    """
    images = f"render {chosen.patterns.count} images of the scene and its truth"
    yield Rendering("render", images, "render", skin(chosen, out))
    if chosen.poses is not None:
        yield Rendering("board", f"render the calibration board in {chosen.poses.count} poses", "render", board(chosen, out))
    if not chosen.looks_inside:
        return
    rests, clocks = choices.read("path", "wire"), chosen.clocks
    wires = {
        "scene": choices.read("scene", "crosswire"),
        "ultrasound": _in_water(chosen),
        "path": rests | {"count": chosen.wires},
    }
    resting = clocks.model_copy(update={"camera_hz": RESTING_HZ})
    yield _swept(
        chosen, out, WIRES, f"render {chosen.wires} B-scans of crossed wires, and frames of both cameras", wires, resting
    )
    bob = choices.read("path", "bob") | {"seconds": chosen.bottom_s}
    bottom = {"scene": choices.read("scene", "tank"), "ultrasound": _in_water(chosen), "path": bob}
    slower = clocks.model_copy(update={"camera_hz": min(clocks.camera_hz, bottom_hz)})
    yield _swept(chosen, out, BOTTOM, "render a flat bottom, up and down", bottom, slower)
    scan = {name: getattr(chosen, name) for name in ("scene", "ultrasound", "path", "living")}
    yield _swept(chosen, out, SCAN, "render a sweep over the scene: B-scans, frames, and their truth", scan, clocks)


def board(chosen: Settings, out: Path, add: bool = True) -> render.Config:
    """Settings of the calibration board, which has an exposure and a number of rays of its own."""
    assert chosen.poses is not None
    shooting = chosen.shooting.model_copy(update={"exposure_s": None})
    tracing = chosen.tracing
    if chosen.board_samples is not None:
        tracing = tracing.model_copy(update={"samples": min(tracing.samples, chosen.board_samples)})
    own = {
        "scene": choices.read("scene", "board"),
        "patterns": choices.read_patterns("paper_calibration"),
        "cameras": ["cam1", "cam2"],
    }
    own |= {"poses": chosen.poses, "shooting": shooting, "tracing": tracing, "out": out, "add": add}
    return render.Config.model_validate(_shared(chosen) | own)


def skin(chosen: Settings, out: Path) -> render.Config:
    """Settings of the scene under fringes."""
    own = {name: getattr(chosen, name) for name in ("scene", "patterns", "cameras", "shooting", "living", "images_hz")}
    return render.Config.model_validate(_shared(chosen) | own | {"out": out, "add": True})


def cylinders(chosen: Settings, out: Path) -> Iterator[Rendering]:
    """The paper's cylinders, in another capture of the same rig.

    Light measures the outer one; then that is taken away, and ultrasound measures the inner one, which stays where it is, in
    water, in 94 B-scans as in Meza et al. 2021.
    """
    outer = chosen.model_copy(update={"scene": choices.read("scene", "cylinders")})
    yield Rendering("render", "render images of the outer cylinder", "render", skin(outer, out))
    along = {"start_mm": (-19.35, -2), "end_mm": (27.35, -2), "turn_deg": 90, "standoff_mm": 17}
    scene = choices.read("scene", "inner_cylinder") | {"centre_mm": list(INNER_MM)}
    fields = {"scene": scene, "ultrasound": _in_water(chosen), "path": choices.read("path", "stroke") | along}
    clocks = chosen.clocks.model_copy(update={"camera_hz": TANK_HZ})
    yield _swept(chosen, out, TUBE, "render a sweep along the inner cylinder", fields, clocks)


def _swept(chosen: Settings, out: Path, name: str, does: str, fields: dict, clocks: Clocks) -> Rendering:
    shared = {"rig": chosen.rig, "conditions": chosen.conditions, "seed": chosen.seed, "clocks": clocks}
    settings = sweep.Config.model_validate({**shared, **fields, "filmed": True, "name": name, "out": out, "add": True})
    return Rendering(name, does, "sweep", settings)


def _shared(chosen: Settings) -> dict:
    return {name: getattr(chosen, name) for name in ("rig", "tracing", "seed", "conditions")}


def _in_water(chosen: Settings) -> Transducer:
    """The scanner as it is set for water, its images as over the scene."""
    in_water = Transducer.model_validate(choices.read("ultrasound", "water"))
    same = {"image_size": chosen.ultrasound.image_size, "scale_mm_per_px": chosen.ultrasound.scale_mm_per_px}
    return Transducer.model_validate(in_water.model_dump() | same)
