"""Plausible mistakes of users in what a command is given: units, frames, order, mirrored, doubled, late, frozen, devices, fields.

Each changes the files of a folder of links, or gives other fields, and has the words by which a refusal would name it.
"""

import json
import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Rng = np.random.Generator
Change = Callable[[Path, Rng], tuple[str, ...]]  # (folder of the command, seed) -> fields that are given instead

UNITS = {"metres": 1e-3, "centimetres": 0.1, "inches": 1 / 25.4, "micrometres": 1e3}


@dataclass(frozen=True)
class Mistake:
    """A mistake, as it can be made with one command."""

    kind: str  # units, frames, order, mirrored, doubled, late, frozen, device or field
    what: str  # was done, in words
    cause: str  # a pattern of words that name it
    change: Change


def _named(folder: Path, field: str, ending: str) -> list[Path]:
    paths = sorted((folder / field).glob(f"*{ending}"))
    if not paths:
        raise FileNotFoundError(folder / field)
    return paths


def write(path: Path, content: bytes | str) -> None:
    """Write a file anew: others may be linked to the old one."""
    path.unlink(missing_ok=True)
    path.write_bytes(content if isinstance(content, bytes) else content.encode())


# Images


def reordered(images: str, how: str) -> Change:
    """The images of a folder in another order: exchanged, shuffled, reversed, doubled or late by one."""

    def change(folder: Path, rng: Rng) -> tuple[str, ...]:
        paths = _named(folder, images, ".png")
        order = np.arange(len(paths))
        a, b = sorted(rng.choice(len(paths), 2, replace=False).tolist())
        if how == "exchanged":
            order[[a, b]] = b, a
        elif how == "shuffled":
            order = rng.permutation(order)
        elif how == "reversed":
            order = order[::-1]
        elif how == "doubled":
            order[b] = b - 1
        elif how == "late":
            order = np.roll(order, 1)
        elif how == "frozen":
            order[a:] = a
        kept = [path.read_bytes() for path in paths]
        for path, k in zip(paths, order.tolist(), strict=True):
            write(path, kept[k])
        return ()

    return change


def seen(images: str, how: Callable[[NDArray], NDArray]) -> Change:
    """The images of folders (a pattern of names) changed one by one."""

    def change(folder: Path, rng: Rng) -> tuple[str, ...]:
        paths = sorted(path for path in folder.glob(images) if path.suffix == ".png")
        for path in paths:
            image = how(cv2.imread(str(path), cv2.IMREAD_UNCHANGED))
            write(path, cv2.imencode(".png", image)[1].tobytes())
        return ()

    return change


def mirrored(image: NDArray) -> NDArray:
    """Left and right exchanged."""
    return np.ascontiguousarray(image[:, ::-1])


def upside_down(image: NDArray) -> NDArray:
    """Up and down exchanged."""
    return np.ascontiguousarray(image[::-1])


def turned(image: NDArray) -> NDArray:
    """Turned by half a turn."""
    return np.ascontiguousarray(image[::-1, ::-1])


def with_gamma(image: NDArray) -> NDArray:
    """Stored with the gamma of a screen."""
    full = np.iinfo(image.dtype).max
    return np.rint(full * (image / full) ** (1 / 2.2)).astype(image.dtype)


def stretched(image: NDArray) -> NDArray:
    """Stretched to the whole range, as viewers store it."""
    low, high = np.percentile(image, [0.5, 99.5])
    return np.uint8(np.clip(255 * (image.astype(float) - low) / max(high - low, 1), 0, 255))


def swapped(first: str, second: str) -> Change:
    """Two folders, or files, exchanged."""

    def change(folder: Path, rng: Rng) -> tuple[str, ...]:
        a, b, aside = folder / first, folder / second, folder / "aside"
        os.rename(a, aside)
        os.rename(b, a)
        os.rename(aside, b)
        return ()

    return change


def taken_from(source: str, target: str) -> Change:
    """The images of another folder in the place of the right ones, as many as there are."""

    def change(folder: Path, rng: Rng) -> tuple[str, ...]:
        others = _named(folder, source, ".png")
        for path, other in zip(_named(folder, target, ".png"), others, strict=False):
            write(path, other.read_bytes())
        return ()

    return change


# Fields


def given(*fields: str) -> Change:
    """Other fields."""
    return lambda folder, rng: fields


def json_field(path: str, field: str, value: Any) -> Change:
    """A field of a JSON; a function makes the value from the right one."""

    def change(folder: Path, rng: Rng) -> tuple[str, ...]:
        content = json.loads((folder / path).read_text(encoding="utf-8"))
        *way, last = [int(key) if key.isdigit() else key for key in field.split(".")]
        inner = content
        for key in way:
            inner = inner[key]
        right = inner.get(last) if isinstance(inner, dict) else inner[last]
        inner[last] = value(right) if callable(value) else value
        write(folder / path, json.dumps(content))
        return ()

    return change


def both(*changes: Change) -> Change:
    """Several changes."""

    def change(folder: Path, rng: Rng) -> tuple[str, ...]:
        return tuple(field for one in changes for field in one(folder, rng))

    return change
