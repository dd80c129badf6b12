"""Augmentation of whole batches in torch: poses, light, lenses, noise, compression.

Images are (n, 1, h, w) float32 in digital numbers, 0 to 255, and every random number comes from the generator passed in. Views
and patches are never mirrored: no target has its circles in the other order. B-scans are.
"""

import math
from collections.abc import Callable
from functools import partial

import cv2
import numpy as np
import torch
from kornia.filters import filter2d
from numpy.typing import NDArray
from torch import Generator, Tensor
from torch.nn.functional import interpolate, pad

WHITE = 255.0  # digital numbers

Change = Callable[[Tensor, Generator], Tensor]
Grey = NDArray[np.uint8]


def uniform(least: float, most: float, shape: int | tuple[int, ...], generator: Generator) -> Tensor:
    """Random numbers."""
    shape = (shape,) if isinstance(shape, int) else shape
    return least + (most - least) * torch.rand(shape, generator=generator)


def log_uniform(least: float, most: float, shape: int | tuple[int, ...], generator: Generator) -> Tensor:
    """Random numbers as many in each octave."""
    return torch.exp(uniform(math.log(least), math.log(most), shape, generator))


def turns(n: int, scales: tuple[float, float], generator: Generator) -> Tensor:
    """Linear maps (n, 2, 2): rotated by any angle, scaled, a little narrower in some direction; never mirrored."""
    angle, direction = uniform(-math.pi, math.pi, (2, n), generator)
    scale, narrow = log_uniform(*scales, n, generator), uniform(0.85, 1.0, n, generator)
    stretch = torch.diag_embed(torch.stack([narrow, torch.ones(n)], -1))
    across = _rotation(direction)
    return scale[:, None, None] * _rotation(angle) @ across @ stretch @ across.mT


def tilts(n: int, generator: Generator) -> Tensor:
    """Linear maps (n, 2, 2) of B-scans: half of them mirrored, tilted by up to 8 degrees, scaled, wider or narrower."""
    angle, scale = uniform(-0.14, 0.14, n, generator), log_uniform(0.6, 1.5, n, generator)
    wide = log_uniform(0.8, 1.25, n, generator)
    side = torch.where(torch.rand(n, generator=generator) < 0.5, -1.0, 1.0)
    return scale[:, None, None] * _rotation(angle) @ torch.diag_embed(torch.stack([side * wide, torch.ones(n)], -1))


def scanned(images: Tensor, generator: Generator) -> Tensor:
    """B-scans (n, 1, h, w) of digital numbers as of another scanner: greys, gain over depth, contact, grain, sharpness."""
    n, _, height, width = images.shape

    def column(values: Tensor) -> Tensor:
        return values[:, None, None, None]

    grey = (images / WHITE).clamp(min=0) ** column(log_uniform(0.55, 1.7, n, generator))
    grey = grey * column(log_uniform(0.6, 1.9, n, generator)) + column(uniform(-0.06, 0.06, n, generator)) * (grey > 0)
    depth, across = torch.linspace(-1, 1, height)[:, None], torch.linspace(-1, 1, width)
    grey = grey * (1 + column(uniform(-0.4, 0.4, n, generator)) * depth)
    contact = uniform(-1.0, 1.0, n, generator)  # somewhere along the array
    lost = column(uniform(0.0, 0.7, n, generator) * (torch.rand(n, generator=generator) < 0.2))
    grey = grey * (1 - lost * torch.exp(-0.5 * ((across - column(contact)) / column(uniform(0.03, 0.15, n, generator))) ** 2))
    images = WHITE * grey * (1 + column(uniform(0.0, 0.25, n, generator)) * torch.randn(images.shape, generator=generator))
    images = _some(0.5, images, generator, _grained)
    images = _some(0.3, images, generator, _blurred)
    images = _some(0.25, images, generator, partial(_thumbnail, 0.45))
    return images.clamp(0, WHITE).round()


def _grained(images: Tensor, generator: Generator) -> Tensor:
    """With further speckle, of grains of up to some pixels."""
    noise = torch.randn(images.shape, generator=generator)
    coarse = _blurred(noise, generator)
    coarse = coarse / coarse.std((2, 3), keepdim=True).clamp(min=1e-6)
    return images * (1 + uniform(0.05, 0.4, len(images), generator)[:, None, None, None] * coarse).clamp(min=0)


def warp(images: Grey, linear: Tensor, source: Tensor, goal: Tensor, size: tuple[int, int], fill: Tensor) -> Tensor:
    """Views of images through affine maps that take the point `source` to the point `goal`.

    OpenCV's, since on a CPU torch's takes ten times as long; it rounds places to 1/32 px.

    Parameters
    ----------
    images : (n, h, w) uint8
    linear : (n, 2, 2) float
        Linear part of the map from pixels of the image to those of the result.
    source, goal : (n, 2) float, px
    size : (width, height) of the result, px
    fill : (n,) float
        Where the image doesn't reach.

    Returns
    -------
    (n, 1, height, width) float32
    """
    shift = goal - torch.einsum("nij,nj->ni", linear, source)
    result = np.empty((len(images), 1, size[1], size[0]), np.float32)
    maps = torch.cat([linear, shift[..., None]], -1).double().numpy()
    for image, change, level, target in zip(images, maps, fill.tolist(), result, strict=True):
        target[0] = cv2.warpAffine(np.float32(image), change, size, flags=cv2.INTER_LINEAR, borderValue=level)
    return torch.from_numpy(result)


def moved(points: Tensor, linear: Tensor, source: Tensor, goal: Tensor) -> Tensor:
    """Where `warp` moves points (n, k, 2), px."""
    return (points - source[:, None]) @ linear.mT + goal[:, None]


def occlude(images: Tensor, count: int, generator: Generator) -> tuple[Tensor, Tensor]:
    """Put rectangles of one grey in front, up to `count` an image; gives a mask too, 1 where something was covered."""
    n, _, height, width = images.shape
    covered = torch.zeros(n, 1, height, width, dtype=torch.bool)
    images = images.clone()
    for _ in range(count):
        used = torch.nonzero(torch.rand(n, generator=generator) < 0.3)[:, 0].tolist()
        middles, halves, greys = (
            torch.rand(n, 2, generator=generator),
            uniform(0.03, 0.15, (n, 2), generator),
            torch.rand(n, generator=generator),
        )
        for k in used:
            (u, v), (a, b) = middles[k].tolist(), halves[k].tolist()
            columns = slice(max(round((u - a) * width), 0), round((u + a) * width))
            rows = slice(max(round((v - b) * height), 0), round((v + b) * height))
            images[k, 0, rows, columns] = greys[k] ** 2 * WHITE
            covered[k, 0, rows, columns] = True
    return images, covered


def photograph(images: Tensor, white: Tensor, coarsest: float, generator: Generator) -> Tensor:
    """Pictures as of a random camera, from nearly black to saturated, and of the processing behind it.

    Parameters
    ----------
    images : (n, 1, h, w) float32
        Digital numbers.
    white : (n,) float
        Digital number of the target's white, 0 without a target.
    coarsest : float
        Least resolution that a picture came with, relative to that which it has.

    Returns
    -------
    (n, 1, h, w) float32, whole numbers from 0 to 255.
    """
    images = _some(0.35, images, generator, _blurred)
    images = _lit(images, white, generator)
    images = _some(0.25, images, generator, partial(_thumbnail, coarsest))
    images = _noisy(images, generator).clamp(0, WHITE).round()
    images = _some(0.15, images, generator, _palette)
    return _some(0.4, images, generator, _compressed)


def _rotation(angle: Tensor) -> Tensor:
    c, s = torch.cos(angle), torch.sin(angle)
    return torch.stack([torch.stack([c, -s], -1), torch.stack([s, c], -1)], -2)


def _some(probability: float, images: Tensor, generator: Generator, change: Change) -> Tensor:
    """Change some of the images; the others cost nothing."""
    which = torch.nonzero(torch.rand(len(images), generator=generator) < probability)[:, 0]
    return images.index_copy(0, which, change(images[which], generator)) if len(which) else images


def _lit(images: Tensor, white: Tensor, generator: Generator) -> Tensor:
    """Another exposure, contrast and gamma, and light that falls off to some side."""
    n, _, height, width = images.shape
    level = torch.where(white > 0, white, images.amax((1, 2, 3))).clamp(min=1)
    changed = torch.rand(n, generator=generator) < 0.6
    wanted = log_uniform(5.0, 400.0, n, generator)
    gain = torch.where(changed, (wanted / level).clamp(0.02, 4.0), uniform(0.8, 1.25, n, generator))
    gamma = torch.where(torch.rand(n, generator=generator) < 0.3, log_uniform(0.5, 1.8, n, generator), torch.ones(n))
    # gamma keeps the white where it is, or dark images would go all black
    top = level[:, None, None, None]
    images = top * (images / top).clamp(min=0) ** gamma[:, None, None, None] if bool((gamma != 1).any()) else images
    slope = uniform(-0.35, 0.35, (n, 2), generator)
    across, down = torch.linspace(-1, 1, width), torch.linspace(-1, 1, height)
    fall = 1 + slope[:, 0, None, None] * across + slope[:, 1, None, None] * down[:, None]
    black = torch.where(torch.rand(n, generator=generator) < 0.3, uniform(0.0, 25.0, n, generator), torch.zeros(n))
    return images * (gain[:, None, None] * fall)[:, None] + (black * gain.clamp(max=1))[:, None, None, None]


def _noisy(images: Tensor, generator: Generator) -> Tensor:
    """Noise of reading, and of light: its variance grows with the signal."""
    n = len(images)
    reading, light = log_uniform(0.15, 3.0, n, generator), log_uniform(0.005, 0.3, n, generator)
    variance = reading[:, None, None, None] ** 2 + light[:, None, None, None] * images.clamp(0, WHITE)
    return images + variance.sqrt() * torch.randn(images.shape, generator=generator)


def _blurred(images: Tensor, generator: Generator) -> Tensor:
    """Out of focus, moved in some direction, or both: an elongated Gaussian of up to 9 px."""
    n, half = len(images), 4
    along, across = log_uniform(0.3, 3.0, n, generator), log_uniform(0.3, 1.2, n, generator)
    turn = _rotation(uniform(-math.pi, math.pi, n, generator))
    offsets = torch.arange(-half, half + 1.0)
    grid = torch.stack(torch.meshgrid(offsets, offsets, indexing="xy"), -1)
    turned = torch.einsum("rcj,njk->nrck", grid, turn)
    kernel = torch.exp(-0.5 * ((turned[..., 0] / along[:, None, None]) ** 2 + (turned[..., 1] / across[:, None, None]) ** 2))
    return filter2d(images, kernel, border_type="replicate", normalized=True)


def _thumbnail(coarsest: float, images: Tensor, generator: Generator) -> Tensor:
    """Made smaller and larger again; one factor for all, since a batch has one size."""
    height, width = images.shape[-2:]
    factor = float(uniform(coarsest, 0.95, 1, generator))
    small = interpolate(images, size=(round(height * factor), round(width * factor)), mode="bilinear", antialias=True)
    return interpolate(small, size=(height, width), mode="bilinear")


def _palette(images: Tensor, generator: Generator) -> Tensor:
    """A few greys only, spread over those that each image has."""
    steps = torch.randint(8, 64, (len(images), 1, 1, 1), generator=generator)
    least, most = images.amin((2, 3), keepdim=True), images.amax((2, 3), keepdim=True)
    step = ((most - least) / steps).clamp(min=1)
    return (least + ((images - least) / step).round() * step).clamp(0, WHITE).round()


def _compressed(images: Tensor, generator: Generator) -> Tensor:
    """JPEG's loss: the cosine coefficients of 8x8 blocks, rounded. Source: ITU-T T.81, annexes A.3.3 and K.1."""
    n, _, height, width = images.shape
    quality = uniform(20.0, 95.0, n, generator)
    dark = images.amax((1, 2, 3)) < 40  # at a low quality nothing is left of such
    quality = torch.where(dark, quality.clamp(min=80), quality)
    percent = torch.where(quality < 50, 5000 / quality, 200 - 2 * quality)[:, None, None]
    table = ((LUMINANCE.reshape(64) * percent + 50) / 100).floor().clamp(1, 255)
    right, low = -width % 8, -height % 8
    whole = pad(images, (0, right, 0, low), mode="replicate") if right or low else images
    rows, columns = (height + low) // 8, (width + right) // 8
    blocks = whole.reshape(n, rows, 8, columns, 8).transpose(2, 3).reshape(n, rows * columns, 64) - 128
    rounded = ((blocks @ COSINES.T / table).round() * table) @ COSINES + 128
    joined = rounded.reshape(n, rows, columns, 8, 8).transpose(2, 3).reshape(whole.shape)
    return joined[..., :height, :width].clamp(0, WHITE).round()


def _cosines() -> Tensor:
    frequency, place = torch.arange(8.0)[:, None], torch.arange(8.0)
    basis = 0.5 * torch.cos((2 * place + 1) * frequency * math.pi / 16)
    basis[0] /= math.sqrt(2)
    return torch.kron(basis, basis)  # one product of matrices instead of two of small ones


COSINES = _cosines()  # (64, 64), orthonormal: from the pixels of a block to its coefficients, row by row
LUMINANCE = torch.tensor(
    [
        [16, 11, 10, 16, 24, 40, 51, 61],
        [12, 12, 14, 19, 26, 58, 60, 55],
        [14, 13, 16, 24, 40, 57, 69, 56],
        [14, 17, 22, 29, 51, 87, 80, 62],
        [18, 22, 37, 56, 68, 109, 103, 77],
        [24, 35, 55, 64, 81, 104, 113, 92],
        [49, 64, 78, 87, 103, 121, 120, 101],
        [72, 92, 95, 98, 112, 100, 103, 99],
    ],
    dtype=torch.float32,
)
