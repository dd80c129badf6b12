"""Pose hypotheses (P3P) of three centres of one view: a tilt either way, mostly, until another view settles it."""

from itertools import combinations

import cv2
import numpy as np
from numpy.typing import NDArray

from recon.geometry import rigid
from recon.geometry.camera import Camera

Array = NDArray[np.float64]

POINTS = 3  # of one view, that leave but some poses


def poses(camera: Camera, centres: Array, model: Array) -> list[Array]:
    """All `world_from_target` : (4, 4) mm that show a model : (n, 3) mm at centres : (n, 2) px; four at most.

    Of centres that aren't NaN the three of the largest triangle count; without three there is no pose. The front faces the
    camera. By P3P, as OpenCV 5 has it [Ding et al. 2023].
    """
    triples = list(combinations(np.flatnonzero(np.isfinite(centres).all(axis=1)).tolist(), POINTS))
    if not triples:
        return []
    areas = [abs(np.linalg.det(model[list(others), :2] - model[first, :2])) for first, *others in triples]
    widest = list(triples[int(np.argmax(areas))])
    _, turns, shifts = cv2.solveP3P(model[widest], camera.undistort(centres[widest]), np.eye(3), None, cv2.SOLVEPNP_P3P)
    found = [rigid.transform(cv2.Rodrigues(turn)[0], shift[:, 0]) for turn, shift in zip(turns, shifts, strict=True)]
    world_from_camera = rigid.invert(camera.camera_from_world)
    return [world_from_camera @ each for each in found if np.isfinite(each).all() and each[:3, 2] @ each[:3, 3] < 0]
