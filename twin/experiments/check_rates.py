"""Rates at which the check of a rig finds and names what has moved, and of its false alarms: rows of the table of accuracy."""

from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from recon.geometry import rigid
from recon.model.calibration import DRIFT_PX, PRINT_SCALE, Calibration, Uncertainty, in_use
from recon.model.rig import Rig
from recon.model.tracks import Track
from recon.rig_check import verdicts
from recon.rig_check.bottom_equations import Known
from recon.rig_check.verdicts import Optics, Verdict
from scenes.board_poses import Config as Poses
from twin import conditions
from twin.conditions import IDEAL, Conditions
from twin.experiments import drawn_check, drawn_session
from twin.experiments.drawn_check import Clocks, Devices
from twin.experiments.drawn_session import Eye, Noise
from twin.experiments.table_rows import Measurement, Row, Setup
from twin.ultrasound.transducer import Transducer

Array = NDArray[np.float64]
Moves = Mapping[str, Callable[[Devices, np.random.Generator], Devices]]

RIGS = 100
ALARM_SIGMA = 3.2  # as `sonotwin check` has it
TURN_DEG, SHIFT_MM, BEND_MM, LAG_S = 0.02, 0.1, 0.3, 0.01
KNOWN_LAG_S, LAG_SIGMA_S, SPEED_MM_S = 0.05, 0.001, 10.0
FACE_MM, SECONDS, CAMERA_HZ = (4.0, -2.0, 672.0), 10.0, 40.0  # of the array over the bottom
SEED = 2027
TARGET_MM = 0.01  # standard deviation of the target's lengths, as calibrate-target measures them
WARM_PX = 0.02  # drift of devices that were warm, in a room of one temperature, when they were calibrated and checked
BOTH, COLUMNS = (0, 1), (0,)  # axes of the fringes


def _unit(rng: np.random.Generator) -> Array:
    direction = rng.standard_normal(3)
    return direction / np.linalg.norm(direction)


MOVES: Moves = {
    "none": lambda devices, rng: devices,
    "cam1": partial(drawn_check.turned, device="cam1", angle_deg=TURN_DEG),
    "cam2": partial(drawn_check.turned, device="cam2", angle_deg=TURN_DEG),
    "projector": lambda devices, rng: drawn_check.shifted(devices, "projector", SHIFT_MM * _unit(rng)),
    "projector, columns": lambda devices, rng: drawn_check.shifted(devices, "projector", SHIFT_MM * _unit(rng)),
    "projector, baseline": lambda devices, rng: drawn_check.shifted(devices, "projector", np.array([SHIFT_MM, 0, 0])),
}


class Rates(NamedTuple):
    """Counts over drawn rigs."""

    rigs: int
    alarms: int  # rigs of which nothing moved, and something is told to have
    found: Counter[str]  # by the move: what moved is among those that are told to have
    named: Counter[str]  # the same, and it alone


class Laboratory(NamedTuple):
    """A calibrated rig, and how it is used."""

    rig: Rig
    life: Conditions
    optics: Calibration
    known: Uncertainty  # of it, when it is checked


def measurements(setup: Setup) -> list[Measurement]:
    """The rows of the part."""
    return [lambda: rows(setup)]


def rows(setup: Setup, rigs: int = RIGS) -> list[Row]:
    """Rows h: over rigs drawn from a calibration of theory, and from one of a laboratory."""
    measured = {"": IDEAL} | ({", calibrated in a laboratory": setup.lifelike} if setup.lifelike else {})
    found = [
        row for words, life in measured.items() for row in _rows(rates(setup.rig, life, setup.scanners["water"], rigs), words)
    ]
    return found + list(_warm_rows(warm_rates(setup.rig, rigs)))


def _rows(counted: Rates, words: str) -> Iterator[Row]:
    bars = {"cam1": 0.95, "cam2": 0.95, "projector": 0.95, "probe": 0.95, "clock": 0.95}
    texts = {
        "cam1": f"camera 1 turned by {TURN_DEG} deg",
        "cam2": f"camera 2 turned by {TURN_DEG} deg",
        "projector": f"projector shifted by {SHIFT_MM} mm any way, fringes along both axes",
        "projector, columns": "the same, vertical fringes alone, which don't show two of three ways",
        "projector, baseline": f"projector shifted by {SHIFT_MM} mm towards camera 1, which looks like drift",
        "probe": f"bracket bent by {BEND_MM} mm",
        "clock": f"clock off by {1e3 * LAG_S:g} ms",
    }  # fmt: skip
    for move, text in texts.items():
        share = counted.named[move] / counted.rigs
        yield Row("h", f"{text}{words}, {counted.rigs} rigs: found and named", share, bars.get(move), None, "", at_least=True)
    shifted = f"{texts['projector']}{words}, {counted.rigs} rigs: found, and named alone or with another part"
    yield Row("h", shifted, counted.found["projector"] / counted.rigs, None, None, "")
    yield Row("h", f"nothing moved{words}: false alarms", counted.alarms / counted.rigs, 0.02, None, "")


def _warm_rows(counted: Rates) -> Iterator[Row]:
    text = f"projector shifted by {SHIFT_MM} mm any way, drift of {WARM_PX} px, {counted.rigs} rigs: found and named"
    yield Row("h", text, counted.named["projector"] / counted.rigs, 0.95, None, "", at_least=True)
    yield Row("h", f"nothing moved, drift of {WARM_PX} px: false alarms", counted.alarms / counted.rigs, 0.02, None, "")


def rates(rig: Rig, life: Conditions, transducer: Transducer, rigs: int) -> Rates:
    """Draw rigs from one calibration, and check each as it is and with one part moved."""
    lab = laboratory(rig, life, DRIFT_PX)
    return _counted(lambda k, true: _optics(lab, MOVES, true, k) | _tank(lab, true, transducer, k), lab, rigs)


def warm_rates(rig: Rig, rigs: int) -> Rates:
    """The same of devices that drift less, with a projector that was shifted."""
    lab, moves = laboratory(rig, IDEAL, WARM_PX), {move: MOVES[move] for move in ("none", "projector")}
    return _counted(lambda k, true: _optics(lab, moves, true, k), lab, rigs)


def laboratory(rig: Rig, life: Conditions, drift_px: float) -> Laboratory:
    """A laboratory, calibrated once."""
    optics = drawn_session.calibrated_optics(rig, life, Noise(), Poses(), SEED)
    known = in_use(optics.uncertainty, optics.cameras, PRINT_SCALE, drift_px)
    assert known is not None
    return Laboratory(rig, life, optics, known)


def _counted(checked: Callable[[int, Devices], dict[str, list[Verdict]]], lab: Laboratory, rigs: int) -> Rates:
    """Counts over drawn rigs, of the verdicts on each by the move."""
    alarms, found, named = set(), Counter(), Counter()
    for k in range(rigs):
        true = drawn_check.drawn_rig(lab.optics.cameras, lab.known, np.random.default_rng([SEED, k, 0]))
        for move, seen in checked(k, true).items():
            moved = {one.part for one in seen if one.state == "moved"}
            part = move.partition(",")[0]
            if part.startswith("none"):
                alarms |= {k} if moved else set()
                continue
            rivals = {one.part for one in seen if one.state == "maybe"}
            found[move] += part in moved | rivals
            named[move] += moved == {part} and not rivals
    return Rates(rigs, len(alarms), found, named)


def _optics(lab: Laboratory, moves: Moves, true: Devices, k: int) -> dict[str, list[Verdict]]:
    """Verdicts on the devices, by a film and fringes, after each move."""
    told, known = {}, lab.optics.cameras
    for number, (move, change) in enumerate(moves.items()):
        rng = np.random.default_rng([SEED, k, 1, number])
        moved, axes = change(true, rng), COLUMNS if move.endswith("columns") else BOTH
        printed = conditions.printed(lab.rig.target, lab.life.target, int(rng.integers(2**31)))
        target = drawn_check.measured(printed, TARGET_MM, rng)
        film = drawn_check.drawn_film(moved, known, printed, Noise().circle_px, rng)
        matches = drawn_check.drawn_matches(moved, known, axes, Noise().column_px, rng)
        told[move] = verdicts.of_optics(Optics(film, matches), lab.optics, lab.known, target, ALARM_SIGMA)
    return told


def _tank(lab: Laboratory, true: Devices, transducer: Transducer, k: int) -> dict[str, list[Verdict]]:
    """Verdicts on probe and clock: as they are, with a bent bracket, and with a clock that is off."""
    rig, optics, pair = lab.rig, lab.optics, (true["cam1"], true["cam2"])
    eye = Eye(pair, drawn_session.pair(optics), lab.known, rig.target, rig.target, Noise().circle_px, 1.0)
    probe = drawn_session.calibrated_probe(rig, eye, lab.life, Noise(), 1.0, transducer, k)
    scale, size, design = np.array(rig.probe.scale_mm_per_px), rig.probe.image_size, rig.probe.target_from_image.matrix()
    middle = np.append(scale * size / 2, 0)
    told = {}
    for number, move in enumerate(("none over the bottom", "probe", "clock")):
        rng = np.random.default_rng([SEED, k, 2, number])
        path = drawn_check.led_over_bottom(np.array(FACE_MM), SECONDS, CAMERA_HZ, rng)
        held = drawn_check.bent(design, middle, BEND_MM, rng) if move == "probe" else design
        carried = Track(path.times, path.poses @ rigid.invert(held))
        track = drawn_check.drawn_track(true, optics.cameras, rig.target, carried, Noise().circle_px, rng)
        clocks = Clocks(KNOWN_LAG_S + (LAG_S if move == "clock" else 0.0))
        lines = drawn_check.drawn_lines(path, scale, size, clocks, rng)
        calibrated = Known(probe, KNOWN_LAG_S + LAG_SIGMA_S * float(rng.standard_normal()), LAG_SIGMA_S)
        told[move] = verdicts.of_bottom(lines, track, calibrated, size, SPEED_MM_S, ALARM_SIGMA)[0]
    return told
