"""The round body about a tube: a cylinder through the surface by light in front of it, and the wall between both.

The tube is known by ultrasound, the surface by light, both in the frame of camera 1, at its origin. The surface counts where
it lies before the tube's measured length, within an arc about the direction from the axis to the camera: what the body lies on is
behind that. Points far from the cylinder, of which the body's edges have some, are left out.
"""

from dataclasses import dataclass

import numpy as np
import trimesh
from numpy.typing import NDArray

from recon.errors import InputError
from recon.geometry.order_statistics import NORMAL_MAD
from recon.geometry.primitives import Cylinder, Fit, fit_cylinder

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Cover:
    """The body's surface, and the thickness of what lies between it and the tube's wall."""

    shape: Cylinder
    rms_mm: float  # of the points about it
    wall_mm: float  # from wall to wall, from the middle of the tube's axis towards the camera


def fit_cover(surface: trimesh.Trimesh, tube: Cylinder, ends: Array) -> Cover:
    """Fit a cylinder to the surface before a tube.

    Parameters
    ----------
    surface : measured by a camera at the origin, mm
    tube : its point the middle of what was measured
    ends : (2, 3) mm, on the tube's axis, of what was measured

    Raises
    ------
    InputError
        If too little surface lies before the tube, it isn't round, or the tube isn't within it.
    """
    points = before(np.asarray(surface.vertices, float), tube, ends)
    least_points = 1000
    if len(points) < least_points:
        raise InputError(f"surface: expected {least_points} points before the tube, found {len(points)}; another session?")
    most_points = 100_000  # evenly chosen; more would change the radius by less than a micrometre
    points = points[:: -(-len(points) // most_points)]
    try:
        fit, points = _robust(points)
    except (ValueError, np.linalg.LinAlgError):
        raise InputError("surface: expected a round body about the tube, found no cylinder through it") from None
    turn = np.rad2deg(np.arccos(min(1.0, abs(float(fit.shape.axis @ tube.axis)))))
    arc = _arc_deg(points, fit.shape)
    most_turn_deg = 20.0  # between both axes
    most_rms_mm = 0.3  # of the points about the cylinder: light is ten times as exact
    least_arc_deg = 70.0  # of the surface about the fitted axis; less leaves the radius to chance
    wrong = {
        f"{fit.rms:.2g} mm RMS off a cylinder": fit.rms > most_rms_mm,
        f"a cylinder turned by {turn:.0f} deg against the tube": turn > most_turn_deg,
        f"an arc of {arc:.0f} deg": arc < least_arc_deg,
    }
    found = [text for text, holds in wrong.items() if holds]
    if found:
        raise InputError(f"surface: expected a round body about the tube, found {', '.join(found)}")
    return Cover(fit.shape, fit.rms, wall_between(fit.shape, tube))


def _robust(points: Array) -> tuple[Fit[Cylinder], Array]:
    """Cylinder through points : (n, 3) mm, and those near it."""
    fit = fit_cylinder(points)
    outlier = 4.0  # standard deviations, by the median absolute deviation
    rounds = 3
    for _ in range(rounds):
        away = np.abs(fit.residuals - np.median(fit.residuals))
        points = points[away < outlier * NORMAL_MAD * np.median(away) + 1e-9]
        fit = fit_cylinder(points)
    return fit, points


def before(points: Array, tube: Cylinder, ends: Array) -> Array:
    """Of points : (n, 3) mm those before the tube, between its ends."""
    local = points - tube.point
    along, (first, last) = local @ tube.axis, np.sort((ends - tube.point) @ tube.axis)
    across = local - np.outer(along, tube.axis)
    half_arc_deg = 75.0  # about the tube's axis, on either side of the direction to the camera
    facing = across @ to_camera(tube) > np.cos(np.deg2rad(half_arc_deg)) * np.linalg.norm(across, axis=1)
    return points[facing & (along > first) & (along < last)]


def _arc_deg(points: Array, shape: Cylinder) -> float:
    """Angle, deg, that points : (n, 3) mm span about a cylinder's axis, less their outer hundredths."""
    middle = points.mean(axis=0) - shape.point
    up = middle - (middle @ shape.axis) * shape.axis
    up /= np.linalg.norm(up)
    local = points - shape.point
    angle = np.arctan2(local @ np.cross(shape.axis, up), local @ up)
    return float(np.rad2deg(np.ptp(np.percentile(angle, [1, 99]))))


def to_camera(tube: Cylinder) -> Array:
    """Unit vector : (3,) from the middle of the tube's axis to the camera at the origin, less what is along the axis."""
    away = -tube.point + (tube.point @ tube.axis) * tube.axis
    return away / np.linalg.norm(away)


def wall_between(outer: Cylinder, tube: Cylinder) -> float:
    """Length, mm, between both walls on the line from the middle of the tube's axis to the camera.

    Raises
    ------
    InputError
        If the tube isn't within the outer one.
    """
    offset = (np.eye(3) - np.outer(outer.axis, outer.axis)) @ np.column_stack([tube.point - outer.point, to_camera(tube)])
    start, step = offset.T
    inside = outer.radius**2 - start @ start
    if inside <= 0:
        raise InputError("surface: expected a round body about the tube, found its axis beside the body; another session?")
    towards = (start @ step) / (step @ step)
    wall = float(np.sqrt(towards**2 + inside / (step @ step)) - towards - tube.radius)
    if wall <= 0:
        raise InputError(f"surface: expected a round body about the tube, found its wall {-wall:.1f} mm outside")
    return wall
