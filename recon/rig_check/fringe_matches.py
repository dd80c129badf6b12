"""Points of a smooth surface that both cameras see under the same fringes: the projector's coordinates there, and how they
change.

A point of camera 1 is put in space by the fringes; there camera 2 must see the same fringe. Maps are read by quadrics through
small windows, so that a pixel's noise, and a surface's grain, count little. A plane would lie beside a curved surface, and not as
far beside it in the other camera.
"""

from collections.abc import Mapping

import cv2
import numpy as np
from numpy.typing import NDArray

from recon.errors import InputError
from recon.geometry.camera import Camera
from recon.rig_check.optics_equations import CAMERAS, PROJECTOR, Matches, points_by_light
from recon.structured_light.decode import ProjectorMap

Array = NDArray[np.float64]

MOST = 4000  # points: fewer hardly show a shift of the projector, whose parallax lies below a point's noise
LEAST = 30
HALF = 3  # px of a window, to each side of its middle
CANDIDATES = 5  # windows tried, for one that is used
FLAT_PX = 0.5  # projector px from a window's quadric: beyond, an edge runs through it
FLOOR_PX = 0.003  # projector px: errors of a map that a window's pixels share, on rendered skin; a sensor's noise isn't shared


def _quadric(x: Array, y: Array) -> Array:
    """Terms : (m, 6) of a quadratic surface at places : (m,) each."""
    return np.column_stack([np.ones_like(x), x, y, x * x, x * y, y * y])


ACROSS, DOWN = (steps.ravel() for steps in np.meshgrid(*2 * (np.arange(-HALF, HALF + 1),)))  # px, of a window's pixels
QUADRIC = _quadric(ACROSS, DOWN).astype(float)
FIT = np.linalg.pinv(QUADRIC)
WINDOW_NOISE = float(np.linalg.norm(FIT[0]))  # of a window's middle, for 1 of each pixel


def match(maps: tuple[ProjectorMap, ProjectorMap], cameras: Mapping[str, Camera], rng: np.random.Generator, name: str) -> Matches:
    """Choose points, at random over all that both cameras see.

    Parameters
    ----------
    maps : of cameras 1 and 2.

    Raises
    ------
    InputError
        If the maps have no axis in common, or fewer than 30 points are seen by both.
    """
    layers = [[(one.columns, one.sigma_columns), (one.rows, one.sigma_rows)] for one in maps]
    axes = tuple(k for k in (0, 1) if all(camera[k][0] is not None for camera in layers))
    if not axes:
        raise InputError(f"{name}: expected both cameras' images of one sequence, found no axis of the projector in both")
    values, sigmas = ([[camera[k][part] for k in axes] for camera in layers] for part in (0, 1))
    pixels = rng.permutation(_raster(np.isfinite(values[0]).all(axis=0)))[: CANDIDATES * MOST].astype(float)
    first, _, _, first_sigma = _read(values[0], sigmas[0], pixels)
    good = np.isfinite(first).all(axis=1)
    pixels, first, first_sigma = pixels[good], first[good], first_sigma[good]
    seen_at = cameras["cam2"].project(points_by_light(pixels, first, axes, cameras))
    second, gradient, bend, second_sigma = _read(values[1], sigmas[1], seen_at)
    both = np.flatnonzero(np.isfinite(second).all(axis=1))[:MOST]
    if len(both) < LEAST:
        expected = f"expected {LEAST} points that both cameras see under the {PROJECTOR}'s fringes, found {len(both)}"
        cause = f"a smooth thing, of 50 x 50 px or more, in both views, or {' and '.join(CAMERAS)} under other names?"
        raise InputError(f"{name}: {expected}: {cause}")
    sigma = np.stack([first_sigma, second_sigma], axis=1)
    return Matches(pixels, first, seen_at, second, gradient, bend, sigma, axes).some(both)


def _raster(seen: NDArray[np.bool_]) -> NDArray[np.intp]:
    """Middles : (m, 2) px of windows that share no pixel and lie in a mask : (h, w), on the raster that holds most of them."""
    side = 2 * HALF + 1
    whole = cv2.erode(seen.astype(np.uint8), np.ones((side, side), np.uint8), borderType=cv2.BORDER_CONSTANT, borderValue=0)
    down, across = max(np.ndindex(side, side), key=lambda start: np.count_nonzero(whole[start[0] :: side, start[1] :: side]))
    return side * np.argwhere(whole[down::side, across::side])[:, ::-1] + [across, down]


def _read(layers: list[NDArray], sigmas: list[NDArray | None], places: Array) -> tuple[Array, Array, Array, Array]:
    """Values : (m, k), gradients : (m, k, 2), second derivatives : (m, k, 2, 2), and sigmas : (m, k) of the values.

    Of k layers, at places : (m, 2) px; values are NaN where an edge is near.
    """
    height, width = layers[0].shape
    with np.errstate(invalid="ignore"):
        inside = ((places >= HALF) & (places <= np.array([width, height]) - 1 - HALF)).all(axis=1)
    middle = np.where(inside[:, None], np.rint(places), HALF).astype(int)
    columns, rows = middle[:, :1] + ACROSS, middle[:, 1:] + DOWN
    aside = places - middle
    values, gradients, bends, noises = [], [], [], []
    for layer, sigma in zip(layers, sigmas, strict=True):
        window = layer[rows, columns].astype(float)
        found = window @ FIT.T
        left = window - found @ QUADRIC.T
        with np.errstate(invalid="ignore"):
            flat = inside & (np.abs(left).max(axis=1) < FLAT_PX)
        bend = found[:, [[3, 4], [4, 5]]] * [[2, 1], [1, 2]]
        claimed = (
            np.sqrt(np.sum(left**2, axis=1) / (len(QUADRIC) - len(FIT))) if sigma is None else sigma[rows, columns].mean(axis=1)
        )
        values.append(np.where(flat, np.einsum("mi,mi->m", found, _quadric(*aside.T)), np.nan))
        gradients.append(found[:, 1:3] + np.einsum("mij,mj->mi", bend, aside))
        bends.append(bend)
        noises.append(np.hypot(FLOOR_PX, claimed * WINDOW_NOISE))
    return np.stack(values, axis=1), np.stack(gradients, axis=1), np.stack(bends, axis=1), np.stack(noises, axis=1)
