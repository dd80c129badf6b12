"""Whether cameras that stand around a target see it: each circle whole in the image, and its face."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from recon.geometry.camera import Camera
from recon.model import circle_layout
from recon.model.rig import Rig, Target
from twin.tracking.target_truth import outline

Array = NDArray[np.float64]


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
