"""What is left of a surface in small patches without its shape, beside the noise that is predicted for it: no truth is needed."""

import numpy as np
from numpy.typing import NDArray

Map = NDArray[np.float32]  # (h, w)

WINDOW = 9  # px; patches in which noise is told from shape by a quadratic fit
DOWN, ACROSS = np.mgrid[:WINDOW, :WINDOW] - WINDOW // 2
DESIGN = np.stack([ACROSS**0, ACROSS, DOWN, ACROSS**2, ACROSS * DOWN, DOWN**2], axis=-1).reshape(-1, 6).astype(float)


def smooth_noise_ratio(distance: Map, sigma: Map, smoothest: float = 0.25) -> float:
    """Noise of neighbouring points over their predicted sigma, the median over smooth patches; NaN without any.

    In each WINDOW x WINDOW patch without gaps a quadratic takes the shape away; what is left, for the degrees of freedom that
    are left, is noise. Smooth are the patches where the quadratic's curvature is among the `smoothest` share: chosen by shape,
    not by residual.
    """
    patches = patches_of(distance), patches_of(sigma)
    whole = np.isfinite(patches[0]).all(axis=1) & np.isfinite(patches[1]).all(axis=1)
    heights, sigmas = (patch[whole].astype(float) for patch in patches)
    if not len(heights):
        return np.nan
    shape, left = _fitted(heights)
    noise = np.sqrt((left**2).sum(axis=1) / (len(DESIGN) - DESIGN.shape[1]))
    curvature = np.abs(shape[3:]).sum(axis=0)
    smooth = curvature <= np.quantile(curvature, smoothest)
    return float(np.median(noise[smooth] / np.sqrt((sigmas[smooth] ** 2).mean(axis=1))))


def residuals(distance: Map) -> Map:
    """Distances : (h, w) less a quadratic in each patch; NaN in patches with gaps and at the right and below."""
    patches = patches_of(distance)
    whole = np.isfinite(patches).all(axis=1)
    left = np.full(patches.shape, np.float32(np.nan))
    left[whole] = _fitted(patches[whole].astype(float))[1]
    down, across = (length // WINDOW for length in distance.shape)
    found = np.full(distance.shape, np.float32(np.nan))
    blocks = left.reshape(down, across, WINDOW, WINDOW).transpose(0, 2, 1, 3)
    found[: down * WINDOW, : across * WINDOW] = blocks.reshape(down * WINDOW, across * WINDOW)
    return found


def patches_of(image: Map) -> Map:
    """Patches side by side : (n, WINDOW * WINDOW)."""
    height, width = (length // WINDOW * WINDOW for length in image.shape)
    blocks = image[:height, :width].reshape(height // WINDOW, WINDOW, width // WINDOW, WINDOW)
    return blocks.transpose(0, 2, 1, 3).reshape(-1, WINDOW * WINDOW)


def _fitted(heights: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Coefficients : (6, n) of quadratics through patches : (n, WINDOW^2), and what they leave."""
    shape = np.linalg.lstsq(DESIGN, heights.T, rcond=None)[0]
    return shape, heights - shape.T @ DESIGN.T
