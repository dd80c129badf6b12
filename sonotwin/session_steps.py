"""The verbs that render a whole session into one capture: board, fringes, filmed sweeps over wires, a bottom and the phantom."""

from collections.abc import Iterator, Sequence
from importlib import import_module
from pathlib import Path

from sonotwin.config import load
from sonotwin.demo_config import BOARD_PATTERNS, WATER_C

TISSUE_M_S = 1450.0  # of the phantom's silicone
WIRES, BOTTOM, SCAN = "wires", "bottom", "scan"
TANK = ["ultrasound=water"]


def rendering(out: Path, given: Sequence[str] = ()) -> Iterator[tuple[str, list[str]]]:
    """Verbs and their fields, in order; fields that are given go to all of them."""
    place = [f"out={out}", "add=true", *given]
    yield "render", ["scene=board", "poses=demo", f"patterns={BOARD_PATTERNS}", "cameras=[cam1,cam2]", *place]
    yield "render", ["scene=breast", *place]
    wires = ["scene=crosswire", *TANK, "path=wire", "path.count=40", "clocks.camera_hz=5"]
    yield "sweep", [*wires, "filmed=true", f"name={WIRES}", *place]
    bottom = ["scene=tank", *TANK, "path=bob", "path.seconds=6", "clocks.camera_hz=20"]
    yield "sweep", [*bottom, "filmed=true", f"name={BOTTOM}", *place]
    yield "sweep", ["scene=breast", "path=raster", "filmed=true", f"name={SCAN}", *place]


def reconstruction(session: Path, out: Path) -> tuple[str, list[str]]:
    """The verb that reconstructs a session, and its fields."""
    capture = f"capture={session / 'capture'}"
    return "reconstruct", [capture, f"temperature_c={WATER_C:g}", f"tissue_m_s={TISSUE_M_S:g}", f"out={out}"]


def do(verb: str, fields: Sequence[str]) -> int:
    """Run a verb; returns its exit status."""
    module = import_module(f"sonotwin.verbs.{verb.replace('-', '_')}")
    return module.run(load(verb, fields, module.Config)) or 0
