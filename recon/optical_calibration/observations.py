"""Observations of a calibration board: each point's place in each device, pose by pose, with its noise.

A projector sees nothing itself. Its coordinate of a point is read from the fringes at the pixel where camera 1 sees the point,
so an error of that pixel moves it along: `d(projector px) = gradient @ d(cam1 px)`. What is kept as the projector's covariance is
the noise of the fringes alone; the two together are independent of each other.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Size = tuple[int, int]  # width, height, px

PROJECTOR = "projector"


@dataclass(frozen=True)
class Observations:
    """Sightings of n points of one board in p poses by d devices; `devices[0]` is the world's, camera 1."""

    poses: tuple[str, ...]  # (p,) names
    devices: tuple[str, ...]  # (d,) cam1, then cam2 and projector as far as there are any
    sizes: tuple[Size, ...]  # (d,) of their images
    points: Array  # (n, 3) mm, the board as designed
    pixels: Array  # (p, n, d, 2) px, NaN where a device doesn't see a point; of discs the centre of the ellipse
    covariance: Array  # (p, n, d, 2, 2) px^2; for the projector that of the fringes alone
    gradient: Array  # (p, n, 2, 2) projector px / cam1 px; zero without a projector

    @property
    def seen(self) -> NDArray[np.bool_]:
        """Whether a device sees a point : (p, n, d)."""
        return np.isfinite(self.pixels).all(axis=-1)

    @property
    def used(self) -> NDArray[np.bool_]:
        """Whether a sighting counts : (p, n, d). The projector's doesn't without camera 1's, at whose point it was read."""
        seen = self.seen
        if PROJECTOR in self.devices[1:]:
            seen[:, :, self.devices.index(PROJECTOR)] &= seen[:, :, 0]
        return seen

    def of_poses(self, chosen: Sequence[int]) -> "Observations":
        """Those of some poses, by number."""
        index = list(chosen)
        names = tuple(self.poses[k] for k in index)
        arrays = (self.pixels[index], self.covariance[index], self.gradient[index])
        return Observations(names, self.devices, self.sizes, self.points, *arrays)

    def of_devices(self, names: Sequence[str]) -> "Observations":
        """Those of some devices, in the order given. Without camera 1 the projector's coordinates count as if measured alone."""
        index = [self.devices.index(name) for name in names]
        covariance, gradient = self.covariance[:, :, index], self.gradient
        if PROJECTOR in names and self.devices[0] not in names:
            carried = gradient @ self.covariance[:, :, 0] @ np.swapaxes(gradient, -1, -2)
            covariance[:, :, list(names).index(PROJECTOR)] += carried
            gradient = np.zeros_like(gradient)
        sizes = tuple(self.sizes[k] for k in index)
        return Observations(self.poses, tuple(names), sizes, self.points, self.pixels[:, :, index], covariance, gradient)
