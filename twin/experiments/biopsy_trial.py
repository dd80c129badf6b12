"""A virtual trial: a needle is led by navigation to a mass of a patient, and its tip's distance from the mass is known.

A patient has a rig, a hand and tissue of her own, and some cores. The planned place is the mass's centre by the reconstructed
session. The needle's tip is by the same cameras, so what errs alike in both cancels. All errors are vectors in the world, of the
tip less the mass as it lies at that moment, and add up; without one of them the others stay as they were.

The planned place is drawn (`drawn_session`, the real software after the detectors), or rendered whole: board, wires and a filmed
sweep over a patient, from whose images the real software calibrates, tracks and segments. All else is drawn, the same in both.

Sources, beside what is assumed: speed of sound in whole breasts, 1463 +- 29 m/s in 43 volunteers [ultrasound tomography 2017];
novices' distance of the tip from the target, 4.26 +- 2.87 mm, in a phantom by electromagnetic navigation [Na 2013]; attending
radiologists' one, 2.6 +- 1.1 mm, likewise [Appelbaum 2011]; deflection of the tip, 1.77 mm in the median of prostate biopsies
[Halstuch 2018]. The distances hold what those trackers err by, too, and are of targets deeper than a breast's: hands are rather
better than drawn here. docs/references.md has all four.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import NamedTuple, get_args

import numpy as np
from numpy.typing import NDArray

from recon.errors import InputError
from recon.files.metrics import Metrics
from recon.geometry import rigid
from recon.model import circle_layout
from recon.model.calibration import DRIFT_PX, PRINT_SCALE, Calibration, in_use
from recon.model.rig import Rig, Target
from recon.optical_calibration.joint_calibration import calibrate
from recon.tip_calibration import pivot
from scenes.acoustics import TISSUES
from scenes.anatomy import GLANDULAR, Density
from twin import conditions
from twin.evaluation import sweep_errors
from twin.experiments import calibration_trial, chain_trial, drawn_session, patient_trial, rehearsal
from twin.experiments.board_sets import rendered
from twin.experiments.drawn_session import Eye, pair
from twin.experiments.experiment_runs import Biopsy, Experiment, Settings
from twin.experiments.rehearsal import Stage
from twin.filmed_sweep import SweepSettings, plan_sweep
from twin.living.living_body import breath, pulse
from twin.optics.surface_session import calibration_of
from twin.shooting import FrameShooting
from twin.ultrasound.probe_path import SurfacePath
from twin.ultrasound.timed_sweep import Clocks
from twin.working_range import working_range

Array = NDArray[np.float64]

NEEDLE = "needle"  # of rig.bodies
CORES = 4  # of a mass; assumed
TOLD_M_S = 1463.0  # that the software is told: the mean of breasts
SHARE = 0.1  # standard deviation of the share of gland on a beam's way, about that of the breast; assumed
SCAN_MM = 0.57  # along each axis: of masses in patients of study `patients`, pressed and breathing, the median error is 1.0 mm,
# of which 0.5 mm are the speed that it is told
LIVING = patient_trial.LIVING
DEFLECTION_MM = (
    0.55  # across the shaft, along each axis, of 14 G: 1.77 mm in the median of prostate biopsies, if these are of 18 G,
)
# force grows with the square of the diameter (2.1 over 1.27 mm) and stiffness with its fourth power; all three assumed
DEEP_MM = chain_trial.DEEP_MM
# from the target's middle to the tip; slope and bearing beside x, by which both cameras see the target; assumed
SHAFT_MM, RISE_DEG, ASIDE_DEG = 100.0, (40.0, 55.0), 25.0
PIVOTS, PIVOT_DEG = 25, 25.0  # frames in which the tip is calibrated, and their tilts about each axis
WORN = 3.0  # drift and bracket of a worn rig over usual ones; assumed: ten times the drift, the target isn't tracked any more
LATENCY_S = 0.1  # from a frame to the screen and the hand; assumed
PUSHED_MM = 0.5  # standard deviation of a mass's way before the needle, in scattered tissue; assumed
SHIFT_MM = 0.5  # along each axis, by which she has moved since the scan, and isn't tracked; assumed
SOFTER = {"fatty": 1.4, "scattered": 1.0, "heterogeneous": 0.85, "dense": 0.7}  # tissue, which yields by that much more; assumed
STROKE = SurfacePath(start_mm=(-14.0, -24.0), end_mm=(-14.0, 24.0), speed_mm_s=15.0, standoff_mm=-2.0)
CLOCKS = Clocks(scanner_hz=15.0, camera_hz=7.5)
HIGH_MM = 42.0  # of the skin there over the chest, to a millimetre in four patients
MASS = {"size_mm": 14.0, "form": "oval", "pattern": "hypoechoic"}  # under the stroke
ARM = ("rig", "training", "tissue")  # fields that patients of one arm share


@dataclass(frozen=True)
class Hand:
    """Who leads the needle."""

    mm: float  # standard deviation along each axis of the tip on the screen from the plan
    varied: float  # of that, among people, relative; both as the sources' means and deviations ask for
    waits_s: float | None  # for the end of an expiration, to within that; None: fires at any moment; assumed
    mm_s: float  # standard deviation of the speed along the shaft when the needle is fired; assumed


HANDS = {"novice": Hand(2.67, 0.48, None, 3.0), "trained": Hand(1.63, 0.03, 0.5, 1.0)}


class Planned(NamedTuple):
    """A planned place, and the rig that it was found with."""

    errors: Mapping[str, Array]  # (3,) mm, by what they come from
    used: Calibration
    optics: Calibration


def key_of(biopsy: Biopsy, seed: int) -> list[int]:
    """Of a patient's random numbers: others in each arm of the trial, and alike for a place that is drawn and one rendered."""
    levels = (get_args(Biopsy.model_fields[name].annotation).index(getattr(biopsy, name)) for name in ARM)
    return [seed, *levels]


def measure(settings: Settings, seed: int) -> Metrics:
    """Figures of one patient's cores."""
    key = key_of(settings.biopsy, seed)
    number = int(np.random.SeedSequence(key).generate_state(1)[0] >> 1)
    of = rig_of(settings)
    planned = (rendered_place if settings.biopsy.measured == "rendered" else drawn_place)(of, number, key)
    return figures(planned.errors, needle_errors(of, planned, number, key))


def figures(planned: Mapping[str, Array], led: Mapping[str, Array]) -> Metrics:
    """Figures of n cores, by errors of the planned place : (3,) and of each core : (n, 3) mm."""
    count = len(next(iter(led.values())))
    parts = {name: planned.get(name, np.zeros(3)) + led.get(name, np.zeros((count, 3))) for name in {**planned, **led}}
    together = np.sum(list(parts.values()), axis=0)
    distances = np.linalg.norm(together, axis=1)
    found: Metrics = {"cores": count, **{f"within_{mm}_mm": int((distances < mm).sum()) for mm in (1, 2, 3)}}
    found |= {"distance_mm": float(distances.mean()), "square_mm2": float((distances**2).mean())}
    found |= {f"without_{name}_mm2": float(((together - part) ** 2).sum(axis=1).mean()) for name, part in parts.items()}
    return found | {"planned_mm": float(np.linalg.norm(np.sum(list(planned.values()), axis=0)))}


def rig_of(settings: Settings) -> Settings:
    """The settings of a rig of some quality.

    An identified one is calibrated in the same session by a board of known length; what the data sheet has is used as it is
    delivered, under the conditions that are set; a worn one has drifted thrice as much, its prints have warped to twice the
    error, its bracket is loose and its lenses are dull. All these factors are assumed.
    """
    life, noise = settings.conditions, settings.noise
    board, drift, motion, print_ = life.board, life.drift, life.motion, life.target
    if settings.biopsy.rig == "identified":
        board = board.model_copy(update={"stretch": board.stretch / 5})
        drift = drift.model_copy(update={"centre_px": 0.0, "focal": 0.0})
        print_ = print_.model_copy(update={"place_mm": print_.place_mm / 5})
    elif settings.biopsy.rig == "worn":
        drift = drift.model_copy(update={"centre_px": WORN * drift.centre_px, "focal": WORN * drift.focal})
        loose = {"bracket_mm": WORN * motion.bracket_mm, "bracket_deg": WORN * motion.bracket_deg}
        motion = motion.model_copy(update=loose)
        print_ = print_.model_copy(update={"place_mm": 2 * print_.place_mm})
        noise = noise.model_copy(update={"circle_px": 2 * noise.circle_px})
    changed = life.model_copy(update={"board": board, "drift": drift, "motion": motion, "target": print_})
    return settings.model_copy(update={"conditions": changed, "noise": noise})


def speed_of(tissue: Density, rng: np.random.Generator) -> float:
    """Speed of sound, m/s, over a mass: that of fat and gland by their shares on the way."""
    gland = float(np.clip(GLANDULAR[tissue] + SHARE * rng.standard_normal(), 0, 1))
    return 1 / (gland / TISSUES["gland"].speed + (1 - gland) / TISSUES["fat"].speed)


def drawn_place(settings: Settings, number: int, key: list[int]) -> Planned:
    """The centre of a mass by a drawn session; the scan's own error as of rendered patients."""
    where, rng = working_range(settings.rig), np.random.default_rng([*key, 70])
    sound = settings.conditions.sound.model_copy(update={"tissue": 0.0})
    life = settings.conditions.model_copy(update={"sound": sound})
    noise = settings.noise.at(where)
    found = drawn_session.draw(settings.rig, life, noise, settings.ultrasound, settings.poses, number, where)
    faster = speed_of(settings.biopsy.tissue, rng) / TOLD_M_S
    true = replace(found.true_probe, scale=found.true_probe.scale * [1.0, faster])
    by_rig = chain_trial.mass_error(found)
    by_sound = chain_trial.mass_error(replace(found, true_probe=true)) - by_rig
    return Planned({"rig": by_rig, "sound": by_sound, "scan": SCAN_MM * rng.standard_normal(3)}, found.used, found.optics)


def rendered_place(settings: Settings, number: int, key: list[int]) -> Planned:
    """The centre of a mass by rendered images of board, wires and a patient.

    Raises
    ------
    InputError
        If the mass isn't found, or something is refused.
    """
    alone = settings.model_copy(update={"rig": settings.rig.model_copy(update={"bodies": {}})})
    seen = rendered(calibration_trial.session(alone, number))
    optics = calibrate(seen.sightings, seen.board, seen.sizes).adjustment.calibration
    stage = Stage(alone, optics, settings.ultrasound.dynamic_range_db, number)
    probe = rehearsal.calibrate(stage, 1).results[0].calibration
    planned = plan_sweep(
        SweepSettings(
            rig=alone.rig,
            scene=patient(settings.biopsy.tissue, number, key),
            ultrasound=settings.ultrasound,
            path=STROKE,
            living=LIVING,
            conditions=settings.conditions.model_copy(update={"sound": conditions.Sound()}),
            clocks=CLOCKS,
            name="scan",
            filmed=True,
            frames=FrameShooting(white_dn=settings.film.white_dn, quality=rehearsal.QUALITY),
            seed=number,
        )
    )
    skin = next(thing.mesh for thing in planned.scene.things if thing.name == "breast")
    track = rehearsal.tracked(stage, planned)[0]
    error = rehearsal.mass_errors(stage, planned, track, [probe], TOLD_M_S, sweep_errors.facing(skin)).centre_mm[0]
    if not np.isfinite(error).all():
        raise InputError("masses: expected the one that was scanned, found none where it lies, so nothing is planned")
    used = calibration_of(conditions.drifted(alone.rig, settings.conditions.drift, number))
    return Planned({"scan": error}, used, optics)


def patient(tissue: str, number: int, key: list[int]) -> dict:
    """A patient with a mass under the stroke, as deep as the drawn ones."""
    aside = np.random.default_rng([*key, 71]).uniform(-3.0, 3.0, 2)
    mass = MASS | {"centre_mm": (float(STROKE.start_mm[0] + aside[0]), float(aside[1]), HIGH_MM - DEEP_MM)}
    return {"kind": "patient", "seed": number, "edge_mm": 1.5, "anatomy": {"density": tissue}, "masses": [mass]}


def needle_errors(settings: Settings, planned: Planned, number: int, key: list[int]) -> dict[str, Array]:
    """Errors : (CORES, 3) mm of the tip less the mass, beside those of the planned place, by what they come from."""
    biopsy, rng = settings.biopsy, np.random.default_rng([*key, 72])
    hand, softer, count = HANDS[biopsy.training], SOFTER[biopsy.tissue], CORES
    where = working_range(settings.rig)
    mass = np.add(where.place(*drawn_session.MIDDLE_MM), (0.0, 0.0, DEEP_MM))
    poses, tip, shafts = held(mass, target_of(settings.rig), rng, count)
    size = skill(hand, rng)
    aimed, bent, moved = rng.standard_normal((count, 3)), rng.standard_normal((count, 3)), rng.standard_normal(3)
    pushed, late, moments = np.abs(rng.standard_normal(count)), rng.standard_normal(count), rng.uniform(-0.5, 0.5, count)
    beats, high = rng.uniform(0, 1, count), float(np.exp(0.3 * rng.standard_normal()))  # of breath's height; assumed
    seconds = moments * (LIVING.breathing_s if hand.waits_s is None else 2 * hand.waits_s)
    risen = LIVING.breathing_mm * high * breath(seconds, LIVING.breathing_s, 0.0)
    risen += LIVING.heartbeat_mm * pulse(beats, 1.0, 0.0)
    across = bent - (bent * shafts).sum(axis=1, keepdims=True) * shafts
    return {
        "rig": -tip_errors(settings, planned, number, key, poses, tip),
        "hand": size * aimed,
        "needle": DEFLECTION_MM / softer * across,
        "breath": np.outer(risen, [0.0, 0.0, 1.0]),  # she rises against z
        "yielding": -softer * PUSHED_MM * pushed[:, None] * shafts,
        "shift": np.tile(SHIFT_MM * moved, (count, 1)),
        "latency": LATENCY_S * hand.mm_s * late[:, None] * shafts,
    }


def skill(hand: Hand, rng: np.random.Generator) -> float:
    """Standard deviation, mm, of one person's aim along each axis: log-normal about the mean of such people."""
    spread = np.log1p(hand.varied**2)
    return hand.mm * float(np.exp(np.sqrt(spread) * rng.standard_normal() - spread / 2))


def held(mass: Array, target: Target, rng: np.random.Generator, count: int) -> tuple[Array, Array, Array]:
    """Poses : (count, 4, 4) world_from_target of a needle's target that faces the cameras, its tip : (3,), and shafts (count, 3).

    The shaft slopes from the side of x down to the mass; the target's y axis is along it, on the way back, level.
    """
    rise = np.deg2rad(rng.uniform(*RISE_DEG))
    along = np.array([0.0, -np.cos(rise), -np.sin(rise)])
    centres = circle_layout.circles(target)[0]
    tip = (centres.min(axis=0) + centres.max(axis=0)) / 2 + SHAFT_MM * along
    bearing = np.deg2rad(ASIDE_DEG) * rng.uniform(-1, 1)
    poses = []
    for _ in range(count):
        back = bearing + np.deg2rad(2.0) * rng.standard_normal()  # of each core; assumed
        y, z = np.array([np.cos(back), np.sin(back), 0.0]), np.array([0.0, 0.0, -1.0])
        tilted = rigid.from_rotation_vector(np.deg2rad(5.0) * rng.standard_normal(3), np.zeros(3))[:3, :3]
        turn = tilted @ np.column_stack([np.cross(y, z), y, z])
        poses.append(rigid.transform(turn, mass - turn @ tip))
    found = np.stack(poses)
    return found, tip, found[:, :3, :3] @ along


def tip_errors(settings: Settings, planned: Planned, number: int, key: list[int], poses: Array, tip: Array) -> Array:
    """Errors : (n, 3) mm of the tip as it is tracked, by the rig with which the place was planned, and a tip found by pivoting.

    Raises
    ------
    InputError
        If the rig has no needle, or its target isn't seen.
    """
    design, noise = target_of(settings.rig), settings.noise.at(working_range(settings.rig))
    printed = conditions.printed(design, settings.conditions.target, number, 1)
    known = in_use(planned.optics.uncertainty, planned.optics.cameras, PRINT_SCALE, DRIFT_PX)
    drawn = noise.drawn.circle_in_scan
    eye = Eye(pair(planned.used), pair(planned.optics), known, printed, design, noise.circle_px, drawn)
    tilts = np.deg2rad(PIVOT_DEG) * np.random.default_rng([*key, 73]).uniform(-1, 1, (PIVOTS, 3))
    upright = poses[0][:3, :3]
    about = [rigid.from_rotation_vector(tilt, np.zeros(3))[:3, :3] @ upright for tilt in tilts]
    dimple = rigid.apply(poses[0], tip[None])[0]
    pivoted = seen(eye, np.stack([rigid.transform(turn, dimple - turn @ tip) for turn in about]), [*key, 74])
    whole = np.isfinite(pivoted.poses).all(axis=(1, 2))
    if whole.sum() < PIVOTS // 4:
        raise InputError(
            f"bodies.{NEEDLE}: expected to be seen while its tip is calibrated, found it in {whole.sum()} of {PIVOTS}"
        )
    found = pivot.calibrate(pivot.Frames(pivoted.poses[whole], pivoted.own[whole], pivoted.shared[whole])).tip
    led = seen(eye, poses, [*key, 75])
    if not np.isfinite(led.poses).all():
        raise InputError(f"bodies.{NEEDLE}: expected to be seen while the needle is led, found it lost")
    return (led.poses[:, :3, :3] @ found + led.poses[:, :3, 3]) - (poses[:, :3, :3] @ tip + poses[:, :3, 3])


def seen(eye: Eye, poses: Array, key: list[int]) -> drawn_session.Tracked:
    """A target at rest in n poses : (n, 4, 4) world_from_target, tracked."""
    rest = np.zeros((len(poses), 3))
    return drawn_session.look(eye, poses, np.broadcast_to(np.eye(4), poses.shape), rest[:, :2], rest, key)


def target_of(rig: Rig) -> Target:
    """The needle's target; InputError without one."""
    if NEEDLE not in rig.bodies:
        raise InputError(f"rig.bodies: expected {NEEDLE}, as in rig=three_bodies, found {', '.join(rig.bodies) or 'none'}")
    return rig.bodies[NEEDLE]


EXPERIMENT = Experiment(
    (
        "rig",
        "board",
        "board_patterns",
        "poses",
        "conditions",
        "tracing",
        "shooting",
        "film.white_dn",
        "noise",
        "wire_path",
        "ultrasound",
        "ranges",
        "biopsy",
    ),
    measure,
    {"distance_mm": "", "planned_mm": ""},
    counts=("cores", "within_1_mm", "within_2_mm", "within_3_mm"),
)
