"""Derivatives of the projection into a device, by the point and by the device's parameters.

All derivatives are the model's own formulas, but those of a tilted sensor's homography by its two angles: that is analytic, so a
step of 1e-30 along the imaginary axis gives them without a difference (Squire & Trapp 1998).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from recon.compiled import njit
from recon.geometry import rigid
from recon.geometry.camera import Camera, tilt_matrix

Array = NDArray[np.float64]

MATRIX = ("fx", "fy", "cx", "cy")
DISTORTION = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4", "tau_x", "tau_y")  # OpenCV's order
MOTION = ("rx", "ry", "rz", "tx", "ty", "tz")  # a turn, rad, and a shift, mm, of device_from_world; see calibration.Uncertainty
PARAMETERS = (*MATRIX, *DISTORTION, *MOTION)
TILTS, TURNS = len(MATRIX) + 12, len(MATRIX) + len(DISTORTION)  # first of the sensor's two angles, and of the turns
STEP = 1e-30


@dataclass(frozen=True)
class Linearised:
    """A projection of m points and its derivatives."""

    pixels: Array  # (m, 2) px
    by_point: Array  # (m, 2, 3) px/mm, in the world's axes
    by_parameter: Array  # (m, 2, g) px per unit of each parameter


class _Device(NamedTuple):
    """A camera for compiled code."""

    matrix: Array  # (3, 3) px
    coefficients: Array  # (22,) as `Camera.coefficients`
    tilts: Array  # (2, 3, 3) derivatives of the tilt's homography by its angles
    turn: Array  # (3, 3) from the world's axes to the camera's


def _tilt_slopes(angles: Array) -> Array:
    """Derivatives : (2, 3, 3) of the tilt's homography by its angles : (2,)."""
    return np.imag([tilt_matrix(angles[0] + 1j * STEP, angles[1]), tilt_matrix(angles[0], angles[1] + 1j * STEP)]) / STEP


UNTILTED = _tilt_slopes(np.zeros(2))


def linearise(camera: Camera, points: Array, names: Sequence[str]) -> Linearised:
    """Project points : (m, 3) mm in the world, with the derivatives by the point and by the parameters named."""
    turned = rigid.rotate(camera.camera_from_world, points)
    local = turned + camera.camera_from_world[:3, 3]
    tilts = _tilt_slopes(camera.distortion[12:]) if camera.distortion.size > 12 else UNTILTED
    device = _Device(camera.matrix, camera.coefficients, tilts, camera.camera_from_world[:3, :3])
    pixels, by_point, by_parameter = _derivatives(np.ascontiguousarray(turned), local, device, len(names) > 0)
    if not names:
        return Linearised(pixels, by_point, np.empty((len(pixels), 2, 0)))
    return Linearised(pixels, by_point, by_parameter[..., [PARAMETERS.index(name) for name in names]])


@njit
def _derivatives(turned, local, device, parameters):
    """Pixels : (m, 2) of points turned to the camera and moved to it, with their derivatives.

    Returns
    -------
    The pixels, and their derivatives by the point : (m, 2, 3) and, where asked for, by all PARAMETERS : (m, 2, 24).
    """
    fx, skew, fy = device.matrix[0, 0], device.matrix[0, 1], device.matrix[1, 1]
    turn, t = device.turn, device.coefficients[12:21].copy().reshape((3, 3))
    m = len(local)
    pixels, by_point, by_parameter = np.empty((m, 2)), np.empty((m, 2, 3)), np.zeros((m if parameters else 0, 2, TURNS + 6))
    slopes, by_local, by_coefficient = np.empty((2, 2)), np.empty((2, 3)), np.zeros((12, 2))
    for i in range(m):
        a, b, c = turned[i]
        z = local[i, 2]
        x, y = local[i, 0] / z, local[i, 1] / z
        u, v = _bent(x, y, device.coefficients, slopes, by_coefficient)
        w = t[2, 0] * u + t[2, 1] * v + t[2, 2]  # then the tilted sensor
        p, q = (t[0, 0] * u + t[0, 1] * v + t[0, 2]) / w, (t[1, 0] * u + t[1, 1] * v + t[1, 2]) / w
        pixels[i, 0] = fx * p + skew * q + device.matrix[0, 2]
        pixels[i, 1] = fy * q + device.matrix[1, 2]
        p_u, p_v = (t[0, 0] - p * t[2, 0]) / w, (t[0, 1] - p * t[2, 1]) / w
        q_u, q_v = (t[1, 0] - q * t[2, 0]) / w, (t[1, 1] - q * t[2, 1]) / w
        across_u, across_v, down_u, down_v = fx * p_u + skew * q_u, fx * p_v + skew * q_v, fy * q_u, fy * q_v
        for k in range(2):  # x and y
            by_local[0, k] = (across_u * slopes[0, k] + across_v * slopes[1, k]) / z
            by_local[1, k] = (down_u * slopes[0, k] + down_v * slopes[1, k]) / z
        for j in range(2):
            by_local[j, 2] = -(x * by_local[j, 0] + y * by_local[j, 1])
            for k in range(3):
                by_point[i, j, k] = by_local[j, 0] * turn[0, k] + by_local[j, 1] * turn[1, k] + by_local[j, 2] * turn[2, k]
        if not parameters:
            continue
        for j in range(2):
            by_parameter[i, j, TURNS] = by_local[j, 2] * b - by_local[j, 1] * c  # a turn moves the point by unit x point
            by_parameter[i, j, TURNS + 1] = by_local[j, 0] * c - by_local[j, 2] * a
            by_parameter[i, j, TURNS + 2] = by_local[j, 1] * a - by_local[j, 0] * b
            for k in range(3):
                by_parameter[i, j, TURNS + 3 + k] = by_local[j, k]
        by_parameter[i, 0, 0], by_parameter[i, 1, 1] = p, q
        by_parameter[i, 0, 2], by_parameter[i, 1, 3] = 1.0, 1.0
        for k in range(12):
            du, dv = by_coefficient[k]
            by_parameter[i, 0, 4 + k] = across_u * du + across_v * dv
            by_parameter[i, 1, 4 + k] = down_u * du + down_v * dv
        for k in range(2):
            d = device.tilts[k]
            dw = d[2, 0] * u + d[2, 1] * v + d[2, 2]
            dp = (d[0, 0] * u + d[0, 1] * v + d[0, 2] - p * dw) / w
            dq = (d[1, 0] * u + d[1, 1] * v + d[1, 2] - q * dw) / w
            by_parameter[i, 0, TILTS + k], by_parameter[i, 1, TILTS + k] = fx * dp + skew * dq, fy * dq
    return pixels, by_point, by_parameter


@njit(inline="always")
def _bent(x, y, k, slopes, by_coefficient):
    """A point distorted by the first 12 coefficients; its slopes : (2, 2) by x and y, and by the coefficients : (12, 2)."""
    r2 = x * x + y * y
    above, below = 1 + r2 * (k[0] + r2 * (k[1] + r2 * k[4])), 1 + r2 * (k[5] + r2 * (k[6] + r2 * k[7]))
    radial = above / below
    steep = (k[0] + r2 * (2 * k[1] + 3 * r2 * k[4]) - radial * (k[5] + r2 * (2 * k[6] + 3 * r2 * k[7]))) / below  # by r2
    prism_x, prism_y = k[8] + 2 * r2 * k[9], k[10] + 2 * r2 * k[11]
    common = 2 * x * y * steep + 2 * k[2] * x + 2 * k[3] * y
    slopes[0, 0] = radial + 2 * x * x * steep + 2 * k[2] * y + 6 * k[3] * x + 2 * x * prism_x
    slopes[0, 1] = common + 2 * y * prism_x
    slopes[1, 0] = common + 2 * x * prism_y
    slopes[1, 1] = radial + 2 * y * y * steep + 6 * k[2] * y + 2 * k[3] * x + 2 * y * prism_y
    power = 1.0
    for first, second in ((0, 5), (1, 6), (4, 7)):
        power *= r2
        by_coefficient[first, 0], by_coefficient[first, 1] = x * power / below, y * power / below
        by_coefficient[second, 0], by_coefficient[second, 1] = -x * radial * power / below, -y * radial * power / below
    by_coefficient[2, 0], by_coefficient[2, 1] = 2 * x * y, r2 + 2 * y * y
    by_coefficient[3, 0], by_coefficient[3, 1] = r2 + 2 * x * x, 2 * x * y
    by_coefficient[8, 0], by_coefficient[9, 0] = r2, r2 * r2
    by_coefficient[10, 1], by_coefficient[11, 1] = r2, r2 * r2
    u = x * radial + 2 * k[2] * x * y + k[3] * (r2 + 2 * x * x) + r2 * (k[8] + r2 * k[9])
    v = y * radial + k[2] * (r2 + 2 * y * y) + 2 * k[3] * x * y + r2 * (k[10] + r2 * k[11])
    return u, v


def moved(camera: Camera, names: Sequence[str], step: Array) -> Camera:
    """The device with some parameters changed by a step : (g,), in the meaning of `calibration.Uncertainty`."""
    change = dict(zip(names, step, strict=True))
    matrix = camera.matrix.copy()
    for name, place in zip(MATRIX, ((0, 0), (1, 1), (0, 2), (1, 2)), strict=True):
        matrix[place] += change.get(name, 0.0)
    distortion = np.zeros(len(DISTORTION))
    distortion[: camera.distortion.size] = camera.distortion
    distortion += [change.get(name, 0.0) for name in DISTORTION]
    step = [change.get(name, 0.0) for name in MOTION]
    place = rigid.moved(camera.camera_from_world, step) if any(step) else camera.camera_from_world
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
