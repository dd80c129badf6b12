"""Dark discs on a bright ground: rough candidates anywhere in an image, and the sub-pixel ellipses of those that matter."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from recon.board_detection.edges import Edges, find_edges
from recon.geometry.ellipses import EllipseFit, Ellipses, fit_ellipses, root

Array = NDArray[np.float64]

BLOCKS = (40, 12, 4)  # the threshold adapts over this part of the image's shorter side: small discs in uneven light, large ones
LEAST_AREA = 30.0  # px^2
LEAST_RATIO = 0.35  # of the semi-axes; a tilt of 45 deg gives 0.7
ROUNDNESS = 0.05  # of the radius, RMS of the outline about its ellipse; 0.1 for a square
THRESHOLD = 6  # of 255, how much darker than its surroundings
REFINEMENTS = 2  # about the first ellipses, which are those of rough outlines
NEAR = (4.0, 6.0)  # px and blurs to either side of the edge: what is farther tells next to nothing about it
ARC = 2.0  # px of the outline an edge point


@dataclass(frozen=True)
class Discs:
    """n discs, measured."""

    fit: EllipseFit
    edges: Edges
    covariance: (
        Array  # (n, 2, 2) px^2, of the centres, from the noise beside the edges, or the scatter of the edges if that is more
    )


def candidates(image: Array, full: float = 255) -> Ellipses:
    """Everything dark and elliptical, to half a pixel or so: discs, and whatever else looks like one.

    The threshold follows the light over several distances, so shadows, bright spots and discs of any size are no matter.
    """
    grey = _stretched(image, full)
    found: list[tuple[float, Array, Array]] = []
    for part in BLOCKS:
        block = max(min(grey.shape) // part, 5) | 1
        dark = cv2.adaptiveThreshold(grey, 255, cv2.ADAPTIVE_THRESH_MEAN_C, cv2.THRESH_BINARY_INV, block, THRESHOLD)
        contours = cv2.findContours(dark, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)[0]
        found += _elliptical([contour.reshape(-1, 2) for contour in contours], grey)
    return _distinct(found)


def measure(image: Array, rough: Ellipses, room: Array, full: float = 255) -> Discs:
    """The ellipses of discs to a hundredth of a pixel or better, from rough ones and the room about their rims : (n,) px."""
    size = np.median(np.trace(rough.shape, axis1=1, axis2=2)) / 2
    sectors = int(np.clip(2 * np.pi * size / ARC, 24, 96))
    fit, edges = _once(image, rough, room, np.ones(len(room)), sectors, full)
    for _ in range(REFINEMENTS):
        fit, edges = _once(image, fit.ellipses, room, edges.blur, sectors, full)
    return Discs(fit, edges, fit.covariance[:, :2, :2] * _excess(fit)[:, None, None])


def _once(image: Array, about: Ellipses, room: Array, blur: Array, sectors: int, full: float) -> tuple[EllipseFit, Edges]:
    reach = np.minimum(room, NEAR[0] + NEAR[1] * blur)
    edges = find_edges(image, about, reach, sectors=sectors, blur=blur, full=full)
    return fit_ellipses(edges.points, edges.sigma, about, edges.shared), edges


def _excess(fit: EllipseFit) -> Array:
    """Scatter of the edge points over that of the noise : (n,), at least 1.

    Texture and the printer's raster do that. What holds for all discs is told by their median; single ones must stand out.
    """
    chance = 1 + 3 * np.sqrt(2 / np.maximum(fit.weights.sum(axis=1) - 5, 1))
    return np.maximum(max(np.median(fit.chi2), 1), fit.chi2 / chance)


def _stretched(image: Array, full: float) -> NDArray[np.uint8]:
    """To 8 bits, the darkest and brightest per cent clipped, so that dim images do."""
    sample = image[:: max(image.shape[0] // 256, 1), :: max(image.shape[1] // 256, 1)]
    low, high = np.percentile(sample, [1, 99])
    high = max(high, low + 0.04 * full)  # an empty image stays empty
    scaled = (np.asarray(image, np.float32) - np.float32(low)) * np.float32(255 / (high - low))
    return cv2.GaussianBlur(np.clip(scaled, 0, 255).astype(np.uint8), (3, 3), 0)


def _elliptical(contours: list[Array], grey: NDArray[np.uint8]) -> list[tuple[float, Array, Array]]:
    """Deviation from an ellipse, centre and shape of each of the closed contours that is one and doesn't touch the border."""
    whole, areas, centres, seconds = [], [], [], []
    for contour in contours:
        if len(contour) < 12:
            continue
        left, top, width, height = cv2.boundingRect(contour)
        if min(left, top) <= 1 or left + width > grey.shape[1] - 2 or top + height > grey.shape[0] - 2:
            continue
        moments = cv2.moments(contour)
        if moments["m00"] < LEAST_AREA:
            continue
        whole.append(contour)
        areas.append(moments["m00"])
        centres.append([moments["m10"], moments["m01"]])
        seconds.append([[moments["mu20"], moments["mu11"]], [moments["mu11"], moments["mu02"]]])
    if not whole:
        return []
    area = np.array(areas)
    centre, second = np.array(centres) / area[:, None], np.array(seconds) / area[:, None, None]
    shape = root(4 * second)
    axes, inverse = np.linalg.eigvalsh(shape), np.linalg.inv(shape)
    found = []
    for k in np.flatnonzero(axes[:, 0] >= LEAST_RATIO * axes[:, 1]):
        v = (whole[k] - centre[k]) @ inverse[k]
        deviation = np.sqrt(np.mean((np.hypot(v[:, 0], v[:, 1]) - 1) ** 2))
        if deviation <= ROUNDNESS + 0.3 / axes[k, 0]:  # the contour runs through the outermost pixels' middles
            found.append((float(deviation), centre[k], shape[k] + 0.5 * np.eye(2)))
    return found


def _distinct(found: list[tuple[float, Array, Array]]) -> Ellipses:
    """One ellipse a place, the roundest: several thresholds see the same disc, and rings have two outlines."""
    kept: list[tuple[float, Array, Array]] = []
    places = np.empty((0, 3))
    for item in sorted(found, key=lambda item: item[0]):
        near = np.hypot(*(places[:, :2] - item[1]).T) < np.maximum(places[:, 2], np.trace(item[2]) / 2) / 2
        if not near.any():
            kept.append(item)
            places = np.vstack([places, [*item[1], np.trace(item[2]) / 2]])
    return Ellipses(np.array([k[1] for k in kept]).reshape(-1, 2), np.array([k[2] for k in kept]).reshape(-1, 2, 2))
