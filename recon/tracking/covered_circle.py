"""A circle that something covers, from the others.

Two discs tell the view's affinity all but exactly: it takes a circle to their ellipses, which leaves a turn, and one centre to
the other, which settles it. Their distance must be that of the circles that they are taken for; which end is which it can't tell.
A third place follows, as exactly as a view is affine: to 2 px in the median, 7 px at most for the rig. So does the shape there,
which a rim of which half is covered doesn't tell by itself.

Where both views together give no pose, rims of which but a part is seen may be the edge of what covers them. Whole ellipses of
two circles in one view and one in the other determine the pose, but for half a turn at worst, and with it all places to a pixel.
There the others are sought a second time, held so closely that another edge beside them doesn't bend them.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import combinations, groupby, product

import numpy as np
from numpy.typing import NDArray

from recon.geometry import pose_hypotheses, rigid
from recon.geometry.camera import Camera
from recon.geometry.circle_outline import ellipses_of, slopes_at
from recon.geometry.ellipses import Ellipses
from recon.geometry.pose_hypotheses import POINTS
from recon.model.calibration import Uncertainty
from recon.model.circle_layout import circle_centres, circles
from recon.model.rig import Target
from recon.tracking.identity import ALIKE, affinity_of
from recon.tracking.pose import APART_MM, same
from recon.tracking.pose_fit import Sighting, TargetPose, meet, refined
from recon.tracking.rim_fit.sectors import STEEP
from recon.tracking.rims import WHOLE, Known, Outlines, measure_covered, reach_px

Array = NDArray[np.float64]

REACH = 0.18  # of a disc's mean semi-axis, by which the place may be off: perspective
REACH_AGAIN_PX = 3.0  # the same of a pose by some circles of both views
PLACE_AGAIN_PX = 0.2  # least standard deviation of a place by such a pose: at 1 px the edge of a cable still bent a rim by 2.8 px
BENT_AGAIN_PX = 0.3  # standard deviation that such an edge, a pixel or two beside the rim, leaves of what is found again
SHAPE = 0.035  # of a disc's size, by which its shape differs from the mean of the others, one standard deviation: perspective
SHAPE_AGAIN = 0.003  # the same of a pose by some circles of both views
SEEN_AGAIN = 0.5  # of a rim that is found so: with less, another thing's edge was taken for it, half a turn from the target
FEWEST = 3  # rims that determine a pose by whole ellipses: two of one view, one of the other
ENOUGH = 5  # rims by which it is the target: three of one view, two of the other
TRIALS = 16  # choices of rims, after which no fewer rims are tried
INK = 0.15  # of a ring's contrast: a middle that is no brighter is ink, and this a black disc


def completed(image: NDArray, outlines: Outlines, target: Target) -> Outlines:
    """The rims of an image; missing ones are sought again at the places that two others or more predict."""
    found = outlines.found
    if found.all() or found.sum() < 2:
        return outlines
    completed = outlines
    for which in np.flatnonzero(~found):
        rough = further(outlines.ellipses, found, which, target)
        again = measure_covered(image, rough, reach_px(rough, REACH), Known(np.inf, SHAPE), target)
        if alike(again, outlines):
            completed = completed.replaced(which, again)
    return completed


def sought_again(
    frames: Sequence[NDArray],
    pair: Sequence[Outlines],
    cameras: Sequence[Camera],
    target: Target,
    optics: Uncertainty | None = None,
) -> Iterator[list[list[Outlines]]]:
    """Refit the remaining rims at the positions that the trusted rims of both views predict.

    Whole rims are trusted, and each selection of the partly seen ones, under each naming whose whole ellipses fit one pose.
    Results with equally many trusted rims come in one list, most first.
    """
    for _, choices in groupby(_counted(pair), key=_number):
        yield [
            rims
            for counted in choices
            for named, pose in named_poses(counted, cameras, target, optics)
            if _are_whole(rims := _completed_by(pose, named, frames, cameras, target), pose, cameras, target, optics)
        ]


def _completed_by(
    pose: TargetPose, pair: Sequence[Outlines], frames: Sequence[NDArray], cameras: Sequence[Camera], target: Target
) -> list[Outlines]:
    """Fit the missing rims of both views at the positions that a pose predicts."""
    return [_sought(frame, rims, camera, pose, target) for frame, rims, camera in zip(frames, pair, cameras, strict=True)]


def _are_whole(
    pair: Sequence[Outlines], pose: TargetPose, cameras: Sequence[Camera], target: Target, optics: Uncertainty | None
) -> bool:
    """Whether there are three rims in one view and two in the other, whose whole ellipses fit a pose near the given one."""
    return _number(pair) >= ENOUGH and refined(pose.world_from_target, _whole(pair, cameras), target, optics).found


def _number(pair: Sequence[Outlines]) -> int:
    """Number of rims in both views."""
    return int(sum(outlines.found.sum() for outlines in pair))


def _counted(pair: Sequence[Outlines]) -> list[list[Outlines]]:
    """Choices of trusted rims, most first: the whole ones, with each selection of the partly seen ones.

    All selections of equally many rims are tried, or none, so that no rival of the result is missed.
    """
    choices = [list(choice) for choice in product(*(list(_fewer(outlines)) for outlines in pair))]
    several = sorted(
        (choice for choice in choices if FEWEST <= _number(choice) < sum(len(rims.reasons) for rims in pair)),
        key=_number,
        reverse=True,
    )
    fewest = _number(several[min(TRIALS, len(several)) - 1]) if several else FEWEST
    return [choice for choice in several if _number(choice) >= fewest]


def _fewer(outlines: Outlines) -> Iterator[Outlines]:
    """The rims of a view, and each selection without some of the partly seen ones; at least one is left."""
    covered = np.flatnonzero(outlines.found & (outlines.seen < WHOLE))
    for kept in product((True, False), repeat=len(covered)):
        fewer = outlines.without(covered[~np.array(kept, bool)])
        if fewer.found.any():
            yield fewer


def named_poses(
    pair: Sequence[Outlines], cameras: Sequence[Camera], target: Target, optics: Uncertainty | None = None
) -> Iterator[tuple[list[Outlines], TargetPose]]:
    """Poses from two or three circles of each view, each with the rims in the order of the names that give it.

    By themselves two circles have no order, so mostly there are two poses of two circles a view, half a turn apart.
    """
    for orders in product(*(_orders(outlines.found) for outlines in pair)):
        named = [outlines[order] for outlines, order in zip(pair, orders, strict=True)]
        if not _meeting(named, cameras):
            continue
        fits = [refined(start, _whole(named, cameras), target, optics) for start in _starts(named, cameras, target)]
        distinct: list[TargetPose] = []
        for fit in sorted((fit for fit in fits if fit.found), key=lambda fit: fit.misfit):
            if not any(same(fit, other) for other in distinct):
                distinct.append(fit)
        yield from ((named, fit) for fit in distinct)


def _starts(pair: Sequence[Outlines], cameras: Sequence[Camera], target: Target) -> list[Array]:
    """Poses that fit the view with more circles."""
    k = int(np.argmax([outlines.found.sum() for outlines in pair]))
    centres, found = pair[k].rings.centre.copy(), pair[k].found
    if found.sum() == POINTS - 1:
        which = int(np.argmin(found))
        centres[which] = further(pair[k].ellipses, found, which, target).centre[0]
    return pose_hypotheses.poses(cameras[k], centres, circle_centres(target))


def _meeting(pair: Sequence[Outlines], cameras: Sequence[Camera]) -> bool:
    """Whether the rays through circles that both views show meet."""
    both = pair[0].found & pair[1].found
    points, gaps = meet(cameras, [outlines.ellipses.centre[both] for outlines in pair])
    return bool(np.isfinite(points).all() and (np.abs(gaps) < APART_MM).all())


def _whole(pair: Sequence[Outlines], cameras: Sequence[Camera]) -> list[Sighting]:
    """Sightings by whole ellipses."""
    return [outlines.sighting(camera).by_shapes() for outlines, camera in zip(pair, cameras, strict=True)]


def _orders(found: NDArray[np.bool_]) -> list[NDArray[np.int64]]:
    """Orders of n circles: as they are; with two that are found exchanged; with one that is found under each name."""
    as_they_are = np.arange(len(found))
    if found.sum() >= POINTS:
        return [as_they_are]
    if found.sum() == 1:
        return [np.roll(as_they_are, k) for k in as_they_are]
    return [as_they_are, exchanged(found)]


def exchanged(found: NDArray[np.bool_]) -> NDArray[np.int64]:
    """The order of n circles with the two that are found exchanged."""
    order = np.arange(len(found))
    order[found] = order[found][::-1]
    return order


def _sought(image: NDArray, outlines: Outlines, camera: Camera, pose: TargetPose, target: Target) -> Outlines:
    """The rims of an image, with the missing ones fitted where a pose predicts them, even if their middles are hidden."""
    expected = Ellipses(*ellipses_of(camera, pose.world_from_target, *circles(target)))
    sigma = _place_sigma(camera, pose, target)
    for which in np.flatnonzero(~outlines.found):
        known = Known(np.hypot(PLACE_AGAIN_PX, sigma[which]), SHAPE_AGAIN)
        again = measure_covered(image, expected[[which]], REACH_AGAIN_PX, known, target)
        if again.found.all() and again.seen[0] >= SEEN_AGAIN and _as_dark(again, outlines):
            bent = replace(again, joint=again.joint + BENT_AGAIN_PX**2 * np.eye(5))
            outlines = outlines.replaced(which, bent)
    return outlines


def _place_sigma(camera: Camera, pose: TargetPose, target: Target) -> Array:
    """Standard deviations : (n,) px, along the worse axis, of the circles' positions by a pose."""
    centres, place = circle_centres(target), pose.world_from_target
    slopes = slopes_at(camera, rigid.apply(place, centres)) @ rigid.slopes(rigid.rotate(place, centres))
    return np.sqrt(np.linalg.eigvalsh(slopes @ pose.total @ np.swapaxes(slopes, 1, 2))[:, -1])


def named_and_completed(image: NDArray, outlines: Outlines, target: Target) -> Outlines:
    """As `completed`, where names are unsure: two rims may have other names, or exchanged ones."""
    named = by_distance(outlines, target)
    whole = completed(image, named, target)
    if whole.found.sum() != POINTS - 1:
        return whole
    other = completed(image, named[exchanged(named.found)], target)
    return other if other.found.sum() >= POINTS else whole


def by_distance(outlines: Outlines, target: Target) -> Outlines:
    """Rename the only two rims of an image if the target's circles of their names are another distance apart."""
    found = np.flatnonzero(outlines.found)
    if len(found) != POINTS - 1:
        return outlines
    two, pairs = outlines.ellipses[found], list(combinations(range(len(outlines.reasons)), 2))
    off = [abs(_log_stretch(two, pair, target)) for pair in pairs]
    best = int(np.argmin(off))
    if off[pairs.index(tuple(found.tolist()))] <= ALIKE or off[best] > ALIKE:
        return outlines
    order = np.arange(len(outlines.reasons))
    for new, old in zip(sorted({*pairs[best]} - {*found}), sorted({*found} - {*pairs[best]}), strict=True):
        order[[new, old]] = old, new
    return outlines[order]


def _log_stretch(two: Ellipses, names: tuple[int, int], target: Target) -> float:
    """Logarithm of the distance between two discs, measured by their sizes and tilts, over that of the circles of two names."""
    first, second = circle_centres(target)[names, :2]
    return float(np.log(np.linalg.norm(_untilted(two, target)) / np.linalg.norm(second - first)))


def _untilted(two: Ellipses, target: Target) -> Array:
    """Vector : (2,) mm on the target from one disc to another, up to a turn, by their mean shape."""
    return np.linalg.solve(two.shape.mean(axis=0) * 2 / target.outer_diameter_mm, two.centre[1] - two.centre[0])


def further(ellipses: Ellipses, found: NDArray[np.bool_], which: int, target: Target) -> Ellipses:
    """Predict the ellipse of circle number `which` from two or more others, `found` : (n,).

    NaN if they are two of another distance than the target's.
    """
    places = circle_centres(target)[:, :2]
    if found.sum() >= POINTS:
        shape, centres = ellipses.shape[found].mean(axis=0), ellipses.centre[found]
        arm = affinity_of(centres, places[found]) @ (places[which] - places[found].mean(axis=0))
        return Ellipses((centres.mean(axis=0) + arm)[None], shape[None])
    a, b = np.flatnonzero(found).tolist()
    two = ellipses[np.array([a, b])]
    if abs(_log_stretch(two, (a, b), target)) > ALIKE:
        return Ellipses(np.full((1, 2), np.nan), np.full((1, 2, 2), np.nan))
    shape, untilted, side = two.shape.mean(axis=0), _untilted(two, target), places[b] - places[a]
    # the target's y points up, the image's v down: of the two turns the one that mirrors
    angle = np.arctan2(untilted[1], untilted[0]) + np.arctan2(side[1], side[0])
    mirror = np.array([[np.cos(angle), np.sin(angle)], [np.sin(angle), -np.cos(angle)]])
    affine = shape * 2 / target.outer_diameter_mm @ mirror
    centre = two.centre.mean(axis=0) + affine @ (places[which] - (places[a] + places[b]) / 2)
    return Ellipses(centre[None], shape[None])


def alike(again: Outlines, outlines: Outlines) -> bool:
    """Whether a single rim is a ring like those found: its ink as dark, its middle free of ink.

    A middle that something hides tells nothing else, and a fingertip beside the target, which is round too, must not pass.
    """
    if not again.found.all():
        return False
    seen_through = again.middle[0] - again.inside[0] > INK * again.contrast[0]
    return bool(_as_dark(again, outlines) and seen_through)


def _as_dark(again: Outlines, outlines: Outlines) -> bool:
    """Whether the ink of a single rim is as dark as that of those found."""
    return bool(again.depth[0] > STEEP * outlines.depth[outlines.found].min())
