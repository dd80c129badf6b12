"""A frame of a film, rendered where it matters: one ray in many pixels at large, more about the target, most at its rims.

Three layers lie on each other: cells of 4 px all over, cells of 2 px about the target's board, and every pixel of the board's
edges and of the circles as far out as a fit of their rims looks; the last with more rays at the rims, where a pixel's share of
ink is the noise. Rays between are interpolated.

How much of the unshadowed light arrives is smooth but for sharp shadows, and it is what few shadow rays know badly: on plain
paper it would scatter by a tenth. So it is averaged over the cells about each, and the pixels take that of the cells beneath;
what the surface reflects is not averaged, and keeps its edges.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from recon.geometry import rigid
from recon.model.rig import CameraDevice, Target
from twin.shooting import FilmQuality
from twin.tracking.moving_transport import NO_CIRCLE, Lanes, Light, circle_number
from twin.tracking.pixel_selection import joined, lanes_of
from twin.tracking.samples import Held, Take
from twin.tracking.target_truth import ViewTruth, board_corners

Array = NDArray[np.float64]
Image = NDArray[np.float32]

CELL_PX, NEAR_CELL_PX = 4, 2
AROUND_PX = 24  # beyond the target's board
BEYOND = 0.42  # radii beyond a circle's rim: a fit of the rim reaches to 0.37
RIM_PX = 4.0  # on either side of a rim, and half of the motion's blur
LINE_PX = 16.0  # about a thin part
TILE = 4  # cells along each axis, among which the points of one set are dealt out: alike in all tiles, which leaves no noise


@dataclass(frozen=True)
class Cells:
    """A rectangle of the image in cells with one lane in the middle of each."""

    first: tuple[int, int]  # its upper left pixel
    extent: tuple[int, int]  # width, height, px
    cell: int  # px
    samples: int

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of cells."""
        width, height = self.extent
        return -(-height // self.cell), -(-width // self.cell)

    def lanes(self, take: int, camera: int) -> Lanes:
        """Lanes, row by row."""
        rows, columns = self.shape
        v = self.first[1] + (np.arange(rows) + 0.5) * self.extent[1] / rows - 0.5
        u = self.first[0] + (np.arange(columns) + 0.5) * self.extent[0] / columns - 0.5
        v, u = np.broadcast_arrays(v[:, None], u)
        row, column = np.indices(u.shape)
        first = ((row % TILE) * TILE + column % TILE) * self.samples
        return lanes_of(take, camera, u, v, self.samples, np.zeros(u.size), first)  # one set for all, or layers would differ

    def lay(self, image: Image, arrived: Image, light: Light) -> None:
        """Interpolate the lanes' radiance, and what arrives of the unshadowed light, into the rectangle of images : (h, w)."""
        plain = light.plain.reshape(self.shape)
        share = arriving(light.radiance.reshape(self.shape), plain)
        (u, v), (width, height) = self.first, self.extent
        for laid, cells in ((image, plain * share), (arrived, share)):
            laid[v : v + height, u : u + width] = cv2.resize(cells, self.extent, interpolation=cv2.INTER_LINEAR)


@dataclass(frozen=True)
class Pixels:
    """Pixels of an image, each with a lane."""

    u: NDArray[np.int64]  # (n,)
    v: NDArray[np.int64]
    samples: NDArray[np.int64]
    circle: NDArray[np.int64]  # `circle_number` of the one that is nearest, or NO_CIRCLE

    def lanes(self, take: int, camera: int) -> Lanes:
        """Lanes in the same order."""
        lanes = lanes_of(take, camera, self.u, self.v, 1, 1 + np.arange(self.u.size))
        return Lanes(**lanes.__dict__ | {"samples": np.uint32(self.samples), "circle": np.uint32(self.circle)})

    def lay(self, image: Image, arrived: Image, light: Light) -> None:
        """Put the lanes' radiance into the image : (h, w), of the light that arrives : (h, w) by the layer beneath."""
        image[self.v, self.u] = light.plain * arrived[self.v, self.u]


@dataclass(frozen=True)
class FilmPicture:
    """All layers of one camera's frame, from the one at the bottom up."""

    size: tuple[int, int]  # width, height
    layers: Sequence[Cells | Pixels]

    def lanes(self, take: int, camera: int) -> Lanes:
        """Lanes of all layers."""
        return joined([layer.lanes(take, camera) for layer in self.layers])

    def radiance(self, light: Light) -> Image:
        """The image : (h, w), from the light of `lanes`."""
        image, arrived = np.zeros((2, *self.size[::-1]), np.float32)
        first = 0
        for layer in self.layers:
            count = len(layer.u) if isinstance(layer, Pixels) else layer.shape[0] * layer.shape[1]
            layer.lay(image, arrived, light.part(slice(first, first + count)))
            first += count
        return image


def film_picture(
    take: Take,
    device: CameraDevice,
    late: float,
    targets: Mapping[str, Target],
    truth: Mapping[str, ViewTruth],
    quality: FilmQuality,
) -> FilmPicture:
    """Layers for a take's frame by one camera, which exposes later by a share of the exposure; targets and truth by body."""
    size, camera = device.optics.size, device.optics.camera()
    about, sharp = [], []
    for number, (name, held) in enumerate(take.held.items()):
        target = targets[name]
        near = about_target(held, device, late, target) if held.present else None
        if near is not None:
            about.append(Cells(*near, NEAR_CELL_PX, quality.view))
            pose = held.motion.later(late).world_from_target
            if held.line is not None:
                sharp.append(line_pixels(camera.project(rigid.apply(pose, held.line)), truth[name], size, quality))
            corners = camera.project(rigid.apply(pose, board_corners(target)))
            sharp.append(sharp_pixels(truth[name], corners, size, target, quality, number))
    return FilmPicture(size, [Cells((0, 0), size, CELL_PX, quality.view), *about, *sharp])


def about_target(held: Held, device: CameraDevice, late: float, target: Target) -> tuple[tuple[int, int], tuple[int, int]] | None:
    """First pixel, and width and height, of the rectangle about the board on its way; None where the image shows none of it."""
    motion, camera, size = held.motion.later(late), device.optics.camera(), np.array(device.optics.size)
    places = np.concatenate([camera.project(rigid.apply(motion.at(time), board_corners(target))) for time in (-0.5, 0.5)])
    if not np.isfinite(places).all():
        return None
    low = np.clip(np.floor(places.min(axis=0)) - AROUND_PX, 0, size)
    extent = np.clip(np.ceil(places.max(axis=0)) + AROUND_PX + 1, 0, size) - low
    return (tuple(low.astype(int).tolist()), tuple(extent.astype(int).tolist())) if extent.min() >= 2 else None


def line_pixels(places: Array, truth: ViewTruth, size: tuple[int, int], quality: FilmQuality) -> Pixels:
    """Pixels beside a line through places : (n, 2) px."""
    mask = np.zeros(size[::-1], np.uint8)
    width = round(LINE_PX + float(truth.blur_px.max()))
    cv2.polylines(mask, [np.rint(places).astype(np.int32)], isClosed=False, color=1, thickness=width)
    v, u = mask.nonzero()
    return Pixels(u, v, np.full(u.size, quality.disc), np.full(u.size, NO_CIRCLE))


def sharp_pixels(
    truth: ViewTruth, corners: Array, size: tuple[int, int], target: Target, quality: FilmQuality, body: int = 0
) -> Pixels:
    """Pixels of the edges of a body's board, between its corners : (4, 2) px, and of the circles, as far out as a fit of their
    rims looks, with more rays at outer and inner rims.
    """
    ratio = target.inner_diameter_mm / target.outer_diameter_mm
    edges = np.zeros(size[::-1], np.uint8)
    width = round(2 * RIM_PX + float(truth.blur_px.max()))  # over which they move
    cv2.polylines(edges, [np.rint(corners).astype(np.int32)], isClosed=True, color=1, thickness=width)
    v, u = edges.nonzero()
    found = [np.column_stack([u, v, *(np.full(u.size, value) for value in (quality.disc, NO_CIRCLE, np.inf))])]
    for k, (row, path) in enumerate(zip(truth.ellipses, truth.blur_px, strict=True)):
        reach = row[2] * (1 + BEYOND) + path
        low = np.clip(np.floor(row[:2] - reach), 0, size).astype(int)
        high = np.clip(np.ceil(row[:2] + reach) + 1, 0, size).astype(int)
        v, u = np.mgrid[low[1] : high[1], low[0] : high[0]].reshape(2, -1)
        radius = _radii(row, u, v)
        beyond = (radius - 1) * row[3] - path / 2
        at_rim = np.minimum(np.abs(radius - 1), np.abs(radius - ratio)) * row[3] < RIM_PX + path / 2
        rays = np.where(at_rim, quality.rim, quality.disc)
        found.append(np.column_stack([u, v, rays, np.full(u.size, circle_number(body, k)), radius])[beyond < BEYOND * row[3]])
    table = np.concatenate(found)
    table = table[np.argsort(table[:, 4], kind="stable")]  # of pixels that two circles share, those of the nearer
    _, kept = np.unique(table[:, 1] * size[0] + table[:, 0], return_index=True)
    u, v, rays, number = table[kept, :4].astype(np.int64).T
    return Pixels(u, v, rays, number)


def most_rays(quality: FilmQuality) -> int:
    """Points of the largest set."""
    return max(TILE**2 * quality.view, quality.disc, quality.rim)


def visible_shares(lanes: Lanes, light: Light, count: int) -> Array:
    """Uncovered share of each disc's area within the image : (n,), by `circle_number` up to a number of them."""
    of_one = lanes.circle != NO_CIRCLE
    seen, disc = (np.bincount(lanes.circle[of_one], (part / lanes.samples)[of_one], count) for part in (light.seen, light.disc))
    return seen / np.maximum(disc, 1)


def arriving(radiance: Image, plain: Image) -> Image:
    """Share : (h, w) of the unshadowed radiance that arrives, averaged over the cells about each."""
    return over_a_tile(radiance) / np.maximum(over_a_tile(plain), np.float32(1e-20))


def over_a_tile(image: Image) -> Image:
    """Mean of the cells about each, by a kernel in which each point of the tiles' set counts alike."""
    box = np.full(TILE, 1 / TILE)
    kernel = np.float32(np.convolve(box, box))
    return cv2.sepFilter2D(image, -1, kernel, kernel, borderType=cv2.BORDER_REFLECT)


def _radii(ellipse: Array, u: NDArray, v: NDArray) -> Array:
    """Distance of pixels from an ellipse's middle, 1 on the ellipse."""
    du, dv = u - ellipse[0], v - ellipse[1]
    cos, sin = np.cos(ellipse[4]), np.sin(ellipse[4])
    return np.hypot((du * cos + dv * sin) / ellipse[2], (dv * cos - du * sin) / ellipse[3])
