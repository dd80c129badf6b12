"""Light of a projector that shows an image which varies along both axes, such as curves drawn on the skin.

The image's light is kept on a grid finer than its pixels, behind the lens's point spread, and read with linear interpolation.
"""

from dataclasses import dataclass
from functools import cached_property

import cv2
import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from recon.model.rig import ProjectorDevice
from twin.optics.raster import within

FINE = 4  # table entries a projector px along each axis
MARGIN = 2  # projector px of the table beyond the raster


@dataclass(frozen=True, eq=False)
class ImageLight:
    """Light of one image, 1 for a pixel that is fully on."""

    values: NDArray[np.float32]  # (h, w)
    blur_px: float  # standard deviation of the lens's point spread in focus

    @classmethod
    def of(cls, image: NDArray[np.uint8], device: ProjectorDevice) -> "ImageLight":
        """An image : (h, w) as a rig's projector shows it: grey values pass gamma, and black is 1/contrast."""
        black = 1 / device.contrast
        return cls(np.float32(black + (1 - black) * (image / 255) ** device.gamma), device.lens.blur_px)

    @property
    def count(self) -> int:
        """Images: one."""
        return 1

    @cached_property
    def table(self) -> "ImageTable":
        """The image's light at any projector coordinates."""
        mirrors = np.repeat(np.repeat(np.pad(self.values, MARGIN), FINE, axis=0), FINE, axis=1)
        fine = cv2.GaussianBlur(mirrors, (0, 0), self.blur_px * FINE) if self.blur_px else mirrors
        return ImageTable((self.values.shape[1], self.values.shape[0]), mi.Float(np.ascontiguousarray(fine).ravel()))


@dataclass(frozen=True)
class ImageTable:
    """Light of an image at any projector coordinates, as `raster.LightTable` has that of patterns."""

    size: tuple[int, int]  # width, height, px
    values: mi.Float  # rows one after the other
    count: int = 1  # images

    def lookup(self, pixel: mi.Point2f, active: mi.Bool) -> list[mi.Float]:
        """Light at projector coordinates in px; none outside the raster."""
        active &= within(self.size, pixel)
        width = (self.size[0] + 2 * MARGIN) * FINE
        place = (pixel + 0.5 + MARGIN) * FINE - 0.5
        below = dr.floor(place)
        fraction = place - below
        first = mi.UInt32(below.y) * width + mi.UInt32(below.x)
        corners = [dr.gather(mi.Float, self.values, first + step, active) for step in (0, 1, width, width + 1)]
        return [dr.lerp(dr.lerp(*corners[:2], fraction.x), dr.lerp(*corners[2:], fraction.x), fraction.y)]
