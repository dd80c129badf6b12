"""Tables of a sweep as CSV files with a header: when images were taken, where the target stood, and pairs of pose and pixel.

Numbers are written with as many digits as it takes to read the same ones back.
"""

import csv
from collections.abc import Iterable, Sequence
from itertools import chain
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from recon.errors import InputError, brief, short
from recon.files import atomic
from recon.files.regular import MOST_TABLE, read_bytes
from recon.geometry import rigid
from recon.model.tracks import Track

Array = NDArray[np.float64]
Times = NDArray[np.int64]

STAMPS = ("frame", "time_ns")
POSE = tuple(f"m{row}{column}" for row in range(3) for column in range(4))  # of world_from_target, row by row; mm
TRIANGLE = np.triu_indices(6)
# covariances as of recon.model.tracks, upper triangle: by each pose's own noise, and by what errs alike in all
COVARIANCE, SHARED = (tuple(f"{letter}{row}{column}" for row, column in zip(*TRIANGLE, strict=True)) for letter in "cs")
TRACK = ("time_ns", "found", *POSE)
PAIRS = (*POSE, "u", "v")


def read_stamps(path: Path) -> tuple[NDArray[np.int64], Times]:
    """Read a device's `timestamps.csv`: numbers of the frames : (n,), and their times : (n,) ns, both strictly increasing.

    Raises
    ------
    InputError
        If the file is missing or damaged, or frames or times don't increase.
    """
    _, rows = _read(path, STAMPS)
    table = np.array([[_whole(path, k, name, word) for name, word in zip(STAMPS, row, strict=True)] for k, row in rows], np.int64)
    lines = [k for k, _ in rows]
    for name, column in zip(STAMPS, table.T, strict=True):
        _increasing(path, lines, name, column)
    if table[0, 0] < 0:
        raise InputError(f"{path}: line {lines[0]}: frame: expected a number from 0 on, found {table[0, 0]}")
    return table[:, 0], table[:, 1]


def write_stamps(path: Path, times: Times) -> None:
    """Write `timestamps.csv` for frames numbered from 0, taken at times : (n,) ns."""
    write_rows(path, STAMPS, ([frame, int(time)] for frame, time in enumerate(times)))


def read_track(path: Path) -> Track:
    """Read poses over time: `time_ns`, `found` (1 or 0), 12 numbers of `world_from_target`, and perhaps 21 of each covariance.

    Where the target was not found the numbers are left alone.

    Raises
    ------
    InputError
        If the file is missing or damaged, times don't increase, a pose has values that are not finite or no rotation, or a
        covariance is none.
    """
    header, rows = _read(path, TRACK, COVARIANCE, SHARED)
    lines = [k for k, _ in rows]
    times = np.array([_whole(path, k, "time_ns", row[0]) for k, row in rows], np.int64)
    _increasing(path, lines, "time_ns", times)
    poses = np.full((len(rows), 4, 4), np.nan)
    first = len(TRACK)
    covariances = [np.full((len(rows), 6, 6), np.nan) for _ in range(first, len(header), len(COVARIANCE))]
    for i, (k, row) in enumerate(rows):
        if row[1] not in ("0", "1"):
            raise InputError(f"{path}: line {k}: found: expected 0 or 1, found {brief(row[1])}")
        if row[1] == "0":
            continue
        poses[i] = _pose(path, k, row[2:first])
        for number, each in enumerate(covariances):
            start = first + number * len(COVARIANCE)
            each[i] = _covariance(path, k, header[start : start + len(COVARIANCE)], row[start : start + len(COVARIANCE)])
    return Track(times, poses, *covariances)


def write_track(path: Path, track: Track) -> None:
    """Write poses over time, with the covariances that the track has; where the target was not found the fields are empty."""
    both = ((COVARIANCE, track.covariance), (SHARED, track.shared))
    known = [(names, matrices) for names, matrices in both if matrices is not None]
    header = (*TRACK, *(name for names, _ in known for name in names))

    def row(k: int, found: bool) -> list[int | float | str]:
        if not found:
            return [int(track.times[k]), 0, *[""] * (len(header) - 2)]
        numbers = [number for _, matrices in known for number in matrices[k][TRIANGLE].tolist()]
        return [int(track.times[k]), 1, *track.poses[k, :3].ravel().tolist(), *numbers]

    write_rows(path, header, (row(k, bool(found)) for k, found in enumerate(track.found)))


def read_pairs(path: Path) -> tuple[Array, Array]:
    """Read pairs of a pose and the pixel where a point at rest was seen: `world_from_target` (n, 4, 4) mm and u, v : (n, 2) px.

    Raises
    ------
    InputError
        If the file is missing or damaged, or a value is not finite or no rotation.
    """
    _, rows = _read(path, PAIRS)
    poses = np.array([_pose(path, k, row[: len(POSE)]) for k, row in rows])
    pixels = [[_number(path, k, name, word) for name, word in zip("uv", row[len(POSE) :], strict=True)] for k, row in rows]
    return poses, np.array(pixels)


def write_rows(path: Path, header: Sequence[str], rows: Iterable[Sequence[object]]) -> None:
    """Write a table, whole or not at all, with a header and lines that end as on Unix."""
    with atomic.new_file(path) as temporary, temporary.open("w", encoding="utf-8", newline="") as stream:
        table = csv.writer(stream, lineterminator="\n")
        table.writerow(header)
        table.writerows(rows)


def _read(path: Path, header: Sequence[str], *optional: Sequence[str]) -> tuple[list[str], list[tuple[int, list[str]]]]:
    """The header, and the rows with the numbers of their lines; at least one.

    optional : names that may follow, each group after those before it
    """
    try:
        lines = read_bytes(path, MOST_TABLE).decode("utf-8-sig").splitlines()
        rows = [(k, [word.strip() for word in row]) for k, row in enumerate(csv.reader(lines), start=1) if row]
    except (UnicodeDecodeError, csv.Error):
        raise InputError(f"{path}: expected a table as CSV text, found other or damaged data") from None
    found = rows[0][1] if rows else []
    if found not in [[*header, *chain(*optional[:count])] for count in range(len(optional) + 1)]:
        expected, *more, there = (short(",".join(names)) for names in (header, *optional, found))
        expected += "".join(f", perhaps followed by {names}" for names in more)
        raise InputError(f"{path}: line 1: expected a header {expected}, found {there or 'none'}")
    for k, row in rows[1:]:
        if len(row) != len(found):
            raise InputError(f"{path}: line {k}: expected {len(found)} columns, found {len(row)}")
    if len(rows) < 2:
        raise InputError(f"{path}: expected one row or more below the header, found none")
    return found, rows[1:]


def _whole(path: Path, line: int, name: str, word: str) -> int:
    longest_ns = 1 << 63
    try:
        value = int(word)
    except ValueError:
        value = longest_ns
    if abs(value) >= longest_ns:
        raise InputError(f"{path}: line {line}: {name}: expected a whole number, found {brief(word)}")
    return value


def _number(path: Path, line: int, name: str, word: str) -> float:
    try:
        value = float(word)
    except ValueError:
        value = np.nan
    if not np.isfinite(value):
        raise InputError(f"{path}: line {line}: {name}: expected a finite number, found {brief(word)}")
    return value


def _numbers(path: Path, line: int, names: Sequence[str], words: Sequence[str]) -> list[float]:
    return [_number(path, line, name, word) for name, word in zip(names, words, strict=True)]


def _increasing(path: Path, lines: Sequence[int], name: str, values: NDArray[np.int64]) -> None:
    wrong = np.flatnonzero(values[1:] <= values[:-1]) + 1
    if len(wrong):
        k = wrong[0]
        expected = f"more than the {values[k - 1]} before, in order of time"
        raise InputError(f"{path}: line {lines[k]}: {name}: expected {expected}, found {values[k]}")


def _pose(path: Path, line: int, words: Sequence[str]) -> Array:
    pose = np.vstack([np.reshape(_numbers(path, line, POSE, words), (3, 4)), [0, 0, 0, 1]])
    if found := rigid.fault(pose):
        raise InputError(f"{path}: line {line}: expected {rigid.RIGID}, row by row, found {found}")
    return pose


def _covariance(path: Path, line: int, names: Sequence[str], words: Sequence[str]) -> Array:
    upper = np.zeros((6, 6))
    upper[TRIANGLE] = _numbers(path, line, names, words)
    matrix = upper + np.triu(upper, 1).T
    sigma = np.sqrt(np.abs(np.diag(matrix)))
    unit = np.where(sigma > 0, sigma, 1.0)
    with np.errstate(over="ignore"):
        correlations = matrix / np.outer(unit, unit)
    if not np.abs(correlations).max() < 2 or np.linalg.eigvalsh(correlations).min() < -1e-6:
        raise InputError(f"{path}: line {line}: expected the upper triangle of a covariance, found a matrix that is none")
    return matrix
