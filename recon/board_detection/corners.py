"""Sub-pixel corners of chessboards: where four squares meet, from the raw pixels about it.

The pixels are modelled as the product of two blurred steps across the two edges that cross there, each of its own direction, on
a brightness and a contrast that may slope. The model looks the same after half a turn about the corner, so what it leaves out
(the blur of edges that don't cross at right angles, a blur that isn't Gaussian) does so too and doesn't move the corner.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

Array = NDArray[np.float64]

STEPS = 8  # of Gauss and Newton
ROUNDING = 1 / 12  # DN^2, the variance of whole numbers
LEAST_BLUR = 0.25  # px
COLUMNS = 11  # corner, two angles, blur, planes of brightness and contrast


@dataclass(frozen=True)
class Corners:
    """n corners, measured."""

    pixels: Array  # (n, 2) px
    covariance: Array  # (n, 2, 2) px^2
    contrast: Array  # (n,) DN between the squares; positive where the quadrant between the two directions is the brighter one
    blur: Array  # (n,) px, standard deviation
    noise: Array  # (n,) DN
    shift: Array  # (n,) px from the rough corner
    clipped: Array  # (n,) share of pixels that are as bright as the image can be


def refine_corners(image: Array, rough: Array, directions: Array, radius: float, full: float = 255) -> Corners:
    """Fit the saddle at each corner.

    Parameters
    ----------
    image : (h, w) DN
        Any depth.
    rough : (n, 2) px
        To a pixel or two.
    directions : (n, 2, 2)
        Of the two edges that cross, one a row, to 10 deg or so.
    radius : float, px
        Of the window about each corner; nothing but the four squares should lie in it.
    full : float
        Largest value that the image can have.
    """
    values, offsets, weights = _windows(image, rough, radius)
    angles = np.arctan2(directions[..., 1], directions[..., 0])
    normals = angles + np.array([np.pi / 2, -np.pi / 2])  # towards the other direction
    turned = np.sign(directions[:, 0, 0] * directions[:, 1, 1] - directions[:, 0, 1] * directions[:, 1, 0])
    state = np.zeros((len(rough), COLUMNS))
    state[:, :2] = rough - np.rint(rough)
    state[:, 2:4] = angles + turned[:, None] * (normals - angles)
    state[:, 4] = 1.0
    _, design = _saddle(state, offsets, radius)
    state[:, 5:] = _least_squares(design[..., 5:], values, weights)[0]
    for _ in range(STEPS):
        model, design = _saddle(state, offsets, radius)
        change, _ = _least_squares(design, values - model, weights)
        limit = np.array([radius / 4, radius / 4, 0.2, 0.2, 0.5])
        change[:, :5] = np.clip(change[:, :5], -limit, limit)
        state += change
        state[:, 4] = np.clip(state[:, 4], LEAST_BLUR, radius)
    model, design = _saddle(state, offsets, radius)
    _, inverse = _least_squares(design, values - model, weights)
    freedom = np.maximum(weights.sum(axis=1) - COLUMNS, 1)
    variance = np.maximum((weights * (values - model) ** 2).sum(axis=1) / freedom, ROUNDING)
    pixels = np.rint(rough) + state[:, :2]
    return Corners(
        pixels=pixels,
        covariance=inverse[:, :2, :2] * variance[:, None, None],
        contrast=2 * state[:, 8],
        blur=state[:, 4],
        noise=np.sqrt(variance),
        shift=np.hypot(*(pixels - rough).T),
        clipped=(weights * (values >= full)).sum(axis=1) / np.maximum(weights.sum(axis=1), 1),
    )


def _windows(image: Array, rough: Array, radius: float) -> tuple[Array, Array, Array]:
    """Values : (n, p), offsets : (p, 2) from the rounded corners, and weights : (n, p), zero outside the image."""
    half = int(np.ceil(radius))
    v, u = np.mgrid[-half : half + 1, -half : half + 1]
    inside = np.hypot(u, v) <= radius
    offsets = np.column_stack([u[inside], v[inside]])
    at = np.rint(rough).astype(int)[:, None] + offsets
    size = np.array(image.shape[::-1])
    weights = ((at >= 0) & (at < size)).all(axis=-1).astype(float)
    at = np.clip(at, 0, size - 1)
    return image[at[..., 1], at[..., 0]].astype(float), offsets.astype(float), weights


def _saddle(state: Array, offsets: Array, radius: float) -> tuple[Array, Array]:
    """The model : (n, p), and its slopes : (n, p, 11)."""
    away = offsets[None] - state[:, None, :2]
    normal = np.stack([np.cos(state[:, 2:4]), np.sin(state[:, 2:4])], axis=-1)  # (n, 2 edges, 2)
    across = np.einsum("npk,nek->enp", away, normal)
    along = np.einsum("npk,nek->enp", away, np.stack([-normal[..., 1], normal[..., 0]], axis=-1))
    blur = state[:, 4][:, None]
    step = 2 * ndtr(across / blur) - 1
    peak = 2 * np.exp(-0.5 * (across / blur) ** 2) / np.sqrt(2 * np.pi) / blur
    plane = np.concatenate([np.ones((len(offsets), 1)), offsets / radius], axis=1)
    brightness, contrast = state[:, 5:8] @ plane.T, state[:, 8:] @ plane.T
    tilt = contrast * np.stack([peak[0] * step[1], peak[1] * step[0]])  # slope by each distance
    corner = -np.einsum("enp,nek->npk", tilt, normal)
    by_blur = -(tilt * across).sum(axis=0) / blur
    linear = np.broadcast_to(plane, (*contrast.shape, 3))
    design = np.concatenate(
        [corner, np.moveaxis(tilt * along, 0, -1), by_blur[..., None], linear, linear * (step[0] * step[1])[..., None]], axis=-1
    )
    return brightness + contrast * step[0] * step[1], design


def _least_squares(design: Array, values: Array, weights: Array) -> tuple[Array, Array]:
    weighted = design * weights[..., None]
    normal = np.swapaxes(weighted, 1, 2) @ design
    ridge = 1e-9 * np.trace(normal, axis1=1, axis2=2)[:, None, None] + 1e-12
    inverse = np.linalg.inv(normal + ridge * np.eye(design.shape[-1]))
    return (inverse @ np.einsum("npk,np->nk", weighted, values)[..., None])[..., 0], inverse
