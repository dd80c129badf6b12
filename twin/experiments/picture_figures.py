"""Figures of a displayed B-scan by which a rendered one and a recorded one can be compared, whatever they show.

They are of greys, not of echoes: scanners don't tell what they did to these.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import stats
from scipy.ndimage import gaussian_filter
from scipy.spatial.distance import jensenshannon

Array = NDArray[np.float64]

PATCH_MM = 5.0  # of patches in which grains are measured
EVEN_MM = 0.8  # standard deviation of the blur that tells slow unevenness from grains


class PictureFigures(NamedTuple):
    """Figures of one image. Lengths are full widths at half maximum of the grains' autocorrelation."""

    grain_along_mm: float  # along the array, median of patches
    grain_deep_mm: float  # in depth
    grain_growth: float  # along the array, of the deeper half's over the upper half's
    contrast: float  # of grains: standard deviation over mean grey, median of patches
    mean: float  # of greys that aren't black
    skew: float
    decay: float  # mean grey at 70 to 90 % of the depth over that at 10 to 30 %
    uneven: float  # standard deviation of slow greys over their mean
    histogram: Array  # (32,) shares of greys from 0 to 255


def measure(image: NDArray[np.uint8], mm_per_px: tuple[float, float]) -> PictureFigures:
    """Measure an image (h, w) of pixels of a size, x and y, mm."""
    greys = image.astype(float)
    sx, sy = mm_per_px
    slow = gaussian_filter(greys, (EVEN_MM / sy, EVEN_MM / sx), mode="nearest")
    grains = greys - slow
    width, height = int(PATCH_MM / sx), int(PATCH_MM / sy)
    along, deep, contrast, rows = [], [], [], []
    for top in range(0, len(greys) - height + 1, height // 2):
        for left in range(0, greys.shape[1] - width + 1, width // 2):
            window = np.s_[top : top + height, left : left + width]
            mean = slow[window].mean()
            if mean < 15 or mean > 220 or slow[window].std() > 0.35 * mean:
                continue
            sizes = _widths(grains[window])
            along.append(sizes[1] * sx)
            deep.append(sizes[0] * sy)
            contrast.append(grains[window].std() / mean)
            rows.append((top + height / 2) / len(greys))
    upper = np.array(rows) < 0.5
    growth = np.median(np.array(along)[~upper]) / np.median(np.array(along)[upper]) if 0 < upper.sum() < len(rows) else np.nan
    lit = greys[greys > 3]
    profile = greys.mean(axis=1)
    count = len(profile)
    near, far = (profile[int(low * count) : int(high * count)].mean() for low, high in ((0.1, 0.3), (0.7, 0.9)))
    histogram, _ = np.histogram(greys, 32, (0, 256))
    return PictureFigures(
        float(np.median(along)) if along else np.nan,
        float(np.median(deep)) if deep else np.nan,
        float(growth),
        float(np.median(contrast)) if contrast else np.nan,
        float(lit.mean()),
        float(stats.skew(lit)),
        float(far / near),
        float(slow.std() / slow.mean()),
        histogram / histogram.sum(),
    )


def divergence(first: Array, second: Array) -> float:
    """Jensen-Shannon divergence of two histograms, in bits."""
    return float(jensenshannon(first, second, base=2) ** 2)


def _widths(patch: Array) -> tuple[float, float]:
    """Full widths at half maximum of a patch's autocorrelation, px, in depth and along the array."""
    spectrum = np.abs(np.fft.fft2(patch - patch.mean(), [2 * n for n in patch.shape])) ** 2
    found = np.fft.ifft2(spectrum).real
    deep, along = found[: len(patch), 0], found[0, : patch.shape[1]]
    return _half(deep / deep[0]), _half(along / along[0])


def _half(line: Array) -> float:
    below = np.flatnonzero(line < 0.5)
    k = int(below[0]) if len(below) else len(line) - 1
    return 2 * (k - 1 + (line[k - 1] - 0.5) / max(line[k - 1] - line[k], 1e-9))
