"""Which lens distortion a device needs: the simplest model that predicts poses it has not been fitted to as well as the best."""

from typing import Literal

import numpy as np

from recon.geometry.camera import Camera
from recon.optical_calibration.adjustment import adjust, free_parameters
from recon.optical_calibration.bundle import Array, Estimate
from recon.optical_calibration.observations import Observations

ModelName = Literal["none", "radial1", "radial2", "decentred", "brown", "rational", "thin_prism", "tilted"]

MODELS: dict[ModelName, tuple[str, ...]] = {  # simple to complex; each contains the one before it
    "none": (),
    "radial1": ("k1",),
    "radial2": ("k1", "k2"),
    "decentred": ("k1", "k2", "p1", "p2"),
    "brown": ("k1", "k2", "p1", "p2", "k3"),  # OpenCV's default
    "rational": ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
    "thin_prism": ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4"),
    "tilted": ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4", "tau_x", "tau_y"),
}
FOLDS = 5
TRIED: tuple[ModelName, ...] = ("none", "radial1", "radial2", "decentred", "brown", "rational")
ENOUGH_POSES = 10  # to compare models: the scatter of fewer errors says little of their mean's
FEW_POSES_MODEL: ModelName = (
    "brown"  # with fewer; a model that is too poor is worse than one too rich, which shows as uncertainty
)


def choose(observations: Observations, start: Estimate, device: str, offsets: Array) -> tuple[ModelName, dict[ModelName, float]]:
    """Choose a device's distortion model by cross-validation over the poses.

    The poses are dealt into five parts. Each part is left out in turn, the device is calibrated on the others, the poses left out
    are found with that calibration, and what remains of their points is the score. Of the models that are no worse than the best
    by more than one standard error of the difference, pose by pose, the simplest is chosen (Breiman et al. 1984).

    Parameters
    ----------
    observations : Observations
        Of all devices.
    start : Estimate
        An adjustment of all devices, with any distortion.
    offsets : (p, n, d, 2) px
        As in `adjust.adjust`.

    Returns
    -------
    name, scores
        The model, and the cross-validated RMS of each one tried, px; none if the device sees too few poses to choose by.
    """
    number = observations.devices.index(device)
    seeing = np.flatnonzero(observations.seen[:, :, number].any(axis=1))
    if len(seeing) < ENOUGH_POSES:
        return FEW_POSES_MODEL, {}
    own, offset = observations.of_devices([device]).of_poses(seeing), offsets[seeing][:, :, [number]]
    begin = Estimate(start.cameras, start.poses[seeing], start.points)
    errors = {name: held_out(own, begin, device, MODELS[name], offset) for name in TRIED}
    best = min(errors, key=lambda name: float(np.nanmean(errors[name])))
    chosen = next(name for name in TRIED if _no_worse(errors[name] - errors[best]))
    return chosen, {name: float(np.sqrt(np.nanmean(error))) for name, error in errors.items()}


def held_out(own: Observations, start: Estimate, device: str, model: tuple[str, ...], offsets: Array) -> Array:
    """Mean squared distance of each pose's points from where a calibration without this pose puts them : (p,) px^2.

    Outliers of the pose itself don't count: they would decide.
    """
    count = len(own.poses)
    camera = start.cameras[device]
    ideal = Camera(camera.size, camera.matrix, np.zeros(0))  # at the origin: alone, a device is its own world
    bare = Estimate({device: ideal}, camera.camera_from_world @ start.poses, start.points)
    free = free_parameters([device], {device: model})
    errors = np.full(count, np.nan)
    for fold in range(FOLDS):
        left_out = np.arange(fold, count, FOLDS)
        if not len(left_out):
            continue
        rest = np.setdiff1d(np.arange(count), left_out)
        fitted = adjust(own.of_poses(rest), _of_poses(bare, rest), free, offsets[rest])
        known = Estimate(fitted.calibration.cameras, bare.poses[left_out], bare.points)
        found = adjust(own.of_poses(left_out), known, {}, offsets[left_out])
        squares = np.sum(found.residuals[:, :, 0] ** 2, axis=-1)
        errors[left_out] = np.nanmean(np.where(found.outliers[:, :, 0], np.nan, squares), axis=1)
    return errors


def _no_worse(difference: Array) -> bool:
    """Whether errors : (p,) px^2 above the best model's are within one standard error of zero."""
    known = difference[np.isfinite(difference)]
    return bool(known.mean() <= known.std(ddof=1) / np.sqrt(len(known)))


def _of_poses(estimate: Estimate, chosen: Array) -> Estimate:
    return Estimate(estimate.cameras, estimate.poses[chosen], estimate.points)
