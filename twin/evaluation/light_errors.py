"""Lines of light on the skin, as a camera sees them, against the curves that they were to draw.

The middle of a bright line is found where the image's second derivative across it is most negative and its slope is zero
[Steger 1998], to a fraction of a pixel; the true surface on each ray gives its place in space.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, map_coordinates
from scipy.spatial import KDTree

from recon.skin_projection.skin_curve import evenly

Array = NDArray[np.float64]

FAINTEST = 0.3  # of the strongest ridge's sharpness; weaker ones are noise or the skin's own marks
FINE_MM = 0.02  # between points of a true curve, so that the nearest is as near as the curve


@dataclass(frozen=True, eq=False)
class LightErrors:
    """Distances between drawn lines and true curves, mm."""

    from_true: Array  # (n,) of points on the true curves that the camera sees, to the nearest point of light
    from_light: Array  # (m,) of points of light, to the nearest true curve

    @property
    def all(self) -> Array:
        """Both together: what is missing counts, and what is too much."""
        return np.concatenate([self.from_true, self.from_light])


def ridges(image: Array, sigma_px: float) -> Array:
    """Middles of bright lines in an image : (h, w), as points (u, v) : (n, 2) px, one a pixel of each line.

    sigma_px : of the smoothing; a line of a width w shows best with w / sqrt(12) or more
    """
    image = np.asarray(image, float)
    along_v, along_u = (gaussian_filter(image, sigma_px, order=order) for order in ((1, 0), (0, 1)))
    vv, uv, uu = (gaussian_filter(image, sigma_px, order=order) for order in ((2, 0), (1, 1), (0, 2)))
    half_spread = np.hypot((uu - vv) / 2, uv)
    sharpest = (uu + vv) / 2 - half_spread  # the eigenvalue across a bright line
    angle = np.arctan2(uv, (uu - vv) / 2) / 2 + np.pi / 2  # of its eigenvector
    nu, nv = np.cos(angle), np.sin(angle)
    with np.errstate(divide="ignore", invalid="ignore"):
        offset = -(along_u * nu + along_v * nv) / sharpest
    on = (sharpest < -FAINTEST * np.percentile(-sharpest, 99.95)) & (np.abs(offset * nu) <= 0.5) & (np.abs(offset * nv) <= 0.5)
    v, u = np.nonzero(on)
    return np.column_stack([u + (offset * nu)[on], v + (offset * nv)[on]])


def in_space(pixels: Array, points: NDArray[np.float32]) -> Array:
    """Places : (n, 3) mm of pixels (u, v) : (n, 2) on a surface known at each pixel's centre : (h, w, 3) mm; NaN beside it."""
    return np.stack([map_coordinates(axis, pixels.T[::-1], order=1, cval=np.nan) for axis in np.moveaxis(points, -1, 0)], axis=-1)


def compare(light: Array, true: Sequence[Array]) -> LightErrors:
    """Compare points of light : (n, 3) mm with chains of points on true curves : (k, 3) mm each, all within the camera's view."""
    curves = np.concatenate([evenly(chain, FINE_MM) for chain in true])
    lit = light[np.isfinite(light).all(axis=1)]
    return LightErrors(KDTree(lit).query(curves)[0], KDTree(curves).query(lit)[0])
