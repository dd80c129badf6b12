"""Outer rims of the target's rings in a frame, to a hundredth of a pixel, from rough ellipses.

The limit by noise is `(n/C) sqrt(2 sqrt(pi) s / (pi R))` px along each axis for noise n, contrast C, blur s
and radius R: 0.0012 px for n = 1, C = 100, s = 0.6, R = 45. `recon.tracking.rim_fit.rim_model` has the model that is fitted.
"""

from collections.abc import Container, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from recon.geometry.camera import Camera
from recon.geometry.ellipses import Ellipses, joined
from recon.model.rig import Target
from recon.tracking.pose_fit import Sighting
from recon.tracking.rim_fit.rim_model import FIT, START, fit_rims

Array = NDArray[np.float64]

FLOOR_PX = 0.002  # error by lens model, print and pixel grid, without any noise
COVERED = 2  # power of the visible share, by which variances are divided: a cover bends the rim beside it
LEAST_SEEN = 0.4  # of the rim: with less an ellipse is a guess
LEAST_CONTRAST = 4.0  # times the noise of a pixel over the root of the semi-axis
LEAST_DN = 1.5
BRIGHT = 0.3  # of the contrast, least excess of the middle over the ring: less light may fall on it than around
LARGEST_SIGMA = 1.5  # px: beyond, the ellipse is no measurement
FULL_DN = 255.0  # the end of the scale, see `frames.grey`
WHOLE = 0.85  # of the rim: with less in view, parts may be the edge of something else
SMEARED = 0.4  # of the semi-axis: on a longer path the speed isn't constant, as in the model
EXCEEDED = 2.0  # factor of variances where the path is longer, or white is clipped; measured on rendered frames
SKEWED = 0.03  # of the path, standard deviation of a centre by clipped white; measured on rendered frames
SHRUNK = 0.3  # of the path, standard deviation of a semi-axis by clipped white; measured on rendered frames
UNEVEN = 0.05  # of the contrast: white of a larger spread over the sectors isn't even within one
BENT_PX = 0.1  # times that share: standard deviation of a centre by uneven white
LARGEST_BLUR = 0.35  # of the ring's width; beyond that its dark ring is gone
LEAST_REACH_PX = 1.5
AGAIN = 0.05  # of a disc's mean semi-axis, that a rim is off which was fitted as that of another ring
FARTHEST = 0.4  # of the smaller semi-axis, that a rough rim may be off
ELSEWHERE = "not at the place that the others predict"


class Sought(NamedTuple):
    """Rings of a target that are sought in two frames."""

    rough: Ellipses  # of n
    of_second: NDArray[np.bool_]  # (n,) that lie in the second frame
    reach: float | Array  # or (n,) px, largest error of the rough rims
    target: Target


class Known(NamedTuple):
    """Standard deviations of what is known of a rim before it is fitted."""

    place_px: float | Array  # of its centre
    shape: float  # of its size

    def certainty(self, shapes: Array) -> Array:
        """Inverse variances : (n, 5) px^-2 of the centres and of the shapes : (n, 2, 2) px."""
        sigma = np.empty((len(shapes), 5))
        sigma[:, :2] = np.reshape(self.place_px, (-1, 1))
        sigma[:, 2:] = self.shape * np.trace(shapes, axis1=1, axis2=2)[:, None] / 2
        return sigma**-2.0


UNKNOWN = Known(np.inf, np.inf)
UNFITTED = np.zeros((), FIT)
for _name in set(FIT.names or ()) - {"found"}:
    UNFITTED[_name] = np.nan


@dataclass(frozen=True)
class Outlines:
    """n fitted rims; NaN where there is none."""

    ellipses: Ellipses  # of n
    joint: Array  # (n, 5, 5) px^2, covariance of centre and shape: x, y, a, b, c
    inside: Array  # (n,) DN, of the dark ring
    outside: Array  # (n,) DN, of the white around it
    middle: Array  # (n,) DN, of the white within it
    noise: Array  # (n,) DN, a pixel's, the larger of both sides
    motion: Array  # (n, 2) px, path over the exposure, up to its sign
    seen: Array  # (n,) share of the rim that looks like one
    doubtful: NDArray[np.bool_]  # (n,) covered in part, clipped, unevenly lit or smeared: errors may exceed the covariances
    uneven: NDArray[np.bool_]  # (n,) those of them that are in uneven light alone, which their covariances hold
    reasons: tuple[str | None, ...]  # of the rejection; None of a ring

    @property
    def covariance(self) -> Array:
        """Of the centres : (n, 2, 2) px^2."""
        return self.joint[:, :2, :2]

    @cached_property
    def found(self) -> NDArray[np.bool_]:
        """Whether each is a ring : (n,)."""
        return np.array([reason is None for reason in self.reasons], bool)

    @cached_property
    def rings(self) -> Ellipses:
        """The ellipses of those that are rings, NaN of the others."""
        return Ellipses(
            np.where(self.found[:, None], self.ellipses.centre, np.nan),
            np.where(self.found[:, None, None], self.ellipses.shape, np.nan),
        )

    @property
    def contrast(self) -> Array:
        """Of white and black : (n,) DN."""
        return self.outside - self.inside

    @property
    def depth(self) -> Array:
        """Contrast in whatever light, (white - black) / (white + black) : (n,)."""
        return self.contrast / (self.outside + self.inside)

    def sighting(self, camera: Camera) -> Sighting:
        """The sighting for the pose estimate, of the rims of c0, c1 and on."""
        return Sighting(camera, self.rings.centre, self.covariance, self.ellipses.shape, self.doubtful, self.joint)

    def without(self, which: Container[int]) -> "Outlines":
        """The same with some rims left out."""
        reasons = tuple(ELSEWHERE if k in which else reason for k, reason in enumerate(self.reasons))
        return replace(self, reasons=reasons)

    def replaced(self, which: int, other: "Outlines") -> "Outlines":
        """The same, with the one rim of `other` in place of number `which`."""
        order = np.arange(len(self.reasons))
        order[which] = len(order)
        return Outlines.joined([self, other])[order]

    @classmethod
    def joined(cls, parts: Sequence["Outlines"]) -> "Outlines":
        """Rims one after the other."""
        arrays = {name: np.concatenate([getattr(part, name) for part in parts]) for name in ARRAYS}
        return cls(joined([part.ellipses for part in parts]), **arrays, reasons=sum((part.reasons for part in parts), ()))

    def __getitem__(self, chosen) -> "Outlines":
        arrays = {name: getattr(self, name)[chosen] for name in ARRAYS}
        return Outlines(self.ellipses[chosen], **arrays, reasons=tuple(np.array(self.reasons, object)[chosen]))


ARRAYS = ("joint", "inside", "outside", "middle", "noise", "motion", "seen", "doubtful", "uneven")


def measure(image: NDArray, rough: Ellipses, reach: float | Array, target: Target) -> Outlines:
    """Fit the outer rims of rings.

    Parameters
    ----------
    image : (h, w) DN
        uint8 or float32, 255 is full.
    rough : Ellipses
        n rough ellipses.
    reach : float or (n,) px
        Largest error of the rough rims; beyond 0.4 of the smaller semi-axis as if it were that: neighbours come into reach.
    """
    (outlines,) = measure_all(image, image, [Sought(rough, np.zeros(len(rough.centre), bool), reach, target)])
    return outlines


def measure_all(first: NDArray, second: NDArray, sought: Sequence[Sought]) -> list[Outlines]:
    """The same for rings of several targets in two frames, all at once: threads share them."""
    starts = np.concatenate([_starts(each, UNKNOWN) for each in sought])
    fits = _fitted(first, second, starts)
    every = _judged(fits, np.zeros((len(fits), 5)), starts["hole"], middles=True)
    if len(sought) == 1:
        return [every]
    ends = np.cumsum([len(each.rough.centre) for each in sought]).tolist()
    return [every[end - len(each.rough.centre) : end] for end, each in zip(ends, sought, strict=True)]


def measure_again(image: NDArray, rims: Outlines, target: Target) -> Outlines:
    """The same rims, fitted as rings of a target whose holes are of another size than those that were expected."""
    again = measure(image, rims.ellipses, reach_px(rims.ellipses, AGAIN), target)
    return again.without(np.flatnonzero(~rims.found))


def reach_px(rough: Ellipses, share: float) -> Array:
    """Largest errors : (n,) px of n rough ellipses, a share of a disc's mean semi-axis: they grow with the discs."""
    return np.maximum(share * np.trace(rough.shape, axis1=1, axis2=2) / 2, LEAST_REACH_PX)


def measure_covered(image: NDArray, rough: Ellipses, reach: float | Array, known: Known, target: Target) -> Outlines:
    """The same for rings whose middle may be hidden, of which something is known before."""
    starts = _starts(Sought(rough, np.zeros(len(rough.centre), bool), reach, target), known)
    return _judged(_fitted(image, image, starts), known.certainty(rough.shape), starts["hole"], middles=False)


def _starts(sought: Sought, known: Known) -> NDArray:
    """Starts of the fit : (n,) START."""
    rough, starts = sought.rough, np.empty(len(sought.rough.centre), START)
    starts["second"], starts["hole"] = sought.of_second, hole_of(sought.target)
    starts["reach"] = np.minimum(sought.reach, _smaller_axis(rough) * FARTHEST)
    starts["place_sigma"], starts["shape_sigma"] = known.place_px, known.shape * np.trace(rough.shape, axis1=1, axis2=2) / 2
    starts["x"], starts["y"] = rough.centre.T
    starts["a"], starts["b"], starts["c"] = rough.shape[:, 0, 0], rough.shape[:, 0, 1], rough.shape[:, 1, 1]
    return starts


def _fitted(first: NDArray, second: NDArray, starts: NDArray) -> NDArray:
    """Fits : (n,) FIT of rims in two frames; NaN where none is found."""
    kind, fits = np.uint8 if first.dtype == second.dtype == np.uint8 else np.float32, np.full(len(starts), UNFITTED)
    fit_rims(np.ascontiguousarray(first, kind), np.ascontiguousarray(second, kind), starts, fits)
    return fits


def _smaller_axis(ellipses: Ellipses) -> Array:
    """Smaller semi-axes : (n,) px; NaN of ellipses that are none."""
    a, b, c = ellipses.shape[:, 0, 0], ellipses.shape[:, 0, 1], ellipses.shape[:, 1, 1]
    return (a + c) / 2 - np.hypot((a - c) / 2, b)


def hole_of(target: Target) -> float:
    """Inner over outer diameter of a target's rings."""
    return target.inner_diameter_mm / target.outer_diameter_mm


def _widened(covariance: Array, times: Array, known: Array) -> Array:
    """Covariances : (n, 5, 5) px^2 with the image's own part `times` : (n,) as large; what was known before stays as it was.

    known : (n, 5) px^-2, its inverse variances, which are in the covariances.
    """
    if not known.any():
        return covariance * times[:, None, None]
    before = known[:, :, None] * np.eye(5)
    return np.linalg.inv((np.linalg.inv(covariance) - before) / times[:, None, None] + before)


def _judged(fits: NDArray, known: Array, holes: Array, middles: bool) -> Outlines:
    """Rims by their fits, with the inverse variances : (n, 5) px^-2 of what was known of them before.

    holes : (n,) inner over outer diameters.
    """
    centre = np.stack([fits["x"], fits["y"]], axis=1)
    shape = np.stack([fits["a"], fits["b"], fits["b"], fits["c"]], axis=1).reshape(-1, 2, 2)
    inside, outside, middle, seen, spread = (fits[name] for name in ("inside", "outside", "middle", "seen", "uneven"))
    noise = fits["noise"].max(axis=1, initial=0)
    joint = _widened(fits["covariance"], np.maximum(fits["excess"], 1) / np.maximum(seen, 0.1) ** COVERED, known)
    joint = joint + FLOOR_PX**2 * np.eye(5)
    v0, v1, v2 = fits["variance"].T
    path, direction = np.sqrt(24 * np.hypot(v1, v2)), np.arctan2(v2, v1) / 2
    semi = np.trace(shape, axis1=1, axis2=2) / 2
    clipped, uneven = outside + 2 * spread + noise > FULL_DN, spread / np.maximum(outside - inside, LEAST_DN)
    beyond = clipped | (path > SMEARED * semi)
    joint[beyond] *= EXCEEDED
    joint[:, :2, :2] += ((BENT_PX * uneven) ** 2 + clipped * (SKEWED * path) ** 2)[:, None, None] * np.eye(2)
    joint[:, 2:, 2:] += ((BENT_PX * uneven) ** 2 + clipped * (SHRUNK * path) ** 2)[:, None, None] * np.eye(3)
    sigma = np.sqrt(np.trace(joint[:, :2, :2], axis1=1, axis2=2))
    motion = path[:, None] * np.column_stack([np.cos(direction), np.sin(direction)])
    reasons: list[str | None] = []
    for i in range(len(fits)):
        contrast = outside[i] - inside[i]
        if not fits["found"][i]:
            reasons.append("no rim")
        elif not contrast >= max(LEAST_DN, LEAST_CONTRAST * noise[i] / np.sqrt(semi[i])):
            reasons.append(f"a contrast of {contrast:.1f} DN in noise of {noise[i]:.1f}")
        elif not seen[i] >= LEAST_SEEN:
            reasons.append(f"{100 * seen[i]:.0f} % of its rim seen")
        elif middles and not middle[i] - inside[i] > BRIGHT * contrast * (1 - np.sqrt(v0[i]) / (holes[i] * semi[i])):
            reasons.append("no white middle")
        elif not np.sqrt(v0[i]) <= LARGEST_BLUR * (1 - holes[i]) * semi[i]:
            reasons.append(f"blurred by {np.sqrt(12 * v0[i]):.0f} px")
        elif not sigma[i] <= LARGEST_SIGMA:
            reasons.append(f"an uncertainty of {sigma[i]:.1f} px")
        else:
            reasons.append(None)
    worse = beyond | (seen < WHOLE)
    lit = (uneven > UNEVEN) & ~worse
    return Outlines(
        Ellipses(centre, shape), joint, inside, outside, middle, noise, motion, seen, worse | lit, lit, tuple(reasons)
    )
