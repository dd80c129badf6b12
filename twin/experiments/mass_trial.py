"""Masses of the breast phantom under conditions that nothing was tuned to: measured rightly, named with a reason, or missed.

Poses have the noise of `PoseNoise` and its covariance; probe, lag and the tissue's speed of sound are known, and so is the skin,
that of the breast at rest.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import trimesh
from numpy.typing import NDArray

from recon.errors import InputError
from recon.files.metrics import Metrics
from recon.freehand.scans import Scans
from recon.geometry import rigid
from recon.geometry.surface_tree import signed_distances
from recon.model.calibration import Uncertainty
from recon.model.probe import NAMES
from recon.segmentation.left_out import UNLIKELY, LeftOut
from recon.segmentation.segmented_scans import DOUBTED, VOLUME_WARNING
from recon.session import masses_step
from scenes.acoustics import TISSUES
from scenes.scene_types import Thing
from twin.evaluation import sweep_errors
from twin.evaluation.sweep_errors import Finding
from twin.experiments import mass_conditions
from twin.experiments.experiment_runs import Experiment, Settings
from twin.experiments.mass_conditions import CONDITIONS, Condition
from twin.filmed_sweep import PlannedSweep, SweepSettings, plan_sweep
from twin.session import CAPTURE, Session
from twin.ultrasound import sweep_session
from twin.ultrasound.probe_path import SurfacePath
from twin.ultrasound.timed_sweep import Clocks, PoseNoise
from twin.ultrasound.transducer import Transducer

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

PATH = SurfacePath(start_mm=(-22.0, -31.0), end_mm=(-22.0, 36.0), strokes=2, stroke_step_mm=44.0, speed_mm_s=21.0)
CLOCKS, NOISE = Clocks(), PoseNoise()
TISSUE_M_S = TISSUES["silicone"].speed
MARGIN_MM = 1.0  # around masses that is scanned, too: bodies at the scan's edges are none
NEAR_MM = 1.5  # to a B-scan's plane, within which a point is scanned: they lie up to 1.6 mm apart


@dataclass(frozen=True)
class Judgement:
    """When a mass counts as measured rightly, or as named."""

    centre_mm: float = 0.6
    volume: float = 0.12  # of its own
    near_mm: float = 2.0  # from a mass to the place of what is left out
    sigmas: float = 3.0  # of a volume of which it is warned


LIMITS = Judgement()


@dataclass(frozen=True)
class Findings:
    """What the software says of a sweep."""

    masses: Sequence[trimesh.Trimesh]
    sigmas_mm: Sequence[float]  # of their centres
    volume_sigmas_mm3: Sequence[float]
    left_out: Sequence[LeftOut]
    doubted: bool  # whether contact or motion is warned of, which concerns all masses
    axes: Array  # (3, 3) of array and beam, and across the B-scans, in columns


def measure(settings: Settings, seed: int) -> Metrics:
    """Figures of one sweep; errors are NaN where no mass was found."""
    condition = CONDITIONS[settings.masses.condition]
    planned = plan(condition, settings, seed)
    hidden = [thing for thing in planned.scene.things if thing.inside]
    check_scanned(planned, hidden)
    skin = sweep_errors.facing(sweep_session.surface_of("", planned.scanned).mesh)
    kept = kept_scans(condition, planned, hidden, np.random.default_rng([seed, 50]))
    with TemporaryDirectory() as folder:
        scans = recorded(planned, Path(folder))
        scans = replace(scans, world_from_pixel=np.where(kept[:, None, None], scans.world_from_pixel, np.nan))
        found = masses_step.find(scans, masses_step.Method(overlays=0), skin)
    shown = [thing for thing in hidden if seen(planned, inner_points(thing.mesh), kept).any()]
    sigmas = [found.figures[f"{name}_centre_sigma_mm"] for name in found.meshes]
    volume_sigmas = [found.figures[f"{name}_volume_sigma_mm3"] for name in found.meshes]
    doubted = any(line.startswith("warning") and not line.startswith(VOLUME_WARNING) for line in found.lines)
    told = [one for one in found.left_out if one.reason not in UNLIKELY]
    said = Findings(list(found.meshes.values()), sigmas, volume_sigmas, told, doubted, axes(scans))
    return judge(shown, said) | {"contact_mm": found.figures.get("contact_mm", np.nan)}


def plan(condition: Condition, settings: Settings, seed: int) -> PlannedSweep:
    """The sweep under a condition."""
    scanner = settings.ultrasound.model_dump()
    scanner |= {name: scanner[name] + more for name, more in condition.ultrasound.items()}
    chosen = SweepSettings(
        rig=settings.rig,
        scene=mass_conditions.scene(condition, seed),
        ultrasound=Transducer.model_validate(scanner),
        path=PATH.model_copy(update={"standoff_mm": condition.standoff_mm}),
        living=condition.living,
        clocks=CLOCKS,
        seed=seed,
    )
    return tracked(chosen)


def tracked(settings: SweepSettings) -> PlannedSweep:
    """A sweep with poses of the noise of `NOISE`, and with their covariance."""
    planned = plan_sweep(settings.model_copy(update={"pose_noise": NOISE}))
    noise = np.diag(np.repeat([np.deg2rad(NOISE.turn_deg), NOISE.shift_mm], 3) ** 2)
    track = replace(planned.plan.track, covariance=np.tile(noise, (len(planned.plan.track.times), 1, 1)))
    return replace(planned, plan=replace(planned.plan, track=track))


def check_scanned(planned: PlannedSweep, hidden: Sequence[Thing]) -> None:
    """Refuse masses that the sweep's B-scans don't show whole, and something around them; InputError."""
    for thing in hidden:
        around = thing.mesh.vertices + MARGIN_MM * thing.mesh.vertex_normals
        whole = seen(planned, around, np.ones(len(planned.plan.times), bool)).mean()
        if whole < 1:
            raise InputError(f"masses: {thing.name}: expected it scanned whole, found {100 * whole:.1f} % of its outside scanned")


def seen(planned: PlannedSweep, points: Array, kept: Mask) -> Mask:
    """Which points : (n, 3) mm of the body at rest lie in or near some of its B-scans."""
    scanner = planned.settings.ultrasound
    sides = np.array([scanner.width_mm, scanner.depth_mm * TISSUE_M_S / scanner.assumed_speed])
    found = np.zeros(len(points), bool)
    for pose in planned.body_from_image[kept]:
        place = rigid.apply(rigid.invert(pose), points)
        found |= ((place[:, :2] >= 0) & (place[:, :2] <= sides)).all(axis=1) & (np.abs(place[:, 2]) < NEAR_MM)
    return found


def inner_points(mesh: trimesh.Trimesh) -> Array:
    """Points : (n, 3) mm of a star-shaped body, from its middle outwards."""
    return np.concatenate([mesh.center_mass + share * (mesh.vertices - mesh.center_mass) for share in (0.3, 0.6, 0.9)])


def kept_scans(condition: Condition, planned: PlannedSweep, hidden: Sequence[Thing], rng: np.random.Generator) -> Mask:
    """Which of the n B-scans keep their pose under a condition."""
    poses, times = planned.body_from_image, planned.plan.truth.times * 1e-9
    kept = np.arange(len(poses)) < condition.share * len(poses)
    if condition.every_mm:
        middles = poses[:, :3] @ [*planned.settings.ultrasound.face_mm, 0.0, 1.0]
        way = np.append(0.0, np.linalg.norm(np.diff(middles, axis=0), axis=1).cumsum())
        kept &= np.diff(np.floor(way / condition.every_mm), prepend=-1.0) > 0
    if condition.lost_s:
        largest = max((thing.mesh for thing in hidden), key=lambda mesh: float(mesh.volume))
        scanner = planned.settings.ultrasound
        world_from_pixel = poses @ np.diag([*scanner.scale_mm_per_px, 1, 1])
        over = sweep_errors.nearest_frame(largest.center_mass, world_from_pixel, scanner.image_size)
        assert over is not None, "it was scanned whole"
        middle = times[over] + condition.lost_s * rng.uniform(-0.25, 0.25)
        kept &= np.abs(times - middle) > condition.lost_s / 2
    return kept


def recorded(planned: PlannedSweep, folder: Path, tissue_m_s: float = TISSUE_M_S) -> Scans:
    """The sweep as the software reads it, told lag and speed of sound, by a probe that is calibrated without errors."""
    chosen, probe = planned.settings, sweep_session.calibration_of(planned.settings.rig, planned.settings.ultrasound)
    session = Session(folder, "sweep", chosen.model_dump(mode="json"))
    taken = (planned.scene, planned.scanned, chosen.ultrasound, planned.plan, planned.scans(), probe)
    sweep_session.write_session(session, *taken)
    fields = {"capture": folder / CAPTURE, "lag_s": chosen.clocks.lag_s, "tissue_m_s": tissue_m_s, "tissue_sigma_m_s": 0.0}
    scans = masses_step.read(masses_step.Settings(**fields))
    exact = Uncertainty(NAMES, np.zeros((len(NAMES), len(NAMES))))
    return replace(scans, probe=None if scans.probe is None else replace(scans.probe, uncertainty=exact))


def axes(scans: Scans) -> Array:
    """Mean axes of the B-scans : (3, 3), unit, of array and beam, and across, in columns."""
    placed = scans.world_from_pixel[np.isfinite(scans.world_from_pixel).all(axis=(1, 2))]
    mean = (placed[:, :3, :3] / np.linalg.norm(placed[:, :3, :3], axis=1, keepdims=True)).mean(axis=0)
    return mean / np.linalg.norm(mean, axis=0)


def judge(hidden: Sequence[Thing], said: Findings) -> Metrics:
    """Count masses by what became of them; errors are NaN where none was found.

    Parameters
    ----------
    hidden : masses that B-scans with poses show, whole or in part
    """
    pairs = sweep_errors.compare(said.masses, hidden) if hidden else []
    here = [pair for pair in pairs if pair.found is not None]
    centres = [pair.centre_error_mm for pair in here]
    volumes = [float(abs(pair.found.volume / pair.true.volume - 1)) for pair in here if pair.found is not None]
    right = sum(centre <= LIMITS.centre_mm and volume <= LIMITS.volume for centre, volume in zip(centres, volumes, strict=True))
    off = len(here) - right
    told = 0 if said.doubted else sum(_volume_is_doubted(pair, said.volume_sigmas_mm3[pair.number]) for pair in here)
    named = sum(any(names(one, pair.true, said.axes) for one in said.left_out) for pair in pairs if pair.found is None)
    taken = {pair.number for pair in here}
    false = [mass for number, mass in enumerate(said.masses) if number not in taken]
    warned = [said.doubted or any(names(one, mass, said.axes) for one in said.left_out) for mass in false]
    bodies = [one for one in said.left_out if one.reason != "gap"]
    over = [pair.centre_error_mm / said.sigmas_mm[pair.number] for pair in here]
    return {
        "masses_true": len(hidden),
        "masses_right": right,
        "masses_off": off,
        "masses_off_warned": off if said.doubted else told,
        "masses_named": named,
        "masses_silent": len(hidden) - len(here) - named,
        "masses_false": len(false),
        "masses_false_warned": sum(warned),
        "named_nowhere": sum(not any(names(one, thing.mesh, said.axes) for thing in hidden) for one in bodies),
        "centre_error_mm": float(np.mean(centres)) if here else np.nan,
        "worst_centre_error_mm": max(centres) if here else np.nan,
        "volume_error_percent": 100 * float(np.mean(volumes)) if here else np.nan,
        "worst_volume_error_percent": 100 * max(volumes) if here else np.nan,
        "centre_error_over_sigma": float(np.mean(over)) if here else np.nan,
    }


def _volume_is_doubted(pair: Finding, sigma_mm3: float) -> bool:
    """Whether a mass is off by its volume alone, of which it is warned, and by no more than that."""
    assert pair.found is not None
    off = float(abs(pair.found.volume - pair.true.volume))
    allowed = LIMITS.volume * float(pair.true.volume)
    warned = 2 * sigma_mm3 > DOUBTED * float(pair.found.volume)
    return pair.centre_error_mm <= LIMITS.centre_mm and allowed < off <= LIMITS.sigmas * sigma_mm3 and warned


def names(one: LeftOut, mass: trimesh.Trimesh, axes: Array) -> bool:
    """Whether what is left out lies in a mass or near it, or is a gap that covers some of it."""
    if one.reason == "gap":
        aside = np.abs((inner_points(mass) - np.array(one.centre_mm)) @ axes)
        return bool((aside <= np.array(one.extents_mm) / 2).all(axis=1).any())
    return bool(signed_distances(np.array([one.centre_mm]), mass)[0] <= LIMITS.near_mm)


COUNTS = (
    "masses_true",
    "masses_right",
    "masses_off",
    "masses_off_warned",
    "masses_named",
    "masses_silent",
    "masses_false",
    "masses_false_warned",
    "named_nowhere",
)
ERRORS = {
    "centre_error_mm": "",
    "worst_centre_error_mm": "",
    "volume_error_percent": "",
    "worst_volume_error_percent": "",
    "centre_error_over_sigma": "",
    "contact_mm": "",
}
EXPERIMENT = Experiment(("rig.probe", "ultrasound", "masses"), measure, ERRORS, counts=COUNTS)
