"""A camera's view of the skin with the curves on it as they should be seen, to compare with what the camera sees."""

from collections.abc import Sequence

import cv2
import numpy as np
import trimesh
from numpy.typing import NDArray

from recon.files import meshes
from recon.geometry.camera import Camera
from recon.skin_projection import projector_image
from recon.skin_projection.projector_image import Lines, Lit
from recon.skin_projection.skin_curve import SkinCurve

Image = NDArray[np.uint8]


def expected(curves: Sequence[SkinCurve], lit: Lit, skin: trimesh.Trimesh, camera: Camera, lines: Lines) -> Image:
    """Grey view : (h, w) of the skin's vertices, in their own grey where they carry one, and of what is lit of the curves."""
    width, height = camera.size
    view = np.zeros((height, width), np.uint8)
    pixels = np.rint(camera.project(np.asarray(skin.vertices)))
    within = ((pixels >= 0) & (pixels < [width, height])).all(axis=1)
    u, v = pixels[within].astype(int).T
    greys = meshes.greys_of(skin)
    dimmed = 0.5  # of the skin's grey, so that lines stand out
    plain = 128  # grey of a skin that carries none
    view[v, u] = dimmed * (plain if greys is None else greys[within])
    filled = np.where(view == 0, cv2.dilate(view, np.ones((3, 3), np.uint8)), view)  # between vertices that are farther apart
    seen = projector_image.in_sight(curves, skin, camera)
    both = {name: points & seen[name] for name, points in lit.items()}
    drawn = projector_image.strips_of_light(curves, both, camera, lines)
    return np.maximum(filled, np.uint8(np.rint(255 * drawn)))
