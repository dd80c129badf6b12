"""JSON of any origin: plain values of bounded size and depth, or refused in one line."""

import json
import math
import re
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

from recon.errors import InputError, brief
from recon.files.regular import read_bytes, shown

MOST_BYTES = 1 << 24
MOST_DIGITS = 40  # of a whole number
ODD_LETTER = re.compile(r"\\u(?:0000|[dD][89a-fA-F][0-9a-fA-F]{2})")  # a zero, or half of a pair of surrogates
PAIR = re.compile(r"\\u[dD][89abAB][0-9a-fA-F]{2}\\u[dD][c-fC-F][0-9a-fA-F]{2}")


def read(path: Path, expected: str = "a file", most: int = MOST_BYTES) -> Any:
    """Values of a JSON file.

    Parameters
    ----------
    most : bytes that it may have

    Raises
    ------
    InputError
        If the file is missing, no regular one or no JSON, or has keys twice, numbers that aren't finite or of very many digits,
        half letters (lone surrogates), or values nested too deeply.
    """
    return of_bytes(path, read_bytes(path, most, expected))


def of_bytes(path: Path, data: bytes) -> Any:
    """Values of JSON in UTF-8 that stood in a file; raises InputError as `read` does."""
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"{shown(path)}: expected JSON, found it damaged: no UTF-8 at byte {error.start}") from None
    return parsed(path, text)


def parsed(path: Path, text: str) -> Any:
    """Values of a JSON text that stood in a file; raises InputError as `read` does."""
    endless = partial(_refuse_endless, path)

    def decimal(word: str) -> float:
        value = float(word)
        return value if math.isfinite(value) else endless(word)

    try:
        value = json.loads(text, parse_constant=endless, parse_int=_whole, parse_float=decimal, object_pairs_hook=_object)
    except InputError:
        raise
    except RecursionError:
        raise InputError(f"{shown(path)}: expected JSON, found values nested too deeply: damaged?") from None
    except ValueError as error:  # of the text, or of a number or key in it
        raise InputError(f"{shown(path)}: expected JSON, found it damaged: {error}") from None
    _check_depth(path, value)
    if ODD_LETTER.search(text):
        _check_letters(path, text)
    return value


def _check_letters(path: Path, text: str) -> None:
    """Refuse zeros and half letters, which no file's name takes."""
    whole = PAIR.sub("", text.replace("\\\\", ""))
    if odd := ODD_LETTER.search(whole):
        raise InputError(f"{shown(path)}: expected JSON, found a text with half a letter or a zero in it, {odd[0]}")


def _check_depth(path: Path, value: Any) -> None:
    layer: Sequence[Any] = [value]
    most_depth = 64  # of lists and objects within each other
    for _ in range(most_depth):
        layer = [
            inner
            for outer in layer
            if isinstance(outer, list | dict)
            for inner in (outer if isinstance(outer, list) else outer.values())
        ]
        if not layer:
            return
    raise InputError(f"{shown(path)}: expected JSON, found values nested too deeply: damaged?")


def _object(pairs: Sequence[tuple[str, Any]]) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for key, value in pairs:
        if key in found:
            raise ValueError(f"the key {brief(key)} twice in one object")
        found[key] = value
    return found


def _whole(word: str) -> int:
    if len(word) > MOST_DIGITS:
        raise ValueError(f"a number of {len(word)} digits")
    return int(word)


def _refuse_endless(path: Path, word: str) -> float:
    raise InputError(f"{shown(path)}: expected finite numbers, found {word[:MOST_DIGITS]}")
