"""Image files of any common kind, PNG, BMP, TIFF or JPEG, decoded whole or refused in one line that names the file.

Pillow decodes PNG and JPEG, as OpenCV's libraries write lines of their own to the console where a file is damaged; OpenCV the
other two, and colours of 16 bits, which Pillow makes 8 of.
"""

import io
import re
import struct
import warnings
import zlib
from pathlib import Path
from typing import BinaryIO

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import BmpImagePlugin, Image, JpegImagePlugin, PngImagePlugin

from recon.errors import InputError

Pixels = NDArray[np.uint8] | NDArray[np.uint16]

JPEG = (".jpg", ".jpeg")
SUFFIXES = (".png", ".bmp", ".tif", ".tiff", *JPEG)
KINDS = f"an image ({', '.join(SUFFIXES)})"
MOST_PX = 1 << 26  # of an image
PNG_BEGIN = b"\x89PNG\r\n\x1a\n"
PNG_CHANNELS = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}  # numbers a pixel, by the kind of colour
JPEG_BEGIN, NEXT_IMAGE, JPEG_END = b"\xff\xd8\xff", b"\xd8", b"\xd9"
JPEG_MARKER = re.compile(rb"\xff+([\x02-\xcf\xd8-\xfe])")  # neither a number of the pixels' nor a mark between these
READERS = {  # by the beginnings of files
    PNG_BEGIN: PngImagePlugin.PngImageFile,
    JPEG_BEGIN: JpegImagePlugin.JpegImageFile,
    b"BM": BmpImagePlugin.BmpImageFile,
}
TIFF_NUMBERS = {3: "H", 4: "L", 16: "Q"}  # by the type of a field
MODES = {"1": "L", "LA": "L"}  # of Pillow's, that become grey; all others become colours
DAMAGE = (  # what Pillow raises on files damaged at random
    *(OSError, SyntaxError, ValueError, TypeError, LookupError, AttributeError, OverflowError, MemoryError, EOFError),
    *(RuntimeError, NotImplementedError, ZeroDivisionError, struct.error, zlib.error, Image.DecompressionBombError),
)


def decode_image(path: Path, data: bytes) -> Pixels:
    """Pixels of an image file : (h, w) grey or (h, w, 3) blue, green, red, as they are stored: no turn that a JPEG asks for.

    Libraries give an image, partly grey, for a JPEG whose end was lost and filled up; so its end is looked for here.

    Raises
    ------
    InputError
        If the data is of no such kind, cut short, damaged, of another depth than 8 or 16 bits, or larger than any camera's.
    """
    if not data:
        raise InputError(f"{path}: expected {KINDS}, found an empty file")
    if data.startswith(PNG_BEGIN):
        data = _without_remarks(path, data)
    size_of(path, io.BytesIO(data))
    png_depth, png_colour = 24, 25  # places of bytes
    if data.startswith(PNG_BEGIN):
        pixels = _by_pillow(path, data)
        if not pixels[-1].any():
            _check_rows(path, data)
        deep = data[png_depth] == 16 and data[png_colour] != 0
        return _by_opencv(path, data) if deep else pixels  # which was whole, so that OpenCV's library has nothing to say
    if data.startswith(JPEG_BEGIN):
        if not _ends(data):
            raise InputError(f"{path}: expected a whole JPEG image, found it cut short at {len(data)} bytes")
        return _by_pillow(path, data)
    return _by_opencv(path, data)


def _ends(data: bytes) -> bool:
    """Whether a JPEG has its end, which one that stands in a preview before it, or in a phone's trailer behind it, is not.

    Source: ITU-T T.81, B.1.
    """
    position = len(JPEG_BEGIN) - 1
    while marker := JPEG_MARKER.search(data, position):
        if marker[1] in (JPEG_END, NEXT_IMAGE):
            return marker[1] == JPEG_END
        position = marker.end() + int.from_bytes(data[marker.end() : marker.end() + 2], "big")  # of the segment, not of pixels
    return False


def size_of(path: Path, stream: BinaryIO) -> tuple[int, int]:
    """Width and height, px, of an image by the header of its file.

    Raises
    ------
    InputError
        If the data is of no such kind, damaged, or larger than any camera's.
    """
    start = stream.read(len(PNG_BEGIN))
    stream.seek(0)
    tiff_beginnings = b"II*\0", b"MM\0*", b"II+\0", b"MM\0+"  # the last two of BigTIFF, with places of 64 bits
    width, height = _size_of_tiff(path, stream) if start.startswith(tiff_beginnings) else _opened(path, stream).size
    if not 0 < width * height <= MOST_PX:
        raise InputError(f"{path}: expected an image of up to {MOST_PX} px, found {width}x{height}")
    return width, height


def _opened(path: Path, stream: BinaryIO) -> Image.Image:
    """The image of a file whose header was read, and no more."""
    start = stream.read(len(PNG_BEGIN))
    reader = next((reader for beginning, reader in READERS.items() if start.startswith(beginning)), None)
    stream.seek(0)
    try:
        with warnings.catch_warnings():  # of fields that are odd, and of large images
            warnings.simplefilter("ignore")
            opened = None if reader is None else reader(stream)
    except DAMAGE:
        opened = None
    if opened is None:
        raise InputError(f"{path}: expected {KINDS}, found other or damaged data")
    return opened


def _without_remarks(path: Path, data: bytes) -> bytes:
    """The PNG with the chunks that pixels are made of alone; refused if it is cut short, or a checksum doesn't fit.

    Others may be odd, or unpack to any size. Source: W3C, Portable Network Graphics, third edition.
    """
    kept, position, kind = [PNG_BEGIN], len(PNG_BEGIN), b""
    png_chunks = (b"IHDR", b"PLTE", b"IDAT", b"IEND")  # that pixels are made of
    while kind != b"IEND":
        length, kind = struct.unpack_from(">I4s", data.ljust(position + 8, b"\0"), position)
        end = position + 12 + length
        if end > len(data):
            raise InputError(f"{path}: expected a whole PNG image, found it cut short at {len(data)} bytes")
        if zlib.crc32(memoryview(data)[position + 4 : end - 4]) != struct.unpack_from(">I", data, end - 4)[0]:
            raise InputError(f"{path}: expected a whole PNG image, found damaged data at byte {position}")
        if kind in png_chunks:
            kept.append(data[position:end])
        position = end
    return b"".join(kept)


def _check_rows(path: Path, data: bytes) -> None:
    """Refuse a PNG, without remarks, of fewer rows than its header has: Pillow leaves those that are missing black."""
    width, height, depth, colour, *_, interlaced = struct.unpack_from(">IIBBBBB", data, 16)
    wanted = height * (1 + -(-width * PNG_CHANNELS[colour] * depth // 8))
    stream, position = zlib.decompressobj(), len(PNG_BEGIN)
    found = 0
    while not interlaced and position < len(data) and found < wanted:
        length, kind = struct.unpack_from(">I4s", data, position)
        if kind == b"IDAT":
            found += len(stream.decompress(data[position + 8 : position + 8 + length], wanted - found))
        position += 12 + length
    if not interlaced and found < wanted:
        raise InputError(f"{path}: expected a whole image, found damaged data in it: {found} bytes of {wanted}")


def _size_of_tiff(path: Path, stream: BinaryIO) -> tuple[int, int]:
    """Width and height of a TIFF file's first image, of any kind of pixels, those that Pillow doesn't know included."""
    try:
        fields = _fields_of_tiff(stream)
    except (struct.error, OverflowError, ValueError, OSError):
        fields = {}
    tiff_width, tiff_height, tiff_channels = 256, 257, 277  # tags
    width, height, channels = fields.get(tiff_width, 0), fields.get(tiff_height, 0), fields.get(tiff_channels, 1)
    most_channels = 4
    if not (width > 0 and height > 0 and 0 < channels <= most_channels):
        raise InputError(f"{path}: expected {KINDS}, found other or damaged data")
    return width, height


def _fields_of_tiff(stream: BinaryIO) -> dict[int, int]:
    """Fields of one whole number each, by their tags; of the first image of a TIFF or BigTIFF file.

    Sources: Adobe, TIFF revision 6.0; the same with places of 64 bits, BigTIFF, Library of Congress fdd000328.
    """
    start = stream.read(16)
    order, big = "<" if start.startswith(b"II") else ">", b"+" in start[2:4]
    place, length, field = ("Q", "Q", "HHQ8s") if big else ("L", "H", "HHL4s")
    stream.seek(struct.unpack_from(order + place, start, 8 if big else 4)[0])
    (count,) = struct.unpack(order + length, stream.read(struct.calcsize(order + length)))
    size = struct.calcsize(order + field)
    most_fields = 4096
    entries = stream.read(min(count, most_fields) * size)
    entries = entries[: len(entries) // size * size]
    return {
        tag: struct.unpack_from(order + TIFF_NUMBERS[kind], value)[0]
        for tag, kind, numbers, value in struct.iter_unpack(order + field, entries)
        if numbers == 1 and kind in TIFF_NUMBERS and struct.calcsize(order + TIFF_NUMBERS[kind]) <= len(value)
    }


def _by_pillow(path: Path, data: bytes) -> Pixels:
    image = _opened(path, io.BytesIO(data))
    try:
        pixels = np.array(image if image.mode in ("L", "RGB", "I;16") else image.convert(MODES.get(image.mode, "RGB")))
    except DAMAGE:
        raise InputError(f"{path}: expected a whole image, found damaged data in it") from None
    return np.ascontiguousarray(pixels[..., ::-1]) if pixels.ndim == 3 else pixels


def _by_opencv(path: Path, data: bytes) -> Pixels:
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error:
        image = None
    if image is None or image.shape[0] * image.shape[1] > MOST_PX:
        raise InputError(f"{path}: expected {KINDS}, found other or damaged data")
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
