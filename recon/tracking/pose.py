"""The target's pose from its three circles in two views, with its covariance, or the reason why there is none.

Six centres are twelve numbers for a pose of six: the other six tell whether it is the target that is seen, with the right names
and through the right cameras. One circle may be missing in one view: then four are left, and two poses may fit, of which the
ellipses' shapes tell one. Circles, not points, are fitted: what a view should show is the centre of the projected outline, which
is not the projected centre.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from recon.geometry import rigid
from recon.geometry.camera import Camera
from recon.geometry.circle_outline import ellipses_of, slopes_at
from recon.geometry.levenberg_marquardt import Rules, descend
from recon.model.rig import Target
from recon.tracking import pose_hypotheses

Array = NDArray[np.float64]

NAMES = ("c0", "c1", "c2")
PAIRS = ("c0-c1", "c0-c2", "c1-c2")
GROSS_MM = 4.0  # by which distances between centres may be off, before the fit: a sixth of the least
APART_MM = 4.0  # by which two views' rays of one centre may miss each other
RULES = Rules(damping=0, rounding=1e-6, converged=0, steps=20)  # two or three steps from where rays meet, more from one view
SETTLED = 1e-4  # squared standard deviations of the last step
IMPLAUSIBLE = 1e-6  # chance of a misfit so large, by chi-square, below which it isn't the target
SUSPICIOUS = 1e-3  # chance of a misfit below which circles that are doubtful are left out, one by one
PARAMETERS = 6
MISFITTING = "views that no pose fits: other circles, or cameras swapped or moved"
RANK = 1e-7  # least ratio of singular values
SIZES = 0.12  # of a disc's size, by which shapes may differ from the pose's
SIZES_ALONE = 0.05  # the same of one view by itself: three rings of a sheet were 14 % off, targets 0.5 % in the median
SHAPES = 0.005  # the same: what blur and gradients leave of a shape, one standard deviation
SIGMAS = 3.0  # standard deviations that are added to what sizes may differ by
DISTINCT = 16.0  # least excess of another pose's misfit, with shapes
SAME = 16.0  # squared standard deviations within which two poses are one


@dataclass(frozen=True)
class Sighting:
    """The circles in one view."""

    camera: Camera
    centres: Array  # (3, 2) px, of the ellipses, in the order of NAMES; NaN where one isn't seen
    covariance: Array  # (3, 2, 2) px^2
    shapes: Array | None = None  # (3, 2, 2) px, of the ellipses, as ellipses.Ellipses has them; None if they aren't known
    doubtful: NDArray[np.bool_] = field(default_factory=partial(np.zeros, 3, bool))  # (3,) as in outlines.Outlines

    @cached_property
    def seen(self) -> NDArray[np.bool_]:
        """Which circles are seen : (3,)."""
        return np.isfinite(self.centres).all(axis=1)

    def without(self, which: int) -> "Sighting":
        """The same with one circle not seen."""
        return replace(self, centres=np.where(np.arange(len(NAMES))[:, None] == which, np.nan, self.centres))


@dataclass(frozen=True)
class TargetPose:
    """Where the target is, or why that isn't known."""

    world_from_target: Array  # (4, 4) mm; NaN if it isn't known
    covariance: Array  # (6, 6) of a turn (rad) after the pose's own, and a shift (mm) in the world; as in tracks.Track
    misfit: float  # squared normalised residuals, chi-square with `freedom` degrees; NaN where it isn't told
    reason: str | None = None
    freedom: int = PARAMETERS  # numbers that were measured beyond the pose's own
    used: NDArray[np.bool_] = field(default_factory=partial(np.ones, (2, 3), bool))  # (2, 3) of each view's circles, fitted to

    @property
    def found(self) -> bool:
        """Whether there is a pose."""
        return self.reason is None


def circle_centres(target: Target) -> Array:
    """Centres : (3, 3) mm of the circles in the target's frame."""
    return np.array([[0.0, 0.0, 0.0], [target.c1_mm, 0.0, 0.0], [0.0, target.c2_mm, 0.0]])


def estimate(first: Sighting, second: Sighting, target: Target) -> TargetPose:
    """Estimate the pose from two views, by least squares over all ellipses' centres, or all but a doubtful one that misfits.

    Doubtful circles are right but inexact: one whose rays don't even meet, or that lies millimetres from where the others ask for
    it, is another thing. Never raises on what the views show: what can't be the target is not found, with a reason.
    """
    views = (first, second)
    found = _chosen(_fits(views, target), views, target)
    if np.isnan(found.misfit) or found.misfit < chdtri(found.freedom, SUSPICIOUS):
        return found
    fewer = [fit for each in _without_one(views) for fit in _fits(each, target)]
    again = _chosen(fewer, views, target) if fewer else found
    doubtful = np.stack([view.doubtful for view in views])
    return again if again.found and (doubtful & ~again.used).any() else found


def _without_one(views: tuple[Sighting, Sighting]) -> Iterator[tuple[Sighting, Sighting]]:
    """The views without a circle that is doubtful in either, in the one and in the other: which is wrong must be told."""
    first, second = views
    for k in np.flatnonzero((first.doubtful | second.doubtful) & first.seen & second.seen):
        yield first.without(k), second
        yield first, second.without(k)


def _fits(views: tuple[Sighting, Sighting], target: Target) -> list[TargetPose]:
    """A pose of each start, or the reason why there is none."""
    model, (first, second) = circle_centres(target), views
    both = first.seen & second.seen
    if both.sum() < 2 or not (first.seen.all() or second.seen.all()):
        return [lost("fewer circles than a pose needs: three in one view, two in the other")]
    points, apart = meet(first, second)
    if not np.isfinite(points[both]).all():
        return [lost("a centre whose rays do not meet in front of the cameras")]
    if apart[both].max() > APART_MM:
        worst = int(np.where(both, apart, 0).argmax())
        return [lost(f"rays of {NAMES[worst]} miss each other by {apart[worst]:.1f} mm: other circles, or cameras swapped")]
    expected, found = distances(model), distances(points)
    if np.nanmax(np.abs(found - expected)) > GROSS_MM:
        pairs = [k for k in range(3) if np.isfinite(found[k])]
        shown = ", ".join(f"{PAIRS[k]} {found[k]:.1f} mm apart, expected {expected[k]:.1f}" for k in pairs)
        return [lost(f"centres {shown}")]
    starts = [aligned(model, points)] if both.all() else _starts(views, model)
    return [_refined(start, views, target, model) for start in starts] or [lost("no pose shows three circles so")]


def allowed(sighting: Sighting, target: Target) -> bool:
    """Whether some pose gives three circles of one view the centres and the shapes that they have."""
    poses = _starts([sighting], circle_centres(target)) if sighting.seen.all() else []
    return any(_like(*_off_shapes(pose, [sighting], [sighting.seen], target), SIZES_ALONE) for pose in poses)


def _starts(views: Sequence[Sighting], model: Array) -> list[Array]:
    """Poses that the view of all three circles allows."""
    whole = next(view for view in views if view.seen.all())
    return pose_hypotheses.poses(whole.camera, whole.centres, model)


def _chosen(fits: Sequence[TargetPose], views: Sequence[Sighting], target: Target) -> TargetPose:
    """Of poses that fit the centres, the one that fits the shapes, too; none if it doesn't, or if another does as well."""
    good = [fit for fit in fits if fit.found]
    if not good:
        return min(fits, key=lambda fit: np.nan_to_num(fit.misfit, nan=np.inf))
    shapes = [_off_shapes(fit.world_from_target, views, fit.used, target) for fit in good]
    total = [fit.misfit + float(np.sum((off / sigma) ** 2)) for fit, (off, sigma) in zip(good, shapes, strict=True)]
    best = int(np.argmin(total))
    off, sigma = shapes[best]
    if not _like(off, sigma, SIZES):
        return lost(f"circles whose sizes are {100 * np.abs(off).max():.0f} % from what their distance asks for")
    rivals = [fit for k, fit in enumerate(good) if k != best and total[k] < total[best] + DISTINCT]
    if any(_distance2(good[best], rival) > SAME for rival in rivals):
        return lost("two poses that the circles seen do not tell apart")
    return good[best]


def _like(off: Array, sigma: Array, share: float) -> bool:
    """Whether shapes agree with a pose's, within a share and their own uncertainty."""
    return bool((np.abs(off) <= share + SIGMAS * sigma).all())


def _off_shapes(pose: Array, views: Sequence[Sighting], used: Iterable[NDArray[np.bool_]], target: Target) -> tuple[Array, Array]:
    """Relative shape residuals of ellipses against a pose : (m, 3), and their standard deviations : (m, 1)."""
    off, sigma = [np.zeros((0, 3))], [np.zeros((0, 1))]
    for view, circles in zip(views, used, strict=True):
        if view.shapes is not None:
            expected = ellipses_of(view.camera, pose, circle_centres(target)[circles], target.outer_diameter_mm / 2)[1]
            size = np.trace(expected, axis1=1, axis2=2)[:, None] / 2
            off.append((view.shapes[circles] - expected)[:, [0, 0, 1], [0, 1, 1]] / size)
            rim = np.trace(view.covariance[circles], axis1=1, axis2=2)[:, None] / size**2  # a shape's is about its centre's
            sigma.append(np.sqrt(SHAPES**2 + rim))
    return np.concatenate(off), np.concatenate(sigma)


def _distance2(first: TargetPose, second: TargetPose) -> float:
    """Squared distance of two poses in standard deviations of the first."""
    off = rigid.difference(first.world_from_target, second.world_from_target)
    return float(off @ np.linalg.solve(first.covariance, off))


def lost(reason: str, misfit: float = np.nan) -> TargetPose:
    """No pose, for a reason."""
    return TargetPose(np.full((4, 4), np.nan), np.full((6, 6), np.nan), misfit, reason, used=np.zeros((2, 3), bool))


def meet(first: Sighting, second: Sighting) -> tuple[Array, Array]:
    """Midpoints : (3, 3) mm of the shortest lines between the rays of each centre, and their lengths : (3,) mm.

    NaN where rays are parallel or meet behind a camera.
    """
    origins = [view.camera.centre for view in (first, second)]
    rays = [view.camera.rays(view.centres) for view in (first, second)]
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


def distances(points: Array) -> Array:
    """Of the pairs PAIRS of three points : (..., 3, n), to (..., 3)."""
    return np.linalg.norm(points[..., [1, 2, 2], :] - points[..., [0, 0, 1], :], axis=-1)


def _refined(start: Array, views: Sequence[Sighting], target: Target, model: Array) -> TargetPose:
    """Least squares on the ellipses' centres, by Gauss-Newton, damped where that leads uphill."""
    whiten = [np.linalg.inv(np.linalg.cholesky(view.covariance[view.seen])) for view in views]

    def linearised(pose: Array) -> tuple[tuple[Array, Array], float]:
        design, residual = _linearised(pose, views, whiten, target, model)
        if not (np.isfinite(design).all() and np.isfinite(residual).all()):
            raise _Astray(MISFITTING)
        return (design, residual), residual @ residual

    try:
        pose, (design, residual), step, _ = descend(start, linearised, _solved, rigid.moved, _settled, RULES)
    except _Astray as astray:
        return lost(str(astray))
    if step is None:
        return lost(MISFITTING)
    misfit, freedom = float(np.sum((residual - design @ step) ** 2)), len(design) - PARAMETERS
    if not misfit < chdtri(freedom, IMPLAUSIBLE if freedom == PARAMETERS else SUSPICIOUS):
        times = np.sqrt(misfit / freedom)
        return lost(f"a misfit of {times:.0f} times the centres' uncertainty: other circles, or cameras swapped or moved", misfit)
    pose = rigid.moved(pose, step)
    if not all(pose[:3, 2] @ (pose[:3, 3] - view.camera.centre) < 0 for view in views):
        return lost("a target whose front does not face both cameras")
    used = np.stack([view.seen for view in views])
    return TargetPose(pose, np.linalg.inv(design.T @ design), misfit, freedom=freedom, used=used)


def _linearised(
    pose: Array, views: Sequence[Sighting], whiten: Sequence[Array], target: Target, model: Array
) -> tuple[Array, Array]:
    """Slopes : (n, 6) and residuals : (n,) of the centres seen, in standard deviations; ellipses' offsets follow the pose."""
    rows, left = [], []
    for view, white in zip(views, whiten, strict=True):
        circles = model[view.seen]
        predicted = ellipses_of(view.camera, pose, circles, target.outer_diameter_mm / 2)[0]
        by_point = slopes_at(view.camera, rigid.apply(pose, circles))
        rows.append((white @ by_point @ rigid.slopes(rigid.rotate(pose, circles))).reshape(-1, PARAMETERS))
        left.append((white @ (view.centres[view.seen] - predicted)[..., None]).ravel())
    return np.concatenate(rows), np.concatenate(left)


def _solved(_: Array, system: tuple[Array, Array], damping: float) -> Array:
    """The step : (6,) of the equations, with others that keep it short."""
    design, residual = system
    if damping > 0:
        design = np.vstack([design, np.diag(np.sqrt(damping) * np.linalg.norm(design, axis=0))])
        residual = np.append(residual, np.zeros(PARAMETERS))
    step, _, rank, _ = np.linalg.lstsq(design, residual, RANK)
    if rank < PARAMETERS:
        raise _Astray("views that do not determine the pose")
    return step


def _settled(system: tuple[Array, Array], step: Array) -> bool:
    return bool(np.sum((system[0] @ step) ** 2) < SETTLED)


class _Astray(Exception):
    """The reason why a start leads to no pose."""
