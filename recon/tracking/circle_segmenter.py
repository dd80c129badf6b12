"""Rough ellipses of discs from the segmenter's masks of patches."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from recon.geometry.ellipses import Ellipses, root
from recon.model.rig import Target
from recon.tracking.identity import affinity, stretch
from recon.tracking.networks import PATCH, Networks

Array = NDArray[np.float64]

OFFSET = 59  # px from a patch's corner to the point that it is about
WIDEST = 105.0  # px of a disc's width that a patch holds
NARROWEST = 40.0  # px of the patch, of a disc's width that it is sure of; smaller ones are magnified
FINEST, COARSEST = 0.25, 12  # px of the image that make one of a patch; no disc is wider, see identity.DISC
SIZE = (14.0, 75.0)  # px of the patch, of the semi-axes
FLATTEST = 0.35
AREA = (0.8, 1.15)  # of a blob to that of its ellipse
OFF = 0.11  # of a disc's mean semi-axis, by which its ellipses may be off
ASTRAY = 40.0  # px of the patch, from the patch's middle


@dataclass(frozen=True)
class Patches:
    """Patches for the segmenter, and their places."""

    images: NDArray[np.float32]  # (n, 120, 120) from 0 to 1
    corners: Array  # (n, 2) px, the first pixel in the image
    step: float = 1  # px of the image that make one of a patch: whole ones, or a half or a quarter


def rough_ellipses(image: NDArray, points: Array, networks: Networks, target: Target) -> Ellipses:
    """Ellipses about points : (n, 2) px of c0, c1 and on, to a pixel or two; NaN where there is none, or no point."""
    cut = patches(image, points, step_for(points, target))
    found = read(networks.segment(cut.images), cut)
    there = np.isfinite(points).all(axis=1)
    return Ellipses(np.where(there[:, None], found.centre, np.nan), np.where(there[:, None, None], found.shape, np.nan))


def step_for(points: Array, target: Target) -> float:
    """Scale of patches that hold the discs and show them large enough, from the distances of two or more circles : (n, 2) px."""
    affine = affinity(points, target)
    scale = np.linalg.svd(affine, compute_uv=False)[0] if np.isfinite(affine).all() else stretch(points, target)
    wide = scale * target.outer_diameter_mm
    if wide >= NARROWEST:
        return float(np.clip(np.ceil(wide / WIDEST), 1, COARSEST))
    return 0.5 if 2 * wide >= NARROWEST else FINEST


def patches(image: NDArray, points: Array, step: float = 1) -> Patches:
    """Patches about points : (n, 2) px; beyond the image its border goes on."""
    height, width = image.shape
    corners = np.rint(np.nan_to_num(points)) - OFFSET * step
    if step < 1:
        return Patches(_magnified(image, corners, step), corners, step)
    within = int(step)
    along = np.arange(PATCH * within)
    first = corners.astype(np.int64)
    rows = np.clip(first[:, 1, None] + along, 0, height - 1)
    columns = np.clip(first[:, 0, None] + along, 0, width - 1)
    cut = image[rows[:, :, None], columns[:, None, :]].astype(np.float32) / np.float32(255)
    return Patches(cut.reshape(-1, PATCH, within, PATCH, within).mean(axis=(2, 4)), corners, step)


def _magnified(image: NDArray, corners: Array, step: float) -> NDArray[np.float32]:
    """Patches of which several pixels lie within one of the image, between which light is interpolated."""
    along = (step - 1) / 2 + step * np.arange(PATCH)
    source = image.astype(np.float32)
    made = np.empty((len(corners), PATCH, PATCH), np.float32)
    for number, corner in enumerate(corners):
        columns, rows = np.meshgrid(*np.float32(corner[:, None] + along))
        cv2.remap(source, columns, rows, cv2.INTER_LINEAR, dst=made[number], borderMode=cv2.BORDER_REPLICATE)
    return made / np.float32(255)


def read(masks: NDArray, cut: Patches) -> Ellipses:
    """Ellipses, in px of the image, of the patches' masks : (n, 120, 120), logits."""
    found = [_ellipse(np.asarray(mask) > 0) for mask in masks]
    centre = np.array([item[0] for item in found]).reshape(-1, 2) * cut.step + (cut.step - 1) / 2 + cut.corners
    return Ellipses(centre, np.array([item[1] for item in found]).reshape(-1, 2, 2) * cut.step)


NOTHING = (np.full(2, np.nan), np.full((2, 2), np.nan))


def _ellipse(mask: NDArray[np.bool_]) -> tuple[Array, Array]:
    """Centre and shape of the largest blob near the middle, NaN if it isn't elliptical."""
    count, labels, stats, centroids = cv2.connectedComponentsWithStats(mask.astype(np.uint8))
    if count < 2:
        return NOTHING
    away = np.hypot(*(centroids[1:] - OFFSET).T)
    area = np.where(away < ASTRAY, stats[1:, cv2.CC_STAT_AREA], 0)
    if area.max() < np.pi * SIZE[0] ** 2 * FLATTEST:
        return NOTHING
    blob = 1 + int(area.argmax())
    left, top, width, height = stats[blob, :4]
    contours, _ = cv2.findContours(np.asarray(labels == blob, np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    outline = max(contours, key=len).reshape(-1, 2)
    if min(left, top) <= 0 or left + width >= PATCH or top + height >= PATCH:
        inner = (outline > 0).all(axis=1) & (outline < PATCH - 1).all(axis=1)
        return _through(outline[inner])  # a disc larger than the patch is known by the part of its rim that is in it
    moments = cv2.moments(outline.reshape(-1, 1, 2).astype(np.int32))  # of the outline, filled
    if moments["m00"] <= 0:
        return NOTHING
    centre = np.array([moments["m10"], moments["m01"]]) / moments["m00"]
    second = np.array([[moments["mu20"], moments["mu11"]], [moments["mu11"], moments["mu02"]]]) / moments["m00"]
    shape = root(4 * second[None])[0] + 0.5 * np.eye(2)  # the outline runs through the outermost pixels' middles
    share = float(stats[blob, cv2.CC_STAT_AREA]) / (np.pi * max(np.linalg.det(shape), 1e-9))
    return (centre, shape) if _plausible(shape) and AREA[0] < share < AREA[1] else NOTHING


def _through(outline: NDArray) -> tuple[Array, Array]:
    if len(outline) < 60:
        return NOTHING
    centre, axes, angle = cv2.fitEllipseDirect(outline.astype(np.float32).reshape(-1, 1, 2))
    c, s = np.cos(np.radians(angle)), np.sin(np.radians(angle))
    turn = np.array([[c, -s], [s, c]])
    shape = turn @ np.diag(np.asarray(axes) / 2 + 0.5) @ turn.T
    middle = np.asarray(centre)
    good = np.isfinite(shape).all() and _plausible(shape) and np.hypot(*(middle - OFFSET)) < ASTRAY
    return (middle, shape) if good else NOTHING


def _plausible(shape: Array) -> bool:
    low, high = np.linalg.eigvalsh(shape)
    return bool(SIZE[0] * FLATTEST * 2 < low and high < SIZE[1] and high > SIZE[0] and low > FLATTEST * high)
