"""Parts of a surface's errors: what the calibration explains, what noise does, and the rest.

With the true projector coordinates and the estimated calibration every pixel's point is off by the calibration alone. What is
left of the error is noise, which neighbours don't share, and a rest that they do: light between surfaces, blur at edges, lenses
that the model doesn't describe.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from recon.model.calibration import Calibration
from recon.optical_calibration import uncertainty
from recon.optical_calibration.observations import PROJECTOR
from recon.structured_light import triangulate
from recon.structured_light.decode import ProjectorMap
from twin.evaluation.surface_errors import Comparison, Map, Mask, Truth, points_with_prediction, rms

AVERAGED_PX = 15  # width of the square that errors are averaged over
MOST_POINTS = 2000  # whose calibration's covariance is carried to the surface


@dataclass(frozen=True)
class CalibrationPart:
    """What an estimated calibration adds to the errors."""

    error: Map  # (h, w) mm, positive outwards; NaN where the truth isn't lit
    sigma_mm: float  # RMS of its predicted standard deviation where points count; NaN where the calibration has no covariance


@dataclass(frozen=True)
class Part:
    """One part of the errors, over all points that are compared: its RMS squared is its mean squared and its scatter squared."""

    mean_mm: float
    scatter_mm: float  # standard deviation about the mean
    predicted_mm: float = np.nan  # RMS of the predicted standard deviations

    @property
    def rms_mm(self) -> float:
        """Root mean square."""
        return float(np.hypot(self.mean_mm, self.scatter_mm))


@dataclass(frozen=True, eq=False)
class ErrorParts:
    """Errors and what they are made of. Their means add up; so do the squares of their scatters, but for chance correlations."""

    whole: Part
    parts: Mapping[str, Part]  # calibration, if it was estimated; rest; noise
    left: Map  # (h, w) mm, errors less the calibration's part
    smooth: Map  # (h, w) mm, their mean over neighbours
    known: Mask  # (h, w) points that count


def of_calibration(found: ProjectorMap, truth: Truth, estimated: Calibration, camera: str, known: Mask) -> CalibrationPart:
    """The calibration's part: points of the true projector coordinates, by the estimated cameras, against the true points.

    Parameters
    ----------
    found : ProjectorMap
        Which axes are decoded, and their weights.
    known : (h, w)
        Points that count: those with a prediction.
    """
    pair = estimated.cameras[camera], estimated.cameras[PROJECTOR]
    points = triangulate.triangulate(_true_coordinates(found, truth), *pair).points
    error = np.where(truth.lit, ((points - truth.points) * truth.normals).sum(axis=-1), np.nan)
    return CalibrationPart(np.float32(error), _predicted(found, truth, estimated, camera, known & np.isfinite(error)))


def split(comparison: Comparison, calibration: CalibrationPart | None) -> ErrorParts:
    """Errors of the points that have a prediction, and their parts."""
    known = points_with_prediction(comparison)
    left, parts = comparison.error, {}
    if calibration is not None:
        known = known & np.isfinite(calibration.error)
        left = left - calibration.error
        parts["calibration"] = _part(calibration.error[known], calibration.sigma_mm)
    smooth = local_mean(left, known, AVERAGED_PX)
    parts["rest"] = _part(smooth[known])
    parts["noise"] = _part((left - smooth)[known], rms(comparison.predicted[known]))
    return ErrorParts(_part(comparison.error[known]), parts, left, smooth, known)


def local_mean(values: Map, mask: Mask, width: int) -> Map:
    """Mean over a square of the masked pixels around each masked pixel : (h, w), NaN elsewhere."""
    total, weight = (cv2.blur(part, (width, width)) for part in (np.where(mask, values, np.float32(0)), np.float32(mask)))
    return np.where(mask, total / np.maximum(weight, np.float32(1e-6)), np.float32(np.nan))


def _true_coordinates(found: ProjectorMap, truth: Truth) -> ProjectorMap:
    """The map with the coordinates that the true projector has at the true points."""
    seen = truth.projector.project(np.float64(truth.points).reshape(-1, 3)).reshape(*truth.lit.shape, 2)
    columns, rows = np.moveaxis(seen, -1, 0)
    return replace(
        found,
        columns=None if found.columns is None else np.float32(columns),
        rows=None if found.rows is None else np.float32(rows),
    )


def _predicted(found: ProjectorMap, truth: Truth, estimated: Calibration, camera: str, known: Mask) -> float:
    """RMS of the standard deviations along the normals that the calibration's covariance gives known points of the surface."""
    counted = np.flatnonzero(known)
    if estimated.uncertainty is None or not len(counted):
        return np.nan
    chosen = counted[:: max(1, len(counted) // MOST_POINTS)]
    points, normals = (np.float64(part.reshape(-1, 3)[chosen]) for part in (truth.points, truth.normals))
    decoded = [1.0 if axis is not None else np.inf for axis in (found.columns, found.rows)]
    spread = uncertainty.triangulation(estimated, camera, PROJECTOR, points, (1.0, decoded))
    return float(np.sqrt(np.einsum("ni,nij,nj->n", normals, spread, normals).mean()))


def _part(values: NDArray[np.float32], predicted: float = np.nan) -> Part:
    if not values.size:
        return Part(np.nan, np.nan, predicted)
    return Part(float(np.mean(values, dtype=np.float64)), float(np.std(values, dtype=np.float64)), predicted)
