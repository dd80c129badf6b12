"""Grey PNG images of a capture: written, and read with every fault refused in one line that names the file."""

import re
import struct
import zlib
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from recon.errors import InputError
from recon.files.regular import read_bytes
from recon.threads import mapped

Images = NDArray[np.uint8] | NDArray[np.uint16]
Size = tuple[int, int]  # width, height, px

PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
PNG_COLOURS = {0: "grey", 2: "colour", 3: "palette", 4: "grey with alpha", 6: "colour with alpha"}
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
    """Read grey PNG images of one size : (n, h, w), uint8 for 8 bits and uint16 above.

    Raises
    ------
    InputError
        If one is missing, cut short, damaged, coloured, of another size or depth, or brighter than its bits allow.
    """
    images = np.empty((len(paths), size[1], size[0]), np.uint8 if bits == 8 else np.uint16)

    def read(i: int) -> None:
        images[i] = read_image(paths[i], size, bits)

    list(mapped(read, range(len(paths))))
    return images


def read_image(path: Path, size: Size, bits: int) -> Images:
    """Read one grey PNG image : (h, w); see `read_images`."""
    data = read_bytes(path)
    width, height, depth, colour = png_header(path, data)
    stored = 8 if bits == 8 else 16
    if (width, height) != size or depth != stored or colour != "grey":
        raise InputError(f"{path}: expected {size[0]}x{size[1]} {stored}-bit grey, found {width}x{height} {depth}-bit {colour}")
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    if image is None or image.shape != (height, width):
        raise InputError(f"{path}: expected a whole grey PNG image, found damaged data")
    if bits > 8 and (brightest := int(image.max())) >= 1 << bits:
        raise InputError(f"{path}: expected {bits}-bit values up to {(1 << bits) - 1}, right-aligned, found {brightest}")
    return image


def image_size(path: Path) -> Size:
    """Width and height of a PNG file, in px; checked as in `png_header`."""
    return png_header(path, read_bytes(path))[:2]


def png_header(path: Path, data: bytes) -> tuple[int, int, int, str]:
    """Width, height, bit depth and colour of a PNG file whose every chunk is whole.

    Versions of OpenCV return an image, partly black, for a file that was cut short; so the chunks and their checksums are
    checked here.

    Raises
    ------
    InputError
        If the data is no PNG, cut short, or a checksum doesn't fit.
    """
    if not data.startswith(PNG_SIGNATURE):
        raise InputError(f"{path}: expected a PNG image, found {'an empty file' if not data else 'other data'}")
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
    width, height, depth, colour = struct.unpack_from(">IIBB", data, len(PNG_SIGNATURE) + 8)
    return width, height, depth, PNG_COLOURS.get(colour, f"colour type {colour}")


def natural_key(path: Path) -> list[tuple[int, str]]:
    """Key that sorts names as people do: 2.png before 10.png."""
    return [(int(piece), "") if piece.isdigit() else (-1, piece) for piece in re.split(r"(\d+)", Path(path).name)]
