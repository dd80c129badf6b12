"""Poses of the target from pairs of frames, beside the Cramer-Rao bound of its circles' centres."""

import numpy as np

from recon.files.metrics import Metrics
from recon.geometry.camera import Array
from recon.model.rig import Target
from recon.tracking import networks
from twin.evaluation.surface_errors import rms
from twin.experiments import closed_forms, tracking_frames
from twin.experiments.experiment_runs import Experiment, Settings
from twin.experiments.experiment_setup import Setup
from twin.experiments.layout import laid_out
from twin.experiments.pose_accuracy import cameras_of, located
from twin.tracking.samples import Take


def measure(settings: Settings, seed: int) -> Metrics:
    """Figures of some frames, each tracked as if nothing were known before."""
    rig, film = laid_out(settings.rig, settings.layout), settings.film
    setup = Setup(rig, {}, frames=settings.ranges)
    shown = tracking_frames.study(setup, seed, film.frames, film.white_dn, film.blur_px, film.rays)
    known = networks.load(kind=settings.rig.target.kind)
    takes, errors = [], []
    for take, frames in shown:
        takes.append(take)
        errors.append(located(take, frames, rig.target, known))
    shift, turn, misfit = (np.array([getattr(one, name) for one in errors]) for name in ("shift_mm", "turn_deg", "misfit"))
    bounds = np.stack([bound(take, one.limit_px, rig.target) for take, one in zip(takes, errors, strict=True)])
    found = np.isfinite(shift)
    return {
        "translation_rms_mm": rms(shift[found]),
        "translation_limit_mm": rms(bounds[found, 1]),
        "rotation_rms_deg": rms(turn[found]),
        "rotation_limit_deg": rms(bounds[found, 0]),
        "centre_rms_px": rms(np.concatenate([one.centre_px for one in errors])[np.repeat(found, 6)]),
        "centre_limit_px": rms(np.concatenate([one.limit_px for one in errors])[np.repeat(found, 6)]),
        "error_over_sigma": rms(np.sqrt(misfit[found] / 6)),
        "found": float(found.mean()),
    }


def bound(take: Take, limit_px: Array, target: Target) -> tuple[float, float]:
    """Bound of a take's pose: RMS of its turn, deg, and of its shift, mm, by the limit of its centres : (6,) px."""
    sigma = limit_px.reshape(2, 3) / np.sqrt(2)
    covariance = closed_forms.pose_covariance(cameras_of(take), take.motion.world_from_target, target, sigma)
    turn, shift = np.trace(covariance[:3, :3]), np.trace(covariance[3:, 3:])
    return float(np.rad2deg(np.sqrt(turn))), float(np.sqrt(shift))


EXPERIMENT = Experiment(
    ("rig", "layout.camera_mm", "layout.target_scale", "film", "ranges"),
    measure,
    {"translation_rms_mm": "translation_limit_mm", "rotation_rms_deg": "rotation_limit_deg"},
    "Cramér-Rao bound",
)
