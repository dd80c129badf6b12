"""Whether a camera's image changed as its pattern did: a pattern that was not shown, or shown late, leaves the image before it.

Black and white tell how strongly the projector lights a camera's pixels. From one pattern to the next, the mean square of the
image's change is then about that of the pattern's times that of the light; two images of the same are apart by their noise alone.
"""

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from recon.devices.interfaces import Image

Pattern = NDArray[np.uint8]


class Light(NamedTuple):
    """A projector's light in a camera's image, as mean squares over it."""

    power: float  # DN^2, of white less black, without noise
    noise: float  # DN^2, of the difference of two images of white


def measure_light(black: Image, white: Image, again: Image) -> Light:
    """The light by an image of black and two of white, all (h, w)."""
    noise = _mean_square(white, again)
    return Light(max(_mean_square(white, black) - noise, 0.0), noise)


def change(light: Light, images: tuple[Image, Image], patterns: tuple[Pattern, Pattern]) -> float:
    """Change from an image to the next, as a share of that expected by their patterns.

    Parameters
    ----------
    images : two of (h, w)
    patterns : two of (height, width)

    Returns
    -------
    float
        About 1, by the part of the projector that the camera sees and by gamma; 0 where the second pattern was not shown; NaN
        where the patterns differ too little for this light.
    """
    full = 255.0  # level of a pattern
    expected = light.power * _mean_square(*patterns) / full**2
    telling = 1.0  # times the noise that a change must be for a verdict
    if expected <= telling * light.noise:
        return np.nan
    return max(_mean_square(*images) - light.noise, 0.0) / expected


def _mean_square(one: Image, other: Image) -> float:
    return cv2.norm(one, other, cv2.NORM_L2SQR) / one.size
