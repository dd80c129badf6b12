"""Pose hypotheses (P3P) of one view's three centres: a tilt either way, mostly, until another view settles it."""

import cv2
import numpy as np
from numpy.typing import NDArray

from recon.geometry import rigid
from recon.geometry.camera import Camera

Array = NDArray[np.float64]


def poses(camera: Camera, centres: Array, model: Array) -> list[Array]:
    """All `world_from_target` : (4, 4) mm that show points of the model : (3, 3) mm at centres : (3, 2) px; four at most.

    The front faces the camera. By P3P, as OpenCV 5 has it [Ding et al. 2023].
    """
    _, turns, shifts = cv2.solveP3P(model, camera.undistort(centres), np.eye(3), None, cv2.SOLVEPNP_P3P)
    found = [rigid.transform(cv2.Rodrigues(turn)[0], shift[:, 0]) for turn, shift in zip(turns, shifts, strict=True)]
    world_from_camera = rigid.invert(camera.camera_from_world)
    return [world_from_camera @ each for each in found if np.isfinite(each).all() and each[:3, 2] @ each[:3, 3] < 0]
