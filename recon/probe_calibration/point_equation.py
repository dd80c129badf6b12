"""The equation of a probe's calibration by one point: its solution in closed form, and the Jacobian of points."""

import numpy as np
from numpy.typing import NDArray

from recon.geometry import rigid

Array = NDArray[np.float64]


def closed_form(poses: Array, pixels: Array) -> tuple[Array, Array, Array]:
    """Least squares without iteration, all frames alike, for any number of sets of frames at once.

    `R_i (u_i a + v_i b + t) + t_i = wire` is linear in a = sx x, b = sy y, t and the wire. The lengths of a and b are the scales;
    the rotation is the one nearest to their directions.

    Parameters
    ----------
    poses, pixels : (..., n, 4, 4) and (..., n, 2)
        n >= 4.

    Returns
    -------
    target_from_image, scale, wire : (..., 4, 4), (..., 2), (..., 3)
    """
    turns, shifts = poses[..., :3, :3], poses[..., :3, 3]
    u, v = pixels[..., 0, None, None], pixels[..., 1, None, None]
    fixed = np.broadcast_to(-np.eye(3), turns.shape)
    design = np.concatenate([u / 100 * turns, v / 100 * turns, turns / 100, fixed / 100], axis=-1)  # columns of like length
    rows = (*pixels.shape[:-2], -1)
    solution = -(np.linalg.pinv(design.reshape(*rows, 12)) @ shifts.reshape(*rows, 1))[..., 0] / 100
    columns = np.stack([solution[..., :3], solution[..., 3:6]], axis=-1)
    scale = np.linalg.norm(columns, axis=-2)
    left, _, right = np.linalg.svd(columns / np.maximum(scale, 1e-12)[..., None, :], full_matrices=False)
    axes = left @ right
    result = np.zeros((*pixels.shape[:-2], 4, 4))
    result[..., :3, :2], result[..., :3, 2] = axes, np.cross(axes[..., 0], axes[..., 1])
    result[..., :3, 3], result[..., 3, 3] = solution[..., 6:9], 1
    return result, scale, solution[..., 9:]


def point_jacobian(target_from_image: Array, scale: Array, pixels: Array) -> Array:
    """Of points in the target's frame, by sx, sy, turn and shift : (n, 3, 8)."""
    x, y = target_from_image[:3, 0], target_from_image[:3, 1]
    arms = pixels[:, :1] * scale[0] * x + pixels[:, 1:] * scale[1] * y
    return np.concatenate([(pixels[:, :1] * x)[..., None], (pixels[:, 1:] * y)[..., None], rigid.slopes(arms)], axis=-1)
