"""The published recipe for the three circles, as a rival: what follows the networks' answers, as printed and as its code has it.

Best three peaks of the detector, named by its other head; ellipses fitted to the masks' largest contours; triangulation of the
ellipses' centres as if they were points; axes along the differences. The lengths between the circles are not used, nor is the
right angle, so the matrix that comes out is not quite a rotation.

Source: Meza, Romero & Marrugo, MarkerPose: Robust Real-Time Planar Target Tracking for Accurate Stereo Pose Estimation, 2021.
"""

import cv2
import numpy as np
from numpy.typing import NDArray

from recon.geometry.camera import Camera

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Pixels = NDArray[np.int64]

CELL = 8  # px of the small image, along each side
SUPPRESSION = 4  # px of the small image, within which a peak has no rival
LEAST_SCORE = 0.015
NONE = 3  # class of a cell without circle
PATCH = 120  # px
MIDDLE = 59  # px, of a patch: its upper left is that far from the peak
LEAST_POINTS = 5  # of a contour, for an ellipse


def scores(detection: NDArray) -> NDArray:
    """Softmax of the detector's logits : (65, h, w), as a picture : (8 h, 8 w) of the chance of a centre in each pixel."""
    raised = np.exp(detection - detection.max(axis=0))
    share = (raised / raised.sum(axis=0))[:-1]
    _, rows, columns = share.shape
    return share.reshape(CELL, CELL, rows, columns).transpose(2, 0, 3, 1).reshape(CELL * rows, CELL * columns)


def peaks(score: NDArray) -> NDArray:
    """Local maxima of scores : (h, w), all else 0; maxima hidden by a greater one get a second chance."""
    window = np.ones((2 * SUPPRESSION + 1,) * 2, np.uint8)
    score = np.asarray(score, np.float32)
    top = score == cv2.dilate(score, window)
    near = cv2.dilate(top.astype(np.uint8), window) > 0
    rest = np.where(near, np.float32(0), score)
    return np.where(top | ((rest == cv2.dilate(rest, window)) & ~near), score, 0)


def candidates(detection: NDArray, identity: NDArray) -> Array | None:
    """Where the detector has c0, c1, c2 : (3, 2) px of the small image, from logits (65, h, w) and (4, h, w); None if not thrice.

    If the three are seen as from behind, the first two change places: of three in a wrong order that mends one kind.
    """
    score = peaks(scores(detection))
    rows, columns = np.nonzero(score > LEAST_SCORE)
    if len(rows) < 3:
        return None
    best = np.argsort(-score[rows, columns], kind="stable")[:3] if len(rows) > 3 else np.arange(3)
    rows, columns = rows[best], columns[best]
    names = identity.argmax(axis=0)[rows // CELL, columns // CELL].astype(int)
    if (names == NONE).any():
        names[names == NONE] = 6 - names.sum()  # the name that is missing, if just one is
    order = np.argsort(names, kind="stable")
    found = np.column_stack([columns, rows])[order].astype(float)
    x, y = found[1] - found[0], found[2] - found[0]
    return found[[1, 0, 2]] if x[0] * y[1] - x[1] * y[0] > 0 else found


def patch_origins(found: Array, small: tuple[int, int], full: tuple[int, int]) -> Pixels:
    """Upper left corners : (3, 2) px of the patches, from centres : (3, 2) in the small image; sizes are width, height."""
    return np.rint(found * (np.array(full) / np.array(small))).astype(np.int64) - MIDDLE


def centre_from_mask(mask: Mask, origin: Pixels) -> Array:
    """Centre : (2,) px in the image of the ellipse fitted to a mask's largest contour; NaN if there is none."""
    contours, _ = cv2.findContours(np.uint8(mask) * 255, cv2.RETR_TREE, cv2.CHAIN_APPROX_SIMPLE)
    largest = max(contours, key=cv2.contourArea, default=None)
    if largest is None or len(largest) < LEAST_POINTS:
        return np.full(2, np.nan)
    return np.array(cv2.fitEllipse(largest)[0]) + origin


def centres_from_logits(logits: NDArray, origins: Pixels) -> Array:
    """Centres : (3, 2) px from the segmenter's logits : (3, 120, 120): its masks are where the chance is more than one half."""
    return np.array([centre_from_mask(patch > 0, origin) for patch, origin in zip(logits, origins, strict=True)])


def pose_from_centres(first: Array, second: Array, cam1: Camera, cam2: Camera) -> Array:
    """Matrix world_from_target : (4, 4) mm from centres : (3, 2) px in both views; its upper left is not quite a rotation."""
    seen, projections = [], []
    for centres, camera in ((first, cam1), (second, cam2)):
        straight = cv2.undistortPoints(
            np.asarray(centres, float).reshape(-1, 1, 2), camera.matrix, camera.distortion, P=camera.matrix
        )
        seen.append(np.ascontiguousarray(np.asarray(straight, float).reshape(-1, 2).T))
        projections.append(camera.matrix @ camera.camera_from_world[:3])
    met = np.asarray(cv2.triangulatePoints(*projections, *seen), float)
    return pose_from_points((met[:3] / met[3]).T)


def pose_from_points(points: Array) -> Array:
    """Matrix world_from_target : (4, 4) mm from c0, c1, c2 : (3, 3) mm: unit differences as axes, and their cross product."""
    x, y = (away / np.linalg.norm(away) for away in points[1:] - points[0])
    result = np.eye(4)
    result[:3] = np.column_stack([x, y, np.cross(x, y), points[0]])
    return result
