"""Whether cameras that stand around targets see them: each circle whole in the image, its face, and none before another."""

from collections.abc import Sequence
from functools import partial

import cv2
import numpy as np
from numpy.typing import NDArray

from recon.geometry import rigid
from recon.geometry.camera import Camera
from recon.model import circle_layout
from recon.model.rig import Rig, Target
from twin.tracking.target_truth import outline

Array = NDArray[np.float64]

WIDER = 1.5  # outline of a board with the hand that holds it, over that of its circles


def cameras_of(rig: Rig) -> tuple[Camera, Camera]:
    """Both cameras as they were calibrated."""
    return rig.cam1.optics.camera(), rig.cam2.optics.camera()


def in_views(
    poses: Array, target: Target, cameras: Sequence[Camera], margin: float = 0.0, most_deg: float = 90.0
) -> NDArray[np.bool_]:
    """Whether all cameras see the target : (n,) at poses : (n, 4, 4) of it in the world; what hides it is left out.

    margin : of each image, as a part of its width, in which no circle may lie
    most_deg : angle of the target's normal to the line of sight
    """
    rims = outline(circle_layout.circle_centres(target), target.outer_diameter_mm / 2).reshape(-1, 3)
    middles = poses[:, :3, :3] @ circle_layout.middle(target) + poses[:, :3, 3]
    places = rims @ np.swapaxes(poses[:, :3, :3], 1, 2) + poses[:, None, :3, 3]
    seen = np.ones(len(poses), bool)
    for camera in cameras:
        pixels, edge = camera.project(places), margin * camera.size[0]
        sight = camera.centre - middles
        facing = (sight * poses[:, :3, 2]).sum(axis=1) / np.linalg.norm(sight, axis=1)
        inside = ((pixels >= edge) & (pixels <= np.array(camera.size) - 1 - edge)).all(axis=(1, 2))
        seen &= inside & (facing > np.cos(np.deg2rad(most_deg)))
    return seen


def covers(pose: Array, target: Target, other_pose: Array, other: Target, cameras: Sequence[Camera]) -> bool:
    """Whether one of two targets at poses : (4, 4) in the world hides a circle of the other for any camera, or its hand may."""
    placed = [(pose, target), (other_pose, other)]
    return any(_hides(*sorted(placed, key=partial(_distance, camera)), camera=camera) for camera in cameras)


def _hides(nearer: tuple[Array, Target], farther: tuple[Array, Target], camera: Camera) -> bool:
    outlines = _outline(*nearer, camera, WIDER), _outline(*farther, camera, 1.0)
    return cv2.intersectConvexConvex(*outlines)[0] > 0


def _distance(camera: Camera, placed: tuple[Array, Target]) -> float:
    pose, target = placed
    return float(np.linalg.norm(rigid.apply(pose, circle_layout.middle(target)) - camera.centre))


def _outline(pose: Array, target: Target, camera: Camera, wider: float) -> NDArray[np.float32]:
    """Convex outline : (k, 1, 2) px of a target's circles, wider by a factor."""
    rims = outline(circle_layout.circle_centres(target), target.outer_diameter_mm / 2).reshape(-1, 3)
    pixels = camera.project(rigid.apply(pose, rims))
    middle = pixels.mean(axis=0)
    return cv2.convexHull((middle + wider * (pixels - middle)).astype(np.float32))
