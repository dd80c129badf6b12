"""Blur of a board's image, by the steepness of its edges in each direction: out of focus, or moved during the exposure."""

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from recon.geometry.camera import Array

STEEPEST = 0.998  # quantile of the slopes: discs of 20 px radius have 1 % of all pixels on edges of one direction


class Blur(NamedTuple):
    """Standard deviations of the blur, px."""

    least: float  # in the sharpest direction
    most: float  # in the softest


def blur(image: NDArray, pixels: Array) -> Blur:
    """Blur of the image : (h, w) of a board whose points lie at pixels : (n, 2), NaN where not seen.

    An edge of contrast C that is blurred by s has the steepest slope `C / (sqrt(2 pi) s)` across it.
    """
    seen = pixels[np.isfinite(pixels).all(axis=1)]
    around = 0.1  # of the points' extent, beyond them
    beyond = around * np.ptp(seen, axis=0)
    left, top = np.maximum(seen.min(axis=0) - beyond, 0).astype(int)
    right, low = (seen.max(axis=0) + beyond + 2).astype(int)
    smoothing = 1.0  # px, standard deviation: taken out of the blur again
    level = cv2.GaussianBlur(np.float32(image[top:low, left:right]), (0, 0), smoothing)
    across, down = (cv2.Sobel(level, cv2.CV_32F, du, dv, ksize=1, scale=0.5) for du, dv in ((1, 0), (0, 1)))
    dark, bright = 0.05, 0.95  # quantiles of the levels, both of which a board has many of
    contrast = float(np.subtract(*np.quantile(level, [bright, dark])))
    widths = []
    directions = 4  # over half a turn
    for way in np.pi / directions * np.arange(directions):
        steepest = float(np.quantile(np.abs(np.cos(way) * across + np.sin(way) * down), STEEPEST))
        width = contrast / (np.sqrt(2 * np.pi) * max(steepest, 1e-9))
        widths.append(np.sqrt(max(width**2 - smoothing**2, 0.0)))
    return Blur(min(widths), max(widths))
