"""A circle that something covers, from the other two of its view.

Two discs tell the view's affinity all but exactly: it takes a circle to their ellipses, which leaves a turn, and one centre to
the other, which settles it. Their distance must be that of the circles that they are taken for; which end is which it can't tell.
The third place follows, as exactly as a view is affine: to 2 px in the median, 7 px at most for the rig. So does the shape there,
which a rim of which half is covered doesn't tell by itself.
"""

import numpy as np
from numpy.typing import NDArray

from recon.geometry.ellipses import Ellipses
from recon.model.circle_layout import circle_centres
from recon.model.rig import Target
from recon.tracking.identity import ALIKE
from recon.tracking.rim_fit.sectors import STEEP
from recon.tracking.rims import Outlines, measure_covered

Array = NDArray[np.float64]

REACH_PX = 8.0  # by which the place may be off
SHAPE = 0.035  # of a disc's size, by which its shape differs from the mean of the others, one standard deviation: perspective
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
    others = np.delete(outlines.depth, which)
    seen_through = again.middle[0] - again.inside[0] > INK * again.contrast[0]
    return bool(again.depth[0] > STEEP * others.min() and seen_through)
