"""A circle that something covers, from the other two of its view.

Two discs tell the view's affinity all but exactly: it takes a circle to their ellipses, which leaves a turn, and one centre to
the other, which settles it. Their distance must be that of the circles that they are taken for; which end is which it can't tell.
The third place follows, as exactly as a view is affine: to 2 px in the median, 7 px at most for the rig. So does the shape there,
which a rim of which half is covered doesn't tell by itself.

Where neither view shows it, two ellipses of each determine the pose but for a half turn, and with it the place to a pixel.
"""

from collections.abc import Iterator, Sequence
from itertools import product

import numpy as np
from numpy.typing import NDArray

from recon.geometry import pose_hypotheses
from recon.geometry.camera import Camera
from recon.geometry.circle_outline import ellipses_of
from recon.geometry.ellipses import Ellipses
from recon.model.calibration import Uncertainty
from recon.model.circle_layout import circle_centres, circles
from recon.model.rig import Target
from recon.tracking.identity import ALIKE
from recon.tracking.pose import APART_MM
from recon.tracking.pose_fit import Sighting, meet, refined
from recon.tracking.rim_fit.sectors import STEEP
from recon.tracking.rims import Outlines, measure_covered

Array = NDArray[np.float64]

REACH_PX = 8.0  # by which the place may be off
REACH_AGAIN_PX = 4.0  # the same of a pose by two circles of each view
SHAPE = 0.035  # of a disc's size, by which its shape differs from the mean of the others, one standard deviation: perspective
SHAPE_AGAIN = 0.01  # the same of a pose by two circles of each view
SEEN_AGAIN = 0.5  # of a rim that is found so: with less, another thing's edge was taken for it, half a turn from the target
INK = 0.15  # of a ring's contrast: a middle that is no brighter is ink, and this a black disc


def completed(image: NDArray, outlines: Outlines, target: Target) -> Outlines:
    """Three rims of an image; a missing one is sought again at the place that the other two predict."""
    which = missing(outlines.found)
    if which is None:
        return outlines
    rough = third(outlines.ellipses, which, target)
    known = SHAPE * np.trace(rough.shape, axis1=1, axis2=2) / 2
    again = measure_covered(image, rough, REACH_PX, known, target)
    return outlines.replaced(which, again) if alike(again, outlines, which) else outlines


def sought_again(
    frames: Sequence[NDArray],
    pair: Sequence[Outlines],
    cameras: Sequence[Camera],
    target: Target,
    optics: Uncertainty | None = None,
) -> Iterator[list[Outlines]]:
    """Rims of both views, which show two circles each, with the third where these have it, of the shape that it has there.

    Under each naming of the two by which that is so: at most under the right one, unless something looks very much like a ring.
    """
    for named, pose in named_poses(pair, cameras, target, optics):
        again = [
            _sought(frame, outlines, Ellipses(*ellipses_of(camera, pose, *circles(target))), target)
            for frame, outlines, camera in zip(frames, named, cameras, strict=True)
        ]
        if any(outlines.found.all() for outlines in again) and refined(pose, _whole(again, cameras), target, optics).found:
            yield again


def named_poses(
    pair: Sequence[Outlines], cameras: Sequence[Camera], target: Target, optics: Uncertainty | None = None
) -> Iterator[tuple[list[Outlines], Array]]:
    """Poses : (4, 4) mm by two circles of each view, with the rims in the order of the names under which they are such.

    By themselves two circles have no order, so mostly there are two poses, half a turn apart.
    """
    for orders in product(*(_orders(outlines.found) for outlines in pair)):
        named = [outlines[order] for outlines, order in zip(pair, orders, strict=True)]
        if not _meeting(named, cameras):
            continue
        which = int(np.argmin(named[0].found))
        centres = named[0].ellipses.centre.copy()
        centres[which] = third(named[0].ellipses, which, target).centre[0]
        starts = pose_hypotheses.poses(cameras[0], centres, circle_centres(target)) if np.isfinite(centres).all() else []
        fits = [refined(start, _whole(named, cameras), target, optics) for start in starts]
        if fits := [fit for fit in fits if fit.found]:
            yield named, min(fits, key=lambda fit: fit.misfit).world_from_target


def _meeting(pair: Sequence[Outlines], cameras: Sequence[Camera]) -> bool:
    """Whether the rays of circles that both views show meet."""
    both = pair[0].found & pair[1].found
    points, gaps = meet(cameras, [outlines.ellipses.centre[both] for outlines in pair])
    return bool(np.isfinite(points).all() and (np.abs(gaps) < APART_MM).all())


def _whole(pair: Sequence[Outlines], cameras: Sequence[Camera]) -> list[Sighting]:
    """Sightings of which whole ellipses count."""
    return [outlines.sighting(camera).by_shapes() for outlines, camera in zip(pair, cameras, strict=True)]


def _orders(found: NDArray[np.bool_]) -> list[NDArray[np.int64]]:
    """The order of three circles, and that with the two that are found exchanged."""
    kept, exchanged = np.arange(3), np.arange(3)
    exchanged[found] = exchanged[found][::-1]
    return [kept, exchanged]


def _sought(image: NDArray, outlines: Outlines, expected: Ellipses, target: Target) -> Outlines:
    """Three rims of an image; a missing one is sought again where a pose has it, hidden middle or not."""
    which = missing(outlines.found)
    if which is None:
        return outlines
    rough = expected[[which]]
    again = measure_covered(image, rough, REACH_AGAIN_PX, SHAPE_AGAIN * np.trace(rough.shape, axis1=1, axis2=2) / 2, target)
    sound = again.found.all() and again.seen[0] >= SEEN_AGAIN and _as_dark(again, outlines, which)
    return outlines.replaced(which, again) if sound else outlines


def missing(found: NDArray[np.bool_]) -> int | None:
    """Which one of three is not found, if the other two are."""
    return int(np.argmin(found)) if found.sum() == 2 else None


def third(ellipses: Ellipses, which: int, target: Target) -> Ellipses:
    """The ellipse, one, of circle number `which`, from the other two of three; NaN if their distance is another one."""
    places = circle_centres(target)[:, :2]
    a, b = (k for k in range(3) if k != which)
    shape = (ellipses.shape[a] + ellipses.shape[b]) / 2
    untilted = np.linalg.solve(shape * 2 / target.outer_diameter_mm, ellipses.centre[b] - ellipses.centre[a])
    side = places[b] - places[a]
    if abs(np.log(np.linalg.norm(untilted) / np.linalg.norm(side))) > ALIKE:
        return Ellipses(np.full((1, 2), np.nan), np.full((1, 2, 2), np.nan))
    # the target's y points up, the image's v down: of the two turns the one that mirrors
    angle = np.arctan2(untilted[1], untilted[0]) + np.arctan2(side[1], side[0])
    mirror = np.array([[np.cos(angle), np.sin(angle)], [np.sin(angle), -np.cos(angle)]])
    affine = shape * 2 / target.outer_diameter_mm @ mirror
    middle = (ellipses.centre[a] + ellipses.centre[b]) / 2
    centre = middle + affine @ (places[which] - (places[a] + places[b]) / 2)
    return Ellipses(centre[None], shape[None])


def alike(again: Outlines, outlines: Outlines, which: int) -> bool:
    """Whether a rim, one, is a ring as the other two of three are: of ink as dark, and with a middle that isn't ink.

    A middle that something hides tells nothing else, and a fingertip beside the target, which is round too, must not pass.
    """
    if not again.found.all():
        return False
    seen_through = again.middle[0] - again.inside[0] > INK * again.contrast[0]
    return bool(_as_dark(again, outlines, which) and seen_through)


def _as_dark(again: Outlines, outlines: Outlines, which: int) -> bool:
    return bool(again.depth[0] > STEEP * np.delete(outlines.depth, which).min())
