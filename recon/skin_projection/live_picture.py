"""The projector's image of curves on a skin that moves, drawn anew for each place of it in some ms.

As `projector_image.draw`, whose strips and light it has, but what doesn't change is made once: strips lie on the skin in its own
frame, and it is the projector that moves about it. Occlusion is looked for on a coarse skin, and a pixel's share of a strip comes
from its distance to the strip's middle.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import trimesh
from numpy.typing import NDArray

from recon.compiled import kernel, njit
from recon.fusion import fused_scene
from recon.geometry import rigid
from recon.geometry.camera import Camera
from recon.skin_projection import projector_image, skin_curve
from recon.skin_projection.projector_image import Line
from recon.skin_projection.skin_curve import SkinCurve

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

COARSE_MM = 2.0  # to which vertices are merged, to look for what hides what: a chord leaves a sphere of 60 mm by 0.01 mm
LONGEST_MM = 3.0  # of a piece of a curve: a longer one leads through the air, past the skin's border or a fold


@dataclass(frozen=True, eq=False)
class Strips:
    """Strips of light on a skin, in its frame: pieces from each point to the next one, where these belong together."""

    middle: Array  # (n, 3) mm
    aside: Array  # (n, 3) mm, from the middle to an edge
    light: NDArray[np.uint8]  # (n,) of the piece from this point to the next, of 255; 0 where there is none

    @classmethod
    def of(cls, curve: SkinCurve, line: Line) -> "Strips":
        """A curve as a line of a look."""
        left, _ = skin_curve.edges(curve, line.width_mm)
        steps = np.linalg.norm(np.diff(curve.points, axis=0), axis=1)
        drawn = skin_curve.dashed(curve, line.dash_mm) & (steps < LONGEST_MM)
        known = np.isfinite(left).all(axis=1)
        light = np.uint8(round(255 * line.light)) * (drawn & known[:-1] & known[1:])
        middle, aside = curve.points, left - curve.points
        if len(middle) > 2 and np.array_equal(middle[0], middle[-1]):  # its last piece has a neighbour, too
            middle, aside, light = (
                np.concatenate([each, each[first : first + 1]]) for each, first in ((middle, 1), (aside, 1), (light, 0))
            )
        return cls(middle, aside, np.append(light, np.uint8(0)))

    @classmethod
    def joined(cls, strips: Sequence["Strips"]) -> "Strips":
        """Several as one."""
        empty = cls(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0, np.uint8))
        parts = [(each.middle, each.aside, each.light) for each in (empty, *strips)]
        return cls(*(np.concatenate(arrays) for arrays in zip(*parts, strict=True)))


class LivePicture:
    """Draws strips on a skin for a projector, wherever the skin is."""

    def __init__(self, skin: trimesh.Trimesh, projector: Camera, gamma: float = 1.0) -> None:
        """Take a skin in its own frame, the projector in the world, and its gamma: light = value ** gamma."""
        self._coarse = fused_scene.merged(skin, COARSE_MM)
        self._projector = projector
        self._values = np.uint8(np.rint(255 * (np.arange(256) / 255) ** (1 / gamma)))  # by light

    @property
    def dark(self) -> Image:
        """An image : (h, w) without light."""
        return np.zeros(self._projector.size[::-1], np.uint8)

    def draw(self, strips: Strips, world_from_skin: Array) -> Image:
        """The projector's image : (h, w) that lights strips of the skin where that is now."""
        image = self.dark
        if not strips.light.any():
            return image
        device = seen_from_skin(self._projector, world_from_skin)
        lit = projector_image.visible(strips.middle, self._coarse, device)
        light = np.where(lit & np.append(lit[1:], False), strips.light, np.uint8(0))
        middle, edge = device.project(strips.middle), device.project(strips.middle + strips.aside)
        _fill_strips(middle, edge - middle, light, image)
        return self._values[image]


def seen_from_skin(device: Camera, world_from_skin: Array) -> Camera:
    """A device as it stands to a skin : in the frame of that."""
    return replace(device, camera_from_world=device.camera_from_world @ rigid.nearest(world_from_skin))


@kernel
def _fill_strips(middle, aside, light, image):
    """Light each piece by the distance of pixels from its middle; the brightest stays.

    A pixel's share of a strip is that of a half-plane whose border runs through the pixel along an axis; of a thinner strip it is
    the strip's width. Pieces end along their edges' connections, a pixel later where another one follows.
    """
    height, width = image.shape
    for k in range(len(light) - 1):
        u, v = middle[k, 0], middle[k, 1]
        across, down = middle[k + 1, 0] - u, middle[k + 1, 1] - v
        length = np.sqrt(across * across + down * down)
        if light[k] == 0 or not length > 0:
            continue
        across, down = across / length, down / length
        begin, end = abs(aside[k, 0] * down - aside[k, 1] * across), abs(aside[k + 1, 0] * down - aside[k + 1, 1] * across)
        if not begin + end + length < width + height:
            continue
        backwards = _across(aside[k], -across, -down)
        forwards = _across(aside[k + 1], across, down)
        first = 0.5 if k == 0 or light[k - 1] == 0 else 1.0
        last = 0.5 if light[k + 1] == 0 else 1.0
        reach = max(begin, end) + 1
        left, right = min(u, u + length * across) - reach, max(u, u + length * across) + reach
        top, bottom = min(v, v + length * down) - reach, max(v, v + length * down) + reach
        for row in range(max(0, int(top)), min(height - 1, int(bottom) + 1) + 1):
            for column in range(max(0, int(left)), min(width - 1, int(right) + 1) + 1):
                x, y = column - u, row - v
                before = x * backwards[0] + y * backwards[1]
                after = (x - length * across) * forwards[0] + (y - length * down) * forwards[1]
                half = begin + min(1.0, max(0.0, (x * across + y * down) / length)) * (end - begin)
                along = min(1.0, min(first - before, last - after))
                share = min(1.0, min(half + 0.5 - abs(x * down - y * across), 2 * half))
                if along > 0 and share > 0:
                    image[row, column] = max(image[row, column], int(light[k] * along * share + 0.5))


@njit(inline="always")
def _across(aside, across, down):
    """The unit vector across an end's edge, on the side of a direction."""
    x, y = -aside[1], aside[0]
    size = np.sqrt(x * x + y * y)
    if x * across + y * down < 0:
        size = -size
    return x / size, y / size
