"""A tool's tip in the world: its distances from masses, from a planned path and from the B-scan's plane, with sigma.

Covariances are the tip's. Masses, the path and the plane count as exact.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import trimesh
from numpy.typing import NDArray

from recon.errors import InputError
from recon.geometry import rigid
from recon.model.tip import TIP, Tip

Array = NDArray[np.float64]

IN_PLANE_MM = 1.5  # half the thickness of a B-scan's slice: what lies nearer to its plane echoes in it
LEAST_SINE = 0.02  # of the shaft's angle to the plane, 1.1 degrees, below which their crossing isn't determined
LEAST_MM = 1e-9  # of a direction


@dataclass(frozen=True)
class Surface:
    """A mass's triangles, ready for distances of points."""

    triangles: Array  # (m, 3, 3) mm, in the world
    middles: Array  # (m, 3) mm, a point of each
    radii: Array  # (m,) mm, of the ball about its middle that holds it
    bounds: Array  # (2, 3) mm, of all


class Distance(NamedTuple):
    """Distance of the tip from a mass's surface."""

    mm: float  # negative inside
    sigma_mm: float  # along the direction to the nearest point of the surface


class FromPath(NamedTuple):
    """The tip beside a planned path."""

    off_mm: float  # from the path's line
    off_sigma_mm: float
    left_mm: float  # to the aim, along the path; negative beyond
    angle_deg: float | None  # of the shaft, from the direction to the aim; None where the shaft's direction isn't known


class Crossing(NamedTuple):
    """The point at which the shaft's line crosses the plane of a B-scan."""

    pixel: Array  # (2,) u, v
    ahead_mm: float  # from the tip; negative where the shaft itself crosses the plane, behind the tip
    in_image: bool


class AtPlane(NamedTuple):
    """The tip and the shaft beside the plane of a B-scan."""

    off_mm: float  # of the tip, along the image's normal, x cross y
    sigma_mm: float
    crossing: Crossing | None  # None of a shaft along the plane, or of an unknown direction
    seen: (
        Array | None
    )  # (2, 2) px, ends of the part of the shaft that lies in the slice, the nearer to the tip last; None without


@dataclass(frozen=True)
class TipFigures:
    """A tool's tip at a moment."""

    tip: Array  # (3,) mm, in the world
    covariance: Array  # (3, 3) mm2
    axis: Array | None  # (3,) in the world, of length 1, from the handle to the tip
    masses: Mapping[str, Distance]
    path: FromPath | None = None  # None without a plan
    plane: AtPlane | None = None  # None without a B-scan in place

    @property
    def sigma_mm(self) -> float:
        """Standard deviation of the tip over all directions: root of the sum of the three variances."""
        return float(np.sqrt(np.trace(self.covariance)))


def surface_of(vertices: Array, faces: NDArray[np.int64]) -> Surface:
    """A surface of vertices : (n, 3) mm and faces : (m, 3); triangles without an area are left out.

    Raises
    ------
    InputError
        If all are.
    """
    triangles = np.asarray(vertices, float)[faces]
    triangles = triangles[trimesh.triangles.area(triangles) > 0]
    if not len(triangles):
        raise InputError(f"masses: expected triangles with an area, found {len(faces)} without in one of them")
    middles = triangles.mean(axis=1)
    radii = np.linalg.norm(triangles - middles[:, None], axis=2).max(axis=1)
    return Surface(triangles, middles, radii, np.array([triangles.min(axis=(0, 1)), triangles.max(axis=(0, 1))]))


def figures(
    world_from_body: Array,
    covariance: Array,
    tip: Tip,
    masses: Mapping[str, Surface],
    plan: Array | None = None,
    scan: tuple[Array, tuple[int, ...]] | None = None,
) -> TipFigures:
    """All figures of a tool's tip at a moment.

    Parameters
    ----------
    world_from_body : (4, 4) mm
    covariance : (6, 6) of its pose, as of `tracks.Track`, the patient's part included
    plan : (2, 3) mm, entry and aim in the world
    scan : world_from_pixel : (4, 4) of the newest B-scan, and the shape (h, w) of its image
    """
    place, spread = tip_at(world_from_body, covariance, tip.tip_mm, tip.covariance_of(TIP))
    axis = None if tip.axis is None else rigid.rotate(world_from_body, tip.axis)
    return TipFigures(
        place,
        spread,
        axis,
        {name: from_surface(place, spread, surface) for name, surface in masses.items()},
        None if plan is None else from_path(place, spread, axis, plan),
        None if scan is None else at_plane(place, spread, axis, float(np.linalg.norm(tip.tip_mm)), *scan),
    )


def tip_at(world_from_body: Array, covariance: Array, tip_mm: Array, tip_covariance: Array) -> tuple[Array, Array]:
    """The tip : (3,) mm in the world, and its covariance : (3, 3) mm2: the pose's at the lever arm, and the tip's own.

    Parameters
    ----------
    covariance : (6, 6) of the pose, as of `tracks.Track`
    tip_mm, tip_covariance : (3,) mm in the body's frame, (3, 3) mm2
    """
    slopes, turn = rigid.slopes(rigid.rotate(world_from_body, tip_mm)), world_from_body[:3, :3]
    return rigid.apply(world_from_body, tip_mm), slopes @ covariance @ slopes.T + turn @ tip_covariance @ turn.T


def from_surface(tip: Array, covariance: Array, surface: Surface) -> Distance:
    """Distance of a tip : (3,) mm with a covariance : (3, 3) mm2 from the nearest point of a surface.

    Only triangles whose ball reaches nearer than the nearest middle can hold that point.
    """
    away = np.linalg.norm(surface.middles - tip, axis=1)
    near = surface.triangles[away - surface.radii <= away.min()]
    points = trimesh.triangles.closest_point(near, np.broadcast_to(tip, (len(near), 3)))
    lengths = np.linalg.norm(tip - points, axis=1)
    k = int(lengths.argmin())
    way = tip - points[k] if lengths[k] > LEAST_MM else np.cross(near[k, 1] - near[k, 0], near[k, 2] - near[k, 0])
    sign = -1.0 if is_inside(tip, surface) else 1.0
    return Distance(sign * float(lengths[k]), _along(way, covariance))


def is_inside(point: Array, surface: Surface) -> bool:
    """Whether a point : (3,) mm lies within a surface: its triangles fill more than half of the sphere about the point.

    So small holes, and triangles wound inwards, change nothing. Source: van Oosterom & Strackee 1983, solid angle of a triangle.
    """
    if (point < surface.bounds[0]).any() or (point > surface.bounds[1]).any():
        return False
    a, b, c = np.moveaxis(surface.triangles - point, 1, 0)
    ra, rb, rc = (np.linalg.norm(each, axis=1) for each in (a, b, c))
    volume = np.einsum("ij,ij->i", a, np.cross(b, c))
    ab, bc, ca = (np.einsum("ij,ij->i", *pair) for pair in ((a, b), (b, c), (c, a)))
    angles = 2 * np.arctan2(volume, ra * rb * rc + ab * rc + bc * ra + ca * rb)
    return bool(abs(angles.sum()) > 2 * np.pi)


def from_path(tip: Array, covariance: Array, axis: Array | None, plan: Array) -> FromPath:
    """The tip : (3,) mm and the shaft's axis : (3,) beside a path : (2, 3) mm from its entry to its aim."""
    entry, aim = plan
    along = (aim - entry) / np.linalg.norm(aim - entry)
    aside = (tip - entry) - along * ((tip - entry) @ along)
    off = float(np.linalg.norm(aside))
    across = np.eye(3) - np.outer(along, along)
    sigma = _along(aside, covariance) if off > LEAST_MM else float(np.sqrt(np.trace(across @ covariance @ across) / 2))
    angle = None if axis is None else float(np.rad2deg(np.arctan2(np.linalg.norm(np.cross(axis, along)), axis @ along)))
    return FromPath(off, sigma, float((aim - tip) @ along), angle)


def at_plane(
    tip: Array, covariance: Array, axis: Array | None, length_mm: float, world_from_pixel: Array, shape: tuple[int, ...]
) -> AtPlane:
    """The tip : (3,) mm and the shaft : axis (3,), as long as given, beside the plane of a B-scan of a shape (h, w)."""
    normal = np.cross(world_from_pixel[:3, 0], world_from_pixel[:3, 1])
    normal /= np.linalg.norm(normal)
    off, sigma = float((tip - world_from_pixel[:3, 3]) @ normal), _along(normal, covariance)
    if axis is None:
        return AtPlane(off, sigma, None, None)
    pixel_from_world, rise = np.linalg.inv(world_from_pixel), float(axis @ normal)

    def pixels(ahead_mm: Array) -> Array:
        return rigid.apply(pixel_from_world, tip + ahead_mm[:, None] * axis)[:, :2]

    crossing = None
    if abs(rise) > LEAST_SINE:
        ahead = -off / rise
        (pixel,) = pixels(np.array([ahead]))
        inside = (pixel >= -0.5) & (pixel <= np.array(shape[1::-1]) - 0.5)
        crossing = Crossing(pixel, ahead, bool(inside.all()))
    first, last = _within_slice(off, rise, length_mm)
    return AtPlane(off, sigma, crossing, pixels(np.array([first, last])) if first < last else None)


def _within_slice(off_mm: float, rise: float, length_mm: float) -> tuple[float, float]:
    """Part of the shaft that lies in the slice, in mm ahead of the tip: `-length_mm` to 0 at most; empty if first >= last."""
    if abs(rise) * length_mm < LEAST_MM:
        return (-length_mm, 0.0) if abs(off_mm) <= IN_PLANE_MM else (0.0, 0.0)
    ends = sorted(((-IN_PLANE_MM - off_mm) / rise, (IN_PLANE_MM - off_mm) / rise))
    return max(ends[0], -length_mm), min(ends[1], 0.0)


def _along(way: Array, covariance: Array) -> float:
    """Standard deviation along a direction : (3,) of any length."""
    unit = way / np.linalg.norm(way)
    return float(np.sqrt(max(unit @ covariance @ unit, 0.0)))
