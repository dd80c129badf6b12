"""Arrays from npz files: read whole and checked, or refused in one line."""

import io
import tokenize
import warnings
import zipfile
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from recon.errors import InputError
from recon.files.regular import opened, read_bytes

NUMBERS = {"f": "decimal numbers", "u": "whole numbers", "b": "true or false", "fiu": "numbers"}  # by letters of numpy's kinds
MOST_BYTES = 1 << 29  # of arrays, once they are unpacked
PACKINGS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
DAMAGE = (  # what numpy raises on files damaged at random, in the archive or in an array's header
    *(ValueError, TypeError, EOFError, OSError, OverflowError, MemoryError, RuntimeError, SyntaxError),
    *(tokenize.TokenError, zipfile.BadZipFile, zlib.error),
)


@dataclass(frozen=True)
class Form:
    """Expected form of an array."""

    numbers: str  # a key of NUMBERS
    shape: tuple[int | None, ...] | None = None  # None for a length that is free, or for any shape
    optional: bool = False  # whether the file may be without it


def read(path: Path, forms: Mapping[str, Form]) -> dict[str, NDArray]:
    """Read named arrays from an npz file, optional ones as far as they are there; others in it are left alone.

    Raises
    ------
    InputError
        If the file is missing, damaged or of another kind, or an array is missing or of another form.
    """
    with opened(path, MOST_BYTES) as stream:
        try:
            with zipfile.ZipFile(stream) as archive:
                entries = {entry.filename.removesuffix(".npy"): entry for entry in archive.infolist()}
                arrays = _arrays(path, archive, {name: entries[name] for name in forms if name in entries})
        except DAMAGE as error:
            if isinstance(error, InputError):
                raise
            raise InputError(f"{path}: expected an npz file of plain arrays, found other or damaged data") from None
    check_forms(path, arrays, forms)
    return arrays


def read_npy(path: Path) -> NDArray:
    """Read the only array of an npy file; InputError if it is missing or damaged, or holds more than numbers and texts."""
    data = read_bytes(path, MOST_BYTES)
    try:
        return _array(data)
    except DAMAGE:
        raise InputError(f"{path}: expected an array of numbers, found other or damaged data") from None


def _arrays(path: Path, archive: zipfile.ZipFile, entries: Mapping[str, zipfile.ZipInfo]) -> dict[str, NDArray]:
    if (size := sum(entry.file_size for entry in entries.values())) > MOST_BYTES:
        raise InputError(f"{path}: expected arrays of up to {MOST_BYTES >> 20} MiB, found {size >> 20} MiB")
    arrays = {}
    for name, entry in entries.items():
        if entry.compress_type not in PACKINGS:
            raise zipfile.BadZipFile("packed in another way")
        with archive.open(entry) as stream:
            arrays[name] = _array(stream.read(entry.file_size))  # no more than it says, whatever is unpacked
    return arrays


def _array(data: bytes) -> NDArray:
    with warnings.catch_warnings():  # of old files, and of odd types
        warnings.simplefilter("ignore")
        return np.lib.format.read_array(io.BytesIO(data), allow_pickle=False)


def check_forms(path: Path, arrays: Mapping[str, NDArray], forms: Mapping[str, Form]) -> None:
    """Check that the arrays of a file are all there, each in its form; raises InputError at the first that isn't."""
    for name, form in forms.items():
        if name not in arrays and form.optional:
            continue
        if name not in arrays:
            raise InputError(f"{path}: {name}: expected an array, found none")
        array = arrays[name]
        if array.dtype.kind not in form.numbers:
            raise InputError(f"{path}: {name}: expected {NUMBERS[form.numbers]}, found {array.dtype}")
        if form.shape is not None and not _fits(array.shape, form.shape):
            wanted = " x ".join("any" if length is None else str(length) for length in form.shape)
            raise InputError(f"{path}: {name}: expected an array of {wanted}, found one of {' x '.join(map(str, array.shape))}")


def _fits(found: tuple[int, ...], wanted: tuple[int | None, ...]) -> bool:
    return len(found) == len(wanted) and all(w in (None, f) for f, w in zip(found, wanted, strict=True))
