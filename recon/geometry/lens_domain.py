"""Where a lens model is a map: each point of an image, and of a margin around it, has one ray, and no pole or fold comes before.

A polynomial fitted to points runs on beyond them. It may turn back (a fold: two rays meet in one pixel) or, as a quotient, go to
infinity (a pole), between the points or in a corner where none ever was.
"""

from dataclasses import replace

import numpy as np

from recon.geometry.camera import Camera
from recon.geometry.camera_jacobian import linearise

MARGIN = 0.1  # of the image's width and height, on each side
DIRECTIONS, STEPS = 128, 256  # of rays from the principal point, besides those to the corners, and along each
REACH = 4.0  # times the distance of the farthest corner without distortion: lenses compress by less
USUAL = 96  # steps within which rays have left the image through nearly all lenses: the others are seldom computed
LEAST_STRETCH = 0.02  # of areas, against the middle: less is about to fold


def is_one_to_one(camera: Camera, margin: float = MARGIN) -> bool:
    """Whether pixels and rays belong to each other one by one, all over the image and a margin : share of its sides around it.

    Along rays from the principal point outwards the image must leave this area, and until it does, run outwards and keep the
    sense of areas.
    """
    own, middle, size = replace(camera, camera_from_world=np.eye(4)), camera.matrix[:2, 2], np.array(camera.size)
    low, high = np.minimum(-0.5 - margin * size, middle), np.maximum((1 + margin) * size - 0.5, middle)
    focal = camera.matrix[[0, 1], [0, 1]]
    corners = (np.array([low, (low[0], high[1]), (high[0], low[1]), high]) - middle) / focal
    turns = np.append(np.linspace(0, 2 * np.pi, DIRECTIONS, endpoint=False), np.arctan2(corners[:, 1], corners[:, 0]))
    farthest = float(np.linalg.norm(corners, axis=1).max())
    ways = np.column_stack([np.cos(turns), np.sin(turns)])
    rays = ways[:, None] * np.linspace(0, REACH * farthest, STEPS)[:, None]
    for steps in (USUAL, STEPS):
        points = rays[:, :steps]
        seen = linearise(own, np.concatenate([points, np.ones((*points.shape[:2], 1))], axis=-1).reshape(-1, 3), ())
        pixels, slopes = seen.pixels.reshape(points.shape), seen.by_point[:, :, :2].reshape(*points.shape, 2)
        with np.errstate(invalid="ignore", over="ignore"):
            outside = ((pixels < low) | (pixels > high)).any(axis=-1)
            outwards = np.einsum("dsi,di->ds", np.diff(pixels, axis=1), ways * focal) > 0
            stretch = slopes[..., 0, 0] * slopes[..., 1, 1] - slopes[..., 0, 1] * slopes[..., 1, 0]
            keeps = stretch > LEAST_STRETCH * focal.prod()
        first = np.where(outside.any(axis=1), outside.argmax(axis=1), steps)
        before = np.arange(steps) < first[:, None]
        if not ((keeps | ~before).all() and (outwards | ~before[:, :-1]).all()):
            return False
        if outside.any(axis=1).all():
            return True
    return False
