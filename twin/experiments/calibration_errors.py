"""Errors of a calibration in the quantities that matter, and their expectation from its covariance."""

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from recon.geometry.camera import Array
from recon.geometry.camera_jacobian import MOTION
from recon.model.calibration import Calibration
from recon.optical_calibration import figures_of_merit, uncertainty

DEPTHS = (606.0, 660.0, 713.0)  # mm: the rig's working range (Meza et al. 2021) and its middle
PAIRS = (("cam1", "cam2"), ("cam1", "projector"))
REGION = 0.95  # probability of the regions that points are looked for in


def motion_error(found: Calibration, truth: Calibration, name: str) -> tuple[float, float]:
    """Error of a device's rotation, deg, and of its translation, mm."""
    first, second = (calibration.cameras[name].camera_from_world for calibration in (found, truth))
    turn = Rotation.from_matrix(first[:3, :3] @ second[:3, :3].T).magnitude()
    return float(np.rad2deg(turn)), float(np.linalg.norm(first[:3, 3] - second[:3, 3]))


def motion_sigma(found: Calibration, name: str) -> tuple[float, float]:
    """Expectation of `motion_error` from the covariance, RMS: deg, mm."""
    assert found.uncertainty is not None
    sigmas = np.array([found.uncertainty.sigma(f"{name}.{parameter}") for parameter in MOTION])
    return float(np.rad2deg(np.linalg.norm(sigmas[:3]))), float(np.linalg.norm(sigmas[3:]))


def focal_error(found: Calibration, truth: Calibration, name: str) -> float:
    """The larger relative error of a device's two focal lengths, %."""
    first, second = (calibration.cameras[name].matrix[[0, 1], [0, 1]] for calibration in (found, truth))
    return 100 * float(np.abs(first / second - 1).max())


def focal_sigma(found: Calibration, name: str) -> float:
    """The larger relative standard deviation of a device's two focal lengths, %."""
    assert found.uncertainty is not None
    sigmas = np.array([found.uncertainty.sigma(f"{name}.{parameter}") for parameter in ("fx", "fy")])
    return 100 * float((sigmas / found.cameras[name].matrix[[0, 1], [0, 1]]).max())


def baseline_error(found: Calibration, truth: Calibration) -> float:
    """The larger error of the distances of camera 2 and of the projector from camera 1, mm."""
    lengths = [[np.linalg.norm(which.cameras[name].centre) for name in ("cam2", "projector")] for which in (found, truth)]
    return float(np.abs(np.subtract(*lengths)).max())


def squared_length(error: Array, covariance: Array) -> float:
    """Squared Mahalanobis length of an error : (g,), whose parts may have very different units."""
    scale = np.sqrt(np.diag(covariance))
    return float(error / scale @ np.linalg.solve(covariance / np.outer(scale, scale), error / scale))


def inside_region(found: Calibration, truth: Calibration, pair: tuple[str, str], volume: Array) -> float:
    """Share of a volume's points : (k, 3) mm whose error lies in its predicted 95 % region."""
    return float(np.mean(squared_point_errors(found, truth, pair, volume) < chi2.ppf(REGION, 3)))


def squared_point_errors(found: Calibration, truth: Calibration, pair: tuple[str, str], points: Array) -> Array:
    """Squared Mahalanobis lengths : (k,) of the errors of points : (k, 3) mm, chi-square with 3 degrees of freedom."""
    error, covariance = point_errors(found, truth, pair, points), uncertainty.triangulation(found, *pair, points)
    return np.einsum("ki,ki->k", error, np.linalg.solve(covariance, error[..., None])[..., 0])


def point_errors(found: Calibration, truth: Calibration, pair: tuple[str, str], points: Array) -> Array:
    """Error : (k, 3) mm of points that two devices see exactly and that are triangulated with a calibration."""
    pixels = [truth.cameras[name].project(points) for name in pair]
    return figures_of_merit.triangulated([found.cameras[name] for name in pair], pixels, points) - points


def scale_error(measured: Array, true: Array) -> float:
    """Scale error of measured points : (m, 3) mm, %, by the similarity that maps the true ones onto them best.

    Source: Umeyama 1991, least-squares estimation of transformation parameters between two point patterns.
    """
    left, right = measured - measured.mean(axis=0), true - true.mean(axis=0)
    u, singular, vt = np.linalg.svd(left.T @ right)
    signs = np.array([1, 1, np.sign(np.linalg.det(u @ vt))])
    return 100 * abs(float((singular * signs).sum() / (right**2).sum()) - 1)


def scale_sigma(found: Calibration) -> float:
    """Standard deviation of scale that the covariance predicts for the working volume, %."""
    volume = uncertainty.working_volume(found, DEPTHS)
    return 100 * uncertainty.scale(found, "cam1", "projector", volume)


def rms_length(errors: Array) -> float:
    """Root mean square length of vectors : (k, 3)."""
    return float(np.sqrt((errors**2).sum(axis=1).mean()))


def expected_length(found: Calibration, pair: tuple[str, str], volume: Array) -> float:
    """Expectation of `rms_length(point_errors(...))` from the covariance, mm."""
    return float(np.sqrt(np.trace(uncertainty.triangulation(found, *pair, volume), axis1=1, axis2=2).mean()))
