"""Which lens distortion a device needs: a richer model only if it predicts poses better that it has not been fitted to.

The choice begins with OpenCV's five coefficients. A poorer model would be confidently wrong beyond the points, while coefficients
that no point determines are held by those of usual lenses (`recon.geometry.usual_lenses`), and show as uncertainty.
"""

from dataclasses import replace
from typing import Literal

import numpy as np

from recon.geometry.camera import Camera
from recon.geometry.lens_domain import is_one_to_one
from recon.optical_calibration.adjustment import OUTLIER, fit, free_parameters
from recon.optical_calibration.bundle import Array, Estimate, Problem, linear_system
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
CONVERGED = 1e-7  # relative change of the cost of poses alone: far less than the scatter of errors
TRIED: tuple[ModelName, ...] = ("brown", "rational")
SURE = 2.0  # standard errors by which a richer model must be better
ENOUGH_POSES = 10  # to compare models: the scatter of fewer errors says little of their mean's


def choose(observations: Observations, start: Estimate, device: str, offsets: Array) -> tuple[ModelName, dict[ModelName, float]]:
    """Choose a device's distortion model by cross-validation over the poses.

    The poses are dealt into five parts. Each part is left out in turn, the device is calibrated on the others, the poses left out
    are found with that calibration, and what remains of their points is the score. Of the models that are no worse than the best
    by more than two standard errors of the difference, pose by pose, the simplest is chosen (Breiman et al. 1984). A rich model
    with a pole or a fold within the image, in any of the calibrations, is none to choose.

    Parameters
    ----------
    observations : Observations
        Of all devices.
    start : Estimate
        An adjustment of all devices, with any distortion.
    offsets : (p, n, d, 2) px
        As in `adjustment.adjust`.

    Returns
    -------
    name, scores
        The model, and the cross-validated RMS of each one to choose, px; none if the device sees too few poses to choose by.
    """
    number = observations.devices.index(device)
    seeing = np.flatnonzero(observations.seen[:, :, number].any(axis=1))
    if len(seeing) < ENOUGH_POSES:
        return TRIED[0], {}
    own, offset = observations.of_devices([device]).of_poses(seeing), offsets[seeing][:, :, [number]]
    camera = start.cameras[device]
    ideal = Camera(camera.size, camera.matrix, np.zeros(0))  # at the origin: alone, a device is its own world
    errors = held_out(own, Estimate({device: ideal}, camera.camera_from_world @ start.poses[seeing], start.points), offset)
    if not all(np.count_nonzero(np.isfinite(error)) >= 2 for error in errors.values()):
        return TRIED[0], {}
    best = min(errors, key=lambda name: float(np.nanmean(errors[name])))
    chosen = next(name for name in errors if _no_worse(errors[name] - errors[best]))
    return chosen, {name: float(np.sqrt(np.nanmean(error))) for name, error in errors.items()}


def held_out(own: Observations, start: Estimate, offsets: Array) -> dict[ModelName, Array]:
    """Mean squared distance of each pose's points from where calibrations without this pose put them : (p,) px^2, by model.

    Each model starts from the one that it contains. Outliers of the pose itself don't count: they would decide.

    Parameters
    ----------
    own : Observations
        Of one device.
    start : Estimate
        A device without distortion.
    """
    errors, torn = {name: np.full(len(own.poses), np.nan) for name in TRIED}, set[ModelName]()
    for fold in range(min(FOLDS, len(own.poses))):
        left_out = np.arange(fold, len(own.poses), FOLDS)
        rest = np.setdiff1d(np.arange(len(own.poses)), left_out)
        known, alone = own.of_poses(rest), Problem(own.of_poses(left_out), offsets[left_out], {})
        found, place = replace(start, poses=start.poses[rest]), start.poses[left_out]
        for name in TRIED:
            free = free_parameters(own.devices, dict.fromkeys(own.devices, MODELS[name]))
            found, noise, _ = fit(Problem(known, offsets[rest], free), found)
            laid, noise, _ = fit(alone, replace(found, poses=place), noise, CONVERGED)
            errors[name][left_out], place = _squares(alone, laid, noise), laid.poses
            if not all(map(is_one_to_one, found.cameras.values())):
                torn.add(name)
    return {name: error for name, error in errors.items() if name not in torn or name == TRIED[0]}


def _squares(problem: Problem, estimate: Estimate, noise: Array) -> Array:
    """Mean squared distance of each pose's points from where a device is expected to see them, outliers left out : (p,) px^2."""
    system = linear_system(problem, estimate, noise)
    counting = problem.observations.seen & (system.lengths <= OUTLIER)
    squares = np.where(counting, np.sum(system.plain**2, axis=-1), 0.0).sum(axis=(1, 2))
    number = counting.sum(axis=(1, 2))
    return np.where(number > 0, squares / np.maximum(number, 1), np.nan)


def _no_worse(difference: Array) -> bool:
    """Whether errors : (p,) px^2 above the best model's are within some standard errors of zero."""
    known = difference[np.isfinite(difference)]
    return bool(known.mean() <= SURE * known.std(ddof=1) / np.sqrt(len(known)))
