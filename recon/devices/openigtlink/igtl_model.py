"""Models of OpenIGTLink: POLYDATA, read and written as triangles in RAS, mm. Vertices, lines and attributes aren't read."""

import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from recon.devices.openigtlink import igtl_header
from recon.errors import InputError

HEAD = struct.Struct(">10I")  # points; number and bytes of vertices, lines, polygons and strips; attributes


@dataclass(frozen=True)
class Model:
    """A surface of triangles."""

    points: NDArray[np.float64]  # (n, 3), mm
    triangles: NDArray[np.int64]  # (m, 3), places among the points


def write(model: Model) -> bytes:
    """A model's bytes.

    Raises
    ------
    InputError
        If a point is not finite or a triangle has a corner that is none of them.
    """
    points, triangles = np.asarray(model.points), np.asarray(model.triangles)
    if points.shape[1:] != (3,) or triangles.shape[1:] != (3,) or not np.isfinite(points).all():
        raise InputError(
            f"OpenIGTLink: expected points and triangles of three finite numbers, found {points.shape}, {triangles.shape}"
        )
    _check_corners(triangles, len(points))
    cells = np.column_stack([np.full(len(triangles), 3), triangles]).astype(">u4").tobytes()
    head = HEAD.pack(len(points), 0, 0, 0, 0, len(triangles), len(cells), 0, 0, 0)
    return head + points.astype(">f4").tobytes() + cells


def read(content: memoryview) -> Model:
    """Read a model; polygons are parted into triangles about their first corner, strips into theirs.

    Raises
    ------
    InputError
        If the sizes contradict the number of bytes, or a corner is none of the points.
    """
    if len(content) < HEAD.size:
        raise InputError(f"expected at least {HEAD.size} bytes, found {len(content)}")
    count, *sizes, _ = HEAD.unpack_from(content)
    ends = np.cumsum([HEAD.size, 12 * count, *sizes[1::2]]).tolist()
    if ends[-1] > len(content) or any(size % 4 for size in sizes[1::2]):
        raise InputError(f"expected a model of {ends[-1]} bytes and its attributes, found {len(content)} bytes")
    points = igtl_header.finite(np.frombuffer(content[ends[0] : ends[1]], ">f4").reshape(-1, 3))
    polygons = _triangles(np.frombuffer(content[ends[3] : ends[4]], ">u4").astype(np.int64), sizes[4], _fan)
    strips = _triangles(np.frombuffer(content[ends[4] : ends[5]], ">u4").astype(np.int64), sizes[6], _strip)
    triangles = np.concatenate([polygons, strips])
    _check_corners(triangles, count)
    return Model(points, triangles)


def _triangles(
    numbers: NDArray[np.int64], count: int, parted: Callable[[NDArray[np.int64]], NDArray[np.int64]]
) -> NDArray[np.int64]:
    """Triangles of cells, each of which is its number of corners and these."""
    if len(numbers) == 4 * count and (numbers[::4] == 3).all():
        return numbers.reshape(-1, 4)[:, 1:]
    most_cells = 100_000  # other than triangles, which are read one by one
    if count > most_cells:
        raise InputError(f"expected at most {most_cells} polygons that aren't triangles, found {count}")
    found = [parted(cell) for cell in _cells(numbers, count)]
    return np.concatenate([np.empty((0, 3), np.int64), *found])


def _cells(numbers: NDArray[np.int64], count: int) -> Iterator[NDArray[np.int64]]:
    at = 0
    for _ in range(count):
        if at >= len(numbers) or at + numbers[at] >= len(numbers):
            raise InputError(f"expected {count} polygons, found their numbers cut short")
        yield numbers[at + 1 : at + 1 + numbers[at]]
        at += int(numbers[at]) + 1
    if at != len(numbers):
        raise InputError(f"expected {at} numbers in {count} polygons, found {len(numbers)}")


def _fan(corners: NDArray[np.int64]) -> NDArray[np.int64]:
    """Triangles of a convex polygon."""
    return np.column_stack([np.full(max(len(corners) - 2, 0), corners[0] if len(corners) else 0), corners[1:-1], corners[2:]])


def _strip(corners: NDArray[np.int64]) -> NDArray[np.int64]:
    """Triangles of a strip: every second one is turned over."""
    found = np.column_stack([corners[:-2], corners[1:-1], corners[2:]])
    found[1::2] = found[1::2, ::-1]
    return found


def _check_corners(triangles: NDArray[np.int64], count: int) -> None:
    if triangles.size and not 0 <= triangles.min() <= triangles.max() < count:
        raise InputError(f"expected corners among {count} points, found {triangles.min()} to {triangles.max()}")
