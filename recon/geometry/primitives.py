"""Plane, sphere and cylinder, and their least-squares fits by orthogonal distance.

The uncertainty of a fit is the covariance `s^2 (J^T J)^-1` of its free parameters at the solution, where s^2 is the residuals'
variance; it holds where the points' errors are independent.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Generic, TypeAlias, TypeVar

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import least_squares

from recon.geometry.camera import Array

AXES_TRIED = 200  # starting directions of a cylinder's axis: about 10 deg apart, well inside the basin of convergence
START_POINTS = 500  # points that choose among them
CURVED = 5.0  # standard deviations by which a sphere must be curved: below, its radius is chance


@dataclass(frozen=True, eq=False)
class Plane:
    """The plane through a point, with its unit normal."""

    name: str
    point: Array  # (3,), mm; of a fit the middle of the points
    normal: Array  # (3,), unit, towards the origin

    def distance(self, points: Array) -> Array:
        """Signed distance of points : (..., 3) mm, positive on the normal's side : (...)."""
        return (points - self.point) @ self.normal


@dataclass(frozen=True, eq=False)
class Sphere:
    """A sphere."""

    name: str
    centre: Array  # (3,), mm
    radius: float  # mm

    def distance(self, points: Array) -> Array:
        """Signed distance of points : (..., 3) mm, positive outside : (...)."""
        return np.linalg.norm(points - self.centre, axis=-1) - self.radius


@dataclass(frozen=True, eq=False)
class Cylinder:
    """An infinite circular cylinder."""

    name: str
    point: Array  # (3,), mm, on the axis; of a fit the one nearest to the middle of the points
    axis: Array  # (3,), unit
    radius: float  # mm

    def distance(self, points: Array) -> Array:
        """Signed distance of points : (..., 3) mm, positive outside : (...)."""
        return np.linalg.norm(np.cross(points - self.point, self.axis), axis=-1) - self.radius


Shape: TypeAlias = Plane | Sphere | Cylinder
Kind = TypeVar("Kind", Plane, Sphere, Cylinder)


@dataclass(frozen=True)
class Fit(Generic[Kind]):
    """Parameters of a fitted shape, and its residuals."""

    shape: Kind
    residuals: Array  # (n,), mm; positive outside the sphere or cylinder, or on the side of the plane's normal
    covariance: Array  # of the free parameters, which the fitting function names

    @property
    def rms(self) -> float:
        """Root mean square of the residuals, mm."""
        return float(np.sqrt(np.mean(self.residuals**2)))


def fit_plane(points: ArrayLike) -> Fit[Plane]:
    """Fit a plane to points : (n, 3) mm, n >= 4.

    The covariance : (3, 3) is of the tilts in rad about the plane's two principal directions through the middle of the points,
    and of the offset there in mm.

    Raises
    ------
    ValueError
        If there are too few points, or they are not finite.
    """
    points, middle = _checked(points, 4)
    _, _, directions = np.linalg.svd(points - middle, full_matrices=False)
    normal = directions[2] * (-1 if directions[2] @ middle > 0 else 1)
    residuals = (points - middle) @ normal
    jacobian = np.column_stack([(points - middle) @ directions[:2].T, -np.ones(len(points))])
    return Fit(Plane("", middle, normal), residuals, _covariance(jacobian, residuals))


def fit_sphere(points: ArrayLike) -> Fit[Sphere]:
    """Fit a sphere to points : (n, 3) mm, n >= 5, starting from the algebraic fit.

    The covariance : (4, 4) is of centre and radius, mm.

    Raises
    ------
    ValueError
        If there are too few points, they are not finite, or lie in a plane as far as their scatter tells: if a sphere doesn't
        fit them significantly better (F test of the one parameter more, 5 standard deviations).
    """
    points, middle = _checked(points, 5)
    local = points - middle
    system = np.column_stack([2 * local, np.ones(len(local))])
    (x, y, z, w), _, rank, _ = np.linalg.lstsq(system, (local**2).sum(axis=1), rcond=1e-9)
    start = np.array([x, y, z, np.sqrt(w + x * x + y * y + z * z)])

    def distances(p: Array) -> Array:
        return np.linalg.norm(local - p[:3], axis=1) - p[3]

    def jacobian(p: Array) -> Array:
        away = local - p[:3]
        return np.column_stack([-away / np.linalg.norm(away, axis=1, keepdims=True), -np.ones(len(local))])

    off_plane, off_sphere = np.linalg.svd(local, compute_uv=False)[2] ** 2, (distances(start) ** 2).sum()
    if rank < 4 or off_plane - off_sphere <= CURVED**2 * off_sphere / (len(local) - 4):
        raise ValueError("points: expected a piece of a sphere, found points in a plane")
    solution, residuals, covariance = _solve(distances, start, jacobian)
    return Fit(Sphere("", middle + solution[:3], float(solution[3])), residuals, covariance)


def fit_cylinder(points: ArrayLike) -> Fit[Cylinder]:
    """Fit a cylinder to points : (n, 3) mm, n >= 6.

    Starting directions of the axis are tried all over the half sphere: the points, seen along the axis, lie on a circle.

    The covariance : (5, 5) is of the shift of the axis in mm along two directions across it, of its tilt in rad along the same
    two, and of the radius in mm.

    Raises
    ------
    ValueError
        If there are too few points, or they are not finite.
    """
    points, middle = _checked(points, 6)
    local = points - middle
    few = local[:: max(1, len(local) // START_POINTS)]
    axis, centre, radius = _rough_cylinder(few)
    for _ in range(2):  # the second round turns the frame onto the solution, where tilts and covariance are meant
        across = _across(axis)
        start = np.array([*(across @ centre), 0, 0, radius])

        def distances(p: Array, across: Array = across, axis: Array = axis) -> Array:
            direction = axis + p[2:4] @ across
            direction /= np.linalg.norm(direction)
            return np.linalg.norm(_radial(local - p[:2] @ across, direction), axis=1) - p[4]

        def jacobian(p: Array, across: Array = across, axis: Array = axis) -> Array:
            direction = axis + p[2:4] @ across
            size = np.linalg.norm(direction)
            direction /= size
            offset = local - p[:2] @ across
            radial = _radial(offset, direction)
            outwards = radial / np.maximum(np.linalg.norm(radial, axis=1), 1e-12)[:, None]
            turned = (across - np.outer(across @ direction, direction)) / size  # of the direction, by the tilts
            tilts = -(offset @ direction)[:, None] * (outwards @ turned.T)
            return np.column_stack([-outwards @ across.T, tilts, np.full(len(local), -1.0)])

        solution, residuals, covariance = _solve(distances, start, jacobian)
        axis = axis + solution[2:4] @ across
        axis /= np.linalg.norm(axis)
        centre, radius = solution[:2] @ across, float(solution[4])
        centre = centre - (centre @ axis) * axis
    return Fit(Cylinder("", middle + centre, axis, radius), residuals, covariance)


def _solve(distances: Callable[[Array], Array], start: Array, jacobian: Callable[[Array], Array]) -> tuple[Array, Array, Array]:
    """Least squares, first with outliers held down to find the right place, then plain: solution, residuals, covariance."""
    spread = np.median(np.abs(distances(start))) + 1e-9
    held = least_squares(distances, start, jacobian, loss="soft_l1", f_scale=3 * spread, x_scale="jac")
    result = least_squares(distances, held.x, jacobian, x_scale="jac", xtol=1e-12, ftol=1e-12, gtol=1e-12)
    return result.x, result.fun, _covariance(result.jac, result.fun)


def _covariance(jacobian: Array, residuals: Array) -> Array:
    freedom = len(residuals) - jacobian.shape[1]
    return np.linalg.inv(jacobian.T @ jacobian) * (residuals @ residuals) / freedom


def _radial(offsets: Array, direction: Array) -> Array:
    """The parts of vectors : (n, 3) across a unit direction."""
    return offsets - np.outer(offsets @ direction, direction)


def _rough_cylinder(points: Array) -> tuple[Array, Array, float]:
    """Axis, a point on it and radius: of many axes the one along which points : (n, 3) lie best on an algebraic circle."""
    axes, across = _axes_tried()
    flat = points @ across.swapaxes(1, 2)  # (axes, n, 2)
    system = np.concatenate([2 * flat, np.ones((*flat.shape[:2], 1))], axis=2)
    transposed = system.swapaxes(1, 2)
    squares = (flat**2).sum(axis=2, keepdims=True)
    x, y, w = np.moveaxis(np.linalg.pinv(transposed @ system) @ (transposed @ squares), 1, 0)  # each (axes, 1)
    radius = np.sqrt(np.maximum(w + x * x + y * y, 0))
    distance = np.median(np.abs(np.hypot(flat[..., 0] - x, flat[..., 1] - y) - radius), axis=1)
    best = int(distance.argmin())
    return axes[best], x[best] * across[best, 0] + y[best] * across[best, 1], float(radius[best, 0])


@cache
def _axes_tried() -> tuple[Array, Array]:
    """Axes : (n, 3) all over the half sphere, and two directions across each : (n, 2, 3)."""
    axes = _half_sphere(AXES_TRIED)
    return axes, np.array([_across(axis) for axis in axes])


def _across(axis: Array) -> Array:
    """Two unit vectors : (2, 3) at right angles to an axis and to each other."""
    first = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(axis, first)])


def _half_sphere(n: int) -> Array:
    """About evenly spread unit vectors : (n, 3) on the upper half of the sphere (Fibonacci spiral)."""
    z = (np.arange(n) + 0.5) / n
    angle = np.pi * (1 + np.sqrt(5)) * np.arange(n)
    return np.column_stack([np.sqrt(1 - z * z) * np.cos(angle), np.sqrt(1 - z * z) * np.sin(angle), z])


def _checked(points: ArrayLike, least: int) -> tuple[Array, Array]:
    """The points as an array, and their middle : (3,)."""
    points = np.asarray(points, float)
    if points.ndim != 2 or points.shape[1] != 3 or len(points) < least or not np.isfinite(points).all():
        raise ValueError(f"points: expected at least {least} finite points (n, 3), found an array of shape {points.shape}")
    return points, points.mean(axis=0)
