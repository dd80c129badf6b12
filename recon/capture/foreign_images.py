"""Images that other programs wrote: PNG, BMP, TIFF or JPEG, grey or in colour, as 8-bit grey."""

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from recon.capture.images import natural_key
from recon.errors import InputError
from recon.files.regular import read_bytes

SUFFIXES = (".png", ".bmp", ".tif", ".tiff", ".jpg", ".jpeg")
MOST_PX = 1 << 26  # of an image, before it is unpacked


def image_files(folder: Path) -> list[Path]:
    """Images of a folder in natural order, 2.png before 10.png; none if there is no such folder."""
    if not folder.is_dir():
        return []
    return sorted((path for path in folder.iterdir() if path.suffix.lower() in SUFFIXES), key=natural_key)


def read_grey(path: Path, size: tuple[int, int] | None = None) -> NDArray[np.uint8]:
    """Read an image : (h, w); colours become their luma (BT.601).

    Parameters
    ----------
    size : width, height that it must have; None for any

    Raises
    ------
    InputError
        If it is missing, damaged, deeper than 8 bits, larger than any camera's, or of another size.
    """
    data = np.frombuffer(read_bytes(path), np.uint8)
    image = cv2.imdecode(data, cv2.IMREAD_ANYDEPTH | cv2.IMREAD_ANYCOLOR) if data.size else None
    if image is None or image.shape[0] * image.shape[1] > MOST_PX:
        raise InputError(f"{path}: expected an image ({', '.join(SUFFIXES)}), found other or damaged data")
    if image.dtype != np.uint8:
        raise InputError(f"{path}: expected 8 bits a pixel, found {8 * image.dtype.itemsize}")
    grey = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    if size is not None and grey.shape != size[::-1]:
        raise InputError(f"{path}: expected {size[0]}x{size[1]} as of its camera, found {grey.shape[1]}x{grey.shape[0]}")
    return grey
