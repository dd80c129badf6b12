"""Corners of squares in images, as chessboards, ChArUco boards and AprilGrids have them."""

import cv2
import numpy as np
from numpy.typing import NDArray

from recon.board_detection.corners import Corners, refine_corners
from recon.board_detection.findings import Detection, first_faults, refuse_bad, spread

Array = NDArray[np.float64]

WINDOW = (0.4, 14.0)  # of a square's shorter side, at most px: radius of what is looked at about a corner
LEAST_WINDOW = 3.0  # px
MARGIN = 0.9  # of the way from a corner to the nearest marker
LEAST_CONTRAST = 0.03  # of the full scale
LEAST_SIGNAL = 4.0  # contrast over noise
LOW_CONTRAST = "contrast of {:.1f} %"
MOST_BLUR = 0.35  # of the window's radius
MOST_CLIPPED = 0.7  # of the window's pixels: white squares fill half of it
MOST_SIGMA = 0.2  # px
LEAST_CORNERS = 6  # of a board of which a part is enough: they tell a pose
LEAST_MARKERS = 4  # that a mirrored image must show before it is called so


def eight_bits(image: Array, full: float) -> NDArray[np.uint8]:
    """For OpenCV's detectors, the brightest thousandth clipped."""
    top = max(float(np.percentile(image[::4, ::4], 99.9)), 0.04 * full)
    return np.clip(image * (255 / top), 0, 255).astype(np.uint8)


def board_to_image(points: Array, pixels: Array) -> Array:
    """Homography : (3, 3), by least squares."""
    return np.asarray(cv2.findHomography(points[:, :2].astype(float), pixels.astype(float), 0)[0])


def moved(homography: Array, points: Array) -> Array:
    """Where a homography takes points : (n, 2 or 3) of a plane, to (n, 2)."""
    moved = np.column_stack([points[:, :2], np.ones(len(points))]) @ homography.T
    return moved[:, :2] / moved[:, 2:]


def shortest_side(pixels: Array, points: Array, square_mm: float) -> float:
    """Of the squares about the corners, px."""
    homography = board_to_image(points, pixels)
    sides = [np.hypot(*(moved(homography, points + step) - moved(homography, points)).T) for step in square_mm * np.eye(3)[:2]]
    return float(np.min(sides))


def refine(image: Array, rough: Array, points: Array, window: float, full: float) -> Corners:
    """Corners at their best, the edges' directions taken from the board."""
    homography = board_to_image(points, rough)
    step = 1e-3 * np.ptp(points, axis=0).max() * np.eye(3)
    directions = np.stack([moved(homography, points + step[k]) - moved(homography, points) for k in range(2)], axis=1)
    return refine_corners(image, rough, directions, window, full)


def detection(image: Array, rough: Array, points: Array, at: NDArray[np.intp], window: float, full: float) -> Detection:
    """Corners at their best, of a board's points : (n, 3) mm those `at` : (k,), roughly known : (k, 2) px.

    Raises
    ------
    BoardNotFound
        If too few of them are good.
    """
    measured = refine(image, rough, points[at], window, full)
    good = refuse_bad(faults(measured, window, full), len(at), "corners")
    pixels, covariance = (spread(each[good], at[good], len(points)) for each in (measured.pixels, measured.covariance))
    return Detection(pixels, covariance, None)


def faults(corners: Corners, window: float, full: float) -> list[str | None]:
    """Reasons to refuse each corner, None for good ones."""
    contrast = np.abs(corners.contrast)
    sigma = np.sqrt(np.trace(corners.covariance, axis1=1, axis2=2) / 2)
    tests = [
        (
            contrast < np.maximum(LEAST_CONTRAST * full, LEAST_SIGNAL * corners.noise),
            100 * contrast / full,
            LOW_CONTRAST,
        ),
        (corners.clipped > MOST_CLIPPED, 100 * corners.clipped, "saturated, {:.0f} % of it"),
        (corners.blur > MOST_BLUR * window, corners.blur, "too blurred, {:.1f} px"),
        (corners.shift > window / 2, corners.shift, "no corner within {:.1f} px"),
        (~(sigma < MOST_SIGMA), sigma, "uncertain by {:.2f} px"),
    ]
    return first_faults(tests, len(contrast))


def detected(detector: cv2.aruco.ArucoDetector, grey: NDArray[np.uint8]) -> tuple[Array, NDArray[np.int64]]:
    """Corners : (k, 4, 2) px and numbers : (k,)."""
    corners, numbers, _ = detector.detectMarkers(grey)
    if numbers is None or not len(numbers):
        return np.empty((0, 4, 2)), np.empty(0, np.int64)
    return np.asarray(corners, float).reshape(-1, 4, 2), np.asarray(numbers, np.int64).ravel()


def astray(points: Array, pixels: Array, side: float) -> float:
    """RMS distance of pixels : (n, 2) from where the best map has the board's points : (n, 3), in sides on the board."""
    back = moved(np.linalg.inv(board_to_image(points, pixels)), pixels)
    return float(np.sqrt(np.mean(np.sum((back - points[:, :2]) ** 2, axis=1))) / side)
