"""The target in one camera: its rims, or the reason why they aren't found."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from recon.geometry.camera import Camera
from recon.geometry.ellipses import Ellipses
from recon.geometry.pose_hypotheses import POINTS
from recon.model.rig import Target
from recon.tracking import identity
from recon.tracking.circle_detector import LEAST_PX
from recon.tracking.pose import allowed
from recon.tracking.rims import ELSEWHERE, WHOLE, Outlines

Array = NDArray[np.float64]

DARK_DN = 6.0  # of 255, range of grey levels below which an image shows nothing: a white of 8 is found in 95 of 100
NEAR = 0.6  # of a disc's size, by which it differs from an affine view's where the target is as near as it is high


@dataclass(frozen=True)
class View:
    """The circles of one view, c0 and on. In one of two views a circle may be told by the pose alone."""

    outlines: Outlines  # of n
    reason: str | None = None  # why this isn't the target

    @property
    def found(self) -> bool:
        """Whether it is known where the circles are: three at least."""
        return self.reason is None

    @property
    def useful(self) -> bool:
        """Whether it can go into a pose: two rings are not compared with each other, the pose does that."""
        return self.found or self.outlines.found.sum() == POINTS - 1

    @property
    def blur_px(self) -> Array:
        """Lengths : (n,) of the circles' paths over the exposure; NaN of one that isn't seen."""
        return np.where(self.outlines.found, np.linalg.norm(self.outlines.motion, axis=1), np.nan)


def nothing(reason: str, count: int) -> View:
    """None of some circles, for a reason."""
    numbers, pairs = np.full(count, np.nan), np.full((count, 2), np.nan)
    outlines = Outlines(
        Ellipses(pairs, np.full((count, 2, 2), np.nan)),
        joint=np.full((count, 5, 5), np.nan),
        inside=numbers,
        outside=numbers,
        middle=numbers,
        noise=numbers,
        motion=pairs,
        seen=numbers,
        doubtful=np.zeros(count, bool),
        uneven=np.zeros(count, bool),
        reasons=(reason,) * count,
    )
    return View(outlines, reason)


def judged(outlines: Outlines, target: Target, camera: Camera | None = None) -> View:
    """A view of rims: the target if three or more are rings, of the sizes that their distances imply.

    camera : by which sizes may differ by perspective; None of a view that counts as affine.
    """
    if outlines.found.sum() < POINTS:
        return View(outlines, "; ".join(f"c{k}: {reason}" for k, reason in enumerate(outlines.reasons) if reason is not None))
    off = identity.disagreement(outlines.rings, target)
    if not np.isfinite(off):
        return View(outlines, "circles of which the names are mirrored")
    if off > identity.ALIKE and not (camera is not None and off < NEAR and _in_perspective(outlines, camera, target)):
        return View(outlines, f"circles of other sizes than at their distances: {100 * off:.0f} % off")
    return View(outlines)


def _in_perspective(outlines: Outlines, camera: Camera, target: Target) -> bool:
    """Whether some pose gives all rims their places and shapes."""
    return allowed(outlines.sighting(camera), outlines.found & (outlines.seen < WHOLE), target)


def unconfirmed(view: View, camera: Camera, target: Target) -> View:
    """A view that the other one doesn't confirm: shapes must be those of a pose, and no rim may be another thing's edge."""
    if not view.found or _in_perspective(view.outlines, camera, target):
        return view
    return replace(view, reason="circles of shapes that no pose gives them")


def gone(view: View, expected: Ellipses, size: tuple[int, int]) -> View:
    """A view without the target, with the reason that the expected place gives: beyond the view, or too far off."""
    if view.found:
        return view
    beyond = ~((expected.centre > 0) & (expected.centre < np.array(size) - 1)).all(axis=1)
    if beyond.any():
        return replace(view, reason=f"out of view: {', '.join(f'c{k}' for k in np.flatnonzero(beyond))}")
    wide = diameter(expected)
    return replace(view, reason=too_small(wide)) if wide < LEAST_PX else view


def in_light(view: View, frame: NDArray) -> View:
    """A view, without a ring for the reason that its frame : (h, w) DN is dark, if it is."""
    if view.outlines.found.any():
        return view
    low, high = np.percentile(frame[::8, ::8], (1, 99.5))
    if high - low >= DARK_DN:
        return view
    return nothing(f"too dark, or even: grey levels over {high - low:.0f} of 255", len(view.outlines.reasons))


def absent(places: int, count: int) -> View:
    """None of some circles, for a number of places like circles that aren't the target."""
    few = f"{places} of {count} circles"
    return nothing(few if places < count else f"{places} places like circles, no {count} that lie like the target's", count)


def too_small(wide: float) -> str:
    """Why circles of a diameter (px) are not found."""
    return f"too small: circles of {wide:.0f} px, expected {LEAST_PX:.0f} at least"


def unseen(seen: tuple[View, View]) -> str:
    """Why two views, not both with the target, give no pose."""
    for k in (0, 1):
        if seen[k].found:
            return f"only camera {k + 1} sees the target; camera {2 - k}: {seen[1 - k].reason}"
    return f"camera 1: {seen[0].reason}; camera 2: {seen[1].reason}"


def diameter(ellipses: Ellipses) -> float:
    """Of the smallest of some circles, px; NaN if there is none."""
    return float(np.fmin.reduce(np.trace(ellipses.shape, axis1=1, axis2=2), initial=np.nan))


def with_predicted(view: View, predicted: Ellipses, used: NDArray[np.bool_]) -> View:
    """The view of a known pose: unmeasured circles where the pose predicts them, measured ones unchanged."""
    outlines = view.outlines
    centre = np.where(used[:, None], outlines.ellipses.centre, predicted.centre)
    shape = np.where(used[:, None, None], outlines.ellipses.shape, predicted.shape)
    reasons = tuple(None if u else reason or ELSEWHERE for u, reason in zip(used, outlines.reasons, strict=True))
    return View(replace(outlines, ellipses=Ellipses(centre, shape), reasons=reasons))


def doubted(pair: tuple[View, View], reason: str | None) -> tuple[View, View]:
    """Two views that give no pose together: which one is wrong isn't known, so neither counts as the target's."""
    first, second = pair
    return replace(first, reason=reason), replace(second, reason=reason)


def renamed(outlines: Outlines, target: Target, camera: Camera | None = None) -> Outlines:
    """The same rims in the order of the target's geometry, if three or more are rings; close to a camera, that of a pose."""
    if outlines.found.sum() < POINTS:
        return outlines
    order, off = identity.named(outlines.rings, target)
    if camera is None or not identity.ALIKE < off < np.inf:
        return outlines[order]
    turned = [outlines[np.roll(order, k)] for k in range(len(order))]
    return next((one for one in turned if _in_perspective(one, camera, target)), turned[0])
