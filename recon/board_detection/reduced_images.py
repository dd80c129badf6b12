"""Large images made smaller to look for a board in: what is found there is measured in the image as it is.

A detector's time and memory grow with the pixels, and most in images without a board.
"""

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from recon.geometry.ellipses import Ellipses

Array = NDArray[np.float64]

LARGE_PX = 4e6  # pixels of an image from which on it is reduced: to so many at most


class Reduced(NamedTuple):
    """An image, perhaps a smaller one, and how much smaller it is."""

    image: NDArray  # (h, w)
    times: float  # full px a reduced one

    def full(self, pixels: Array) -> Array:
        """Pixels : (..., 2) of the whole image."""
        return (pixels + 0.5) * self.times - 0.5

    def full_ellipses(self, found: Ellipses) -> Ellipses:
        """Ellipses in the whole image."""
        return Ellipses(self.full(found.centre), found.shape * self.times)


def reduced(image: NDArray, most: float | None = None) -> Reduced:
    """The image as it is where it isn't large, or else the mean over its pixels on a grid of at most so many (LARGE_PX)."""
    if image.size <= LARGE_PX:
        return Reduced(image, 1.0)
    times = float(np.sqrt(image.size / (most or LARGE_PX)))
    height, width = (max(int(length / times), 1) for length in image.shape)
    smaller = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
    return Reduced(smaller, image.shape[1] / width)
