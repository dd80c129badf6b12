"""The target's pose from its three circles in two views, with its covariance, or the reason why there is none.

Six centres are twelve numbers for a pose of six: the other six tell whether it is the target that is seen, with the right names
and through the right cameras. Circles, not points, are fitted: what a view should show is the centre of the projected outline,
which is not the projected centre.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from recon import rigid
from recon.camera import Camera
from recon.rig import Target
from recon.tracking.outline_model import ellipses_of, rays_through, slopes_at

Array = NDArray[np.float64]

NAMES = ("c0", "c1", "c2")
GROSS_MM = 4.0  # by which distances between centres may be off, before the fit: a sixth of the least
APART_MM = 4.0  # by which two views' rays of one centre may miss each other
STEPS = 3  # of the fit: the start is a few hundredths of a mm off
IMPLAUSIBLE = 1e-9  # chance of a misfit so large, below which it isn't the target
FREEDOM = 6
MOST = float(chi2.isf(IMPLAUSIBLE, FREEDOM))


@dataclass(frozen=True)
class Sighting:
    """The three circles in one view."""

    camera: Camera
    centres: Array  # (3, 2) px, of the ellipses, in the order of NAMES
    covariance: Array  # (3, 2, 2) px^2


@dataclass(frozen=True)
class TargetPose:
    """Where the target is, or why that isn't known."""

    world_from_target: Array  # (4, 4) mm; NaN if it isn't known
    covariance: Array  # (6, 6) of a turn (rad) after the pose's own, and a shift (mm) in the world; as in tracks.Track
    misfit: float  # squared normalised residuals, chi-square with FREEDOM degrees; NaN if there was no fit
    reason: str | None = None

    @property
    def found(self) -> bool:
        """Whether there is a pose."""
        return self.reason is None


def circle_centres(target: Target) -> Array:
    """Centres : (3, 3) mm of the circles in the target's frame."""
    return np.array([[0.0, 0.0, 0.0], [target.c1_mm, 0.0, 0.0], [0.0, target.c2_mm, 0.0]])


def estimate(first: Sighting, second: Sighting, target: Target) -> TargetPose:
    """Estimate the pose from two views, by least squares over all six ellipses' centres.

    Never raises on what the views show: what can't be the target is not found, with a reason.
    """
    model = circle_centres(target)
    points, apart = meet(first, second)
    if not np.isfinite(points).all():
        return lost("a centre whose rays do not meet in front of the cameras")
    if apart.max() > APART_MM:
        worst = int(apart.argmax())
        return lost(f"rays of {NAMES[worst]} miss each other by {apart[worst]:.1f} mm: other circles, or cameras swapped")
    expected, found = _distances(model), _distances(points)
    if np.abs(found - expected).max() > GROSS_MM:
        shown = ", ".join(f"{value:.1f}" for value in found)
        return lost(f"centres {shown} mm apart (c0-c1, c0-c2, c1-c2), expected {', '.join(f'{value:.1f}' for value in expected)}")
    start = aligned(model, points)
    facing = start[:3, 2] @ (start[:3, 3] - first.camera.centre)
    if facing * (start[:3, 2] @ (start[:3, 3] - second.camera.centre)) <= 0:
        return lost("the target's plane lies between the cameras")
    return _refined(start, (first, second), target, model)


def lost(reason: str) -> TargetPose:
    """No pose, for a reason."""
    return TargetPose(np.full((4, 4), np.nan), np.full((6, 6), np.nan), np.nan, reason)


def meet(first: Sighting, second: Sighting) -> tuple[Array, Array]:
    """Midpoints : (3, 3) mm of the shortest lines between the rays of each centre, and their lengths : (3,) mm.

    NaN where rays are parallel or meet behind a camera.
    """
    origins = [view.camera.centre for view in (first, second)]
    rays = [rays_through(view.camera, view.centres) for view in (first, second)]
    base = origins[1] - origins[0]
    cosine = np.einsum("ni,ni->n", *rays)
    along = [ray @ base for ray in rays]
    with np.errstate(divide="ignore", invalid="ignore"):
        s = (along[0] - cosine * along[1]) / (1 - cosine**2)
        t = (cosine * along[0] - along[1]) / (1 - cosine**2)
    near = [origins[0] + s[:, None] * rays[0], origins[1] + t[:, None] * rays[1]]
    behind = ~((s > 0) & (t > 0))
    middle = np.where(behind[:, None], np.nan, (near[0] + near[1]) / 2)
    return middle, np.linalg.norm(near[0] - near[1], axis=1)


def aligned(model: Array, points: Array) -> Array:
    """The rigid transform : (4, 4) that takes model : (n, 3) to points : (n, 3) with the least squares [Kabsch 1976]."""
    middle, centre = model.mean(axis=0), points.mean(axis=0)
    left, _, right = np.linalg.svd((points - centre).T @ (model - middle))
    turn = left @ np.diag([1, 1, np.linalg.det(left @ right)]) @ right
    return rigid.transform(turn, centre - turn @ middle)


def _distances(points: Array) -> Array:
    return np.linalg.norm(points[[1, 2, 2]] - points[[0, 0, 1]], axis=1)


def _refined(start: Array, views: Sequence[Sighting], target: Target, model: Array) -> TargetPose:
    """Gauss-Newton on the ellipses' centres; the offsets from the projected centres follow the pose."""
    pose, radius = start, target.outer_diameter_mm / 2
    whiten = [np.linalg.inv(np.linalg.cholesky(view.covariance)) for view in views]
    design, misfit = np.zeros((12, 6)), np.nan
    for _ in range(STEPS):
        rows, left = [], []
        for view, white in zip(views, whiten, strict=True):
            predicted = ellipses_of(view.camera, pose, model, radius)[0]
            by_point = slopes_at(view.camera, rigid.apply(pose, model))
            jacobian = np.concatenate([-rigid.cross(rigid.rotate(pose, model)), np.tile(np.eye(3), (3, 1, 1))], axis=-1)
            rows.append((white @ by_point @ jacobian).reshape(-1, 6))
            left.append((white @ (view.centres - predicted)[..., None]).ravel())
        design, residual = np.concatenate(rows), np.concatenate(left)
        step, _, rank, _ = np.linalg.lstsq(design, residual)
        if rank < 6 or not np.isfinite(step).all():
            return lost("views that do not determine the pose")
        misfit = float(np.sum((residual - design @ step) ** 2))
        pose = rigid.transform(Rotation.from_rotvec(step[:3]).as_matrix() @ pose[:3, :3], pose[:3, 3] + step[3:])
    if not misfit < MOST:
        times = np.sqrt(misfit / FREEDOM)
        return lost(f"a misfit of {times:.0f} times the centres' uncertainty: other circles, or cameras swapped or moved")
    return TargetPose(pose, np.linalg.inv(design.T @ design), misfit)
