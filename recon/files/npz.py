"""Arrays from npz files: read whole and checked, or refused in one line."""

import tokenize
import zipfile
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from recon.errors import InputError

NUMBERS = {"f": "decimal numbers", "u": "whole numbers", "b": "true or false", "fiu": "numbers"}  # by letters of numpy's kinds
DAMAGE = (  # what numpy raises on files damaged at random, in the archive or in an array's header; TypeError on a .npy file
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
    try:
        with np.load(path, allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in forms if name in archive.files}
    except FileNotFoundError:
        raise InputError(f"{path}: expected a file, found none") from None
    except DAMAGE:
        raise InputError(f"{path}: expected an npz file of plain arrays, found other or damaged data") from None
    for name in arrays:
        if not isinstance(arrays[name], np.ndarray):  # numpy gives the bytes of what it doesn't know
            raise InputError(f"{path}: {name}: expected an array, found other or damaged data")
    check_forms(path, arrays, forms)
    return arrays


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
