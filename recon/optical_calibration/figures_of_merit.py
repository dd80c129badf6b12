"""Figures of merit of a calibration: residuals, predicted uncertainty of measurements, and, on renders, errors."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from recon.files.metrics import Metrics, shown
from recon.geometry.camera import Array, Camera
from recon.geometry.camera_jacobian import DISTORTION, MATRIX, MOTION, linearise
from recon.model.calibration import Calibration
from recon.optical_calibration import optical_checks, uncertainty
from recon.optical_calibration.joint_calibration import Result, departure, deviation
from recon.optical_calibration.observations import PROJECTOR
from recon.optical_calibration.uncertainty import rigid_modes

DEPTHS = (0.05, 0.5, 0.95)  # quantiles of the depths of the board's points: those that the calibration is judged at
CELLS = (8, 6)  # of an image, across and down, for the residuals' pattern
GAUSS_NEWTON_STEPS = 5
SAME_LENS = 0.05  # of the focal length, by which a lens of the paper's rig may differ when it is set up again
TURN_STEP = 1e-6  # rad, of central differences


@dataclass(frozen=True)
class Published:
    """A device of the paper's rig: what tells it from others, and what is printed of it."""

    size: tuple[int, int]  # px
    focal_px: float  # fx, likely: see conf/rig/meza2021.yaml
    rms_px: float  # of the reprojection


PAPER = {  # Meza et al. 2021, Optical Engineering 60(5) 054106
    "cam1": Published((1280, 1024), 3320.0, 0.138),
    "projector": Published((1280, 800), 1921.0, 0.131),
    "cam2": Published((1280, 1024), 3318.0, 0.151),
}


@dataclass(frozen=True)
class Parameter:
    """One parameter as people read it."""

    device: str
    label: str
    unit: str
    value: float
    sigma: float  # zero if it was held fixed
    true: float  # NaN if unknown

    @property
    def error(self) -> float:
        """Value less true value."""
        return self.value - self.true


def measure(result: Result, truth: Calibration | None = None) -> Metrics:
    """Figures of a calibration, each named with its unit; those of points that are measured need two devices.

    Parameters
    ----------
    truth : Calibration, optional
        The true one, of a render.
    """
    found, adjusted = result.adjustment.calibration, result.adjustment
    volume = working_volume(result)
    figures: Metrics = {
        "poses": len(result.observations.poses),
        "poses_dropped": len({_pose(name) for name in result.dropped} - set(result.observations.poses)),
        "sightings_dropped": sum(_pose(name) != name for name in result.dropped),
        "sightings": int(np.count_nonzero(result.observations.seen)),
        "outliers": int(np.count_nonzero(adjusted.outliers)),
    }
    for device in result.observations.devices:
        figures[f"reprojection_rms_{device}_px"] = result.rms[device]
    for device in result.observations.devices:
        figures[f"noise_ratio_{device}"] = float(adjusted.noise[device])
        figures[f"pattern_ratio_{device}"] = pattern_ratio(result, device)
        figures[f"coverage_{device}"] = coverage(result, device)
        figures[f"projection_sigma_{device}_px"] = _rms(uncertainty.projection(found, device, volume, volume))
    if len(found.cameras) > 1:
        pair = devices_that_measure(found)
        figures["point_sigma_mm"] = _rms(uncertainty.triangulation(found, *pair, volume))
        figures["shape_sigma_mm"] = _rms(uncertainty.shape(found, *pair, volume, volume))
        figures["scale_sigma_ppm"] = 1e6 * uncertainty.scale(found, *pair, volume)
    in_plane, out_of_plane = departure(result.adjustment.points, result.observations.points)
    figures["board_in_plane_mm"], figures["board_out_of_plane_mm"] = in_plane, out_of_plane
    if np.isfinite(result.halves).all():
        figures["halves_rms_sigma"] = float(np.sqrt(np.mean(result.halves**2)))
        figures["halves_worst_sigma"] = float(np.abs(result.halves).max())
    return figures if truth is None else figures | errors(found, truth, volume)


def describe_board(result: Result, figures: Metrics) -> str:
    """The board's departure from its design, in words."""
    if not result.released:
        if result.tolerances.sigmas.any():
            return "taken as designed"
        return "taken as designed and exact: sigma leaves out the errors of its print; shape.in_plane_mm puts them in"
    in_plane, out_of_plane = (shown(figures[f"board_{name}_mm"], ".4f", " mm") for name in ("in_plane", "out_of_plane"))
    return f"differs from its design by {in_plane} in its plane and {out_of_plane} out of it (RMS), which is corrected"


def published_rms(found: Calibration) -> dict[str, float]:
    """Reprojection RMS by device, px, as the paper prints it for its rig; none of a rig of other images or lenses."""
    for device, camera in found.cameras.items():
        paper = PAPER.get(device)
        if paper is None or camera.size != paper.size or abs(camera.matrix[0, 0] / paper.focal_px - 1) > SAME_LENS:
            return {}
    return {device: PAPER[device].rms_px for device in found.cameras}


def errors(found: Calibration, truth: Calibration, volume: Array) -> Metrics:
    """Errors of a calibration against the true one: its devices' places, and points of a volume : (k, 3) mm measured with it."""
    figures: Metrics = {}
    for device, camera in list(found.cameras.items())[1:]:
        difference = camera.camera_from_world @ np.linalg.inv(truth.cameras[device].camera_from_world)
        turn = Rotation.from_matrix(difference[:3, :3]).magnitude()
        shift = camera.camera_from_world[:3, 3] - truth.cameras[device].camera_from_world[:3, 3]
        figures[f"{device}_rotation_error_deg"] = float(np.rad2deg(turn))
        figures[f"{device}_translation_error_mm"] = float(np.linalg.norm(shift))
    for device, camera in found.cameras.items():
        focal = [camera.matrix[k, k] / truth.cameras[device].matrix[k, k] - 1 for k in (0, 1)]
        figures[f"{device}_focal_error_ppm"] = 1e6 * float(np.mean(focal))
    figures["parameters_error_sigma"] = normalised_error(found, truth)
    if len(found.cameras) == 1:
        return figures
    error = point_errors(found, truth, volume)
    modes = rigid_modes(volume).reshape(-1, 6)
    left = error.ravel() - modes @ np.linalg.lstsq(modes, error.ravel(), rcond=None)[0]
    figures["point_error_rms_mm"] = float(np.sqrt((error**2).sum(axis=1).mean()))
    figures["shape_error_rms_mm"] = float(np.sqrt((left**2).sum() / len(volume)))
    return figures


def pose_rms(result: Result) -> Array:
    """Root mean square length of the residuals without outliers, by pose and device : (p, d) px, NaN where there are none."""
    used = np.isfinite(result.adjustment.residuals).all(axis=-1) & ~result.adjustment.outliers
    squares = np.where(used, np.sum(np.nan_to_num(result.adjustment.residuals) ** 2, axis=-1), 0.0).sum(axis=1)
    number = used.sum(axis=1)
    return np.where(number > 0, np.sqrt(squares / np.maximum(number, 1)), np.nan)


def sightings(result: Result, device: str) -> tuple[Array, Array, NDArray[np.intp]]:
    """Where a device saw points : (s, 2) px, their residuals : (s, 2) px, and which poses these were : (s,); without outliers."""
    d = result.observations.devices.index(device)
    used = result.observations.seen[:, :, d] & ~result.adjustment.outliers[:, :, d]
    pose = np.nonzero(used)[0]
    return result.observations.pixels[:, :, d][used], result.adjustment.residuals[:, :, d][used], pose


def cell_means(result: Result, device: str) -> tuple[Array, Array, NDArray[np.intp]]:
    """Mean residual of each cell of the image that has any: the cells' middles, the means : (c, 2) px, their numbers : (c,)."""
    pixels, residuals, _ = sightings(result, device)
    cell = _cells(pixels, result.adjustment.calibration.cameras[device])
    number = np.bincount(cell, minlength=CELLS[0] * CELLS[1])
    sums = [np.bincount(cell, column, minlength=number.size) for column in (*pixels.T, *residuals.T)]
    filled = number > 0
    means = np.stack(sums, axis=-1)[filled] / number[filled, None]
    return means[:, :2], means[:, 2:], number[filled]


def pattern_ratio(result: Result, device: str) -> float:
    """RMS of the cells' mean residuals over that of random residuals: 1 if there is no pattern."""
    _, residuals, _ = sightings(result, device)
    _, means, number = cell_means(result, device)
    return float(np.sqrt(np.mean(number * (means**2).sum(axis=1)) / np.mean((residuals**2).sum(axis=1))))


def coverage(result: Result, device: str) -> float:
    """Share of the part of a device's image that measures within the hull of the points that were seen."""
    return optical_checks.coverage(sightings(result, device)[0], optical_checks.measuring_part(result.adjustment, device))


def devices_that_measure(calibration: Calibration) -> tuple[str, str]:
    """The pair of devices, of two or more, that surfaces are measured with: camera 1 and projector, or else the second camera."""
    first, *others = calibration.cameras
    return first, "projector" if "projector" in others else others[0]


def working_depths(result: Result) -> tuple[float, ...]:
    """Depths to judge the calibration at, mm: the nearest, middle and farthest at which points of the board were."""
    return _depths(board_points(result))


def _depths(points: Array) -> tuple[float, ...]:
    depths = np.quantile(points[..., 2], DEPTHS)
    return tuple(float(depth) for depth in sorted({*np.round(depths)}))


def working_volume(result: Result) -> Array:
    """Points that stand for the working volume : (m, 3) mm, as of `volume_about`."""
    return volume_about(result.adjustment.calibration, board_points(result).reshape(-1, 3))


def volume_about(calibration: Calibration, points: Array) -> Array:
    """Points that all devices see : (m, 3) mm, at the depths of a board's points : (n, 3) mm; else these themselves."""
    try:
        return uncertainty.working_volume(calibration, _depths(points))
    except ValueError:
        return points


def board_points(result: Result) -> Array:
    """The board's points in each pose : (p, n, 3) mm in the world."""
    poses = result.adjustment.poses
    return np.einsum("pij,nj->pni", poses[:, :3, :3], result.adjustment.points) + poses[:, None, :3, 3]


def board_centres(result: Result) -> Array:
    """Middle of the board's points in each pose : (p, 3) mm in the world."""
    return board_points(result).mean(axis=1)


def tilts(result: Result) -> Array:
    """Angle between the board's normal and camera 1's axis in each pose : (p,) rad."""
    return np.arccos(np.clip(np.abs(result.adjustment.poses[:, 2, 2]), 0, 1))


def parameters(found: Calibration, truth: Calibration | None = None) -> list[Parameter]:
    """All parameters of all devices in readable units, with their standard deviations and, if given, the true ones.

    The turn of a device is its rotation vector in deg; a device's distance from the first one's pinhole is added.
    """
    rows = []
    for device, camera in found.cameras.items():
        true = truth.cameras.get(device) if truth is not None else None
        values, known = _read(camera), _read(true) if true is not None else {}
        sigmas = _sigmas(found, device)
        for name, value in values.items():
            if device == next(iter(found.cameras)) and name in (*MOTION, "distance"):
                continue
            unit = "px" if name in MATRIX else "deg" if name in MOTION[:3] else "mm" if name in (*MOTION, "distance") else ""
            if name in DISTORTION and not (value or sigmas.get(name, 0.0) or known.get(name, 0.0)):
                continue
            rows.append(Parameter(device, name, unit, value, sigmas.get(name, 0.0), known.get(name, np.nan)))
    return rows


def normalised_error(found: Calibration, truth: Calibration) -> float:
    """Error of all free parameters together, correlations and all, in standard deviations: about 1 if these are right."""
    assert found.uncertainty is not None
    names, covariance = found.uncertainty.names, found.uncertainty.covariance
    error = deviation(found, truth)
    scale = np.sqrt(np.diag(covariance))
    return float(np.sqrt(error / scale @ np.linalg.solve(covariance / np.outer(scale, scale), error / scale) / len(names)))


def point_errors(found: Calibration, truth: Calibration, points: Array) -> Array:
    """Error : (m, 3) mm of points that the true devices see exactly, and that are triangulated with the calibration."""
    pair = devices_that_measure(found)
    pixels = [truth.cameras[name].project(points) for name in pair]
    return triangulated([found.cameras[name] for name in pair], pixels, points) - points


def triangulated(cameras: list[Camera], pixels: list[Array], start: Array) -> Array:
    """Points : (m, 3) mm of least squared distance from pixels : (m, 2) in all images, by Gauss-Newton from a start nearby."""
    points = start.copy()
    for _ in range(GAUSS_NEWTON_STEPS):
        seen = [linearise(camera, points, ()) for camera in cameras]
        slopes = np.concatenate([part.by_point for part in seen], axis=1)
        missing = np.concatenate([found - part.pixels for found, part in zip(pixels, seen, strict=True)], axis=1)
        points = points + np.einsum("mik,mk->mi", np.linalg.pinv(slopes), missing)
    return points


def _pose(dropped: str) -> str:
    """The pose of what was left out, whether all of it (POSE) or one device's part (POSE DEVICE)."""
    pose, _, device = dropped.rpartition(" ")
    return pose if device in ("cam1", "cam2", PROJECTOR) else dropped


def _read(camera: Camera) -> dict[str, float]:
    """A device's parameters by name; turns in deg."""
    matrix, distortion = camera.matrix, np.zeros(len(DISTORTION))
    distortion[: camera.distortion.size] = camera.distortion
    turn = np.rad2deg(Rotation.from_matrix(camera.camera_from_world[:3, :3]).as_rotvec())
    shift = camera.camera_from_world[:3, 3]
    intrinsic = (matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2], *distortion)
    values = dict(zip(MATRIX + DISTORTION + MOTION, (*intrinsic, *turn, *shift), strict=True))
    return {name: float(value) for name, value in values.items()} | {"distance": float(np.linalg.norm(shift))}


def _sigmas(found: Calibration, device: str) -> Mapping[str, float]:
    """Standard deviations of what `_read` gives."""
    assert found.uncertainty is not None
    names, covariance = found.uncertainty.names, found.uncertainty.covariance
    sigmas = {name.rsplit(".", 1)[1]: found.uncertainty.sigma(name) for name in names if name.startswith(f"{device}.")}
    place = [names.index(f"{device}.{name}") for name in MOTION if f"{device}.{name}" in names]
    if len(place) < len(MOTION):
        return sigmas
    of_motion = covariance[np.ix_(place, place)]
    rotation = Rotation.from_matrix(found.cameras[device].camera_from_world[:3, :3])
    slopes = np.stack(  # of the rotation vector by a further turn
        [
            ((Rotation.from_rotvec(step) * rotation).as_rotvec() - (Rotation.from_rotvec(-step) * rotation).as_rotvec())
            / (2 * TURN_STEP)
            for step in TURN_STEP * np.eye(3)
        ],
        axis=-1,
    )
    turn = np.rad2deg(np.sqrt(np.diag(slopes @ of_motion[:3, :3] @ slopes.T)))
    shift = found.cameras[device].camera_from_world[:3, 3]
    along = shift / np.linalg.norm(shift)
    return sigmas | dict(zip(MOTION, turn, strict=False)) | {"distance": float(np.sqrt(along @ of_motion[3:, 3:] @ along))}


def _cells(pixels: Array, camera: Camera) -> NDArray[np.intp]:
    """Number of the image's cell that each of pixels : (s, 2) lies in."""
    place = np.floor((pixels + 0.5) / np.array(camera.size) * CELLS).astype(int)
    across, down = np.clip(place, 0, np.array(CELLS) - 1).T
    return down * CELLS[0] + across


def _rms(covariances: Array) -> float:
    """Root mean square distance that covariances : (m, k, k) let expect."""
    return float(np.sqrt(np.trace(covariances, axis1=-2, axis2=-1).mean()))
