"""The log of a session: a line of JSON for each drawing, undo and event, written as it comes, from which all is restored.

Points are in mm in the skin's frame, that of the file of the skin. The last line may be in part, of a computer that stopped.
"""

import errno
import hashlib
import json
import os
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from threading import Lock
from time import time_ns
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from recon.errors import InputError, short, validated
from recon.files import json_text, regular
from recon.files.atomic import named_in_errors
from recon.mentoring.drawings import Drawing, Drawings
from recon.mentoring.posts import MOST_LETTERS, MOST_PLACES, Place
from recon.model.part import Part, Vector
from recon.skin_projection.projector_image import Line
from recon.skin_projection.skin_curve import Kind, SkinCurve

SCHEMA = "sonotwin-mentor/1"
MOST_BYTES = 1 << 30
DIGITS = 4  # of mm, and of normals

Number = Annotated[int, Field(ge=0)]


class Begun(Part):
    """The first line."""

    event: Literal["begun"] = "begun"
    time: str
    schema_: Annotated[Literal["sonotwin-mentor/1"], Field(alias="schema")]
    skin_sha256: str


class Drawn(Part):
    """A drawing."""

    event: Literal["drawn"] = "drawn"
    time: str
    number: Number
    who: str
    picture: Number  # on which it was drawn
    kind: Kind
    text: Annotated[str, Field(max_length=MOST_LETTERS)] = ""
    pixels: Annotated[list[Place], Field(max_length=MOST_PLACES)]  # of camera 1's image
    line: Line
    points: list[Vector | None]  # mm; null where there is no skin
    normals: list[Vector | None]


class Removed(Part):
    """An undo, or a clear."""

    event: Literal["undone", "cleared"]
    time: str
    who: str
    numbers: list[Number]


class Noted(Part):
    """Anything else: who came and left, who was refused, and why it was dark."""

    event: Literal["noted"] = "noted"
    time: str
    words: str


class _Line(Part):
    """A line of the file."""

    line: Annotated[Begun | Drawn | Removed | Noted, Field(discriminator="event")]


class DrawingLog:
    """A log that is written to."""

    def __init__(self, path: Path, clock: Callable[[], int] = time_ns) -> None:
        """Go on with a log that was begun."""
        self._clock, self._lock = clock, Lock()
        with named_in_errors(path):
            self._file = path.open("ab", buffering=0)
            self._file.truncate(_whole(path))

    def drawn(self, drawing: Drawing, picture: int, pixels: list[Place]) -> None:
        """Write a drawing."""
        curve, line = drawing.curve, drawing.line
        self._write(
            {
                "event": "drawn",
                "time": _calendar(drawing.time_ns),
                "number": drawing.number,
                "who": drawing.who,
                "picture": picture,
                "kind": curve.kind,
                "text": drawing.words,
                "pixels": pixels,
                "line": {"width_mm": line.width_mm, "light": line.light, "dash_mm": line.dash_mm},
                "points": _listed(curve.points),
                "normals": _listed(curve.normals),
            }
        )

    def removed(self, how: Literal["undone", "cleared"], who: str, numbers: list[int]) -> None:
        """Write an undo or a clear."""
        self._write({"event": how, "time": self._time(), "who": who, "numbers": numbers})

    def noted(self, words: str) -> None:
        """Write anything else."""
        self._write({"event": "noted", "time": self._time(), "words": short(words, 200)})

    def close(self) -> None:
        """End."""
        self._file.close()

    def _time(self) -> str:
        return _calendar(self._clock())

    def _write(self, entry: dict[str, Any]) -> None:
        """Write a line, or nothing of it: OSError of a full disk leaves no part of it there."""
        content = json.dumps(entry, allow_nan=False).encode() + b"\n"
        with self._lock:
            before = self._file.seek(0, os.SEEK_END)
            try:
                if self._file.write(content) != len(content):
                    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(self._file.name))
            except OSError:
                self._file.truncate(before)
                raise


def begin(path: Path, skin_file: Path) -> None:
    """Write the first line of a log, of drawings on a skin's file."""
    first = {"event": "begun", "time": _calendar(time_ns()), "schema": SCHEMA, "skin_sha256": digest(skin_file)}
    path.write_text(json.dumps(first) + "\n", encoding="utf-8")


def restore(path: Path, skin_file: Path) -> Drawings:
    """Drawings that a log leaves lit.

    Raises
    ------
    InputError
        If a line is damaged, but for the last one in part, or the log is of another skin.
    """
    drawings = Drawings()
    content = regular.read_bytes(path, MOST_BYTES, "a log of `sonotwin mentor`")[: _whole(path)]
    for number, line in enumerate(content.splitlines(), start=1):
        place = f"{path}: line {number}"
        entry = validated(_Line, {"line": json_text.of_bytes(Path(place), line)}, place).line
        if (number == 1) != isinstance(entry, Begun):
            raise InputError(
                f"{place}: expected {'the beginning' if number == 1 else 'what was drawn'} of a log, found {entry.event}"
            )
        if isinstance(entry, Begun) and entry.skin_sha256 != digest(skin_file):
            raise InputError(f"{path}: expected a log of {skin_file}, found one of another skin: give another out, or that skin")
        if isinstance(entry, Drawn):
            drawings.add(_drawing(entry, place))
        elif isinstance(entry, Removed):
            drawings.remove(entry.numbers)
    return drawings


def digest(path: Path) -> str:
    """SHA-256 of a file."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _drawing(entry: Drawn, place: str) -> Drawing:
    if len(entry.points) != len(entry.normals) or len(entry.points) < 2:
        found = f"{len(entry.points)} and {len(entry.normals)}"
        raise InputError(f"{place}: points: expected as many as normals, two or more, found {found}")
    curve = SkinCurve(f"drawing{entry.number}", entry.kind, _array(entry.points), _array(entry.normals))
    try:
        time = round(datetime.fromisoformat(entry.time).timestamp() * 1e9)
    except ValueError:
        raise InputError(f"{place}: time: expected one as 2026-01-31T12:00:00+00:00, found {short(entry.time)}") from None
    return Drawing(entry.number, entry.who, time, entry.text, entry.line, curve)


def _whole(path: Path) -> int:
    """Bytes of a file's whole lines."""
    end = path.stat().st_size
    with path.open("rb") as file:
        step = 4096  # bytes that are looked at, from the end
        while end > 0:
            begin = max(0, end - step)
            file.seek(begin)
            if (place := file.read(end - begin).rfind(b"\n")) >= 0:
                return begin + place + 1
            end = begin
    return 0


def _calendar(time: int) -> str:
    return datetime.fromtimestamp(time / 1e9, UTC).isoformat(timespec="milliseconds")


def _listed(points: np.ndarray) -> list[list[float] | None]:
    rounded = np.round(points, DIGITS)
    return [
        row if whole else None for row, whole in zip(rounded.tolist(), np.isfinite(rounded).all(axis=1).tolist(), strict=True)
    ]


def _array(points: list[Vector | None]) -> np.ndarray:
    nowhere = (np.nan,) * 3
    return np.array([nowhere if point is None else point for point in points], float)
