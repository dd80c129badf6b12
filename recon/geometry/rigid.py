"""Rigid transforms as 4x4 matrices on column vectors, named `to_from`: `world_from_target @ target_from_image`."""

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

Array = NDArray[np.float64]

RIGID = "a rigid transform of a right-handed frame"  # which `fault` expects
EXACT = 1e-9  # of matrix entries that are zero or one by definition: any file has them with all digits
FARTHEST_MM = 1e7  # that any device or pose lies from the origin
FEW_DIGITS = 1e-3  # of a rotation's products, as text files with few digits have them


def transform(rotation: ArrayLike, translation: ArrayLike) -> Array:
    """Build a 4x4 transform from a (3, 3) rotation matrix and a (3,) translation in mm.

    Raises
    ------
    ValueError
        If their shapes are others; a translation may be a column or a row.
    """
    if np.shape(rotation) != (3, 3) or np.size(translation) != 3:
        raise ValueError(f"expected a 3x3 rotation and 3 translations, found {np.shape(rotation)} and {np.shape(translation)}")
    result = np.eye(4)
    result[:3, :3] = rotation
    result[:3, 3] = np.asarray(translation, float).ravel()
    return result


def from_rotation_vector(vector: ArrayLike, translation: ArrayLike) -> Array:
    """Build a 4x4 transform from a (3,) rotation vector in rad (axis times angle) and a (3,) translation in mm."""
    return transform(Rotation.from_rotvec(np.asarray(vector, float)).as_matrix(), translation)


def apply(to_from: Array, points: ArrayLike) -> Array:
    """Move points : (..., 3) mm, by a 4x4 transform."""
    return np.asarray(points, float) @ to_from[:3, :3].T + to_from[:3, 3]


def rotate(to_from: Array, directions: ArrayLike) -> Array:
    """Turn directions : (..., 3), by the rotation of a 4x4 transform, leaving its translation out."""
    return np.asarray(directions, float) @ to_from[:3, :3].T


def invert(to_from: Array) -> Array:
    """Return `from_to`, the inverse of a rigid transform."""
    rotation = to_from[:3, :3].T
    return transform(rotation, -rotation @ to_from[:3, 3])


def fault(pose: Array, tolerance: float = FEW_DIGITS) -> str | None:
    """Name the fault of a matrix : (4, 4) that is no rigid transform of a right-handed frame; None for one that is.

    tolerance : of the entries of `R @ R.T`.
    """
    if pose.shape != (4, 4) or not np.isfinite(pose).all():
        return "another shape than 4x4, or values that are not finite"
    if np.abs(pose[3] - [0, 0, 0, 1]).max() > EXACT:
        return f"another last row than 0 0 0 1: {_row(pose[3])}"
    if (farthest := np.abs(pose[:3, 3]).max()) > FARTHEST_MM:
        return f"a shift by {farthest:.3g} mm: another unit?"
    rotation = pose[:3, :3]
    if np.abs(rotation).max() > 2 or np.abs(rotation @ rotation.T - np.eye(3)).max() > tolerance:
        return f"a matrix that is no rotation: {'; '.join(map(_row, rotation))}"
    if np.linalg.det(rotation) < 0:
        return "a left-handed frame: two axes swapped or one mirrored"
    return None


def _row(values: Array) -> str:
    return " ".join(f"{value:.9g}" for value in values)


def nearest(pose: Array) -> Array:
    """The rigid transform whose rotation is the nearest to that of a pose : (4, 4) with few digits, be that mirrored."""
    left, _, right = np.linalg.svd(pose[:3, :3])
    left[:, 2] *= np.sign(np.linalg.det(left @ right))  # the axis that matters least, as Kabsch has it
    return transform(left @ right, pose[:3, 3])


def moved(pose: Array, step: ArrayLike) -> Array:
    """Poses : (..., 4, 4) after steps : (..., 6), `R = exp([r]) R`, `t = t + dt`.

    A step is a turn in rad, then a shift in mm, both about the axes of the frame that the pose leads to. All errors, covariances
    and least squares of poses are in such steps.
    """
    step = np.asarray(step, float)
    result = np.array(pose, float, order="C")
    result[..., :3, :3] = Rotation.from_rotvec(step[..., :3]).as_matrix() @ result[..., :3, :3]
    result[..., :3, 3] += step[..., 3:]
    return result


def difference(first: Array, second: Array) -> Array:
    """The step : (6,) from one pose to another, rad and mm: the inverse of `moved`."""
    turn = Rotation.from_matrix(second[:3, :3] @ first[:3, :3].T).as_rotvec()
    return np.concatenate([turn, second[:3, 3] - first[:3, 3]])


def slopes(arms: Array) -> Array:
    """Derivatives : (..., 3, 6), mm/rad and mm/mm, of points by a step of their pose as in `moved`.

    arms : (..., 3) mm, from the pose's origin to the points: `rotate(pose, points)`.
    """
    result = np.empty((*arms.shape, 6))
    result[..., :3], result[..., 3:] = -cross(arms), np.eye(3)
    return result


def cross(vectors: ArrayLike) -> Array:
    """Matrices : (..., 3, 3) of the cross product with vectors : (..., 3) from the left."""
    vectors = np.asarray(vectors, float)
    result = np.zeros((*vectors.shape, 3))
    x, y, z = vectors[..., 0], vectors[..., 1], vectors[..., 2]
    result[..., 0, 1], result[..., 0, 2], result[..., 1, 2] = -z, y, -x
    return result - np.swapaxes(result, -1, -2)
