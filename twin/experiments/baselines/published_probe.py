"""The published calibration of the probe and measurement of a tube, as rivals.

Crossings are clicked by hand, frames that agree count alike, poses are the tracker's matrices as they are, several calibrations
are averaged, and a tube is a cylinder through the contours of masks.

Source: Meza, Contreras-Ortiz, Romero & Marrugo, Three-dimensional multimodal medical imaging system based on free-hand
ultrasound and structured light, 2021, sections 2.3 and 3; what is visible is our assumption.
"""

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from recon.geometry import rigid
from recon.model import tracks
from recon.model.probe import ProbeCalibration
from recon.model.tracks import Track
from recon.probe_calibration import point_calibration

Array = NDArray[np.float64]
Grey = NDArray[np.uint8]

CONTRADICTS = 3.0  # times the median distance from the crossing, beyond which a frame is left out
STEPS = (1e-3, 1e-3, 1e-2, 1e-2, 1e-2, 1, 1, 1, 1, 1, 1)  # ordinary ones of the parameters, mm a px, rad and mm
VISIBLE_DN = 25  # of 255, that stands out of black on a screen
GAP_PX = 7  # between parts of a wall that are taken for one


class Solved(NamedTuple):
    """A calibration, and its equation's RMS: of the coordinates of its frames' pixels from the wires' crossing."""

    calibration: ProbeCalibration
    rms_mm: float


def clicked(pixels: Array, scatter_px: float, rng: np.random.Generator) -> Array:
    """Pixels : (n, 2) as a person clicks on them."""
    return pixels + scatter_px * rng.standard_normal(pixels.shape)


def matrices_at(times: NDArray[np.int64], matrices: Array, wanted: NDArray[np.int64]) -> Array:
    """Matrices : (m, 4, 4) at moments : (m,) ns, element by element between those : (n, 4, 4) at times : (n,) ns.

    A NaN where there is none nearby. They need not be rotations, and stay none.
    """
    track = Track(times, matrices)
    near = np.isfinite(tracks.at(track, wanted)).all(axis=(1, 2))
    result = np.full((len(wanted), 4, 4), np.nan)
    result[near] = np.einsum("nm,mij->nij", tracks.shares_at(track, wanted[near], 0.0), matrices[track.found])
    return result


def calibrate(matrices: Array, pixels: Array) -> Solved:
    """Calibrate from n frames, less those that contradict most of the others, as a person would see, and leave out.

    Parameters
    ----------
    matrices : (n, 4, 4)
    pixels : (n, 2) px, of the crossing
    """
    while True:
        calibration, residuals = least_squares_of(matrices, pixels)
        away = np.linalg.norm(residuals, axis=1)
        good = away < CONTRADICTS * np.median(away)
        if good.all():
            return Solved(calibration, float(np.sqrt((residuals**2).mean())))
        matrices, pixels = matrices[good], pixels[good]


def least_squares_of(matrices: Array, pixels: Array) -> tuple[ProbeCalibration, Array]:
    """Least squares over eleven parameters, all frames alike, and the residuals : (n, 3) mm."""
    start, scale, wire = point_calibration.closed_form(matrices, pixels)

    def residuals(step: Array) -> Array:
        local = np.column_stack([pixels * (scale + step[:2]), np.zeros(len(pixels))])
        in_target = rigid.apply(rigid.moved(start, step[2:8]), local)
        return np.einsum("nij,nj->ni", matrices[:, :3, :3], in_target) + matrices[:, :3, 3] - (wire + step[8:])

    found = least_squares(lambda step: residuals(step).ravel(), np.zeros(11), method="lm", x_scale=STEPS).x
    return ProbeCalibration(rigid.moved(start, found[2:8]), scale + found[:2]), residuals(found)


def mask_contour(image: Grey, top_px: int) -> Array:
    """Contour : (n, 2) px of the front of a tube's mask, drawn as it is seen: the first visible pixel of each column of its wall.

    The wall is the largest connected visible part below the ringing at the face, with small gaps closed.
    """
    visible = (image > VISIBLE_DN).astype(np.uint8)
    visible[:top_px] = 0
    closed = cv2.morphologyEx(visible, cv2.MORPH_CLOSE, np.ones((GAP_PX, GAP_PX), np.uint8))
    count, parts, figures, _ = cv2.connectedComponentsWithStats(closed)
    if count < 2:
        return np.zeros((0, 2))
    wall = (parts == 1 + figures[1:, cv2.CC_STAT_AREA].argmax()) & (visible > 0)
    columns = np.flatnonzero(wall.any(axis=0))
    return np.column_stack([columns, wall[:, columns].argmax(axis=0)]).astype(float)
