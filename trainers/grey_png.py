"""PNGs of a data set: 8-bit grey, looked at before they are decoded, so that damage is said once and costs no memory."""

import struct
import zlib
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from recon.capture.image_formats import MOST_PX, PNG_SIGNATURE, decode_image
from recon.errors import InputError

Grey = NDArray[np.uint8]

HEADER = struct.Struct(">8s4x4sIIBBBBB4x")  # signature, IHDR: width, height, bits, colour, compression, filter, interlace
NEEDED = (b"IHDR", b"IDAT", b"IEND")
FILTERS = 5  # kinds of a row's filter


def decode(place: str, data: bytes, size: tuple[int, int] | None) -> Grey:
    """Pixels of a PNG : (h, w).

    The compressed rows are checked here: libpng would say what is wrong with them on the standard error by itself.

    Parameters
    ----------
    place : where it is, for messages
    size : width and height that it must have; None for any that a camera may have

    Raises
    ------
    InputError
        If it is no PNG, damaged, of another size, in colour, or deeper than 8 bits.
    """
    if len(data) < HEADER.size or not data.startswith(PNG_SIGNATURE):
        raise InputError(f"{place}: expected a PNG, found {'damaged or other data' if data else 'no data'}")
    _, kind, width, height, bits, colour, *methods = HEADER.unpack_from(data)
    if kind != b"IHDR" or any(methods) or not 0 < width * height <= MOST_PX:
        found = f"{width}x{height}" + (", interlaced or damaged" if any(methods) else "")
        raise InputError(f"{place}: expected a plain PNG of up to {MOST_PX} px, found {found}")
    if (bits, colour) != (8, 0) or (size is not None and (width, height) != size):
        wanted = "" if size is None else f"{size[0]}x{size[1]} "
        raise InputError(f"{place}: expected {wanted}8-bit grey, found {width}x{height} {_kind(bits, colour)}")
    chunks = _chunks(data)
    if not chunks or chunks[-1][0] != b"IEND":
        raise InputError(f"{place}: expected a whole PNG image, found it cut short at {len(data)} bytes")
    if not _whole(b"".join(chunk[8:-4] for kind, chunk in chunks if kind == b"IDAT"), width, height):
        raise InputError(f"{place}: expected a whole PNG image, found damaged data in its rows")
    return decode_image(Path(place), PNG_SIGNATURE + b"".join(chunk for kind, chunk in chunks if kind in NEEDED))


def _kind(bits: int, colour: int) -> str:
    return f"{bits}-bit" + ("" if colour == 0 else " with transparency" if colour == 4 else " in colour")


def _chunks(data: bytes) -> list[tuple[bytes, bytes]]:
    """Kind and bytes of each chunk that is there whole, up to the last one."""
    chunks, position = [], len(PNG_SIGNATURE)
    while position + 12 <= len(data) and (not chunks or chunks[-1][0] != b"IEND"):
        length, kind = struct.unpack_from(">I4s", data, position)
        if position + 12 + length > len(data):
            break
        chunks.append((kind, data[position : position + 12 + length]))
        position += 12 + length
    return chunks


def _whole(rows: bytes, width: int, height: int) -> bool:
    """Whether compressed rows, each a filter's number and its pixels, are as many as the image has."""
    inflater = zlib.decompressobj()
    try:
        plain = inflater.decompress(rows, height * (width + 1) + 1)  # no more than that, whatever is declared
    except zlib.error:
        return False
    whole = inflater.eof and not inflater.unused_data and len(plain) == height * (width + 1)
    return whole and max(plain[:: width + 1]) < FILTERS
