"""Pixels of the projector that would light the probe and its target rather than the skin.

Left dark, no line climbs over the probe, where it would mislead, and none crosses the target's circles, which the cameras track.
"""

import cv2
import numpy as np
import trimesh
from numpy.typing import NDArray

from recon.geometry.camera import Camera

MARGIN_MM = 3.0  # around the body: more than it moves by hand between two images of a projector


def shadow(body: trimesh.Trimesh, projector: Camera, margin_mm: float = MARGIN_MM) -> NDArray[np.bool_]:
    """Whether pixels : (h, w) of a projector see a body, such as `recon.fusion.probe_shape.of` moved by its pose, or its margin.

    A body that is partly behind the projector hides what its triangles before it hide.
    """
    width, height = projector.size
    covered, vertices = np.zeros((height, width), np.uint8), np.asarray(body.vertices)
    corners = projector.project(vertices)[body.faces]
    near = np.abs(corners).max(axis=(1, 2)) < 8 * max(width, height)  # farther ones would overflow, and false if not finite
    for corner in np.rint(corners[near]).astype(np.int32):
        cv2.fillConvexPoly(covered, corner, 1)
    distance = float(np.median(np.linalg.norm(vertices - projector.centre, axis=1)))
    reach = int(np.ceil(margin_mm * projector.matrix[0, 0] / distance))
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach + 1, 2 * reach + 1))
    return cv2.dilate(covered, disc).astype(bool)
