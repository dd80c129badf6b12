"""Uncertainty of a mass's place and volume by what all its B-scans share: the probe's calibration and the speed of sound.

The eight parameters of the calibration move every B-scan, and with them the border that they show. Where several B-scans show a
point, it moves by the mean of theirs. The speed of sound is in it as the scale of depths, sy.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from recon.freehand import sequences
from recon.freehand.scans import Scans
from recon.geometry import rigid
from recon.model.calibration import Uncertainty
from recon.model.probe import ProbeCalibration
from recon.probe_calibration.point_calibration import NAMES
from recon.probe_calibration.point_equation import point_jacobian
from recon.segmentation.mass_surface import Mass

Array = NDArray[np.float64]

NEAR_MM = 1.0  # of a B-scan's plane: a point there is shown by it


class Sigma(NamedTuple):
    """Standard deviations of a mass's place and volume; NaN where no calibration with a covariance is known."""

    centre_mm: float  # as a distance in space
    volume_mm3: float


def by_calibration(mass: Mass, scans: Scans) -> Sigma:
    """To first order in the errors of the calibration, and of the speed of sound as far as `scans.probe` has it."""
    if scans.probe is None or scans.probe.uncertainty is None:
        return Sigma(np.nan, np.nan)
    slopes = point_slopes(np.asarray(mass.mesh.vertices), scans, scans.probe)
    order = _order(scans.probe.uncertainty)
    covariance = scans.probe.uncertainty.covariance
    by_face = slopes[mass.mesh.faces].mean(axis=1)[..., order]
    normals = mass.mesh.face_normals * mass.mesh.area_faces[:, None]
    volume = np.einsum("fi,fip->p", normals, by_face)
    outwards = np.einsum("fi,fi->f", normals, mass.mesh.triangles_center - mass.centre) / 3 / mass.volume
    centre = np.einsum("f,fip->ip", outwards, by_face)
    return Sigma(float(np.sqrt(np.trace(centre @ covariance @ centre.T))), float(np.sqrt(volume @ covariance @ volume)))


def point_slopes(points: Array, scans: Scans, probe: ProbeCalibration) -> Array:
    """Derivatives : (n, 3, 8) of the places of points : (n, 3) mm by sx, sy and the probe's turn and shift.

    Points that no B-scan shows move as the mean of the others.
    """
    pixel_from_target = np.linalg.inv(sequences.target_from_pixel(probe))
    height, width = scans.shape
    total, count = np.zeros((len(points), 3, len(NAMES))), np.zeros(len(points))
    for world_from_pixel in scans.world_from_pixel[np.isfinite(scans.world_from_pixel).all(axis=(1, 2))]:
        u, v, w = rigid.apply(np.linalg.inv(world_from_pixel), points).T
        away = np.abs(w) * np.linalg.norm(world_from_pixel[:3, 2])
        shown = (away < NEAR_MM) & (u > -0.5) & (u < width - 0.5) & (v > -0.5) & (v < height - 0.5)
        if shown.any():
            turn = (world_from_pixel @ pixel_from_target)[:3, :3]
            total[shown] += turn @ point_jacobian(probe.target_from_image, probe.scale, np.column_stack([u, v])[shown])
            count[shown] += 1
    mean = total / np.maximum(count, 1)[:, None, None]
    return np.where((count > 0)[:, None, None], mean, mean[count > 0].mean(axis=0) if count.any() else np.nan)


def _order(known: Uncertainty) -> list[int]:
    """Place among NAMES of each of its parameters."""
    return [NAMES.index(name) for name in known.names]
