"""Frames as the tracker works on them: grey, 0 to 255, whatever a camera or a file gives."""

import cv2
import numpy as np
from numpy.typing import NDArray

from recon.errors import InputError

DEPTHS = (8, 10, 12, 14, 16)  # bits of cameras


def grey(image: NDArray, bits: int | None = None) -> NDArray[np.uint8] | NDArray[np.float32]:
    """A grey image : (h, w), uint8 as it is, all else float32 scaled to 0 to 255.

    Parameters
    ----------
    image : (h, w), (h, w, 1), (h, w, 3) BGR or (h, w, 4) BGRA
        Whole numbers, or float: 0 to 1, or as whole numbers. What isn't finite becomes 0.
    bits : int, optional
        Depth of whole numbers beyond 8 bits. Without it the least of 8, 10, 12, 14 and 16 that holds the brightest pixel: too few
        for a dark image, which does no harm to ellipses, but makes its brightness another one.

    Raises
    ------
    InputError
        If it is no image.
    """
    image = np.asarray(image)
    if image.dtype == bool:
        image = image.astype(np.uint8) * np.uint8(255)
    if image.dtype.kind not in "uif" or image.ndim not in (2, 3) or image.size == 0:
        raise InputError(f"expected an image, found an array of {image.dtype} {'x'.join(map(str, image.shape)) or 'alone'}")
    if image.ndim == 3 and image.shape[2] not in (1, 3, 4):
        raise InputError(f"expected an image of 1, 3 or 4 channels, found {image.shape[2]}")
    if image.dtype == np.uint8:
        return _one_channel(image)
    values = np.nan_to_num(image, nan=0.0, posinf=0.0, neginf=0.0).astype(np.float32)
    values = np.maximum(_one_channel(values), 0)
    brightest = float(values.max())
    if image.dtype.kind == "f" and brightest <= 1:
        return values * np.float32(255)
    depth = bits or next((depth for depth in DEPTHS if brightest < 2**depth), 32)
    return np.minimum(values * np.float32(255 / (2**depth - 1)), np.float32(255))


def _one_channel(image: NDArray) -> NDArray:
    if image.ndim == 2:
        return np.ascontiguousarray(image)
    if image.shape[2] == 1:
        return np.ascontiguousarray(image[..., 0])
    return cv2.cvtColor(np.ascontiguousarray(image), cv2.COLOR_BGR2GRAY if image.shape[2] == 3 else cv2.COLOR_BGRA2GRAY)
