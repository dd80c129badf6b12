"""Frames of a film: held bodies, rendered anew in each, before and above a scene that stands still and is rendered once.

A frame is `held_plain * held_arriving + (1 - cover) * still * arriving`: light that bodies reflect, as far as it arrives on them,
and the still scene's, where bodies don't cover it, as far as they throw no shadow on it. Reflected light is known exactly by each
ray; light that arrives is smooth but for sharp shadows, and few shadow rays know it badly. So it is averaged over the cells about
each, on bodies and on the scene apart, that neither's brightness shows beside the other's outline.

Rays are spent in four passes, each where the one before it found something: cells of 8 px all over; cells of 4 px about bodies
and at the borders of their shadows; without shadow rays, cells of 2 px on bodies; and pixels, at outlines with several rays, and
of the targets' circles as far out as a fit of their rims looks, with most at these, where a pixel's share of ink is the noise.
Rays between are interpolated.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from recon.geometry import rigid
from recon.model.rig import CameraDevice, Target
from twin.shooting import FilmQuality
from twin.tracking.moving_transport import NO_CIRCLE, Lanes, Light, circle_number
from twin.tracking.pixel_selection import lanes_of
from twin.tracking.samples import Held
from twin.tracking.target_truth import ViewTruth

Array = NDArray[np.float64]
Image = NDArray[np.float32]
Mask = NDArray[np.bool_]

FIRST_PX, NEAR_PX, FINE_PX = 8, 4, 2  # cells of the first passes
SHADOWS = 4  # shadow rays of a ray of cells, a power of two
SHOWN = 0.02  # of the target's white, by which neighbours differ that aren't interpolated: as much as noise at 65 DN
SHADE, CONTRAST = 0.03, 0.12  # likewise of cells in shadow, and at outlines
BEYOND = 0.42  # radii beyond a circle's rim: a fit of the rim reaches to 0.37
RIM_PX = 4.0  # on either side of a rim, and half of the motion's blur
LINE_PX = 16.0  # about a thin part
TILE = 4  # cells along each axis, among which the points of one set are dealt out: alike in all tiles, which leaves no noise
ABOUT = np.ones((3, 3), np.uint8)  # a cell and its neighbours


@dataclass(frozen=True)
class Cells:
    """An image in square cells, of which some have a lane in their middle."""

    size: tuple[int, int]  # width, height of the image, px
    cell: int  # px
    samples: int
    chosen: Mask  # (rows, columns)

    @classmethod
    def all_over(cls, size: tuple[int, int], cell: int, samples: int) -> "Cells":
        """Each with a lane."""
        return cls(size, cell, samples, np.ones((-(-size[1] // cell), -(-size[0] // cell)), bool))

    def lanes(self, take: int, camera: int) -> Lanes:
        """Lanes, row by row; of one set for all, or cells of different sizes would differ."""
        row, column = np.nonzero(self.chosen)
        rows, columns = self.chosen.shape
        v, u = (row + 0.5) * self.size[1] / rows - 0.5, (column + 0.5) * self.size[0] / columns - 0.5
        first = ((row % TILE) * TILE + column % TILE) * self.samples
        return lanes_of(take, camera, u, v, self.samples, np.zeros(u.size), first)

    def spread(self, values: NDArray) -> Image:
        """Values of the lanes in their cells : (rows, columns), 0 in others."""
        image = np.zeros(self.chosen.shape, np.float32)
        image[self.chosen] = values
        return image


@dataclass(frozen=True)
class Pixels:
    """Pixels of an image, each with a lane."""

    u: NDArray[np.int64]  # (n,)
    v: NDArray[np.int64]
    samples: NDArray[np.int64]
    circle: NDArray[np.int64]  # `circle_number` of the one that is nearest, or NO_CIRCLE

    def lanes(self, take: int, camera: int) -> Lanes:
        """Lanes in the same order, each of a set by its place."""
        lanes = lanes_of(take, camera, self.u, self.v, 1, 1 + (self.v << 14 | self.u))
        return Lanes(**lanes.__dict__ | {"samples": np.uint32(self.samples), "circle": np.uint32(self.circle)})


@dataclass(frozen=True)
class Arriving:
    """Share of the unshadowed light that arrives : (rows, columns) each, of cells."""

    held: Image  # on bodies
    scene: Image  # of what arrives on the scene without bodies

    @classmethod
    def of(cls, cells: Cells, light: Light, beyond: Image | None = None) -> "Arriving":
        """By the light of cells, averaged over those about each; where none is chosen as an image : (rows, columns) has it."""
        lit, unheld = cells.spread(light.radiance - light.held_radiance), cells.spread(light.unheld_radiance)
        if beyond is not None and light.unheld_radiance.size:
            weight = np.where(cells.chosen, 0, light.unheld_radiance.mean())
            lit, unheld = lit + weight * beyond, unheld + weight
        scene = arriving(lit, unheld, 1.0)
        return cls(arriving(cells.spread(light.held_radiance), cells.spread(light.held_plain), scene), scene)


def near_cells(cells: Cells, light: Light, still: Image, white: float, lines: Sequence[Array], quality: FilmQuality) -> Cells:
    """Cells about the bodies that the first ones met, at the borders of their shadows, and about lines : (n, 2) px.

    still : (h, w) radiance of the scene
    white : radiance of the target's white
    """
    scene = Arriving.of(cells, light).scene
    shaded = contrasts(scene) * resized(still, scene.shape[::-1]) > SHADE * white
    return finer(cells, _about_bodies(cells, light, lines) | shaded, NEAR_PX, quality)


def fine_cells(cells: Cells, light: Light, lines: Sequence[Array], quality: FilmQuality) -> Cells:
    """Cells about the bodies that the near ones met, and about lines."""
    return finer(cells, _about_bodies(cells, light, lines), FINE_PX, quality)


def _about_bodies(cells: Cells, light: Light, lines: Sequence[Array]) -> Mask:
    shown = cv2.dilate(np.uint8(cells.spread(light.held) > 0), ABOUT)
    for line in lines:
        cv2.polylines(shown, [np.rint(line / cells.cell).astype(np.int32)], isClosed=False, color=1, thickness=3)
    return shown > 0


def finer(cells: Cells, shown: Mask, cell: int, quality: FilmQuality) -> Cells:
    """Smaller cells where larger ones are shown : (rows, columns)."""
    whole = Cells.all_over(cells.size, cell, quality.view)
    return replace(whole, chosen=_enlarged(shown, whole.chosen.shape[::-1]))


def _enlarged(mask: Mask, size: tuple[int, int]) -> Mask:
    return cv2.resize(np.uint8(mask), size, interpolation=cv2.INTER_NEAREST) > 0


def sharp_pixels(
    outlines: Mask,
    size: tuple[int, int],
    lines: Sequence[Array],
    truth: Sequence[ViewTruth],
    targets: Sequence[Target],
    quality: FilmQuality,
) -> Pixels:
    """Pixels of outlines, about lines : (n, 2) px, and of the circles as far out as a fit of their rims looks, with more rays at
    outer and inner rims.

    outlines : (rows, columns) of cells
    truth, targets : of each body
    """
    rays = cv2.resize(outlines.astype(np.int32) * quality.outline, size, interpolation=cv2.INTER_NEAREST)
    for line in lines:
        cv2.polylines(rays, [np.rint(line).astype(np.int32)], isClosed=False, color=quality.outline, thickness=round(LINE_PX))
    number, nearest = np.full(rays.shape, NO_CIRCLE, np.int64), np.full(rays.shape, np.inf, np.float32)
    for body, (view, target) in enumerate(zip(truth, targets, strict=True)):
        ratio = target.inner_diameter_mm / target.outer_diameter_mm
        for k, (row, path) in enumerate(zip(view.ellipses, view.blur_px, strict=True)):
            if not np.isfinite(row).all():
                continue
            reach = row[2] * (1 + BEYOND) + path
            low = np.clip(np.floor(row[:2] - reach), 0, size).astype(int)
            high = np.clip(np.ceil(row[:2] + reach) + 1, 0, size).astype(int)
            here = np.s_[low[1] : high[1], low[0] : high[0]]
            radius = _radii(row, *np.mgrid[here][::-1])
            at_rim = np.minimum(np.abs(radius - 1), np.abs(radius - ratio)) * row[3] < RIM_PX + path / 2
            its = ((radius - 1) * row[3] - path / 2 < BEYOND * row[3]) & (radius < nearest[here])
            rays[here][its] = np.where(at_rim, quality.rim, quality.disc)[its]
            number[here][its], nearest[here][its] = circle_number(body, k), radius[its]
    v, u = np.divmod(np.flatnonzero(rays), size[0])
    return Pixels(u, v, rays[v, u], number[v, u])


def scene_pixels(plain: Image, white: float, size: tuple[int, int], quality: FilmQuality) -> Pixels:
    """Pixels in which a scene isn't what cells : (rows, columns) interpolated are, with more rays at outlines."""
    contrast = bends(plain) / white
    rays = np.select([contrast > CONTRAST, contrast > SHOWN], [np.int32(quality.rim), np.int32(quality.view)], np.int32(0))
    rays = cv2.resize(rays, size, interpolation=cv2.INTER_NEAREST)
    v, u = np.divmod(np.flatnonzero(rays), size[0])
    return Pixels(u, v, rays[v, u], np.full(u.size, NO_CIRCLE))


def shares(first: Cells, found: Light, near: Cells, light: Light) -> Arriving:
    """By the near cells, and by the first ones beyond them : (h, w)."""
    beyond = resized(Arriving.of(first, found).scene, near.chosen.shape[::-1])
    fine = Arriving.of(near, light, beyond)
    return Arriving(resized(fine.held, near.size), resized(fine.scene, near.size))


def composed(fine: Cells, light: Light, share: Arriving, sharp: Pixels, its: Light, still: Image) -> Image:
    """The frame : (h, w), from the light of cells and pixels and the scene's.

    share : of (h, w)
    """
    cover = resized(fine.spread(light.held / fine.samples), fine.size)
    plain = resized(fine.spread(light.held_plain), fine.size)
    cover[sharp.v, sharp.u], plain[sharp.v, sharp.u] = its.held / sharp.samples, its.held_plain
    return plain * share.held + (1 - cover) * still * share.scene


def lines_of(bodies: Mapping[str, Held], device: CameraDevice, late: float) -> list[Array]:
    """Thin parts of bodies in the image : (n, 2) px each."""
    camera = device.optics.camera()
    there = [(held.motion.later(late).world_from_target, held.line) for held in bodies.values() if held.present]
    return [camera.project(rigid.apply(pose, line)) for pose, line in there if line is not None]


def most_rays(quality: FilmQuality) -> int:
    """Points of the largest set."""
    return max(TILE**2 * quality.view, quality.disc, quality.rim, quality.outline)


def visible_shares(lanes: Lanes | Pixels, light: Light, count: int) -> Array:
    """Uncovered share of each disc's area within the image : (n,), by `circle_number` up to a number of them."""
    of_one = lanes.circle != NO_CIRCLE
    seen, disc = (np.bincount(lanes.circle[of_one], (part / lanes.samples)[of_one], count) for part in (light.seen, light.disc))
    return seen / np.maximum(disc, 1)


def arriving(radiance: Image, plain: Image, otherwise: Image | float = 0.0) -> Image:
    """Share : (h, w) of the unshadowed radiance that arrives, averaged over the cells about each; another where there is none."""
    arrives, all_of_it = over_a_tile(radiance), over_a_tile(plain)
    return np.float32(np.where(all_of_it > 1e-20, arrives / np.maximum(all_of_it, np.float32(1e-20)), otherwise))


def over_a_tile(image: Image) -> Image:
    """Mean of the cells about each, by a kernel in which each point of the tiles' set counts alike."""
    box = np.full(TILE, 1 / TILE)
    kernel = np.float32(np.convolve(box, box))
    return cv2.sepFilter2D(image, -1, kernel, kernel, borderType=cv2.BORDER_REFLECT)


def contrasts(image: Image) -> Image:
    """Largest value less the smallest of each cell and its neighbours."""
    return cv2.dilate(image, ABOUT) - cv2.erode(image, ABOUT)


def bends(image: Image) -> Image:
    """Second differences of each cell along both axes, the larger one: a step counts whole, a slope not at all."""
    second = np.float32([[1, -2, 1]])
    return np.maximum(*(np.abs(cv2.filter2D(image, -1, kernel)) for kernel in (second, second.T)))


def resized(image: Image, size: tuple[int, int]) -> Image:
    """An image of cells in another number of these."""
    return cv2.resize(image, size, interpolation=cv2.INTER_LINEAR)


def _radii(ellipse: Array, u: NDArray, v: NDArray) -> Array:
    """Distance of pixels from an ellipse's middle, 1 on the ellipse."""
    du, dv = u - ellipse[0], v - ellipse[1]
    cos, sin = np.cos(ellipse[4]), np.sin(ellipse[4])
    return np.hypot((du * cos + dv * sin) / ellipse[2], (dv * cos - du * sin) / ellipse[3])
