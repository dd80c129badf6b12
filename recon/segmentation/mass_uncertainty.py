"""Uncertainty of a mass's place and volume by what all its B-scans share: the probe's calibration and the speeds of sound.

The eight parameters of the calibration move every B-scan, and with them the border that they show; where several B-scans show a
point, it moves by the mean of theirs. Another speed in the tissue scales the depths of all that lies above a mass, so its front
and all of it move along the beam. Its extent along the beam depends on the speed within, by which the border behind is placed
(`recon.segmentation.refraction`). Refraction at its sides, which another speed changes too, is left out.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from recon.freehand import sequences
from recon.freehand.scans import Scans
from recon.geometry import rigid
from recon.model.calibration import Uncertainty
from recon.probe_calibration.point_calibration import NAMES
from recon.probe_calibration.point_equation import point_jacobian
from recon.segmentation.mass_surface import Mass

Array = NDArray[np.float64]

DEPTH = len(NAMES)  # column of the ratio of depths
NEAR_MM = 1.0  # of a B-scan's plane: a point there is shown by it


class Sigma(NamedTuple):
    """Standard deviations of a mass's place and volume; NaN where the calibration's covariance isn't known."""

    centre_mm: float  # as a distance in space
    volume_mm3: float


def by_all(mass: Mass, scans: Scans, tissue: float, within: float) -> Sigma:
    """By the calibration and the speeds of sound, see `by_speeds`, which err independently."""
    slopes = point_slopes(np.asarray(mass.mesh.vertices), scans)
    known = None if scans.probe is None else scans.probe.uncertainty
    return Sigma(*np.hypot(by_calibration(mass, slopes, known), by_speeds(mass, slopes, tissue, within)).tolist())


def by_calibration(mass: Mass, slopes: Array, known: Uncertainty | None) -> Sigma:
    """To first order in the errors of the calibration; slopes : (n, 3, 9) of the mesh's vertices, as of `point_slopes`."""
    if known is None:
        return Sigma(np.nan, np.nan)
    moved = _at_faces(mass, slopes)[..., _order(known)]
    centre, volume = _centre_slopes(mass, moved), _volume_slopes(mass, moved)
    return Sigma(
        float(np.sqrt(np.trace(centre @ known.covariance @ centre.T))), float(np.sqrt(volume @ known.covariance @ volume))
    )


def by_speeds(mass: Mass, slopes: Array, tissue: float, within: float) -> Sigma:
    """To first order in the speeds of sound: the tissue's moves the front, that within the border behind.

    tissue, within : standard deviations of the speeds in the tissue and in the mass, relative.
    """
    deeper = _centre_slopes(mass, _at_faces(mass, slopes[..., [DEPTH]]))[:, 0]
    depth = np.linalg.norm(deeper)
    half = np.ptp(np.asarray(mass.mesh.vertices) @ (deeper / depth)) / 2
    return Sigma(float(np.hypot(tissue * (depth - half), within * half)), within * mass.volume)


def point_slopes(points: Array, scans: Scans) -> Array:
    """Derivatives : (n, 3, 9) of points : (n, 3) mm by NAMES' parameters, zero without a probe, and by the ratio of all depths.

    A point that no B-scan shows moves as in the B-scan nearest to it.
    """
    size, probe = np.array(scans.shape[::-1]), scans.probe
    total, count = np.zeros((len(points), 3, DEPTH + 1)), np.zeros(len(points))
    next_to, nearest = np.full_like(total, np.nan), np.full(len(points), np.inf)
    for world_from_pixel in scans.world_from_pixel[np.isfinite(scans.world_from_pixel).all(axis=(1, 2))]:
        local = rigid.apply(np.linalg.inv(world_from_pixel), points)
        away = np.abs(local[:, 2]) * np.linalg.norm(world_from_pixel[:3, 2])
        beside = np.maximum(np.maximum(-0.5 - local[:, :2], local[:, :2] - (size - 0.5)), 0)
        away = np.hypot(away, np.linalg.norm(beside * np.linalg.norm(world_from_pixel[:3, :2], axis=0), axis=1))
        shown, closer = (beside == 0).all(axis=1) & (away < NEAR_MM), away < nearest
        slopes = np.zeros_like(total)
        slopes[..., DEPTH] = local[:, 1:2] * world_from_pixel[:3, 1]
        if probe is not None:
            turn = (world_from_pixel @ np.linalg.inv(sequences.target_from_pixel(probe)))[:3, :3]
            slopes[..., :DEPTH] = turn @ point_jacobian(probe.target_from_image, probe.scale, local[:, :2])
        total[shown] += slopes[shown]
        count[shown] += 1
        next_to[closer], nearest[closer] = slopes[closer], away[closer]
    return np.where((count > 0)[:, None, None], total / np.maximum(count, 1)[:, None, None], next_to)


def _at_faces(mass: Mass, slopes: Array) -> Array:
    """Means : (f, 3, k) over the corners of a mesh's faces."""
    return slopes[mass.mesh.faces].mean(axis=1)


def _volume_slopes(mass: Mass, moved: Array) -> Array:
    """Of the volume : (k,), by the flow through the faces."""
    return np.einsum("f,fi,fik->k", mass.mesh.area_faces, mass.mesh.face_normals, moved)


def _centre_slopes(mass: Mass, moved: Array) -> Array:
    """Of the centre of gravity : (3, k), by what the flow through the faces adds, and where."""
    arms = (mass.mesh.triangles_center - mass.centre) / mass.volume
    return np.einsum("f,fi,fik,fj->jk", mass.mesh.area_faces, mass.mesh.face_normals, moved, arms)


def _order(known: Uncertainty) -> list[int]:
    """Place among NAMES of each of its parameters."""
    return [NAMES.index(name) for name in known.names]
