"""The verbs that render a whole session into one capture: board, fringes, filmed sweeps over wires, a bottom and the phantom."""

from collections.abc import Iterator, Sequence
from importlib import import_module
from pathlib import Path

from recon.probe_calibration.sound_in_water import speed_of_sound
from sonotwin import latency_fields
from sonotwin.config import load
from sonotwin.demo_config import BOARD_PATTERNS, WATER_C
from sonotwin.verbs import calibrate_optics, calibrate_probe

TISSUE_M_S = 1450.0  # of the phantom's silicone
WATER_SIGMA_M_S = 1.5  # of a tank whose temperature is known to half a degree
WIRES, BOTTOM, SCAN, TUBE = "wires", "bottom", "scan", "tube"
TANK = ["ultrasound=water"]
INNER = ["scene=inner_cylinder", "scene.centre_mm=[4.0,-2.0,670.29]"]  # where conf/scene/cylinders.yaml has it
ALONG = ["path.start_mm=[-19.35,-2]", "path.end_mm=[27.35,-2]", "path.turn_deg=90", "path.standoff_mm=17"]


def rendering(out: Path, given: Sequence[str] = (), poses: str = "demo") -> Iterator[tuple[str, list[str]]]:
    """Verbs and their fields, in order; fields that are given go to all of them.

    poses : of the board, as in conf/poses
    """
    place = [f"out={out}", "add=true", *given]
    yield "render", ["scene=board", f"poses={poses}", f"patterns={BOARD_PATTERNS}", "cameras=[cam1,cam2]", *place]
    yield "render", ["scene=breast", *place]
    wires = ["scene=crosswire", *TANK, "path=wire", "path.count=40", "clocks.camera_hz=5"]
    yield "sweep", [*wires, "filmed=true", f"name={WIRES}", *place]
    bottom = ["scene=tank", *TANK, "path=bob", "path.seconds=6", "clocks.camera_hz=20"]
    yield "sweep", [*bottom, "filmed=true", f"name={BOTTOM}", *place]
    yield "sweep", ["scene=breast", "path=raster", "filmed=true", f"name={SCAN}", *place]


def reconstruction(session: Path, out: Path, given: Sequence[str] = ()) -> tuple[str, list[str]]:
    """The verb that reconstructs a session, and its fields, with those that are given."""
    capture = f"capture={session / 'capture'}"
    return "reconstruct", [capture, f"temperature_c={WATER_C:g}", f"tissue_m_s={TISSUE_M_S:g}", f"out={out}", *given]


def rendering_cylinders(out: Path, given: Sequence[str] = ()) -> Iterator[tuple[str, list[str]]]:
    """Verbs and their fields for the paper's cylinders, in another capture of the same rig.

    Light measures the outer one; then that is taken away, and ultrasound measures the inner one, which stays where it is, in
    water, in 94 B-scans as in Meza et al. 2021.
    """
    place = [f"out={out}", "add=true", *given]
    yield "render", ["scene=cylinders", *place]
    yield "sweep", [*INNER, *TANK, "path=stroke", *ALONG, "clocks.camera_hz=20", "filmed=true", f"name={TUBE}", *place]


def reconstruction_of_cylinders(session: Path, calibrated: Path, out: Path, given: Sequence[str] = ()) -> tuple[str, list[str]]:
    """The verb that reconstructs the cylinders by the calibrations of a session's reconstruction, and its fields."""
    optics, probe = calibrated / "optics" / calibrate_optics.OPTICS, calibrated / "probe" / calibrate_probe.PROBE
    known = [f"calibration={optics}", f"probe={probe}", *latency_fields.measured(calibrated / "latency").fields]
    known += [f"tissue_m_s={speed_of_sound(WATER_C)}", f"tissue_sigma_m_s={WATER_SIGMA_M_S}"]
    return "reconstruct", [f"capture={session / 'capture'}", "find=tube", *known, f"out={out}", *given]


def do(verb: str, fields: Sequence[str]) -> int:
    """Run a verb; returns its exit status."""
    module = import_module(f"sonotwin.verbs.{verb.replace('-', '_')}")
    return module.run(load(verb, fields, module.Config)) or 0
