"""Matrices from MATLAB's files, version 5 to 7: read whole and checked, or refused in one line.

SciPy's reader knows more kinds of content, but files damaged at random make it end the process. Read here are arrays of real
numbers, which is all that calibrations need.

Source: MathWorks, MAT-File Level 5 File Format.
"""

import struct
import zlib
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from recon.errors import InputError
from recon.files.npz import Form, check_forms
from recon.files.regular import opened, read_bytes

BEGIN = b"MATLAB "  # of the header's text, in all versions from 5 on
HDF5 = b"MATLAB 7.3"  # a file of another kind
HEADER = 128  # bytes, the order of bytes in the last two
ORDERS = {b"IM": "<", b"MI": ">"}
NUMBERS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}  # by type of an element
MATRIX, COMPRESSED = 14, 15  # types of elements
NUMERIC = range(6, 16)  # classes of arrays
OBJECTS = (3, 17)
COMPLEX = 0x800  # in an array's flags
MOST = 1 << 24  # bytes, of an element once it is unpacked


def is_matlab(path: Path) -> bool:
    """Whether a file is one of MATLAB's, by its first bytes; raises InputError if it can't be read."""
    with opened(path) as stream:
        return stream.read(len(BEGIN)) == BEGIN


def read(path: Path, forms: Mapping[str, Form], other_names: Mapping[str, str]) -> dict[str, NDArray]:
    """Read named matrices; others in the file are left alone.

    Parameters
    ----------
    other_names : old name -> name that stands in `forms`

    Raises
    ------
    InputError
        If the file is damaged, of version 7.3, holds objects in place of matrices, or one is missing or of another form.
    """
    data = read_bytes(path)
    if data.startswith(HDF5):
        raise InputError(f"{path}: expected a MATLAB file of version 5 to 7, found 7.3: save it with -v7")
    arrays, objects = {}, False
    try:
        order = ORDERS[data[HEADER - 2 : HEADER]]
        for content in _arrays(data[HEADER:], order):
            kind, name, array = _array(content, order)
            objects |= kind in OBJECTS
            if array is not None and other_names.get(name, name) in forms:
                arrays[other_names.get(name, name)] = array
    except (KeyError, IndexError, TypeError, ValueError, StopIteration, struct.error, zlib.error):
        raise InputError(f"{path}: expected a MATLAB file of version 5 to 7, found damaged data") from None
    if objects and not forms.keys() & arrays.keys():
        raise InputError(f"{path}: expected matrices {', '.join(forms)}, found a MATLAB object: save its matrices by these names")
    arrays = {name: arrays[name] for name in forms if name in arrays}
    check_forms(path, arrays, forms)
    return arrays


def _arrays(data: bytes, order: str) -> Iterator[bytes]:
    """Contents of the arrays of a file."""
    for kind, content in _elements(data, order):
        if kind == COMPRESSED:
            kind, content = next(_elements(zlib.decompressobj().decompress(content, MOST), order), (0, b""))
        if kind == MATRIX:
            yield content


def _array(content: bytes, order: str) -> tuple[int, str, NDArray | None]:
    """Class and name of an array, and its numbers; these are None, and the name is empty, if it doesn't hold real ones."""
    elements = _elements(content, order)
    flags = int(_numbers(*next(elements), order)[0])
    if flags & 0xFF not in NUMERIC or flags & COMPLEX:
        return flags & 0xFF, "", None
    shape = _numbers(*next(elements), order).tolist()
    name = next(elements)[1].decode("ascii")
    return flags & 0xFF, name, _numbers(*next(elements), order).reshape(shape, order="F")


def _numbers(kind: int, content: bytes, order: str) -> NDArray:
    return np.frombuffer(content, np.dtype(NUMBERS[kind]).newbyteorder(order))


def _elements(data: bytes, order: str) -> Iterator[tuple[int, bytes]]:
    """Types and contents of the elements that follow each other; ValueError if one is cut short."""
    at = 0
    while at < len(data):
        kind, size = struct.unpack_from(f"{order}II", data, at)
        begin, small = at + 8, kind >> 16
        if small:  # up to four bytes lie in the tag itself
            kind, size, begin = kind & 0xFFFF, small, at + 4
        if begin + size > len(data) or small > 4:
            raise ValueError("an element is cut short")
        yield kind, data[begin : begin + size]
        at = begin + size if kind == COMPRESSED else begin + -(-size // 8) * 8 if not small else at + 8
