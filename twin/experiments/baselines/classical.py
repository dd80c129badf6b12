"""The three circles without learning: thresholds, contours, ellipses, and the geometry that only the target has.

What an engineer would write first, and a rival to the networks. A ring is a dark contour with a bright one inside, both
ellipses about one centre in the ratio of the diameters. Three rings are the target if the affinity that takes the design to
their centres takes a circle to their outlines: that names them as well, as a wrong order needs a sheared one. Rims that anything
touches or hides are not found; this is the price of contours.
"""

from dataclasses import dataclass
from itertools import permutations

import cv2
import numpy as np
from numpy.typing import NDArray

from recon.board_detection import discs
from recon.geometry.ellipses import Ellipses, root
from recon.model import circle_layout
from recon.model.rig import Target

Array = NDArray[np.float64]
Grey = NDArray[np.uint8]

BLOCKS = (24, 9, 4)  # the threshold adapts over this part of the image's shorter side
OFFSET = 5  # of 255 stretched, darker than the surroundings
LEAST_SPREAD = 16.0  # DN between the darkest and the brightest per cent; a stretch beyond it shows noise
LEAST_RADIUS = 5.0  # px, the shorter semi-axis of an outline
LEAST_RATIO = 0.45  # of the semi-axes; 50 deg and a camera that looks 15 deg aside give 0.42 at worst, seldom
RATIO = (0.7, 1.35)  # of the hole's size to what the diameters say; blur and the threshold move both rims
CONCENTRIC = 0.12  # of the outline's semi-axes, between the centres of outline and hole
ROUNDNESS = 0.06  # of the radius, RMS of a contour about its ellipse
MOST_RINGS = 30  # rounder ones first; threes are tried in all orders
AFFINE = 0.20  # natural logarithm of lengths, by which the outlines may differ from the affinity's: perspective, pixels
MEASURED = 0.15  # the same once measured
ROOM = 0.30  # of the shorter semi-axis, that is looked at beside a rim: the hole and the board's edge are 0.39 away
ENOUGH = 4.0  # blurs beside a rim; with less of it, neighbours and the board's edge draw the centres along
MINGLED = 0.02  # px a blur and a blur of missing room, as found on blurred pictures
MOST_SIGMA = 0.5  # px, of a centre
MOST_RESIDUAL = (0.03, 0.4)  # of the radius and px, RMS of the edge points about the ellipse
LEAST_SIGNAL = 4.0  # contrast over noise


@dataclass(frozen=True)
class Circles:
    """The three circles in an image, or why they are not found."""

    centres: Array  # (3, 2) px of the outer outlines' ellipses, c0, c1, c2; NaN if not found
    covariance: Array  # (3, 2, 2) px^2
    ellipses: Ellipses | None = None  # the outer outlines
    reason: str | None = None

    @property
    def found(self) -> bool:
        """Whether there are three circles."""
        return self.reason is None


def find(image: Grey, target: Target) -> Circles:
    """Find the target's circles in a grey image : (h, w), anywhere, in any turn, and to about 50 deg of tilt."""
    rough = rings(image, target)
    if len(rough.centre) < 3:
        return _none(f"{len(rough.centre)} rings, fewer than three")
    triple, misfit = choose(rough, target)
    if misfit > AFFINE:
        return _none(f"{len(rough.centre)} rings, but no three that stand as the target's")
    rough = rough[np.array(triple)]
    room = ROOM * rough.semi_axes[:, 1]
    measured = discs.measure(image, rough, room)
    ellipses = measured.fit.ellipses
    fault = _fault(measured)
    if fault is not None:
        return _none(fault)
    if not _misfit(ellipses.centre, ellipses.shape, target) < MEASURED:
        return _none("three rings whose outlines are not where their centres say")
    blur = measured.edges.blur
    mingled = MINGLED * blur * np.clip(ENOUGH - room / blur, 0, None)
    return Circles(ellipses.centre, measured.covariance + np.square(mingled)[:, None, None] * np.eye(2), ellipses)


def rings(image: Grey, target: Target) -> Ellipses:
    """Outer outlines of everything that looks like an annulus of the target, the roundest first, to a pixel or so."""
    grey = _stretched(image)
    found: list[tuple[float, Array, Array]] = []
    for part in BLOCKS:
        block = max(min(grey.shape) // part, 5) | 1
        dark = cv2.adaptiveThreshold(grey, 255, cv2.ADAPTIVE_THRESH_MEAN_C, cv2.THRESH_BINARY_INV, block, OFFSET)
        found += _annuli(dark, target.inner_diameter_mm / target.outer_diameter_mm)
    kept: list[tuple[float, Array, Array]] = []
    for item in sorted(found, key=lambda item: item[0]):
        size = np.sqrt(np.linalg.det(item[2]))
        if all(np.hypot(*(item[1] - other[1])) > size for other in kept):
            kept.append(item)
    kept = kept[:MOST_RINGS]
    return Ellipses(np.array([k[1] for k in kept]).reshape(-1, 2), np.array([k[2] for k in kept]).reshape(-1, 2, 2))


def choose(rough: Ellipses, target: Target) -> tuple[tuple[int, int, int], float]:
    """The three rings, as c0, c1, c2, closest to the target's, and their misfit (see `_misfit`)."""
    order = np.array(list(permutations(range(len(rough.centre)), 3)))
    misfit = _misfit(rough.centre[order], rough.shape[order], target)
    best = int(misfit.argmin())
    a, b, c = (int(i) for i in order[best])
    return (a, b, c), float(misfit[best])


def _misfit(centres: Array, shapes: Array, target: Target) -> Array:
    """Greatest natural logarithm : (...) by which outlines : (..., 3, 2, 2) are longer or shorter than centres : (..., 3, 2) say.

    Infinite where the three are seen from behind or lie on a line.
    """
    x, y = centres[..., 1, :] - centres[..., 0, :], centres[..., 2, :] - centres[..., 0, :]
    front = x[..., 0] * y[..., 1] - x[..., 1] * y[..., 0] < -1.0
    c1, c2 = circle_layout.extent(target)
    from_target = np.stack([x / c1, y / c2], axis=-1) * target.outer_diameter_mm / 2  # px a radius
    from_target = np.where(front[..., None, None], from_target, np.diag([1.0, -1.0]))
    back = np.linalg.inv(from_target)[..., None, :, :] @ shapes  # takes the unit circle to itself, if it is the target
    lengths = np.linalg.svd(back, compute_uv=False)
    return np.where(front, np.abs(np.log(np.maximum(lengths, 1e-9))).max(axis=(-2, -1)), np.inf)


def _annuli(dark: Grey, ratio: float) -> list[tuple[float, Array, Array]]:
    """Deviation, centre and shape of the outer outlines of dark annuli in a binary image."""
    contours, hierarchy = cv2.findContours(dark, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    if hierarchy is None:
        return []
    length = np.array([len(contour) for contour in contours])
    parent = hierarchy.reshape(-1, 4)[:, 3]
    holes = np.flatnonzero((parent >= 0) & (length > ratio * RATIO[0] * 2 * np.pi * LEAST_RADIUS * 0.7))
    largest: dict[int, int] = {}
    for hole in holes[np.argsort(length[holes])]:
        largest[int(parent[hole])] = int(hole)
    found = []
    for outer, inner in largest.items():
        if not 2 <= length[outer] / length[inner] <= 5:
            continue
        rim = _ellipse(contours[outer].reshape(-1, 2), dark.shape, +0.5)
        hole = _ellipse(contours[inner].reshape(-1, 2), dark.shape, -0.5)
        if rim is None or hole is None or np.linalg.eigvalsh(rim[2])[0] < LEAST_RADIUS:
            continue
        back = np.linalg.inv(rim[2])
        lengths = np.linalg.svd(back @ hole[2], compute_uv=False) / ratio
        if np.hypot(*(back @ (hole[1] - rim[1]))) < CONCENTRIC and RATIO[0] < lengths[1] and lengths[0] < RATIO[1]:
            found.append(rim)
    return found


def _ellipse(contour: NDArray[np.int32], shape: tuple[int, int], widen: float) -> tuple[float, Array, Array] | None:
    """Deviation, centre and shape of a closed contour's ellipse, `widen` px outside it; None if it's none or is cut off."""
    low, high = contour.min(axis=0), contour.max(axis=0)
    if len(contour) < 10 or low.min() <= 1 or high[0] >= shape[1] - 2 or high[1] >= shape[0] - 2:
        return None
    moments = cv2.moments(contour.reshape(-1, 1, 2))
    area = moments["m00"]
    if area < 10:
        return None
    centre = np.array([moments["m10"], moments["m01"]]) / area
    second = np.array([[moments["mu20"], moments["mu11"]], [moments["mu11"], moments["mu02"]]]) / area
    outline = root(4 * second[None])[0]
    axes = np.linalg.eigvalsh(outline)
    if axes[0] < LEAST_RATIO * axes[1] * 0.9:
        return None
    away = (contour - centre) @ np.linalg.inv(outline)
    deviation = float(np.sqrt(np.mean((np.hypot(*away.T) - 1) ** 2)))
    return (deviation, centre, outline + widen * np.eye(2)) if deviation < ROUNDNESS + 0.4 / axes[0] else None


def _fault(measured: discs.Discs) -> str | None:
    """Reason to refuse the outlines, or None."""
    fit, edges = measured.fit, measured.edges
    axes = fit.ellipses.semi_axes
    seen = np.isfinite(fit.residuals)
    scatter = np.sqrt(np.nansum(fit.residuals**2, axis=1) / np.maximum(seen.sum(axis=1), 1))
    sigma = np.sqrt(np.trace(measured.covariance, axis1=1, axis2=2) / 2)
    if not (edges.outside - edges.inside > LEAST_SIGNAL * edges.noise).all():
        return "rings that are hardly darker than their board"
    if not (sigma < MOST_SIGMA).all():
        return f"a centre uncertain by {sigma.max():.1f} px"
    if (scatter > np.maximum(MOST_RESIDUAL[0] * axes[:, 1], MOST_RESIDUAL[1])).any():
        return f"a rim {scatter.max():.1f} px off an ellipse"
    return None


def _stretched(image: Grey) -> Grey:
    """The darkest and brightest per cent clipped, so that a dim target does, and smoothed a little."""
    low, high = np.percentile(image[::4, ::4], [1, 99])
    scale = 255 / max(high - low, LEAST_SPREAD)
    return cv2.GaussianBlur(np.clip((image.astype(np.float32) - low) * scale, 0, 255).astype(np.uint8), (5, 5), 0)


def _none(reason: str) -> Circles:
    return Circles(np.full((3, 2), np.nan), np.full((3, 2, 2), np.nan), None, reason)
