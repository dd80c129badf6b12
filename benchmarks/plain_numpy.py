"""The surface pipeline in plain NumPy, with a flood fill in Numba: the peer of the fast one, and short enough to check by eye.

`from_files` is the rig authors' way, written plainly: images read one by one, a mask given, columns from a flood fill, the
projector's rows by epipolar lines, both undistorted by OpenCV, and planes met in closed form.
"""

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from recon.compiled import njit
from recon.geometry import rigid
from recon.geometry.camera import Camera
from recon.model.patterns import CentreLine, Fringes, Patterns

Array = NDArray[np.float64]

DARKEST = 4.0  # DN of modulation
REFINEMENTS = 4  # of the point along its ray; each divides the error by some hundred


def reconstruct(
    images: NDArray[np.uint8], patterns: Patterns, rays: Array, centre: Array, projector: Camera
) -> tuple[Array, Array]:
    """Projector columns : (h, w) px and points : (h, w, 3) mm of a centre line followed by N-step fringes.

    rays : (h, w, 3), unit, and centre : (3,) mm, of the camera in the world.
    """
    line, fringes = patterns.parts
    assert isinstance(line, CentreLine) and isinstance(fringes, Fringes)
    phase, modulation, offset = wrapped_phase(images[1:].astype(float), fringes.shifts)
    bright = (images[0] - offset) / np.maximum(modulation, 1)
    seeds = (bright > 0.5) & (np.abs(phase) < np.pi / 2) & (modulation > DARKEST)
    columns = fringes.zero(patterns.length("columns")) + fringes.pitch / (2 * np.pi) * flood(phase, modulation > DARKEST, seeds)
    return columns, triangulate(columns, rays, centre, projector)


def from_files(paths: Sequence[Path], patterns: Patterns, mask: NDArray[np.bool_], camera: Camera, projector: Camera) -> Array:
    """Points : (n, 3) mm of the pixels of a mask : (h, w), from image files; camera 1 is the world.

    Source: Meza et al. 2021, section 2.2, and the authors' public program.
    """
    line, fringes = patterns.parts
    assert isinstance(line, CentreLine) and isinstance(fringes, Fringes)
    lit = cv2.imread(str(paths[0]), cv2.IMREAD_GRAYSCALE)
    sine, cosine = np.zeros(mask.shape), np.zeros(mask.shape)
    for path, shift in zip(paths[1:], fringes.shifts, strict=True):
        image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        sine += image * np.sin(shift)
        cosine += image * np.cos(shift)
    _, bright = cv2.threshold(np.uint8(lit * mask), 0, 255, cv2.THRESH_BINARY | cv2.THRESH_OTSU)
    v, u = np.nonzero(bright)
    middle = np.abs(v - v.mean()) == np.abs(v - v.mean()).min()
    seeds = np.zeros(mask.shape, bool)
    seeds[round(v[middle].mean()), round(u[middle].mean())] = True
    phase = flood(np.arctan2(-sine, cosine), mask, seeds)[mask]
    v, u = np.nonzero(mask)
    column = fringes.zero(patterns.length("columns")) + fringes.pitch / (2 * np.pi) * phase
    seen = np.stack([u, v], axis=-1).astype(float)
    pixels = cv2.undistortPoints(seen[:, None], camera.matrix, camera.distortion, P=camera.matrix).reshape(-1, 1, 2)
    lines = cv2.computeCorrespondEpilines(pixels, 1, fundamental(camera, projector)).reshape(-1, 3)
    row = -(lines[:, 0] * column + lines[:, 2]) / lines[:, 1]
    x, y = cv2.undistortPoints(seen[:, None], camera.matrix, camera.distortion).reshape(-1, 2).T
    shown = np.stack([column, row], axis=-1)[:, None]
    a = cv2.undistortPoints(shown, projector.matrix, projector.distortion).reshape(-1, 2)[:, 0]
    turn, shift_mm = projector.camera_from_world[:3, :3], projector.camera_from_world[:3, 3]
    across = (turn[0, 0] - turn[2, 0] * a) * x + (turn[0, 1] - turn[2, 1] * a) * y + turn[0, 2] - turn[2, 2] * a
    z = (shift_mm[2] * a - shift_mm[0]) / across
    return np.stack([z * x, z * y, z], axis=-1)


def fundamental(camera: Camera, projector: Camera) -> Array:
    """Fundamental matrix : (3, 3) from the camera, which is the world, to the projector."""
    essential = rigid.cross(projector.camera_from_world[:3, 3]) @ projector.camera_from_world[:3, :3]
    return np.linalg.inv(projector.matrix).T @ essential @ np.linalg.inv(camera.matrix)


def wrapped_phase(images: Array, shifts: Array) -> tuple[Array, Array, Array]:
    """Phase, modulation and offset of N-step fringes."""
    cosine = np.tensordot(np.cos(shifts), images, axes=1)
    sine = np.tensordot(np.sin(shifts), images, axes=1)
    return np.arctan2(-sine, cosine), 2 / len(shifts) * np.hypot(sine, cosine), images.mean(axis=0)


@njit
def flood(phase, valid, seeds):
    """Unwrap from the seeds, whose order is zero, to neighbours of neighbours; NaN where no path leads."""
    height, width = phase.shape
    result = np.full((height, width), np.nan)
    queue = np.empty((height * width, 2), np.int64)
    head = tail = 0
    for v in range(height):
        for u in range(width):
            if seeds[v, u]:
                result[v, u] = phase[v, u]
                queue[tail] = v, u
                tail += 1
    while head < tail:
        v, u = queue[head]
        head += 1
        for dv, du in ((0, 1), (0, -1), (1, 0), (-1, 0)):
            y, x = v + dv, u + du
            if 0 <= y < height and 0 <= x < width and valid[y, x] and np.isnan(result[y, x]):
                step = phase[y, x] - result[v, u]
                result[y, x] = phase[y, x] - 2 * np.pi * np.rint(step / (2 * np.pi))
                queue[tail] = y, x
                tail += 1
    return result


def triangulate(columns: Array, rays: Array, centre: Array, projector: Camera) -> Array:
    """Points where the rays meet the projector's columns : (h, w, 3) mm."""
    origin = rigid.apply(projector.camera_from_world, centre)
    directions = rigid.rotate(projector.camera_from_world, rays)

    def meet(ideal: Array) -> Array:
        """Points where the rays meet columns of a lens without distortion."""
        x = (ideal - projector.matrix[0, 2]) / projector.matrix[0, 0]
        distance = (x * origin[2] - origin[0]) / (directions[..., 0] - x * directions[..., 2])
        return centre + distance[..., None] * rays

    ideal = columns.copy()
    for _ in range(REFINEMENTS):
        ideal += columns - projector.project(meet(ideal))[..., 0]
    return meet(ideal)
