"""Rates at which the check of a rig finds and names what has moved, and of its false alarms: rows of the table of accuracy."""

from collections import Counter, defaultdict
from collections.abc import Callable, Mapping
from functools import partial
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from recon.geometry import rigid
from recon.model.calibration import DRIFT_PX, PRINT_SCALE, Calibration, Uncertainty, in_use
from recon.model.rig import Rig
from recon.model.tracks import Track
from recon.rig_check import bottom_equations, fault_tests, verdicts
from recon.rig_check.bottom_equations import Known
from recon.rig_check.verdicts import Optics, Verdict
from scenes.board_poses import Config as Poses
from twin import conditions
from twin.conditions import IDEAL, Conditions
from twin.experiments import drawn_check, drawn_session
from twin.experiments.drawn_check import Clocks, Devices
from twin.experiments.drawn_session import Eye, Noise
from twin.experiments.experiment_setup import Figures, Setup
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


class Told(NamedTuple):
    """Of a drawn rig after a move."""

    verdicts: list[Verdict]
    limit: float = np.nan  # chance at which the best unbiased test finds the move


class Laboratory(NamedTuple):
    """A calibrated rig, and how it is used."""

    rig: Rig
    life: Conditions
    optics: Calibration
    known: Uncertainty  # of it, when it is checked


def rates(setup: Setup, life: Literal["ideal", "lifelike"], rigs: int = RIGS) -> Figures:
    """Draw rigs from one calibration, and check each as it is and with one part moved."""
    lab = laboratory(setup.rig, setup.conditions(life), DRIFT_PX)
    transducer = setup.scanners["water"]
    return _counted(lambda k, true: _optics(lab, MOVES, true, k) | _tank(lab, true, transducer, k), lab, rigs)


def warm_rates(setup: Setup, rigs: int = RIGS) -> Figures:
    """The same of devices that drift less, with a projector that was shifted."""
    lab, moves = laboratory(setup.rig, IDEAL, WARM_PX), {move: MOVES[move] for move in ("none", "projector")}
    return _counted(lambda k, true: _optics(lab, moves, true, k), lab, rigs)


def laboratory(rig: Rig, life: Conditions, drift_px: float) -> Laboratory:
    """A laboratory, calibrated once."""
    optics = drawn_session.calibrated_optics(rig, life, Noise(), Poses(), SEED)
    known = in_use(optics.uncertainty, optics.cameras, PRINT_SCALE, drift_px)
    assert known is not None
    return Laboratory(rig, life, optics, known)


def _counted(checked: Callable[[int, Devices], dict[str, Told]], lab: Laboratory, rigs: int) -> Figures:
    """Shares of drawn rigs, of the verdicts on each by the move: what moved is found, or found alone; and false alarms.

    Beside them the share that the best unbiased test finds.
    """
    alarms, found, named, limit = set(), Counter(), Counter(), defaultdict(float)
    for k in range(rigs):
        true = drawn_check.drawn_rig(lab.optics.cameras, lab.known, np.random.default_rng([SEED, k, 0]))
        for move, seen in checked(k, true).items():
            moved = {one.part for one in seen.verdicts if one.state == "moved"}
            part = move.partition(",")[0]
            if part.startswith("none"):
                alarms |= {k} if moved else set()
                continue
            rivals = {one.part for one in seen.verdicts if one.state == "maybe"}
            found[move] += part in moved | rivals
            named[move] += moved == {part} and not rivals
            limit[move] += seen.limit
    sizes = {"turn_deg": TURN_DEG, "shift_mm": SHIFT_MM, "bend_mm": BEND_MM, "lag_ms": 1e3 * LAG_S, "warm_px": WARM_PX}
    counts = {"found": found, "named": named, "limit": limit}
    shares = {f"{move}: {how}": count[move] / rigs for how, count in counts.items() for move in count}
    return sizes | shares | {"rigs": rigs, "alarms": len(alarms) / rigs}


def _optics(lab: Laboratory, moves: Moves, true: Devices, k: int) -> dict[str, Told]:
    """Verdicts on the devices, by a film and fringes, after each move."""
    told, known = {}, lab.optics.cameras
    for number, (move, change) in enumerate(moves.items()):
        rng = np.random.default_rng([SEED, k, 1, number])
        moved, axes = change(true, rng), COLUMNS if move.endswith("columns") else BOTH
        printed = conditions.printed(lab.rig.target, lab.life.target, int(rng.integers(2**31)))
        target = drawn_check.measured(printed, TARGET_MM, rng)
        film = drawn_check.drawn_film(moved, known, printed, Noise().circle_px, rng)
        matches = drawn_check.drawn_matches(moved, known, axes, Noise().column_px, rng)
        seen, part = Optics(film, matches), move.partition(",")[0]
        equations = verdicts.equations_of(seen, lab.optics, lab.known, target)
        told[move] = Told(verdicts.of_equations(equations, seen, lab.optics, target, ALARM_SIGMA))
        if part in moved:
            motion = rigid.difference(true[part].camera_from_world, moved[part].camera_from_world)
            told[move] = told[move]._replace(limit=fault_tests.best_chance(equations, part, motion, ALARM_SIGMA))
    return told


def _tank(lab: Laboratory, true: Devices, transducer: Transducer, k: int) -> dict[str, Told]:
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
        told[move] = Told(verdicts.of_bottom(lines, track, calibrated, size, SPEED_MM_S, ALARM_SIGMA)[0])
        motion = {"probe": rigid.difference(design, held), "clock": np.array([LAG_S])}.get(move)
        if motion is not None:
            bottom = bottom_equations.fit(lines, track, calibrated)
            equations = bottom_equations.equations(lines, track, calibrated, bottom)
            limit = fault_tests.best_chance(equations, move, motion, ALARM_SIGMA)
            told[move] = told[move]._replace(limit=limit)
    return told
