"""A virtual biopsy of a mass that a session placed: distance of the needle's tip from the mass's middle, by drawn measurements.

A patient, a hand and a rig are drawn by the seed. The rig is calibrated and the breast swept as in `drawn_session`, by the real
software; so the mass's place has the errors of optics, probe, tracking, latency and of the speed of sound, which is taken as that
of a mixed breast. A needle with a target of its own is calibrated by pivoting, and led until the display has its tip on the
mass. Then

    miss = planned place - true place + aim - error of the displayed tip + deflection - motion of the mass since the sweep

and what the cameras err by alike in sweep and puncture cancels, as it does on a rig.

Assumed, as no published figure of this setting is known to us: a hand's error against the display; how far a needle pushes a
mass; a breath held as it was while swept. Sources of the rest: speeds of sound of fat and gland, `scenes.acoustics`; share of
pressed tissue's motion that is left, `recon.segmentation.rest`; deflection 0.9 mm in the mean of an 18 G needle with a lancet
tip, fired into gel [Stone et al. 2017]. Planned places err by the segmentation, too, by as much as in rendered sessions.

Published beside it: 87 and 92 % of 180 biopsies by an electromagnetically tracked needle hit spheres of 10 mm [Ewertsen 2011],
within 5 mm of the middle.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from recon.files.metrics import Metrics
from recon.geometry import rigid
from recon.model.calibration import DRIFT_PX, PRINT_SCALE, in_use
from recon.model.rig import Rig, Target
from recon.tip_calibration import pivot
from scenes.acoustics import TISSUES
from twin import conditions
from twin.conditions import Conditions
from twin.experiments import chain_trial, drawn_session
from twin.experiments.drawn_session import Eye, Noise, Session
from twin.experiments.experiment_runs import Biopsy, Experiment, Settings
from twin.tracking.film_path import facing
from twin.working_range import working_range

Array = NDArray[np.float64]

GLAND = {"fatty": 0.15, "mixed": 0.45, "dense": 0.75}  # of a breast, the rest being fat; by the words of BI-RADS, assumed
GLAND_SIGMA = 0.1  # from patient to patient, assumed
AIM_MM = {
    "exact": 0.0,
    "trained": 1.0,
    "novice": 2.0,
}  # standard deviation along each axis of the displayed tip from the mass; assumed
PUSHED_MM = {
    "fatty": 1.5,
    "mixed": 1.0,
    "dense": 0.7,
}  # standard deviation along the needle, of a mass before it is pierced; assumed
DEFLECTED_MM = 0.9 / np.sqrt(np.pi / 2)  # standard deviation along both axes across the needle: 0.9 mm in the mean
PRESSED_MM, FOLLOWS, LEFT = 2.0, 0.75, 0.15  # most pressure of the probe; of it, a mass's motion; of that, left by `segment`
HELD_MM = 1.0  # standard deviation of the chest, towards the cameras, from one breath that is held to another; assumed
STEEP_DEG, ASIDE_DEG = (30.0, 60.0), 30.0  # of the needle to the skin; most from the world's x, along which the view is widest
TIP_MM = (80.0, 0.0, -80.0)  # in the needle's target's frame: 113 mm from it, behind its face, which is turned to the cameras
PIVOT = 60  # poses of the needle's calibration
TILT_DEG, TURN_DEG = 25.0, 20.0  # most of these, about axes across the shaft and about it
WITHIN_MM = (1, 2, 3, 5)
STREAM, NEEDLE_STREAM = 41, 5000  # of the patient and the hand; added to the seed of prints, for the needle's


class Parts(NamedTuple):
    """What a miss is made of : (3,) mm each, in the world."""

    planned: Array  # place of the mass, by optics, probe, tracking and the speed of sound
    segmented: Array  # likewise, by segmentation alone
    tip: Array  # displayed tip less the true one, its sign turned
    aim: Array
    deflected: Array
    moved: Array  # the mass since the sweep, its sign turned


def measure(settings: Settings, seed: int) -> Metrics:
    """Distance of a needle from the middle of a mass, what it is made of, and whether it is within some distances (0 or 1)."""
    parts = draw(settings, seed)
    miss = float(np.linalg.norm(np.sum(parts, axis=0)))
    sizes = {f"{name}_mm": float(np.linalg.norm(part)) for name, part in parts._asdict().items()}
    return {"miss_mm": miss, **sizes, **{f"within_{limit}mm": int(miss < limit) for limit in WITHIN_MM}}


def draw(settings: Settings, seed: int) -> Parts:
    """Draw a patient, a hand and a rig."""
    where, biopsy, rng = working_range(settings.rig), settings.biopsy, np.random.default_rng([seed, STREAM])
    life = settings.conditions.model_copy(update={"sound": settings.conditions.sound.model_copy(update={"tissue": 0.0})})
    noise = settings.noise.at(where)
    found = drawn_session.draw(settings.rig, life, noise, settings.ultrasound, settings.poses, seed, where)
    found = in_tissue(found, biopsy, rng)
    into = needle(rng)
    across = np.linalg.svd(into[None])[2][1:]
    towards = np.array([0.0, 0.0, -1.0])  # the cameras, from the breast
    pressed = LEFT * FOLLOWS * PRESSED_MM * rng.uniform() * rng.standard_normal()
    moved = (pressed + HELD_MM * rng.standard_normal()) * towards + PUSHED_MM[biopsy.tissue] * rng.standard_normal() * into
    return Parts(
        planned=chain_trial.mass_error(found),
        segmented=biopsy.segmented_mm * rng.standard_normal(3),
        tip=-tip_error(found, settings.rig, life, noise, seed),
        aim=AIM_MM[biopsy.hand] * rng.standard_normal(3),
        deflected=DEFLECTED_MM * rng.standard_normal(2) @ across,
        moved=-moved,
    )


def in_tissue(found: Session, biopsy: Biopsy, rng: np.random.Generator) -> Session:
    """A session in a breast of one kind, read by the speed of sound of a mixed one."""
    fat, gland = TISSUES["fat"].speed, TISSUES["gland"].speed
    share = np.clip(GLAND[biopsy.tissue] + GLAND_SIGMA * rng.standard_normal(), 0, 1)
    faster = (fat + share * (gland - fat)) / (fat + GLAND["mixed"] * (gland - fat))
    return replace(found, true_probe=replace(found.true_probe, scale=found.true_probe.scale * [1.0, faster]))


def needle(rng: np.random.Generator) -> Array:
    """Direction : (3,) of a needle into the breast, away from the cameras."""
    steep, around = np.deg2rad([rng.uniform(*STEEP_DEG), rng.uniform(-ASIDE_DEG, ASIDE_DEG)])
    return np.array([np.cos(steep) * np.cos(around), np.cos(steep) * np.sin(around), np.sin(steep)])


def tip_error(found: Session, rig: Rig, life: Conditions, noise: Noise, seed: int) -> Array:
    """Place of a needle's tip as displayed less the true one : (3,) mm, at the mass, after a calibration by pivoting there."""
    design: Target = rig.bodies.get("needle", rig.target)
    printed = conditions.printed(design, life.target, seed + NEEDLE_STREAM)
    optics = in_use(found.optics.uncertainty, found.optics.cameras, PRINT_SCALE, DRIFT_PX)
    cameras = drawn_session.pair(found.used), drawn_session.pair(found.optics)
    eye = Eye(*cameras, optics, printed, design, noise.circle_px, noise.drawn.circle_in_scan)
    tip, mass = np.array(TIP_MM), np.add(found.face_mm, (0.0, 0.0, chain_trial.DEEP_MM))
    poses = about(
        tip, mass, np.mean([camera.centre for camera in eye.known], axis=0), PIVOT + 1, np.random.default_rng([seed, 42])
    )
    rest = np.zeros((len(poses), 3))
    tracked = drawn_session.look(eye, poses, np.broadcast_to(np.eye(4), poses.shape), rest[:, :2], rest, [seed, 43])
    seen = np.isfinite(tracked.poses[:-1]).all(axis=(1, 2))
    frames = pivot.Frames(*(part[:-1][seen] for part in tracked))
    return rigid.apply(tracked.poses[-1], pivot.calibrate(frames).tip) - mass


def about(tip: Array, place: Array, eyes: Array, count: int, rng: np.random.Generator) -> Array:
    """Poses : (n, 4, 4) world_from_target of a tool that turns about its tip at a place, its target's face to the cameras."""
    upright = facing(eyes - place, 0.0)
    shaft = upright @ (-tip / np.linalg.norm(tip))
    angles = np.deg2rad(rng.uniform(-1, 1, (count, 3)) * [TILT_DEG, TILT_DEG, TURN_DEG])
    turned = Rotation.from_rotvec(angles @ np.vstack([np.linalg.svd(shaft[None])[2][1:], shaft])).as_matrix() @ upright
    return np.stack([rigid.transform(turn, place - turn @ tip) for turn in turned])


EXPERIMENT = Experiment(
    ("rig", *chain_trial.CONDITIONS, "noise", "poses", "ultrasound", "biopsy"),
    measure,
    {"miss_mm": "", **{f"{name}_mm": "" for name in Parts._fields}},
    shares=tuple(f"within_{limit}mm" for limit in WITHIN_MM),
)
