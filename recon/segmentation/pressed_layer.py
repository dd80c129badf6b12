"""Displacement of soft tissue under a probe's foot: a layer of one stiffness, which keeps its volume, on a base that holds it.

A load moves the points of a half-space by Love's closed form of a rectangle under even pressure, at Poisson's ratio 1/2: with the
potential V of the rectangle, the integral of 1/R over it,

    u_z = p (V - z dV/dz) / (4 pi mu),    u_x = -p z dV/dx / (4 pi mu).

Where a base holds the layer at a depth h, each wavenumber k of the load moves it by `w(k z)`, not by `(1 + k z) exp(-k z)`; the
difference dies away at wavelengths below the layer's height, so its Hankel transform is a short sum. The pressure follows from
the depth of a foot within the resting skin: it only pushes, which is a non-negative least-squares problem. The stiffness cancels.
Sources: Love 1929, Phil. Trans. R. Soc. A 228, 377; Johnson 1985, Contact Mechanics, 3.1 and 3.3.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular
from scipy.optimize import nnls
from scipy.special import j0, j1

Array = NDArray[np.float64]

WAVES, SHORTEST = 48, 14.0  # of the difference by the base: wavenumbers, and the greatest, over the layer's height


class Patches(NamedTuple):
    """m equal rectangles on the skin, each under even pressure."""

    x: Array  # (m,) mm, of their middles, along the array
    y: Array  # (m,) mm, across it
    half_mm: tuple[float, float]  # of their sides

    @property
    def area(self) -> float:
        """Of each, mm^2."""
        return 4 * self.half_mm[0] * self.half_mm[1]


class Response(NamedTuple):
    """Displacements of points at depths z below places x along the array, y = 0, by each patch: (nx, nz, m), of one scale."""

    down: Array
    along: Array  # the array


def respond(patches: Patches, x: Array, z: Array, base_mm: float) -> Response:
    """Displacements of a layer that is held at a depth; none below it."""
    depth = np.minimum(z, base_mm)
    off = patches.x - x[:, None, None], np.broadcast_to(patches.y, (len(x), 1, len(patches.y)))
    value, slope_x, slope_z = _potential(-off[0], -off[1], depth[:, None], patches.half_mm)
    waves, weights = _waves(base_mm)
    held_down, held_aside = _held(waves[:, None], depth, base_mm)
    radius = np.hypot(*off)[:, 0]
    down = np.einsum("xmk,kz->xzm", j0(radius[..., None] * waves) * weights, held_down)
    outwards = np.einsum("xmk,kz->xzm", j1(radius[..., None] * waves) * weights, held_aside)
    share = np.divide(-off[0][:, 0], radius, out=np.zeros_like(radius), where=radius > 0)[:, None]
    found = Response(value - depth[:, None] * slope_z + patches.area * down, patches.area * share * outwards)
    return found._replace(along=found.along - depth[:, None] * slope_x)


def compliance(patches: Patches, base_mm: float) -> Array:
    """Displacement of the skin at the middle of each patch by each other : (m, m), of the scale of `respond`."""
    x, y = patches.x[:, None] - patches.x, patches.y[:, None] - patches.y
    value, _, _ = _potential(x, y, np.zeros(1), patches.half_mm)
    waves, weights = _waves(base_mm)
    held, _ = _held(waves, np.zeros(1), base_mm)
    return value + patches.area * j0(np.hypot(x, y)[..., None] * waves) @ (weights * held)


def pressures(skin: Array, depths: Array) -> Array:
    """Pressures : (m,) under a foot at depths : (m,) mm within the resting skin, negative above it.

    With the compliance C : (m, m), `p >= 0, C p - d >= 0, p (C p - d) = 0` (Signorini), where p'Cp/2 - p'd is least.
    """
    root = np.linalg.cholesky(skin)
    return nnls(root.T, solve_triangular(root, depths, lower=True))[0]


def _potential(x: Array, y: Array, z: Array, half_mm: tuple[float, float]) -> tuple[Array, Array, Array]:
    """Integral of 1/R over a rectangle about the origin, and its slopes along x and z, at points beside and below it."""
    value = slope_x = slope_z = np.zeros(1)
    least = 1e-12  # mm, of a logarithm on a side's line, where its factor vanishes
    for sign_x, sign_y in ((1, 1), (1, -1), (-1, 1), (-1, -1)):
        across, along, sign = x + sign_x * half_mm[0], y + sign_y * half_mm[1], sign_x * sign_y
        radius = np.sqrt(across**2 + along**2 + z**2)
        log_x, log_y = (np.log(np.maximum(radius + one, least)) for one in (across, along))
        angle = np.arctan2(across * along, z * radius)
        value = value + sign * (across * log_y + along * log_x - z * angle)
        slope_x, slope_z = slope_x + sign * log_y, slope_z - sign * angle
    return value, slope_x, slope_z


def _waves(base_mm: float) -> tuple[Array, Array]:
    """Gauss's wavenumbers : (k,) per mm, and their weights."""
    places, weights = np.polynomial.legendre.leggauss(WAVES)
    half = SHORTEST / base_mm / 2
    return half * (places + 1), half * weights


def _held(k: Array, z: Array, base_mm: float) -> tuple[Array, Array]:
    """Displacements down and outwards by a wave of pressure, less those of a half-space, over that of the half-space's skin.

    With s = k z: `w = (A + B s) cosh s + (C + D s) sinh s`, outwards `-dw/ds` for constant volume; no shear on the skin, the same
    pressure as on the half-space, and w = dw/ds = 0 on the base.
    """
    h, s = k * base_mm, k * z
    sinh, cosh = np.sinh(h), np.cosh(h)
    a = (sinh * cosh - h) / (cosh**2 + h**2)
    b = (1 + a * h) * cosh / (h * sinh + cosh)
    c, d = -1.0, -a
    down = (a + b * s) * np.cosh(s) + (c + d * s) * np.sinh(s)
    outwards = -(a + b * s + d) * np.sinh(s) - (b + c + d * s) * np.cosh(s)
    return down - (1 + s) * np.exp(-s), outwards - s * np.exp(-s)
