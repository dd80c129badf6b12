"""Sizes and depths of image files, from their headers, and signs that they aren't raw."""

from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import numpy as np

from recon.capture.image_formats import JPEG, decode_image, size_of
from recon.capture.images import Size
from recon.errors import InputError
from recon.files.regular import opened, read_bytes

Bits = Literal[8, 10, 12]


def common_size(paths: Sequence[Path]) -> Size:
    """Width and height of images that all have the same.

    Raises
    ------
    InputError
        If one is no image, or of another size than the first.
    """
    size = _size(paths[0])
    for path in paths[1:]:
        if (found := _size(path)) != size:
            expected = f"{size[0]}x{size[1]}, as {paths[0]} of the same camera"
            raise InputError(f"{path}: expected {expected}, found {found[0]}x{found[1]}: another camera's? files=... takes some")
    return size


def bits(paths: Sequence[Path]) -> Bits:
    """Bits of the digital numbers: 8 of 8-bit images; of 16-bit ones 10 or 12, by the largest value.

    Raises
    ------
    InputError
        If one is damaged, or brighter than 12 bits allow.
    """
    images = [decode_image(path, read_bytes(path)) for path in paths[:1]]
    if images[0].dtype == np.uint8:
        return 8
    brightest = max(int(decode_image(path, read_bytes(path)).max()) for path in paths)
    if brightest >= 1 << 12:
        raise InputError(f"{paths[0]}: expected 10 or 12 bits, right-aligned, found values up to {brightest}")
    return 10 if brightest < 1 << 10 else 12


def processing(paths: Sequence[Path]) -> str:
    """Signs, by formats alone, that a camera's images aren't its raw ones: colour, by the first and last one, JPEG, or both."""
    ends = [decode_image(path, read_bytes(path)) for path in (paths[0], paths[-1])]
    colour = any(image.ndim == 3 and np.ptp(image, axis=2).any() for image in ends)
    lossy = any(path.suffix.lower() in JPEG for path in paths)
    return " ".join(sign for sign, seen in (("colour", colour), ("JPEG", lossy)) if seen)


def _size(path: Path) -> Size:
    with opened(path) as stream:
        return size_of(path, stream)
