"""Image files of any common kind, PNG, BMP, TIFF or JPEG, decoded whole or refused in one line that names the file."""

import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from recon.errors import InputError

Pixels = NDArray[np.uint8] | NDArray[np.uint16]

SUFFIXES = (".png", ".bmp", ".tif", ".tiff", ".jpg", ".jpeg")
MOST_PX = 1 << 26  # of an image
PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
JPEG_BEGIN, JPEG_END = b"\xff\xd8\xff", b"\xff\xd9"
PADDING = 64  # bytes, that a camera may leave behind a JPEG's end


def decode_image(path: Path, data: bytes) -> Pixels:
    """Pixels of an image file : (h, w) grey or (h, w, 3) blue, green, red, as they are stored: no turn that a JPEG asks for.

    Versions of OpenCV return an image, partly black, for a file that was cut short; so a PNG's chunks and their checksums, and a
    JPEG's end, are checked here.

    Raises
    ------
    InputError
        If the data is of no such kind, cut short, damaged, of another depth than 8 or 16 bits, or larger than any camera's.
    """
    kinds = ", ".join(SUFFIXES)
    if not data:
        raise InputError(f"{path}: expected an image ({kinds}), found an empty file")
    if data.startswith(PNG_SIGNATURE):
        _check_chunks(path, data)
    if data.startswith(JPEG_BEGIN) and JPEG_END not in data[-PADDING:]:
        raise InputError(f"{path}: expected a whole JPEG image, found it cut short at {len(data)} bytes")
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error:  # of images that are declared larger than OpenCV takes
        image = None
    if image is None or image.shape[0] * image.shape[1] > MOST_PX:
        raise InputError(f"{path}: expected an image ({kinds}), found other or damaged data")
    if image.dtype not in (np.uint8, np.uint16):
        raise InputError(f"{path}: expected 8 or 16 bits a pixel, found {image.dtype}")
    return image if image.ndim == 2 else image[..., :3]


def luma(image: Pixels, full: int) -> Pixels:
    """Grey of an image : (h, w) or (h, w, 3), (h, w); colours become their luma (BT.601), but full scale where one of them is.

    Where a colour is saturated, the sum isn't proportional to the light any more, as little as in a grey image at full scale.
    """
    if image.ndim == 2:
        return image
    grey = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    grey[(image >= full).any(axis=2)] = full
    return grey


def _check_chunks(path: Path, data: bytes) -> None:
    """Refuse a PNG file that is cut short, or of which a checksum doesn't fit."""
    view, position, kind = memoryview(data), len(PNG_SIGNATURE), b""
    while kind != b"IEND":
        if position + 12 > len(data):
            raise InputError(f"{path}: expected a whole PNG image, found it cut short at {len(data)} bytes")
        length, kind = struct.unpack_from(">I4s", data, position)
        end = position + 8 + length
        if end + 4 > len(data):
            raise InputError(f"{path}: expected a whole PNG image, found it cut short at {len(data)} bytes")
        if zlib.crc32(view[position + 4 : end]) != struct.unpack_from(">I", data, end)[0]:
            raise InputError(f"{path}: expected a whole PNG image, found damaged data at byte {position}")
        position = end + 4
    if data[12:16] != b"IHDR":
        raise InputError(f"{path}: expected a PNG image, found no header in it")
    width, height = struct.unpack_from(">II", data, 16)
    if width * height > MOST_PX:
        raise InputError(f"{path}: expected an image of up to {MOST_PX} px, found {width}x{height}")
