"""Overlays of tracking results: ellipses, names, the target's axes, or the reason why there is none."""

import math
from collections.abc import Mapping

import cv2
import numpy as np
from numpy.typing import NDArray

from recon.geometry import rigid
from recon.geometry.camera import Camera
from recon.tracking.frames import grey
from recon.tracking.pose_fit import TargetPose
from recon.tracking.views import View

FRACTION = 4  # bits of sub-pixels that cv2 draws with
COLOURS = ((80, 80, 255), (80, 220, 80), (255, 140, 60))  # BGR; of c0, c1, c2, and again; and of x, y, z
BAD = (0, 160, 255)
AXIS_MM = 20.0
FULL = 220.0  # of 255, to which a dark image is brightened


def drawn(image: NDArray, view: View, pose: TargetPose | None = None, camera: Camera | None = None) -> NDArray[np.uint8]:
    """A picture : (h, w, 3) BGR of a frame, brightened, with the view's results; axes need the pose and the camera.

    Raises
    ------
    InputError
        If it isn't an image.
    """
    picture = brightened(image)
    _draw(picture, view, pose, camera)
    reason = pose.reason if pose is not None else view.reason
    if reason is not None:
        _reason(picture, f"not found: {reason}", 0)
    return picture


def bodies_drawn(image: NDArray, found: Mapping[str, tuple[View, TargetPose]], camera: Camera) -> NDArray[np.uint8]:
    """The same of several bodies by name, whose views and poses these are; a body without a name has none."""
    picture, missing = brightened(image), 0
    for name, (view, pose) in found.items():
        _draw(picture, view, pose, camera, name)
        if not pose.found:
            _reason(picture, f"{name or 'not found'}: {pose.reason}", missing)
            missing += 1
    return picture


def brightened(image: NDArray, bits: int | None = None) -> NDArray[np.uint8]:
    """A picture : (h, w, 3) BGR of a frame; a dark one is made as bright as people look at it.

    Raises
    ------
    InputError
        If it isn't an image.
    """
    values = grey(image, bits)
    bright = max(float(np.percentile(values[::4, ::4], 99.5)), 1.0)
    return cv2.cvtColor(cv2.convertScaleAbs(values, alpha=max(FULL / bright, 1.0)), cv2.COLOR_GRAY2BGR)


def _draw(picture: NDArray[np.uint8], view: View, pose: TargetPose | None, camera: Camera | None, name: str = "") -> None:
    for k in range(len(view.outlines.reasons)):
        _ring(picture, view, k)
    if pose is not None and camera is not None and pose.found:
        _axes(picture, pose, camera)
        if name:
            (x, y), *_ = camera.project(pose.world_from_target[:3, 3][None])
            if np.isfinite([x, y]).all():
                _text(picture, name, (int(x) + 12, int(y) + 34), (255, 255, 255))


def _reason(picture: NDArray[np.uint8], text: str, line: int) -> None:
    """A reason at the lower edge, above so many others."""
    high = round(28 * max(picture.shape[1] / 1100, 0.4))
    _text(picture, text, (10, picture.shape[0] - 12 - line * high), BAD, picture.shape[1] - 20)


def _ring(picture: NDArray[np.uint8], view: View, k: int) -> None:
    centre, shape = view.outlines.ellipses.centre[k], view.outlines.ellipses.shape[k]
    if not (np.isfinite(centre).all() and np.isfinite(shape).all()):
        return
    colour = COLOURS[k % len(COLOURS)] if view.outlines.found[k] else BAD
    angles = np.linspace(0, 2 * np.pi, 90, endpoint=False)
    points = centre + np.column_stack([np.cos(angles), np.sin(angles)]) @ shape
    cv2.polylines(picture, [_fixed(points)], True, colour, 1, cv2.LINE_AA, FRACTION)
    cv2.circle(picture, tuple(int(x) for x in _fixed(centre)), 2 << FRACTION, colour, -1, cv2.LINE_AA, FRACTION)
    _text(picture, f"c{k}", tuple(int(x) for x in centre + np.array([6, -6])), colour)


def _axes(picture: NDArray[np.uint8], pose: TargetPose, camera: Camera) -> None:
    ends = camera.project(rigid.apply(pose.world_from_target, np.vstack([np.zeros(3), AXIS_MM * np.eye(3)])))
    for k, end in enumerate(ends[1:]):
        if np.isfinite([*ends[0], *end]).all():
            start, stop = (tuple(int(x) for x in _fixed(point)) for point in (ends[0], end))
            cv2.line(picture, start, stop, COLOURS[k], 2, cv2.LINE_AA, FRACTION)


def _text(
    picture: NDArray[np.uint8], text: str, place: tuple[int, ...], colour: tuple[int, int, int], most: float = math.inf
) -> None:
    """Text at a place, made smaller where it would be wider than `most` px."""
    font, scale = cv2.FONT_HERSHEY_SIMPLEX, max(picture.shape[1] / 1100, 0.4)
    (width, _), _ = cv2.getTextSize(text, font, scale, 2)
    scale *= min(1.0, 0.92 * most / max(width, 1))  # 0.92: sizes come in steps
    cv2.putText(picture, text, place, font, scale, colour, 2, cv2.LINE_AA)


def _fixed(points: NDArray) -> NDArray[np.int32]:
    return np.rint(np.asarray(points) * (1 << FRACTION)).astype(np.int32)
