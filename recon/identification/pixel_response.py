"""Spread of the pixels' response (PRNU), from the mean images of flat frames.

Lighting varies slowly, pixels from one to the next: second differences along rows and columns leave the pixels alone, as they
vanish for any quadratic surface. They have the gain 36 for independent pixels. Differences over two pixels have it too, so a
pattern of the board or the screen, which is no pixel's own, shows as more at two than at one.

Source: EMVA 1288, Release 4.0 (spatial less temporal variance over frames); Immerkaer 1996 (the filter).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from recon.identification.dark_frames import HALF_WIDTH, Interval
from recon.identification.photon_transfer import LIMITS as TRANSFER
from recon.identification.photon_transfer import ROUNDING, PhotonTransfer, in_tiles

Array = NDArray[np.float64]


@dataclass(frozen=True)
class ResponseLimits:
    """When differences of pixels are their own."""

    outlier: float = 6.0  # standard deviations of a tile's differences: dust, or a dead pixel
    textured: float = 3.0  # standard deviations by which there is more over two pixels than over one
    more: float = 1.1  # and its least ratio


LIMITS = ResponseLimits()


class PixelResponse(NamedTuple):
    """What flat frames show."""

    prnu: Interval
    textured: bool  # the light has a fine pattern: `prnu` is a bound


def pixel_response(
    flats: Sequence[NDArray], bits: int, line: PhotonTransfer, black: tuple[float, float], dark: tuple[float, float] | None
) -> PixelResponse | None:
    """Spread of the pixels' response, relative.

    Parameters
    ----------
    flats : stacks (n, h, w), DN
        Of one image size, of a light without fine patterns.
    bits : int
        Of the images.
    line : PhotonTransfer
        Their temporal noise.
    black : DN
        Level of images without light, and its standard deviation.
    dark : DN^2
        Spatial variance of the dark signal and its standard deviation; None solves for it, by flats of several levels.

    Returns
    -------
    PixelResponse or None
        None if too few tiles count, or their levels don't tell response from dark signal.
    """
    one, two = (_squared(flats, bits, line, black[0], dark, stride) for stride in (1, 2))
    if one is None or two is None:
        return None
    textured = two[0] - one[0] > LIMITS.textured * np.hypot(one[1], two[1]) and two[0] > LIMITS.more * one[0]
    square, sigma = two if textured else one
    level = np.mean([flat.mean() for flat in flats]) - black[0]
    sigma = float(np.hypot(sigma, 2 * square * black[1] / level))
    low, high = max(square - HALF_WIDTH * sigma, 0), max(square, 0) + HALF_WIDTH * sigma
    return PixelResponse(Interval(float(np.sqrt(low)), float(np.sqrt(high))), bool(textured))


def _squared(
    flats: Sequence[NDArray], bits: int, line: PhotonTransfer, black: float, dark: tuple[float, float] | None, stride: int
) -> tuple[float, float] | None:
    """Square of the relative spread and its standard deviation, by least squares over tiles and levels.

    Levels share the pixels, and so their errors: a tile counts as one observation of all levels (clustered covariance).
    """
    normal, right = np.zeros((2, 2)), np.zeros(2)
    if dark is not None:
        precision = 1 / max(dark[1], 1e-12) ** 2
        normal[0, 0], right[0] = precision, precision * dark[0]
    known = normal.copy()
    terms = []
    for flat in flats:
        mean = flat.mean(axis=0, dtype=np.float64)
        fine = mean
        for axis in (0, 1):
            length = mean.shape[axis]
            first, middle, last = (np.arange(length - 2 * stride) + k * stride for k in range(3))
            fine = fine.take(first, axis) - 2 * fine.take(middle, axis) + fine.take(last, axis)
        squares = in_tiles(fine) ** 2 / 36
        usual = squares <= LIMITS.outlier**2 * np.median(squares, axis=1, keepdims=True) / 0.455  # median of chi^2
        pixels = in_tiles(mean[stride:-stride, stride:-stride])
        level, spread = pixels.mean(axis=1), pixels.std(axis=1)
        noise = line.variance(level)
        to_ends = TRANSFER.margin * np.sqrt(noise + spread**2)
        used = (level > to_ends) & (level + to_ends < 2**bits - 1) & (noise - ROUNDING > TRANSFER.dithered_dn**2)
        spatial = (squares * usual).sum(axis=1) / usual.sum(axis=1) - noise / len(flat)
        weight = used / np.mean(spatial[used] + noise[used] / len(flat)) ** 2 if used.any() else np.zeros(len(level))
        terms.append((np.stack([np.ones_like(level), (level - black) ** 2], axis=1), weight, spatial))
    tiles = np.count_nonzero(np.any([weight > 0 for _, weight, _ in terms], axis=0))
    for waves, weight, spatial in terms:
        normal, right = normal + (waves * weight[:, None]).T @ waves, right + waves.T @ (weight * spatial)
    scale = np.sqrt(np.diag(normal))
    if tiles < TRANSFER.tiles or not scale.all() or np.linalg.cond(normal / np.outer(scale, scale)) > 1e3:
        return None
    solution, inverse = np.linalg.solve(normal, right), np.linalg.inv(normal)
    scores = sum((waves * (weight * (spatial - waves @ solution))[:, None] for waves, weight, spatial in terms), np.zeros((1, 2)))
    covariance = inverse @ (scores.T @ scores + known) @ inverse
    return float(solution[1]), float(np.sqrt(covariance[1, 1]))
