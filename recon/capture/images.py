"""Images of a capture: written as grey PNG, and read with every fault refused in one line that names the file."""

import re
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from recon.capture.image_formats import SUFFIXES, decode_image, luma
from recon.errors import InputError
from recon.files.regular import read_bytes
from recon.threads import mapped

Images = NDArray[np.uint8] | NDArray[np.uint16]
Size = tuple[int, int]  # width, height, px

# Sensor noise has no repeats to look for, but for runs of one value: twice as fast, and smaller, than zlib's usual search.
PNG_ENCODER = [cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_RLE]


def write_images(paths: Sequence[Path], images: Images) -> None:
    """Write grey PNG images : (n, h, w), making the folders.

    Raises
    ------
    OSError
        If one can't be encoded or written.
    """
    for folder in {path.parent for path in paths}:
        folder.mkdir(parents=True, exist_ok=True)

    def write(path: Path, image: Images) -> None:
        encoded, data = cv2.imencode(".png", image, PNG_ENCODER)
        if not encoded:
            raise OSError(f"{path}: the PNG encoder failed")
        path.write_bytes(data.tobytes())

    list(mapped(write, paths, images))


def read_images(paths: Sequence[Path], size: Size, bits: int) -> Images:
    """Read images of one size as grey : (n, h, w), uint8 for 8 bits and uint16 above; PNG, BMP, TIFF or JPEG, in colour, too.

    Raises
    ------
    InputError
        If one is missing, cut short, damaged, of another size or depth, or brighter than its bits allow.
    """
    if not paths:
        return np.empty((0, size[1], size[0]), np.uint8 if bits == 8 else np.uint16)
    first = read_image(paths[0], size, bits)  # before memory is asked for, whose size is as someone says
    images = np.empty((len(paths), *first.shape), first.dtype)
    images[0] = first

    def read(i: int) -> None:
        images[i] = read_image(paths[i], size, bits)

    list(mapped(read, range(1, len(paths))))
    return images


def read_image(path: Path, size: Size, bits: int) -> Images:
    """Read one image as grey : (h, w); see `read_images`."""
    image = decode_image(path, read_bytes(path))
    (height, width), depth, stored = image.shape[:2], 8 * image.dtype.itemsize, 8 if bits == 8 else 16
    if (width, height) != size or depth != stored:
        raise InputError(f"{path}: expected {size[0]}x{size[1]} {stored}-bit, found {width}x{height} {depth}-bit")
    if bits > 8 and (brightest := int(image.max())) >= 1 << bits:
        expected = f"{bits}-bit values up to {(1 << bits) - 1}, right-aligned"
        raise InputError(f"{path}: expected {expected}, found {brightest}; has the camera 12? describe it with bits=12")
    return luma(image, (1 << bits) - 1)


def read_grey(path: Path, size: Size | None = None) -> NDArray[np.uint8]:
    """Read an 8-bit image of another program as grey : (h, w).

    Parameters
    ----------
    size : width, height that it must have; None for any

    Raises
    ------
    InputError
        If it is missing, damaged, deeper than 8 bits, larger than any camera's, or of another size.
    """
    image = decode_image(path, read_bytes(path))
    if image.dtype != np.uint8:
        raise InputError(f"{path}: expected 8 bits a pixel, found {8 * image.dtype.itemsize}")
    if size is not None and image.shape[:2] != size[::-1]:
        raise InputError(f"{path}: expected {size[0]}x{size[1]} as of its camera, found {image.shape[1]}x{image.shape[0]}")
    return luma(image, 255)


def natural_key(path: Path) -> list[tuple[int, str]]:
    """Key that sorts names as people do: 2.png before 10.png."""
    return [(int(piece), "") if piece.isdecimal() else (-1, piece) for piece in re.split(r"(\d+)", Path(path).name)]


def image_files(folder: Path) -> list[Path]:
    """Images of a folder in natural order, 2.png before 10.png; none if there is no such folder."""
    if not folder.is_dir():
        return []
    kept = (path for path in folder.iterdir() if path.suffix.lower() in SUFFIXES and not path.name.startswith("."))
    return sorted(kept, key=natural_key)


def frame_file(folder: Path, name: str) -> Path:
    """The image of a frame whose file would be `name`, NUMBER.png; where that isn't there, the same of another kind."""
    place = folder / name
    return place if place.exists() else next((path for path in map(place.with_suffix, SUFFIXES) if path.exists()), place)
