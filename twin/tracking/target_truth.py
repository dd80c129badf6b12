"""Ground truth of a target in a view: projected centres, outlines, blur, visibility."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from recon.geometry import rigid
from recon.geometry.camera import Camera
from recon.model import circle_layout
from recon.model.circle_layout import circle_centres
from recon.model.rig import CameraDevice, Target
from twin.tracking.samples import Held, Motion, Take

Array = NDArray[np.float64]

RIM = 64  # points of an outline


@dataclass(frozen=True)
class ViewTruth:
    """One view's truth in the middle of the exposure; NaN throughout without a target."""

    camera: Camera
    centres: Array  # (n, 2) px, the circles' projected centres
    ellipses: Array  # (n, 5) of the outer outlines: middle u, v, semi-axes a >= b px, angle rad of a from u towards v
    inside: NDArray[np.bool_]  # (n,) whether the whole disc lies in the image
    blur_px: Array  # (n,) length of a centre's path over the exposure
    visible: Array  # (n,) part of each disc, 0 to 1: in the image, nothing before it; 0 before it is rendered
    patch_origins: NDArray[np.int64]  # (n, 2) px; 0 before it is rendered
    white_dn: float = float("nan")  # brightness of the target's white, without noise


def view_truth(held: Held | Take, device: CameraDevice, late: float, target: Target) -> ViewTruth:
    """Ground truth of a body's target, or of a take's own, in one camera, which exposes later by a share of the exposure."""
    camera, model = device.optics.camera(), circle_centres(target)
    visible, origins = np.zeros(len(model)), np.zeros((len(model), 2), int)
    if not held.present:
        numbers, inside = np.full((len(model), 5), np.nan), np.zeros(len(model), bool)
        return ViewTruth(camera, numbers[:, :2], numbers, inside, numbers[:, 0], visible, origins)
    motion = held.motion.later(late)
    pose = motion.world_from_target
    rims = camera.project(rigid.apply(pose, outline(model, target.outer_diameter_mm / 2)))
    low, high = rims.min(axis=1), rims.max(axis=1)
    inside = ((low >= 0) & (high <= np.array(camera.size) - 1)).all(axis=1)
    centres, paths = camera.project(rigid.apply(pose, model)), path_length(motion, camera, model)
    return ViewTruth(camera, centres, ellipse_rows(rims), inside, paths, visible, origins)


def outline(centres: Array, radius: float) -> Array:
    """Points of circles in the plane z = 0 of the target : (n, RIM, 3) mm, about centres : (n, 3)."""
    angle = np.arange(RIM) * 2 * np.pi / RIM
    rim = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(RIM)]) * radius
    return centres[:, None] + rim


def board_corners(target: Target) -> Array:
    """Corners : (4, 3) mm of the board's face, its middle at the circles' middle."""
    half = np.array(target.board_mm) / 2
    middle = circle_layout.middle(target)[:2]
    return np.column_stack([middle + half * [[-1, -1], [1, -1], [1, 1], [-1, 1]], np.zeros(4)])


def board_hulls(motion: Motion, cameras: Sequence[Camera], target: Target) -> tuple[NDArray[np.float32], ...]:
    """Convex outlines : (n, 1, 2) px of the board over the exposure, one a view."""
    corners = board_corners(target)
    return tuple(
        cv2.convexHull(np.float32(np.concatenate([camera.project(rigid.apply(motion.at(t), corners)) for t in (-0.5, 0.5)])))
        for camera in cameras
    )


def overlap(one: Sequence[NDArray[np.float32]], other: Sequence[NDArray[np.float32]]) -> bool:
    """Whether two boards, by `board_hulls`, overlap in a view."""
    return any(cv2.intersectConvexConvex(a, b)[0] > 0 for a, b in zip(one, other, strict=True))


def inside_share(ellipses: Array, size: tuple[int, int], rings: int = 24) -> Array:
    """Part of each ellipse's area : (n,) that lies in an image of a size; ellipses : (n, 5) as of `ViewTruth`."""
    radius = np.sqrt((np.arange(rings) + 0.5) / rings)
    angle = (np.arange(4 * rings) + 0.5) * np.pi / (2 * rings)
    x, y = radius[:, None] * np.cos(angle), radius[:, None] * np.sin(angle)
    shares = []
    for u, v, a, b, turn in ellipses:
        du, dv = a * x * np.cos(turn) - b * y * np.sin(turn), a * x * np.sin(turn) + b * y * np.cos(turn)
        within = (np.abs(u + du + 0.5 - size[0] / 2) <= size[0] / 2) & (np.abs(v + dv + 0.5 - size[1] / 2) <= size[1] / 2)
        shares.append(within.mean())
    return np.array(shares)


def ellipse_rows(rims: Array) -> Array:
    """Ellipses through outlines : (n, RIM, 2) px, as (n, 5) rows of `ViewTruth.ellipses`: the conics nearest algebraically.

    Exact for a pinhole; a lens's distortion bends an outline by less than 1e-3 px away from an ellipse.
    """
    rows = []
    for rim in rims:
        middle = rim.mean(axis=0)
        scale = np.abs(rim - middle).max()
        x, y = (rim - middle).T / scale
        a, b, c, d, e = np.linalg.lstsq(np.column_stack([x * x, x * y, y * y, x, y]), np.ones(len(x)))[0]
        quadratic = np.array([[a, b / 2], [b / 2, c]])
        centre = np.linalg.solve(quadratic, [-d / 2, -e / 2])
        values, ways = np.linalg.eigh(quadratic / (1 + centre @ quadratic @ centre))
        axes = scale / np.sqrt(values)
        rows.append([*(middle + scale * centre), *axes, np.arctan2(ways[1, 0], ways[0, 0])])
    return np.array(rows)


def path_length(motion: Motion, camera: Camera, model: Array, steps: int = 9) -> Array:
    """Length of the centres' paths over the exposure : (n,) px."""
    places = camera.project(np.array([rigid.apply(motion.at(time), model) for time in np.linspace(-0.5, 0.5, steps)]))
    return np.linalg.norm(np.diff(places, axis=0), axis=-1).sum(axis=0)


def disc_masks(ellipses: Array, origins: NDArray[np.int64], size: int) -> NDArray[np.uint8]:
    """Filled outlines in patches : (n, size, size), 255 inside, for ellipses : (n, 5) and the patches' first pixels : (n, 2)."""
    masks = np.zeros((len(ellipses), size, size), np.uint8)
    v, u = np.mgrid[:size, :size]
    for mask, (cu, cv, a, b, angle), (u0, v0) in zip(masks, ellipses, origins, strict=True):
        du, dv = u + u0 - cu, v + v0 - cv
        along, across = du * np.cos(angle) + dv * np.sin(angle), dv * np.cos(angle) - du * np.sin(angle)
        mask[(along / a) ** 2 + (across / b) ** 2 <= 1] = 255
    return masks
