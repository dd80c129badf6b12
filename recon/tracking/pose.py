"""The target's pose from its circles in two views, with its covariance, or the reason why there is none.

Centres of three circles in both views are twelve numbers for a pose of six: the other six tell whether it is the target that is
seen, with the right names and through the right cameras. Three circles in one view and two in the other are enough: then four are
left, and two poses may fit, of which the ellipses' shapes tell one.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from recon.geometry import pose_hypotheses, rigid
from recon.geometry.circle_outline import ellipses_of
from recon.geometry.pose_hypotheses import POINTS
from recon.model import circle_layout
from recon.model.calibration import Uncertainty
from recon.model.rig import Target
from recon.tracking.pose_fit import SHAPES, SUSPICIOUS, Sighting, TargetPose, lost, meet, refined

Array = NDArray[np.float64]

GROSS_MM = 4.0  # by which distances between centres may be off, before the fit: a sixth of the least
APART_MM = 4.0  # by which two views' rays of one centre may miss each other
SIZES = 0.12  # of a disc's size, by which shapes may differ from the pose's
SIZES_ALONE = 0.05  # the same of one view by itself: three rings of a sheet were 14 % off, targets 0.5 % in the median
SIGMAS = 3.0  # standard deviations that are added to what sizes may differ by
DISTINCT = 16.0  # least excess of another pose's misfit, with shapes
UNTOLD = "two poses that the circles seen do not tell apart"
SAME = 16.0  # squared standard deviations within which two poses are one


def estimate(first: Sighting, second: Sighting, target: Target, optics: Uncertainty | None = None) -> TargetPose:
    """Estimate the pose from two views, by least squares over all ellipses' centres, or all but a doubtful one that misfits.

    A doubtful circle may be inexact, or another thing's edge: one that no circle of the other view confirms must have the shape,
    too, that the pose gives it; and so must all, where a doubtful one was so wrong that its rays don't meet. Never raises on what
    the views show: what can't be the target is not found, with a reason.

    optics : of both cameras' calibration; None where it isn't known, or exact.
    """
    views = (first, second)
    found = _chosen(_fits(views, target, optics), views, target)
    doubtful, suspicious = np.stack([np.broadcast_to(view.doubtful, view.seen.shape) for view in views]), False
    if not (found.misfit < chdtri(found.freedom, SUSPICIOUS)):
        suspicious = np.isnan(found.misfit)
        fewer = [fit for each in _without_one(views) for fit in _fits(each, target, optics)]
        again = _chosen(fewer, views, target) if fewer else found
        found = again if again.found and (doubtful & ~again.used).any() else found
    lone = found.used & ~found.used[::-1] & doubtful
    return _confirmed(found, views, target, optics) if found.found and (suspicious or lone.any()) else found


def _confirmed(found: TargetPose, views: Sequence[Sighting], target: Target, optics: Uncertainty | None) -> TargetPose:
    """The pose, if the shapes of the ellipses that it was fitted to are those that it gives them, as far as they are known."""
    if any(view.shapes is None for view in views):
        return found
    whole = [view.only(used).by_shapes() for view, used in zip(views, found.used, strict=True)]
    again = refined(found.world_from_target, whole, target, optics)
    return found if again.found else lost("circles seen in part, of shapes that no pose gives them")


def _without_one(views: tuple[Sighting, Sighting]) -> Iterator[tuple[Sighting, Sighting]]:
    """The views without a circle that is doubtful in either, in the one and in the other: which is wrong must be told."""
    first, second = views
    for k in np.flatnonzero((first.doubtful | second.doubtful) & first.seen & second.seen):
        yield first.without(k), second
        yield first, second.without(k)


def _fits(views: tuple[Sighting, Sighting], target: Target, optics: Uncertainty | None) -> list[TargetPose]:
    """A pose of each start, or the reason why there is none."""
    model, (first, second) = circle_layout.circle_centres(target), views
    both = first.seen & second.seen
    if both.sum() < 2 or max(first.seen.sum(), second.seen.sum()) < POINTS:
        return [lost("fewer circles than a pose needs: three in one view, two in the other")]
    points, gaps = meet([first.camera, second.camera], [first.centres, second.centres])
    apart = np.abs(gaps)
    if not np.isfinite(points[both]).all():
        return [lost("a centre whose rays do not meet in front of the cameras")]
    if apart[both].max() > APART_MM:
        worst = int(np.where(both, apart, 0).argmax())
        return [lost(f"rays that miss each other: of c{worst} by {apart[worst]:.1f} mm; other circles, or cameras swapped")]
    expected, found = distances(model), distances(points)
    if np.nanmax(np.abs(found - expected)) > GROSS_MM:
        pairs = zip(combinations(range(len(model)), 2), found, expected, strict=True)
        shown = ", ".join(f"c{a}-c{b} {far:.1f} mm, expected {wanted:.1f}" for (a, b), far, wanted in pairs if np.isfinite(far))
        return [lost(f"circles not as far apart as the target's: {shown}")]
    starts = [aligned(model[both], points[both])] if both.sum() >= POINTS else _starts(views, model)
    return [refined(start, views, target, optics) for start in starts] or [lost("no pose shows three circles so")]


def exchanged(first: Sighting, second: Sighting, target: Target, optics: Uncertainty | None = None) -> bool:
    """Whether two views that give no pose give one as each other's: of cameras of which the frames, or names, are exchanged."""
    crossed = replace(second, camera=first.camera), replace(first, camera=second.camera)  # as `optics` has camera 1's first
    return estimate(*crossed, target, optics).found


def allowed(sighting: Sighting, covered: NDArray[np.bool_], target: Target) -> bool:
    """Whether some pose gives the circles of one view the centres and the shapes that they have, exactly if one is covered.

    covered : (n,) of which but a part of the rim is seen.
    """
    poses = _starts([sighting], circle_layout.circle_centres(target)) if sighting.seen.sum() >= POINTS else []
    likely = [pose for pose in poses if _like(*_off_shapes(pose, [sighting], [sighting.seen], target), SIZES_ALONE)]
    if not covered.any():
        return bool(likely)
    return any(refined(pose, [sighting.by_shapes()], target).found for pose in likely)


def _starts(views: Sequence[Sighting], model: Array) -> list[Array]:
    """Poses that the view of more circles allows."""
    whole = max(views, key=lambda view: view.seen.sum())
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
        return lost(f"circles of other sizes than at their distance: {100 * np.abs(off).max():.0f} % off")
    rivals = [fit for k, fit in enumerate(good) if k != best and total[k] < total[best] + DISTINCT]
    if any(fit.merging for fit in (good[best], *rivals)):
        turn = np.degrees(np.sqrt(np.trace(good[best].total[:3, :3])))
        return lost(f"views that leave the target's turn uncertain: by {turn:.1f} deg", good[best].misfit)
    if not all(same(good[best], rival) for rival in rivals):
        return lost(UNTOLD)
    return good[best]


def _like(off: Array, sigma: Array, share: float) -> bool:
    """Whether shapes agree with a pose's, within a share and their own uncertainty."""
    return bool((np.abs(off) <= share + SIGMAS * sigma).all())


def _off_shapes(pose: Array, views: Sequence[Sighting], used: Iterable[NDArray[np.bool_]], target: Target) -> tuple[Array, Array]:
    """Relative shape residuals of ellipses against a pose : (m, 3), and their standard deviations : (m, 1)."""
    off, sigma, every = [np.zeros((0, 3))], [np.zeros((0, 1))], circle_layout.circles(target)
    for view, circles in zip(views, used, strict=True):
        if view.shapes is not None:
            expected = ellipses_of(view.camera, pose, *every.some(circles))[1]
            size = np.trace(expected, axis1=1, axis2=2)[:, None] / 2
            off.append((view.shapes[circles] - expected)[:, [0, 0, 1], [0, 1, 1]] / size)
            rim = np.trace(view.covariance[circles], axis1=1, axis2=2)[:, None] / size**2  # a shape's is about its centre's
            sigma.append(np.sqrt(SHAPES**2 + rim))
    return np.concatenate(off), np.concatenate(sigma)


def same(first: TargetPose, second: TargetPose) -> bool:
    """Whether two poses are one, within the covariance of the first."""
    off = rigid.difference(first.world_from_target, second.world_from_target)
    return bool(off @ np.linalg.solve(first.total, off) <= SAME)


def aligned(model: Array, points: Array) -> Array:
    """The rigid transform : (4, 4) that takes model : (n, 3) to points : (n, 3) with the least squares [Kabsch 1976]."""
    middle, centre = model.mean(axis=0), points.mean(axis=0)
    left, _, right = np.linalg.svd((points - centre).T @ (model - middle))
    turn = left @ np.diag([1, 1, np.linalg.det(left @ right)]) @ right
    return rigid.transform(turn, centre - turn @ middle)


def distances(points: Array) -> Array:
    """Of all pairs of n points : (..., n, d), to (..., n (n - 1) / 2)."""
    first, second = np.triu_indices(points.shape[-2], 1)
    return np.linalg.norm(points[..., second, :] - points[..., first, :], axis=-1)
