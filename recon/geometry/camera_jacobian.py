"""How the projection into a device changes with the point and with the device's parameters.

The derivatives of the lens distortion are exact to rounding: the model is analytic, so a step of 1e-30 along the imaginary axis
gives them without a difference (Squire & Trapp 1998).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from recon.geometry import rigid
from recon.geometry.camera import Camera, distorted, tilt_matrix

Array = NDArray[np.float64]

MATRIX = ("fx", "fy", "cx", "cy")
DISTORTION = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4", "tau_x", "tau_y")  # OpenCV's order
MOTION = ("rx", "ry", "rz", "tx", "ty", "tz")  # a turn, rad, and a shift, mm, of device_from_world; see calibration.Uncertainty
STEP = 1e-30


@dataclass(frozen=True)
class Linearised:
    """A projection of m points and its derivatives."""

    pixels: Array  # (m, 2) px
    by_point: Array  # (m, 2, 3) px/mm, in the world's axes
    by_parameter: Array  # (m, 2, g) px per unit of each parameter


def linearise(camera: Camera, points: Array, names: Sequence[str]) -> Linearised:
    """Project points : (m, 3) mm in the world, with the derivatives by the point and by the parameters named."""
    turned = rigid.rotate(camera.camera_from_world, points)
    local = turned + camera.camera_from_world[:3, 3]
    x, y = local[:, 0] / local[:, 2], local[:, 1] / local[:, 2]
    padded = np.zeros(len(DISTORTION))
    padded[: camera.distortion.size] = camera.distortion
    layout = _layout(padded)
    slopes = np.stack([_imaginary(x + 1j * STEP, y, layout), _imaginary(x, y + 1j * STEP, layout)], axis=-1)  # (m, 2, 2)
    depth = local[:, 2, None, None]
    central = np.concatenate([np.tile(np.eye(2), (len(x), 1, 1)), -np.stack([x, y], axis=-1)[..., None]], axis=-1) / depth
    matrix = camera.matrix[:2, :2]
    by_local = matrix @ slopes @ central  # (m, 2, 3)
    bent = np.stack(distorted(x, y, camera.coefficients), axis=-1)
    by_parameter = np.zeros((len(points), 2, len(names)))
    for k, name in enumerate(names):
        if name in MATRIX:
            axis = int(name in ("fy", "cy"))
            by_parameter[:, axis, k] = bent[:, axis] if name in ("fx", "fy") else 1.0
        elif name in DISTORTION:
            nudged = padded + 1j * STEP * (np.arange(len(DISTORTION)) == DISTORTION.index(name))
            by_parameter[..., k] = _imaginary(x, y, _layout(nudged)) @ matrix.T
        else:
            unit = np.eye(3)[MOTION.index(name) % 3]
            along = np.cross(unit, turned) if name in MOTION[:3] else np.broadcast_to(unit, turned.shape)
            by_parameter[..., k] = np.einsum("mij,mj->mi", by_local, along)
    return Linearised(camera.to_pixels(bent), by_local @ camera.camera_from_world[:3, :3], by_parameter)


def moved(camera: Camera, names: Sequence[str], step: Array) -> Camera:
    """The device with some parameters changed by a step : (g,), in the meaning of `calibration.Uncertainty`."""
    change = dict(zip(names, step, strict=True))
    matrix = camera.matrix.copy()
    for name, place in zip(MATRIX, ((0, 0), (1, 1), (0, 2), (1, 2)), strict=True):
        matrix[place] += change.get(name, 0.0)
    distortion = np.zeros(len(DISTORTION))
    distortion[: camera.distortion.size] = camera.distortion
    distortion += [change.get(name, 0.0) for name in DISTORTION]
    place = rigid.moved(camera.camera_from_world, [change.get(name, 0.0) for name in MOTION])
    return replace(camera, matrix=matrix, distortion=_trimmed(distortion, camera.distortion.size), camera_from_world=place)


def difference(first: Camera, second: Camera, names: Sequence[str]) -> Array:
    """The step : (g,) that takes the first device to the second, as far as the names go: the inverse of `moved`."""
    changes = dict(zip(MATRIX, (second.matrix - first.matrix)[[0, 1, 0, 1], [0, 1, 2, 2]], strict=True))
    for camera, sign in ((second, 1), (first, -1)):
        for name, value in zip(DISTORTION, camera.distortion, strict=False):
            changes[name] = changes.get(name, 0.0) + sign * value
    changes |= dict(zip(MOTION, rigid.difference(first.camera_from_world, second.camera_from_world), strict=True))
    return np.array([changes.get(name, 0.0) for name in names])


def _trimmed(distortion: Array, least: int) -> Array:
    """The shortest set of OpenCV's lengths, but not below `least`, that leaves out nothing but zeros."""
    used = max(least, int(np.flatnonzero(distortion).max(initial=-1)) + 1)
    return distortion[: next(length for length in (0, 4, 5, 8, 12, 14) if length >= used)]


def _layout(padded: NDArray) -> NDArray:
    """Coefficients : (14,) in the layout of `Camera.coefficients`, real or complex."""
    return np.concatenate([padded[:12], tilt_matrix(padded[12], padded[13]).ravel()])


def _imaginary(x: NDArray, y: NDArray, layout: NDArray) -> Array:
    """Derivative of the distorted point : (m, 2), along the step that was made in the imaginary part of an argument."""
    return np.stack([np.broadcast_to(np.imag(value), x.shape) for value in distorted(x, y, layout)], axis=-1) / STEP
