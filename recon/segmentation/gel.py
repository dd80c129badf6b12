"""Gel between the face and the skin, and how much it brightens what lies behind.

Gel absorbs next to nothing, but the scanner's gain grows with depth as tissue asks for. So tissue behind gel, beside a nipple or
where the skin curves away from the array, is brighter than the same tissue at the same depth under bare skin.
"""

from collections.abc import Callable, Iterator

import cv2
import numpy as np
from numpy.typing import NDArray

from recon import threads
from recon.errors import InputError
from recon.segmentation.echo_power import pixel_mm

Array = NDArray[np.float64]
Map = NDArray[np.float32]

DARK = 0.3  # of tissue's power: gel has no echoes
MOST_MM = 15.0  # of gel; a column that is dark for longer looks at a shadow, or at nothing
SMOOTH_MM = 0.3  # standard deviation; speckle cells are smaller
CLEAR_MM = 2.0  # behind the skin, whose echo isn't speckle
STEP_MM = 0.5  # of depth and gel, within which pixels are compared
MOST_GAIN = 0.25  # nepers a mm: tissue of 11 dB/cm, there and back


def brightening(
    images: Callable[[], Iterator[NDArray[np.uint8]]], world_from_pixel: Array, table: Map, top: int
) -> NDArray[np.float32]:
    """Factor by which gel brightens the tissue in each column of n B-scans : (n, w); 1 where the skin begins at the face.

    The gain a mm of gel is fitted to the scans: tissue behind gel is compared with that at the same depth under bare skin.

    Parameters
    ----------
    images : streams the n B-scans (h, w), from the first at each call
    world_from_pixel : (n, 4, 4), NaN where there is no pose
    table : (256,) power of each grey level, of tissue 1
    top : first row below the ringing at the face

    Raises
    ------
    InputError
        If there are more or fewer images than poses.
    """
    scale = pixel_mm(world_from_pixel)
    thinned = 4  # pixels, columns and rows, of which one is compared

    def looked_through(image: NDArray[np.uint8]) -> tuple[Map, Array, Array]:
        """Gel before each column, and by depth and gel the sum of the power behind it and the number of pixels."""
        power = table[image]
        gel_mm = _before_skin(power[top:], scale, top * scale[1])
        depth_mm = np.arange(0, len(power), thinned) * scale[1]
        depth, gel = np.meshgrid(depth_mm, gel_mm[::thinned], indexing="ij")
        behind = (depth > np.maximum(gel, top * scale[1]) + CLEAR_MM) & (gel < MOST_MM)
        size = int(len(power) * scale[1] / STEP_MM) + 1, int(MOST_MM / STEP_MM) + 1
        bins = np.ravel_multi_index(((depth[behind] / STEP_MM).astype(int), (gel[behind] / STEP_MM).astype(int)), size)
        sums = (np.bincount(bins, value, size[0] * size[1]) for value in (power[::thinned, ::thinned][behind], None))
        total, count = (one.reshape(size) for one in sums)
        return gel_mm, total, count

    several = list(threads.mapped(looked_through, images()))
    posed = np.isfinite(world_from_pixel).all(axis=(1, 2))
    if len(several) != len(posed):
        raise InputError(f"images: expected as many as poses, {len(posed)}, found {len(several)}")
    total, count = (sum(one[k] for one, there in zip(several, posed, strict=True) if there) for k in (1, 2))
    return np.exp(_gain(total, count) * np.stack([one[0] for one in several])).astype(np.float32)


def _before_skin(power: Map, scale_mm: tuple[float, float], top_mm: float) -> Map:
    """Millimetres of gel in each column : (w,) of the power : (h, w) below `top_mm`; 0 where tissue begins there, or nowhere."""
    smooth = cv2.GaussianBlur(power, (0, 0), SMOOTH_MM / scale_mm[0], sigmaY=SMOOTH_MM / scale_mm[1])
    dark_mm = (smooth > DARK).argmax(axis=0).astype(np.float32) * np.float32(scale_mm[1])
    return np.where((dark_mm > SMOOTH_MM) & (dark_mm + top_mm < MOST_MM), dark_mm + np.float32(top_mm), np.float32(0))


def _gain(total: Array, count: Array) -> float:
    """Nepers by which a mm of gel brightens what lies behind: slope, within a depth, of the log mean power : (depths, gels)."""
    few = 20  # pixels, whose mean is mostly speckle
    weight = np.where((count > few) & (total > 0), count, 0.0)
    level = np.log(np.where(weight > 0, total / np.maximum(count, 1), 1.0))
    gel_mm = np.arange(count.shape[1]) * STEP_MM
    away = gel_mm - (weight @ gel_mm / np.maximum(weight.sum(axis=1), 1.0))[:, None]
    spread = (weight * away**2).sum()
    return float(np.clip((weight * away * level).sum() / spread, 0.0, MOST_GAIN)) if spread > 0 else 0.0
