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
from recon.geometry.primitives import Cylinder, fit_cylinder

Array = NDArray[np.float64]

HALF_ARC_DEG = 75.0  # about the tube's axis, on either side of the direction to the camera
LEAST_POINTS = 1000
MOST_POINTS = 100_000  # evenly chosen; more would change the radius by less than a micrometre
OUTLIER = 4.0  # standard deviations, by the median absolute deviation
NORMAL_MAD = 1.4826  # standard deviation of a normal distribution over its median absolute deviation
ROUNDS = 3
ROUND = 0.02  # of the radius, RMS: what is less round is no cylinder


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
    if len(points) < LEAST_POINTS:
        raise InputError(f"surface: expected {LEAST_POINTS} points before the tube, found {len(points)}; another session?")
    points = points[:: -(-len(points) // MOST_POINTS)]
    fit = fit_cylinder(points)
    for _ in range(ROUNDS):
        away = np.abs(fit.residuals - np.median(fit.residuals))
        points = points[away < OUTLIER * NORMAL_MAD * np.median(away) + 1e-9]
        fit = fit_cylinder(points)
    if fit.rms > ROUND * fit.shape.radius:
        raise InputError(f"surface: expected a round body about the tube, found {fit.rms:.2g} mm RMS off a cylinder")
    return Cover(fit.shape, fit.rms, wall_between(fit.shape, tube))


def before(points: Array, tube: Cylinder, ends: Array) -> Array:
    """Of points : (n, 3) mm those before the tube, between its ends."""
    local = points - tube.point
    along, (first, last) = local @ tube.axis, np.sort((ends - tube.point) @ tube.axis)
    across = local - np.outer(along, tube.axis)
    facing = across @ to_camera(tube) > np.cos(np.deg2rad(HALF_ARC_DEG)) * np.linalg.norm(across, axis=1)
    return points[facing & (along > first) & (along < last)]


def to_camera(tube: Cylinder) -> Array:
    """Unit vector : (3,) from the middle of the tube's axis to the camera at the origin, less what is along the axis."""
    away = -tube.point + (tube.point @ tube.axis) * tube.axis
    return away / np.linalg.norm(away)


def wall_between(outer: Cylinder, tube: Cylinder) -> float:
    """Length, mm, between both walls on the line from the middle of the tube's axis to the camera.

    Raises
    ------
    InputError
        If the tube's axis isn't within the outer one.
    """
    offset = (np.eye(3) - np.outer(outer.axis, outer.axis)) @ np.column_stack([tube.point - outer.point, to_camera(tube)])
    start, step = offset.T
    inside = outer.radius**2 - start @ start
    if inside <= 0:
        raise InputError("surface: expected a round body about the tube, found its axis beside the body; another session?")
    towards = (start @ step) / (step @ step)
    return float(np.sqrt(towards**2 + inside / (step @ step)) - towards - tube.radius)
