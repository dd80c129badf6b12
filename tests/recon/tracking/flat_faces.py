"""Synthetic photographs of flat faces for tests: rays of sub-pixels meet the face's plane, then blur, noise and 8 bits."""

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from recon.geometry import rigid

SUB = 3  # sub-pixels a pixel and axis
PAD = 12  # px about the face that are drawn with it


def facing(tilt=(0.0, 0.0), turn=0.0, place=(0.0, 0.0, 660.0)):
    """world_from_target : (4, 4): seen from the front, tilted about the camera's x and y, turned in its plane (deg)."""
    upright = np.diag([1.0, -1.0, -1.0])
    tilted = Rotation.from_euler("xy", tilt, degrees=True).as_matrix()
    turned = Rotation.from_euler("z", turn, degrees=True).as_matrix()
    rotation = tilted @ upright @ turned
    return rigid.transform(rotation, np.array(place) - rotation @ [12.5, 20.0, 0.0])


def corner_of(target):
    """Lower left corner : (2,) mm of the face, which the circles stand in the middle of."""
    return np.array([target.c1_mm, target.c2_mm]) / 2 - np.array(target.board_mm) / 2


def circles(target):
    """How white the target is at (..., 2) mm, NaN off the board."""
    centres = [[0.0, 0.0], [target.c1_mm, 0.0], [0.0, target.c2_mm]]

    def white(xy, footprint):
        squares = [(xy[..., 0] - x) ** 2 + (xy[..., 1] - y) ** 2 for x, y in centres]
        radius = np.sqrt(np.minimum(np.minimum(squares[0], squares[1]), squares[2]))
        inside = np.clip((radius - target.outer_diameter_mm / 2) / footprint + 0.5, 0, 1)
        hole = np.clip((target.inner_diameter_mm / 2 - radius) / footprint + 0.5, 0, 1)
        return np.where(_on(xy, target), inside + hole, np.nan)

    return white


def cells(board, target):
    """The same for a fiducial board."""

    def white(xy, footprint):
        at = np.floor((xy - np.float32(board.origin_mm)) / board.cell_mm).astype(np.int32)
        inside = ((at >= 0) & (at < board.cells.shape[::-1])).all(axis=-1)
        at = np.clip(at, 0, np.array(board.cells.shape[::-1]) - 1)
        return np.where(_on(xy, target), np.where(inside, board.cells[at[..., 1], at[..., 0]], 1.0), np.nan)

    return white


def view(camera, world_from_target, face, target, *, blur=0.6, dark=25.0, white=170.0, ground=60.0, noise=1.0, rng=None):
    """Grey image : (h, w) uint8; `ground` is a brightness or a picture : (h, w) behind the face."""
    low = corner_of(target)
    corners = low + np.array([[0, 0], [1, 0], [0, 1], [1, 1]]) * target.board_mm
    shown = camera.project(rigid.apply(world_from_target, np.column_stack([corners, np.zeros(4)])))
    first = np.maximum(np.floor(shown.min(axis=0)).astype(int) - PAD, 0)
    last = np.minimum(np.ceil(shown.max(axis=0)).astype(int) + PAD, np.array(camera.size) - 1)
    u, v = (np.arange(a, b + 1) for a, b in zip(first, last, strict=True))
    fine_u, fine_v = ((np.arange(SUB * a.size) + 0.5) / SUB - 0.5 + a[0] for a in (u, v))
    coarse = np.stack(np.meshgrid(np.arange(u[0] - 1, u[-1] + 2), np.arange(v[0] - 1, v[-1] + 2)), axis=-1).astype(float)
    back = rigid.invert(world_from_target)
    rays, origin = rigid.rotate(back, camera.rays(coarse)), rigid.apply(back, camera.centre)
    at = (origin + rays * (-origin[2] / rays[..., 2])[..., None])[..., :2]
    grid = np.meshgrid(np.float32(fine_u - u[0] + 1), np.float32(fine_v - v[0] + 1))
    xy = np.stack([cv2.remap(np.float32(at[..., k]), *grid, cv2.INTER_LINEAR) for k in range(2)], axis=-1)
    step_u, step_v = np.diff(xy[:1], axis=1).mean(axis=(0, 1)), np.diff(xy[:, :1], axis=0).mean(axis=(0, 1))
    share = face(xy, float(np.sqrt(abs(step_u[0] * step_v[1] - step_u[1] * step_v[0]))))
    image = np.broadcast_to(np.float32(ground), camera.size[::-1]).copy()
    window = slice(v[0], v[-1] + 1), slice(u[0], u[-1] + 1)
    behind = np.repeat(np.repeat(image[window], SUB, axis=0), SUB, axis=1)
    fine = np.where(np.isnan(share), behind, dark + (white - dark) * np.nan_to_num(share)).astype(np.float32)
    image[window] = fine.reshape(v.size, SUB, u.size, SUB).mean(axis=(1, 3))
    image = cv2.GaussianBlur(image, (0, 0), blur, borderType=cv2.BORDER_REPLICATE) if blur else image
    if rng is not None:
        image = image + np.float32(noise) * rng.standard_normal(image.shape, np.float32)
    return np.clip(np.rint(image), 0, 255).astype(np.uint8)


def clutter(shape, rng, pieces=200):
    """A picture : (h, w) of lines, boxes, letters, discs and rings, whose rings stand nowhere as the target's do."""
    image = np.full(shape, 110, np.uint8)
    for _ in range(pieces):
        at, shade = tuple(int(x) for x in rng.integers(0, shape[::-1])), int(rng.integers(0, 255))
        size = int(rng.integers(8, 60))
        kind = rng.integers(5)
        if kind == 0:
            cv2.line(image, at, tuple(int(x) for x in rng.integers(0, shape[::-1])), shade, int(rng.integers(1, 8)))
        elif kind == 1:
            cv2.rectangle(image, at, (at[0] + size, at[1] + int(rng.integers(8, 60))), shade, -1)
        elif kind == 2:
            cv2.putText(image, chr(int(rng.integers(65, 90))), at, cv2.FONT_HERSHEY_SIMPLEX, size / 20, shade, 5)
        elif kind == 3:
            cv2.circle(image, at, size, shade, -1)
        else:
            cv2.circle(image, at, size, shade, int(rng.integers(3, 20)))
    return image


def _on(xy, target):
    low, (width, height) = corner_of(target), target.board_mm
    x, y = xy[..., 0] - float(low[0]), xy[..., 1] - float(low[1])
    return (x >= 0) & (x <= width) & (y >= 0) & (y <= height)
