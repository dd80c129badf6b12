"""Tables of poses of any tracker: CSV with columns of any name or none, times and lengths of any unit, rotations of any kind."""

import csv
import logging
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BeforeValidator, Field, model_validator
from scipy.spatial.transform import Rotation

from recon.errors import InputError, brief
from recon.files.regular import MOST_TABLE, read_bytes
from recon.geometry import rigid
from recon.model import pose_checks
from recon.model.rig import Part
from recon.model.tracks import Track

log = logging.getLogger(__name__)

Array = NDArray[np.float64]

SECONDS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
MILLIMETRES = {"mm": 1.0, "cm": 10.0, "m": 1000.0}
MOST_SECONDS = 9e9  # of a time stamp, that nanoseconds of 64 bits can hold
MOST_OFF = 0.02  # of a rotation from the nearest exact one

Column = Annotated[str, BeforeValidator(lambda value: str(value) if type(value) is int else value)]  # a name, or a number from 1
Names = tuple[Column, ...]


class Columns(Part):
    """Names of a table's columns, or their numbers from 1 where it has no header, and units of their values."""

    time: Column | None
    """null where the table has a row a frame of the clip"""
    time_unit: Literal["s", "ms", "us", "ns"] = "s"
    """s, ms, us or ns"""
    translation: Annotated[Names, Field(min_length=3, max_length=3)] | None = None
    """three names, x, y, z; null with a matrix of 12 or 16"""
    length_unit: Literal["mm", "cm", "m"] = "mm"
    """mm, cm or m"""
    quaternion: Annotated[Names, Field(min_length=4, max_length=4)] | None = None
    """four names, x, y, z, w; or instead of it"""
    matrix: Names | None = None
    """names row by row: 9 of a rotation, 12 or 16 of a whole pose"""
    inverted: bool = False
    """true where the table holds the tracker in the frame of the probe's target"""

    @model_validator(mode="after")
    def _one_rotation(self) -> "Columns":
        if (self.quaternion is None) == (self.matrix is None):
            raise ValueError(f"expected quaternion or matrix, found {'neither' if self.matrix is None else 'both'}")
        whole = self.matrix is not None and len(self.matrix) in (12, 16)
        if self.matrix is not None and not whole and len(self.matrix) != 9:
            raise ValueError(f"matrix: expected 9, 12 or 16 columns, found {len(self.matrix)}")
        if whole == (self.translation is not None):
            raise ValueError("translation: expected with a quaternion or 9 columns of a matrix, and only then")
        return self

    @property
    def names(self) -> Names:
        """All columns that are read: the time first, if there is one."""
        return (*(() if self.time is None else (self.time,)), *(self.translation or ()), *(self.quaternion or self.matrix or ()))


def read(path: Path, columns: Columns, frames: NDArray[np.int64] | None = None) -> Track:
    """Read poses `world_from_target`; a row with an empty cell, a NaN or NDI's mark is one in which the target wasn't found.

    Of rows with the same time the first with a pose counts; the others are left out, with a warning.

    Parameters
    ----------
    frames : (n,) ns
        Times of the clip's frames, for a table without times.

    Raises
    ------
    InputError
        If the file or a column is missing, a value is no number, times fall or most repeat, or a rotation is none; or a table
        without times has another number of rows than the clip has frames.
    """
    lines, table = _numbers(path, columns.names, columns.time is not None)
    if columns.time is None:
        times = np.empty(0, np.int64) if frames is None else frames
        while len(table) > len(times) and np.isnan(table[-1]).all():
            table = table[:-1]  # empty rows below it
        if len(table) != len(times):
            expected = f"a row for each of {len(times)} frames of the clip, where columns.time is null"
            raise InputError(f"{path}: expected {expected}, found {len(table)}")
        values = table
    else:
        times, values = _times(path, lines, table[:, 0], columns), table[:, 1:]
    if len(table) < 2:
        raise InputError(f"{path}: expected two rows or more below the header, found {len(table)}")
    there = np.isfinite(values).all(axis=1) & ~np.array([pose_checks.is_lost(row) for row in values])
    if not there.any():
        raise InputError(f"{path}: expected a row with values in all of {', '.join(columns.names)}, found none")
    poses = np.full((len(table), 4, 4), np.nan)
    for k in np.flatnonzero(there):
        poses[k] = _pose(path, lines[k], values[k], columns)
    order = np.lexsort((~there, times))
    moments, first = np.unique(times[order], return_index=True)
    if len(moments) < len(times):
        again = np.flatnonzero(np.diff(times) == 0) + 1
        found = f"from line {lines[again[0]]} on, with the time of the row before"
        if 2 * len(moments) <= len(times):
            raise InputError(f"{path}: {columns.time}: expected a time of its own in most rows, found {len(again)} rows, {found}")
        log.warning("%s: left out %d of %d rows, %s", path, len(again), len(times), found)
    return Track(moments, poses[order[first]])


def _times(path: Path, lines: list[int], column: Array, columns: Columns) -> NDArray[np.int64]:
    """Times : (n,) ns, that don't fall."""
    seconds = column * SECONDS[columns.time_unit]
    if not (np.abs(seconds) < MOST_SECONDS).all():
        k = int(np.abs(seconds).argmax())
        expected = f"seconds below {MOST_SECONDS:g}; another unit? give columns.time_unit=ms, us or ns"
        raise InputError(f"{path}: line {lines[k]}: {columns.time}: expected {expected}, found {seconds[k]:.15g}")
    times = np.rint(seconds * 1e9).astype(np.int64)
    wrong = np.flatnonzero(np.diff(times) < 0) + 1
    if len(wrong):
        line, expected = lines[wrong[0]], "a time after that of the row before"
        raise InputError(f"{path}: line {line}: {columns.time}: expected {expected}, found {column[wrong[0]]:.15g}")
    return times


def _pose(path: Path, line: int, values: Array, columns: Columns) -> Array:
    if (largest := np.abs(values).max()) > rigid.FARTHEST_MM:
        raise InputError(f"{path}: line {line}: expected {rigid.RIGID}, found a value of {largest:g}: another unit?")
    pose = np.eye(4)
    if columns.matrix is not None and len(columns.matrix) > 9:
        pose[: len(values) // 4] = values.reshape(-1, 4)
    else:
        pose[:3, 3] = values[:3]
        pose[:3, :3] = _rotation(path, line, values[3:])
    pose[:3, 3] *= MILLIMETRES[columns.length_unit]
    nearest, last = rigid.nearest(pose), np.abs(pose[3] - [0, 0, 0, 1]).max()
    last_row = 1e-6  # by which a matrix' last row may be off 0 0 0 1
    if np.linalg.det(nearest[:3, :3]) < 0 or np.abs(nearest - pose).max() > MOST_OFF or last > last_row:
        raise InputError(
            f"{path}: line {line}: expected {rigid.RIGID}, row by row, found {rigid.fault(pose) or 'another matrix'}"
        )
    return rigid.invert(nearest) if columns.inverted else nearest


def _rotation(path: Path, line: int, values: Array) -> Array:
    if len(values) == 9:
        return values.reshape(3, 3)
    length = float(np.linalg.norm(values))
    if abs(length - 1) > MOST_OFF:
        raise InputError(f"{path}: line {line}: quaternion: expected a length of 1, found {length:.4g}")
    return Rotation.from_quat(values).as_matrix()


def _numbers(path: Path, names: Names, timed: bool) -> tuple[list[int], Array]:
    """Numbers of lines, and values : (n, k) of columns; NaN of empty cells, but none of the first column if it is the time."""
    separators = ",;\t"  # else blanks
    try:
        text = read_bytes(path, MOST_TABLE).decode("utf-8-sig")
        first = text.partition("\n")[0]
        separator = next((one for one in separators if one in first), " ")
        parsed = csv.reader(text.splitlines(), delimiter=separator, skipinitialspace=True)
        rows = [row for row in enumerate(parsed, start=1) if any(row[1]) or (len(row[1]) > 1 and not timed)]
    except (UnicodeDecodeError, csv.Error):
        raise InputError(f"{path}: expected a table as CSV text, found other or damaged data") from None
    while rows and not any(rows[0][1]) and not all(name.isdigit() for name in names):
        del rows[0]  # above a header
    header = [word.strip() for word in rows[0][1]] if rows else []
    words = [word for word in header if word]  # fewer of a pose that wasn't found, and over the rows' own numbers
    named = 1 < len(words) < len(header) and words == [str(number) for number in range(len(words))]
    bare = bool(header) and all(_is_number(word) for word in words) and not named
    by_number = {str(number): number - 1 for number in range(1, len(header) + 1)}
    known = by_number if bare else by_number | {name: header.index(name) for name in header}
    missing = [name for name in names if name not in known]
    if missing and bare:
        way = "without a header give columns by their numbers from 1, such as time: 1"
        raise InputError(f"{path}: line 1: expected a column {missing[0]}, found {len(header)} numbers; {way}")
    if missing:
        raise InputError(f"{path}: line 1: expected a column {missing[0]}, found {', '.join(header) or 'none'}; give columns=...")
    places, rows = [known[name] for name in names], rows[0 if bare else 1 :]
    table = np.full((len(rows), len(names)), np.nan)
    for k, (line, row) in enumerate(rows):
        if len(row) > len(header) and any(row[len(header) :]):
            raise InputError(f"{path}: line {line}: expected {len(header)} values, as the header has, found {len(row)}")
        for j, place in enumerate(places):
            table[k, j] = _number(path, line, names[j], row[place] if place < len(row) else "")
        if timed and not np.isfinite(table[k, 0]):
            raise InputError(f"{path}: line {line}: {names[0]}: expected a time, found none")
    return [line for line, _ in rows], table


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def _number(path: Path, line: int, name: str, word: str) -> float:
    try:
        return float(word) if word.strip() else np.nan
    except ValueError:
        raise InputError(f"{path}: line {line}: {name}: expected a number, found {brief(word)}") from None
