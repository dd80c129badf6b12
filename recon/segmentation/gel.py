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

SKIN, EMPTY = 0.3, 0.05  # of tissue's power: skin begins with more, gel before it has less on average
MOST_MM = 15.0  # of gel; a column that is dark for longer looks at a shadow, or at nothing
SMOOTH_MM = 0.3  # standard deviation; speckle cells are smaller
CLEAR_MM = 2.0  # behind the skin, whose echo isn't speckle
STEP_MM = 0.5  # of depth and gel, within which pixels are compared
MOST_GAIN = 0.25  # nepers a mm: tissue of 11 dB/cm, there and back


def brightening(images: Callable[[], Iterator[NDArray[np.uint8]]], world_from_pixel: Array, table: Map, top: int) -> Map:
    """Factor by which gel brightens the tissue in each column of n B-scans : (n, w); 1 where no gel reaches below the ringing.

    The gain a mm of gel is fitted to the scans: tissue behind gel is compared with that at the same depth under bare skin. Gel
    that ends within the ringing isn't seen.

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
    scale, posed = pixel_mm(world_from_pixel), np.isfinite(world_from_pixel).all(axis=(1, 2))
    thinned = 4  # pixels, columns and rows, of which one is compared

    def looked_through(image: NDArray[np.uint8]) -> tuple[Map, Array, Array]:
        """Gel before each column, and by depth and gel the sum of the power behind it and the number of pixels."""
        power = table[image]
        gel_mm = _before_skin(power[top:], scale, top * scale[1])
        depth_mm = np.arange(0, len(power), thinned) * scale[1]
        depth, gel = np.meshgrid(depth_mm, gel_mm[::thinned], indexing="ij")
        behind = depth > np.maximum(gel, top * scale[1]) + CLEAR_MM  # nowhere without skin
        size = int(len(power) * scale[1] / STEP_MM) + 1, int(MOST_MM / STEP_MM) + 1
        bins = np.ravel_multi_index(((depth[behind] / STEP_MM).astype(int), (gel[behind] / STEP_MM).astype(int)), size)
        sums = (np.bincount(bins, value, size[0] * size[1]) for value in (power[::thinned, ::thinned][behind], None))
        total, count = (one.reshape(size) for one in sums)
        return gel_mm, total, count

    gels, total, count = list[Map](), np.zeros(1), np.zeros(1)
    for number, (gel_mm, power, pixels) in enumerate(threads.mapped(looked_through, images())):
        gels.append(np.nan_to_num(gel_mm))
        if number < len(posed) and posed[number]:
            total, count = total + power, count + pixels
    if len(gels) != len(posed):
        raise InputError(f"images: expected as many as poses, {len(posed)}, found {len(gels)}")
    return np.exp(_gain(total, count) * np.stack(gels)).astype(np.float32)


def _before_skin(power: Map, scale_mm: tuple[float, float], top_mm: float) -> Map:
    """Millimetres of gel in each column : (w,) of the power : (h, w) below `top_mm`; 0 where skin begins there, NaN without skin.

    What is dark before tissue but isn't empty, such as fat or a mass below the ringing, is no gel: NaN as well.
    """
    smooth = cv2.GaussianBlur(power, (0, 0), SMOOTH_MM / scale_mm[0], sigmaY=SMOOTH_MM / scale_mm[1])
    first, columns = (smooth > SKIN).argmax(axis=0), np.arange(power.shape[1])
    whole = np.maximum(first - round(2 * SMOOTH_MM / scale_mm[1]), 1)  # rows of gel alone
    empty = np.cumsum(smooth, axis=0)[whole - 1, columns] < EMPTY * whole
    gel_mm = np.where(first * scale_mm[1] > SMOOTH_MM, first * scale_mm[1] + top_mm, 0.0)
    there = (smooth.max(axis=0) > SKIN) & (gel_mm < MOST_MM) & (empty | (gel_mm == 0))
    return np.where(there, gel_mm, np.nan).astype(np.float32)


def _gain(total: Array, count: Array) -> float:
    """Nepers by which a mm of gel brightens what lies behind: slope, within a depth, of the log mean power : (depths, gels).

    The median over depths, as a mass behind the gel is at some of them alone; 0 where it isn't sure.
    """
    few, certain = 20, 3.0  # pixels, whose mean is mostly speckle; standard deviations of the slope
    weight = np.where((count > few) & (total > 0), count, 0.0)
    level = np.log(np.where(weight > 0, total / np.maximum(count, 1), 1.0))
    gel_mm = np.arange(count.shape[-1]) * STEP_MM
    away = gel_mm - (weight @ gel_mm / np.maximum(weight.sum(axis=-1), 1.0))[..., None]
    spread = (weight * away**2).sum(axis=-1)
    told = spread > 0.1 * spread.max()
    slopes = (weight * away * level).sum(axis=-1)[told] / spread[told]
    if len(slopes) < 2:
        return 0.0
    gain = float(np.median(slopes))
    sigma = 1.4826 * float(np.median(np.abs(slopes - gain))) * np.sqrt(np.pi / 2 / len(slopes))
    return min(gain, MOST_GAIN) if gain > certain * sigma else 0.0
