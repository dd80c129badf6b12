"""The target in one camera: its three rims, or the reason why they aren't found."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from recon.geometry.camera import Camera
from recon.geometry.ellipses import Ellipses
from recon.model.rig import Target
from recon.tracking import identity
from recon.tracking.pose import allowed
from recon.tracking.pose_fit import NAMES
from recon.tracking.rims import ELSEWHERE, WHOLE, Outlines

Array = NDArray[np.float64]


@dataclass(frozen=True)
class View:
    """The three circles of one view, in the order of NAMES. In one of two views a circle may be told by the pose alone."""

    outlines: Outlines  # of 3
    reason: str | None = None  # why this isn't the target

    @property
    def found(self) -> bool:
        """Whether it is known where all three circles are."""
        return self.reason is None

    @property
    def useful(self) -> bool:
        """Whether it can go into a pose: two rings are not compared with each other, the pose does that."""
        return self.found or self.outlines.found.sum() == 2

    @property
    def blur_px(self) -> Array:
        """Lengths : (3,) of the circles' paths over the exposure; NaN of one that isn't seen."""
        return np.where(self.outlines.found, np.linalg.norm(self.outlines.motion, axis=1), np.nan)


def nothing(reason: str) -> View:
    """No circles, for a reason."""
    numbers, pairs = np.full(3, np.nan), np.full((3, 2), np.nan)
    outlines = Outlines(
        Ellipses(pairs, np.full((3, 2, 2), np.nan)),
        joint=np.full((3, 5, 5), np.nan),
        inside=numbers,
        outside=numbers,
        middle=numbers,
        noise=numbers,
        motion=pairs,
        seen=numbers,
        doubtful=np.zeros(3, bool),
        reasons=(reason,) * 3,
    )
    return View(outlines, reason)


def judged(outlines: Outlines, target: Target) -> View:
    """A view of three rims: the target if all are rings, of the sizes that their distances imply."""
    bad = [f"{name}: {reason}" for name, reason in zip(NAMES, outlines.reasons, strict=True) if reason is not None]
    if bad:
        return View(outlines, "; ".join(bad))
    off = identity.disagreement(outlines.ellipses, target)
    if not np.isfinite(off):
        return View(outlines, "circles of which the names are mirrored")
    if off > identity.ALIKE:
        return View(outlines, f"circles whose sizes are {100 * off:.0f} % off those at their distances")
    return View(outlines)


def unconfirmed(view: View, camera: Camera, target: Target) -> View:
    """A view that the other one doesn't confirm: shapes must be those of a pose, and no rim may be another thing's edge."""
    if not view.found or allowed(view.outlines.sighting(camera), view.outlines.seen < WHOLE, target):
        return view
    return replace(view, reason="circles of shapes that no pose gives them")


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


def renamed(outlines: Outlines, target: Target) -> Outlines:
    """The same rims in the order of the target's geometry, if all are rings."""
    return outlines[identity.named(outlines.ellipses, target)[0]] if outlines.found.all() else outlines
