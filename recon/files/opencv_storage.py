"""OpenCV FileStorage as calibrations are kept in it, YAML, XML or JSON: values and matrices read, or refused in one line."""

import base64
import math
import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element

import cv2
import numpy as np
import yaml
from numpy.typing import NDArray
from yaml.events import AliasEvent, CollectionEndEvent, CollectionStartEvent, DocumentStartEvent, ScalarEvent, SequenceStartEvent

from recon.errors import InputError, brief, short
from recon.files import atomic, json_text, regular, xml_text, yaml_text

Array = NDArray[np.float64]

MOST_BYTES = xml_text.MOST_BYTES
Values = dict[str, Any]  # texts, numbers, lists and maps; a matrix is a map of rows, cols, dt and data

DTYPES = {  # by OpenCV's letters
    **{"u": "u1", "c": "i1", "w": "u2", "s": "i2", "i": "i4", "f": "f4", "d": "f8", "h": "f2"},
    **{"b": "u1", "n": "u4", "I": "i8", "U": "u8"},  # of its version 5
}
DTYPE = re.compile(rf"(\d{{0,3}})([{''.join(DTYPES)}])")  # numbers an entry, and their letter
BASE64, BASE64_HEADER = "$base64$", 24  # what packed numbers begin with, and bytes of it that name their type
WHOLE = re.compile(r"[-+]?\d{1,18}")
DECIMAL = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d{1,9})?")
ENDLESS = re.compile(r"([-+]?)\.(nan|inf)", re.IGNORECASE)
WORD = re.compile(r'"([^"]*)"|(\S+)')  # of XML
JSON_PIECE = re.compile(r'("(?:[^"\\]|\\.)*")|//[^\n]*|/\*.*?\*/|([-+.\w]+)', re.DOTALL)  # a text, a comment, or else a word
HEADER = re.compile(r"^%YAML[^\n]*", re.MULTILINE)  # which other parsers don't take


def read(path: Path, expected: str) -> Values | None:
    """Values in a file; None for an npz file.

    OpenCV's own reader believes what a matrix declares, and reads beyond its numbers; it is used to write only.

    Parameters
    ----------
    expected : what the file should be, for the message where it can't be read

    Raises
    ------
    InputError
        If there is no such file, or it is neither, or too large.
    """
    data = regular.read_bytes(path, expected=expected)
    if data.startswith(b"PK"):  # of any zip file
        return None
    if len(data) > MOST_BYTES:
        found = "found more: leave out the images' points and maps, or give the matrices as npz"
        raise InputError(f"{regular.shown(path)}: expected {expected} of up to {MOST_BYTES >> 20} MiB, {found}")
    kinds = "an npz file or OpenCV's YAML, XML or JSON"
    if data.lstrip().startswith(b"<"):
        return _map(_of_element(xml_text.parsed(path, data)))
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError:
        raise InputError(f"{path}: expected {kinds}, found other or damaged data") from None
    if text.lstrip().startswith("{"):
        return _map(json_text.parsed(path, JSON_PIECE.sub(_strict, text)))
    if not text.startswith("%YAML"):
        raise InputError(f"{path}: expected {kinds}, found other or damaged data")
    most = max(len(text), yaml_text.MOST_VALUES)  # by what is written, which aliases can't multiply
    documents = _of_events(yaml_text.events(path, HEADER.sub("", text), most))
    return {key: value for document in reversed(documents) for key, value in _map(document).items()}  # as a file is extended


def read_schema(path: Path, expected: str, schema: str) -> Values:
    """Values in a file of a schema.

    Parameters
    ----------
    expected : as of `read`

    Raises
    ------
    InputError
        As of `read`, or if its schema is missing or another one.
    """
    values = read(path, expected) or {}
    if values.get("schema") != schema:
        found = short(values["schema"]) if isinstance(values.get("schema"), str) else "none"
        raise InputError(f"{path}: schema: expected {schema}, found {found}")
    return values


def _map(value: Any) -> Values:
    return value if isinstance(value, dict) else {}


def _of_events(events: Iterable[yaml.Event]) -> list[Any]:
    """Values of a text's documents, at once: nodes of PyYAML's between would take some hundred bytes a number."""
    documents: list[Any] = []
    open_ones: list[tuple[CollectionStartEvent, list[Any]]] = []
    anchored: dict[str, Any] = {}
    for event in events:
        if isinstance(event, CollectionStartEvent):
            open_ones.append((event, []))
            continue
        if isinstance(event, DocumentStartEvent):
            anchored.clear()
        if isinstance(event, AliasEvent):
            anchor, value = None, anchored[event.anchor]
        elif isinstance(event, ScalarEvent):
            key = open_ones and not isinstance(open_ones[-1][0], SequenceStartEvent) and len(open_ones[-1][1]) % 2 == 0
            anchor, value = event.anchor, event.value if key else _of_scalar(event)
        elif isinstance(event, CollectionEndEvent):
            start, inner = open_ones.pop()
            anchor, value = start.anchor, inner if isinstance(start, SequenceStartEvent) else _of_pairs(inner)
        else:
            continue
        if anchor is not None:
            anchored[anchor] = value
        (open_ones[-1][1] if open_ones else documents).append(value)
    return documents


def _of_pairs(keys_and_values: Sequence[Any]) -> Values:
    pairs = zip(keys_and_values[::2], keys_and_values[1::2], strict=True)
    return {key: value for key, value in pairs if isinstance(key, str)}


def _of_scalar(scalar: ScalarEvent) -> Any:
    if scalar.tag == "tag:yaml.org,2002:binary":
        return BASE64 + scalar.value
    return scalar.value if scalar.style else _of_word(scalar.value)


def _of_element(element: Element) -> Any:
    inner = list(element)
    if inner and all(child.tag == "_" for child in inner):
        return [_of_element(child) for child in inner]
    if inner:
        return {child.tag: _of_element(child) for child in inner}
    if element.get("type_id") == "binary":
        return BASE64 + (element.text or "")
    words = [_of_word(plain) if plain else quoted for quoted, plain in WORD.findall(element.text or "")]
    return words[0] if len(words) == 1 else words


def _of_word(word: str) -> int | float | str:
    """A number, or else the word as it is."""
    if WHOLE.fullmatch(word):
        return int(word)
    if DECIMAL.fullmatch(word):
        return float(word)
    endless = ENDLESS.fullmatch(word)
    return float(endless[1] + endless[2]) if endless else word


def _strict(piece: re.Match) -> str:
    """A piece of OpenCV's JSON as others have it: without comments, and with digits on both sides of a point."""
    if piece[1] is not None:
        return piece[1]
    word = piece[2] or ""
    if ENDLESS.fullmatch(word):
        return f'"{word}"'
    return repr(float(word)) if "." in word and DECIMAL.fullmatch(word) else word


def matrix(path: Path, name: str, value: Any) -> Array:
    """A matrix : (rows, columns), or (rows, columns, channels), by its declaration; of other numbers of axes, too.

    Raises
    ------
    InputError
        If there is none, or something else; or its numbers are more, less or others than it declares.
    """
    if value is None:
        raise InputError(f"{path}: {name}: expected a matrix, found none")
    if not isinstance(value, dict) or not {"dt", "data"} <= value.keys():
        raise InputError(f"{path}: {name}: expected a matrix, found something else")
    kind = DTYPE.fullmatch(str(value["dt"]))
    if kind is None:
        letters = ", ".join(DTYPES)
        raise InputError(
            f"{path}: {name}.dt: expected one of {letters}, perhaps after a number of channels, found {brief(value['dt'])}"
        )
    channels, dtype = int(kind[1] or 1), np.dtype(DTYPES[kind[2]])
    if "sizes" in value:
        shape = tuple(_numbers(path, f"{name}.sizes", value["sizes"], np.dtype("i4")).tolist())
    else:
        shape = tuple(_length(path, f"{name}.{side}", value.get(side)) for side in ("rows", "cols"))
    shape += (channels,) if channels != 1 else ()
    numbers = _numbers(path, name, value["data"], dtype)
    if min(shape, default=0) < 0 or numbers.size != math.prod(shape):
        declared = " x ".join(map(str, shape)) or "no"
        raise InputError(f"{path}: {name}: expected {declared} numbers, as it declares, found {numbers.size}")
    return numbers.reshape(shape).astype(float)


def _length(path: Path, name: str, value: Any) -> int:
    if not isinstance(value, int) or value < 0:
        raise InputError(f"{path}: {name}: expected a whole number, found {'none' if value is None else 'something else'}")
    return value


def _numbers(path: Path, name: str, value: Any, dtype: np.dtype) -> NDArray:
    """Numbers : (n,) of a type, from a list, a single one, or packed ones."""
    if isinstance(value, str) and value.startswith(BASE64):
        return _unpack(path, name, value, dtype)
    listed = [_of_word(one) if isinstance(one, str) else one for one in (value if isinstance(value, list) else [value])]
    wrong = next((one for one in listed if isinstance(one, bool) or not isinstance(one, int | float)), None)
    if wrong is not None or None in listed:
        raise InputError(f"{path}: {name}: expected a matrix of numbers, found {brief(wrong)} among them")
    numbers = np.array(listed, float)
    if dtype.kind == "f":
        with np.errstate(over="ignore"):
            return numbers.astype(dtype)
    bounds = np.iinfo(dtype)
    outside = (numbers != np.rint(numbers)) | (numbers < bounds.min) | (numbers > bounds.max) | ~np.isfinite(numbers)
    if outside.any():
        found = f"{numbers[outside.argmax()]:g}: should dt be d?"
        raise InputError(f"{path}: {name}: expected whole numbers of {bounds.min} to {bounds.max}, as dt declares, found {found}")
    return numbers.astype(dtype)


def _unpack(path: Path, name: str, text: str, dtype: np.dtype) -> NDArray:
    """Numbers : (n,) of a type, packed as base64 after a header that names it."""
    try:
        data = base64.b64decode("".join(text.removeprefix(BASE64).split()), validate=True)
        kind = DTYPE.fullmatch(data[:BASE64_HEADER].decode("ascii").strip())
        if kind is None or np.dtype(DTYPES[kind[2]]) != dtype:
            raise ValueError("another type")
        return np.frombuffer(data[BASE64_HEADER:], dtype.newbyteorder("<")).astype(dtype)
    except ValueError:
        raise InputError(f"{path}: {name}: expected packed numbers of its type, found other or damaged data") from None


def names(values: Values) -> tuple[str, ...] | None:
    """Names of a covariance's parameters; empty where they are no texts, None where there are neither names nor covariance."""
    if not {"parameters", "covariance"} & values.keys():
        return None
    entries = values.get("parameters")
    return tuple(entries) if isinstance(entries, list) and all(isinstance(entry, str) for entry in entries) else ()


def write_covariance(storage: cv2.FileStorage, names: Sequence[str], covariance: Array) -> None:
    """Write a covariance with the names of its parameters."""
    storage.startWriteStruct("parameters", cv2.FileNode_SEQ)
    for name in names:
        storage.write("", name)
    storage.endWriteStruct()
    storage.write("covariance", covariance)


def save(path: Path, storage: cv2.FileStorage) -> None:
    """Write a storage in memory to a file, whole or not at all."""
    text = storage.releaseAndGetString()
    with atomic.new_file(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def covariance(path: Path, values: Values, count: int) -> Array:
    """The matrix `covariance` of a number of parameters, made exactly symmetric.

    Raises
    ------
    InputError
        If it is missing, of another shape, not finite, not symmetric, or no covariance.
    """
    found = matrix(path, "covariance", values.get("covariance"))
    expected = f"{path}: covariance: expected {count}x{count} variances and covariances of the parameters, found"
    if found.shape != (count, count):
        raise InputError(f"{expected} shape {found.shape}")
    if not np.isfinite(found).all():
        raise InputError(f"{expected} values that are not finite")
    sigma = np.sqrt(np.abs(np.diag(found)))
    scale = np.outer(sigma, sigma) + np.finfo(float).tiny
    symmetric = 1e-9  # of a covariance, relative to the standard deviations: it comes from a text file
    if (np.abs(found - found.T) > symmetric * scale).any():
        raise InputError(f"{expected} a matrix that is not symmetric")
    if np.diag(found).min() < 0 or (np.abs(found) > (1 + symmetric) * scale).any():
        raise InputError(f"{expected} a variance below zero or a correlation beyond one")
    return (found + found.T) / 2
