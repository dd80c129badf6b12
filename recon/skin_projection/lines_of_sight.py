"""Straight lines through space, and where they first meet a surface: parallel lines, those of an eye, those of a device.

Each line is a place in a chart. Space is mapped so that the lines stand upright on the chart: (x, y) is the line, and nearness
grows towards where it comes from. The map is projective, so flat triangles stay flat, and what is interpolated linearly within a
triangle on the chart is exact in space.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import trimesh
from numpy.typing import ArrayLike, NDArray

from recon.compiled import kernel, njit
from recon.geometry.camera import Camera
from recon.threads import in_threads

Array = NDArray[np.float64]

CELLS = 256  # of the chart along each axis, in which places are sorted
EDGE = 1e-9  # of a triangle, that belongs to both at an edge: rounding loses no line between them
NOWHERE = -1  # number of the triangle where a line meets none


@dataclass(frozen=True, eq=False)
class Sight:
    """A family of lines, as the map of space to their chart: `(x, y, nearness, 1) ~ chart_from_world @ (point, 1)`."""

    chart_from_world: Array  # (4, 4), homogeneous

    @classmethod
    def along(cls, direction: ArrayLike, through: ArrayLike) -> "Sight":
        """Parallel lines along a direction : (3,); the chart is in mm, its origin at the line through a point : (3,) mm."""
        upright = _facing(direction)
        upright[2] *= -1
        return cls(_homogeneous(upright, -upright @ np.asarray(through, float)))

    @classmethod
    def from_eye(cls, eye: ArrayLike, towards: ArrayLike) -> "Sight":
        """Lines from an eye : (3,) mm; the chart is in mm at a point : (3,) mm, where its origin lies."""
        eye, towards = np.asarray(eye, float), np.asarray(towards, float)
        axes, distance = _facing(towards - eye), float(np.linalg.norm(towards - eye))
        return cls(_perspective(distance) @ _homogeneous(axes, -axes @ eye))

    @classmethod
    def of_device(cls, device: Camera) -> "Sight":
        """Lines through a device's pinhole; the chart's are its normalised coordinates without distortion."""
        return cls(_perspective(1.0) @ device.camera_from_world)

    def chart(self, points: ArrayLike) -> Array:
        """Points : (..., 3) mm on the chart, x, y and nearness : (..., 3); NaN for those behind the eye."""
        flat = np.ascontiguousarray(points, float).reshape(-1, 3)
        charted = np.empty(flat.shape)
        in_threads(_fill_chart, len(flat), flat, self.chart_from_world, charted)
        return charted.reshape(np.shape(points))

    def world(self, places: ArrayLike) -> Array:
        """Points : (..., 3) mm of places on the chart with their nearness : (..., 3)."""
        back = np.linalg.inv(self.chart_from_world)
        mapped = np.asarray(places, float) @ back[:, :3].T + back[:, 3]
        return mapped[..., :3] / mapped[..., 3:]


class Hits(NamedTuple):
    """Where lines first meet a surface."""

    points: Array  # (n, 3) mm, NaN where they don't
    faces: NDArray[np.int64]  # (n,) numbers of the triangles there, or NOWHERE


def first_hits(sight: Sight, places: Array, surface: trimesh.Trimesh) -> Hits:
    """First points of a surface on lines, by their places : (n, 2) on the chart."""
    nearness, faces = _first(sight, places, surface)
    hit = faces != NOWHERE
    points = np.full((len(places), 3), np.nan)
    points[hit] = sight.world(np.column_stack([places[hit], nearness[hit]]))
    return Hits(points, faces)


def covered(sight: Sight, places: Array, body: trimesh.Trimesh) -> NDArray[np.bool_]:
    """Whether lines, by their places : (n, 2) on the chart, meet a body : (n,)."""
    return _first(sight, places, body)[1] != NOWHERE


def _first(sight: Sight, places: Array, surface: trimesh.Trimesh) -> tuple[Array, NDArray[np.int64]]:
    """Nearness and triangles of the first points : (n,) each."""
    charted, faces = sight.chart(surface.vertices), np.ascontiguousarray(surface.faces, np.int64)
    nearness, found = np.full(len(places), -np.inf), np.full(len(places), NOWHERE)
    known = np.flatnonzero(np.isfinite(places).all(axis=1))
    if len(known):
        low = places[known].min(axis=0)
        cell = np.maximum((places[known].max(axis=0) - low) / CELLS, 1e-9)
        columns, rows = np.minimum((places[known] - low) / cell, CELLS - 1).astype(np.int64).T
        order = np.argsort(rows * CELLS + columns, kind="stable")
        starts = np.searchsorted((rows * CELLS + columns)[order], np.arange(CELLS * CELLS + 1))
        _fill_hits(charted, faces, np.ascontiguousarray(places, float), known[order], starts, low, cell, nearness, found)
    return nearness, found


@kernel
def _fill_chart(first, end, points, matrix, charted):
    for i in range(first, end):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        w = matrix[3, 0] * x + matrix[3, 1] * y + matrix[3, 2] * z + matrix[3, 3]
        scale = 1 / w if w > 0 else np.nan
        for n in range(3):
            charted[i, n] = scale * (matrix[n, 0] * x + matrix[n, 1] * y + matrix[n, 2] * z + matrix[n, 3])


@kernel
def _fill_hits(charted, faces, places, order, starts, low, cell, nearness, found):
    """Triangle by triangle: the places within it, of the cells that it may reach."""
    for k in range(len(faces)):
        a, b, c = charted[faces[k, 0]], charted[faces[k, 1]], charted[faces[k, 2]]
        area = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
        if not abs(area) > 0:  # edgewise, or partly behind the eye
            continue
        left, right = _cells(a[0], b[0], c[0], low[0], cell[0])
        top, bottom = _cells(a[1], b[1], c[1], low[1], cell[1])
        for row in range(top, bottom + 1):
            for i in range(starts[row * CELLS + left], starts[row * CELLS + right + 1]):
                n = order[i]
                x, y = places[n, 0] - a[0], places[n, 1] - a[1]
                second = (x * (c[1] - a[1]) - y * (c[0] - a[0])) / area
                third = ((b[0] - a[0]) * y - (b[1] - a[1]) * x) / area
                if second < -EDGE or third < -EDGE or second + third > 1 + EDGE:
                    continue
                near = a[2] + second * (b[2] - a[2]) + third * (c[2] - a[2])
                if near > nearness[n]:
                    nearness[n], found[n] = near, k


@njit(inline="always")
def _cells(a, b, c, low, cell):
    """First and last cell along an axis that a triangle's corners may reach; the last before the first beside the places."""
    least, most = (min(a, b, c) - low) / cell, (max(a, b, c) - low) / cell
    if most < 0 or least > CELLS:
        return 0, -1
    return int(max(least, 0.0)), int(min(most, CELLS - 1.0))


def _facing(direction: ArrayLike) -> Array:
    """A right-handed frame : (3, 3), its axes as rows, the third along a direction : (3,)."""
    forward = np.asarray(direction, float)
    forward = forward / np.linalg.norm(forward)
    across = np.eye(3)[np.argmin(np.abs(forward))]
    across = across - forward * (across @ forward)
    across /= np.linalg.norm(across)
    return np.array([across, np.cross(forward, across), forward])


def _homogeneous(axes: Array, shift: Array) -> Array:
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = axes, shift
    return matrix


def _perspective(distance: float) -> Array:
    """Map of an eye's frame, z forwards, to its chart: x and y over z, times a distance, and 1/z."""
    return np.array([[distance, 0, 0, 0], [0, distance, 0, 0], [0, 0, 0, 1], [0, 0, 1, 0]], float)
