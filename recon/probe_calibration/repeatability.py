"""Agreement of several calibrations of one probe: CR1, CR2 and their mean.

CR1 and CR2 are those of Meza et al. 2021: of a pixel's place in the target's frame, `target_from_image @ [sx u, sy v, 0, 1]`.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from recon.geometry import rigid
from recon.model.calibration import Uncertainty
from recon.model.probe import ProbeCalibration

Array = NDArray[np.float64]
Size = tuple[int, int]  # width, height, px


def five_points(size: Size) -> Array:
    """Centre and corners : (5, 2) px of a B-scan, in this order."""
    right, bottom = size[0] - 1, size[1] - 1
    return np.array([[right / 2, bottom / 2], [0, 0], [right, 0], [0, bottom], [right, bottom]], float)


def cr1(calibrations: Sequence[ProbeCalibration], pixels: ArrayLike) -> Array:
    """Repeatability CR1 : (k,) mm: mean distance, over all pairs of calibrations, of the places of pixels : (k, 2)."""
    return between_pairs(np.stack([calibration.to_target(pixels) for calibration in calibrations]))


def cr2(calibrations: Sequence[ProbeCalibration], pixels: ArrayLike) -> Array:
    """Repeatability CR2 : (k,) mm: mean distance of the places of pixels : (k, 2) by each calibration from the mean place."""
    return from_mean(np.stack([calibration.to_target(pixels) for calibration in calibrations]))


def between_pairs(points: Array) -> Array:
    """Mean distance : (k,) over all pairs of n sets of points : (n, k, 3)."""
    first, second = np.triu_indices(len(points), 1)
    return np.linalg.norm(points[first] - points[second], axis=-1).mean(axis=0)


def from_mean(points: Array) -> Array:
    """Mean distance : (k,) of n sets of points : (n, k, 3) from the mean of the sets."""
    return np.linalg.norm(points - points.mean(axis=0), axis=-1).mean(axis=0)


def average(calibrations: Sequence[ProbeCalibration]) -> ProbeCalibration:
    """The mean of independent calibrations: rotations as rotations (least sum of squared chords), the rest as vectors.

    All have to hold for about the same speed of sound, as those of one tank do; so has the mean.
    """
    turns = Rotation.from_matrix(np.stack([calibration.target_from_image[:3, :3] for calibration in calibrations]))
    origin = np.mean([calibration.target_from_image[:3, 3] for calibration in calibrations], axis=0)
    scale = np.mean([calibration.scale for calibration in calibrations], axis=0)
    known = [calibration.uncertainty for calibration in calibrations if calibration.uncertainty is not None]
    alike = len(known) == len(calibrations) and all(each.names == known[0].names for each in known)
    covariance = np.sum([each.covariance for each in known], axis=0) / len(known) ** 2 if alike else None
    uncertainty = None if covariance is None else Uncertainty(known[0].names, covariance)
    return ProbeCalibration(
        rigid.transform(turns.mean().as_matrix(), origin),
        scale,
        uncertainty,
        float(np.mean([each.speed_m_s for each in calibrations])),
    )
