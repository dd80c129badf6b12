"""Photon transfer: a camera's temporal noise over its grey level, from flat frames, fringes, or a code and its inverse.

An electron makes K digital numbers (DN), and their number is Poisson, so a pixel's variance grows by K for each DN of its level.
Variances are those of tiles of pixels, whose places are chosen before their values are seen: bins of level would pick noise.
What a lamp changes from frame to frame is smooth, or follows the scene: it is fitted within each tile, and no noise.

Source: EMVA 1288, Release 4.0 (variance against mean); Sheppard 1898 (variance of rounding).
"""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from recon.model.patterns import AnyPart, Fringes, GrayCode, Patterns
from recon.structured_light.phase import MIN_STEPS_FOR_NOISE, design, pseudo_inverse

Array = NDArray[np.float64]

ROUNDING = 1 / 12  # DN^2, of whole numbers
TILE = 16  # px, side of a tile: small against the lighting, and 256 pixels know their variance to 9 % from one pair of frames
AROUND = np.array([[1, 1, 1], [1, 0, 1], [1, 1, 1]], np.float32)
FAR = 4  # px, farther than filters of cameras reach
ROUNDS = 4  # of weights by the line that was fitted with the last ones


@dataclass(frozen=True)
class TransferLimits:
    """Which tiles and lines count."""

    dithered_dn: float = 0.6  # noise that hides the steps of whole numbers: the variance of rounding is 1/12 DN^2 to 2e-3 DN^2
    margin: float = 5.0  # standard deviations between a tile's mean and the ends of the range
    uneven: float = 0.002  # relative error of a variance by what isn't in the model, such as steps of the ADC in the noise
    tiles: int = 16  # at least; their scatter is the line's uncertainty
    harmonics: int = 3  # of fringes, which a projector's gamma adds with some strength, and which are left out
    locked: int = 5  # harmonics of the fringes that a frame's error may show in a tile
    pairs: int = 3  # images of a code with their inverses, at least


LIMITS = TransferLimits()


class TileNoise(NamedTuple):
    """Temporal noise of tiles of pixels."""

    level: Array  # (t,) DN, mean over pixels and frames, by their shares of the variance
    variance: Array  # (t,) DN^2, of one frame, rounding included
    freedom: Array  # (t,) degrees of freedom
    beside: (
        Array  # (t, 5) correlation of pixels' noise with that of the next along rows, columns, diagonals, of the next across the
    )
    # borders of blocks of 8 px, and of those 4 px away; 0 in the mean over tiles if the noise is white


def joined(parts: Iterable[TileNoise | None]) -> TileNoise | None:
    """Tiles of several parts in one; None if no part has any."""
    found = [one for one in parts if one is not None]
    return TileNoise(*map(np.concatenate, zip(*found, strict=True))) if found else None


@dataclass(frozen=True)
class PhotonTransfer:
    """A line of variance over level, without rounding: `intercept + gain * level`."""

    gain: float  # K, DN an electron
    intercept: float  # DN^2, at level 0: K^2 dark_noise_e^2 - K black
    covariance: Array  # (2, 2), of gain and intercept
    darkest: float  # DN, of the tiles
    brightest: float  # DN

    def variance(self, level: Array | float) -> Array:
        """Variance of one frame at a mean level, DN^2, rounding included."""
        return np.asarray(self.intercept + self.gain * np.asarray(level, float) + ROUNDING)

    def sigma(self, level: Array | float) -> Array:
        """Standard deviation of that variance, DN^2."""
        slopes = np.stack([np.asarray(level, float), np.ones_like(level, float)])
        return np.sqrt(np.einsum("i...,ij,j...->...", slopes, self.covariance, slopes))


def in_tiles(images: NDArray) -> NDArray:
    """Pixels of images (..., h, w) by tile : (..., tiles, TILE^2); what is left over at the right and below is dropped."""
    down, across = images.shape[-2] // TILE, images.shape[-1] // TILE
    cut = images[..., : down * TILE, : across * TILE].reshape(*images.shape[:-2], down, TILE, across, TILE)
    return cut.swapaxes(-3, -2).reshape(*images.shape[:-2], down * across, TILE * TILE)


def noise_of_flat(frames: NDArray, bits: int) -> TileNoise:
    """Temporal noise of frames of one steady scene.

    A lamp's flicker scales the scene in each frame by its mean over the image; the rest is a constant of each tile. That the
    black level isn't scaled leaves a tenth of what flicker does within a tile, at most, which is nothing beside noise.

    Parameters
    ----------
    frames : (n, h, w), DN, n >= 2
    bits : int
        Of the images. Tiles near the ends of their range are left out.
    """
    n, full = len(frames), 2**bits - 1
    mean = in_tiles(frames.mean(axis=0, dtype=np.float64))
    level, spread = mean.mean(axis=1), mean.std(axis=1)
    power, pairs = np.zeros(len(level)), np.zeros((len(level), 5))
    for frame in frames:
        off = in_tiles(frame) - mean
        flicker = off.mean() / max(level.mean(), 1.0)
        off -= off.mean(axis=1, keepdims=True) + flicker * (mean - level[:, None])
        power += (off**2).sum(axis=1)
        pairs += _of_pairs(off)
    freedom = (n - 1) * (TILE**2 - 1)
    variance = power / freedom
    to_ends = LIMITS.margin * np.sqrt(variance + spread**2)
    usable = (level - to_ends > 0) & (level + to_ends < full)
    beside = _correlation(pairs, variance * (n - 1), np.full((1, TILE**2, 1), 1 / TILE))
    return TileNoise(level[usable], variance[usable], np.full(np.count_nonzero(usable), float(freedom)), beside[usable])


def noise_of_patterns(images: NDArray, patterns: Patterns, bits: int) -> TileNoise | None:
    """Temporal noise of a sequence of patterns on any steady scene, of all parts that show it.

    Those are fringes of eight steps or more, an even number of them if binary, and codes with the inverse of each image. Sets of
    fewer steps have a mean light that harmonics add to, which looks like noise: 5 to 12 % of the electrons under a gamma of 1.5.

    Parameters
    ----------
    images : (n, h, w), DN
        One an image of the sequence.
    bits : int
        Of the images.

    Returns
    -------
    TileNoise or None
        None if no part shows it.
    """
    found = []
    for part, place in patterns.slices():
        if isinstance(part, GrayCode) and has_free_dimensions(part):
            found.append(noise_of_inverses(images[place], bits))
        elif isinstance(part, Fringes) and has_free_dimensions(part):
            measure = noise_of_fringes if part.waveform == "sine" else noise_of_binary_fringes
            found.append(measure(images[place], part.shifts, bits))
    return joined(found)


def has_free_dimensions(part: AnyPart) -> bool:
    """Whether a part's images by themselves hold noise that isn't light."""
    if isinstance(part, GrayCode):
        return part.inverted and part.count >= 2 * LIMITS.pairs
    return isinstance(part, Fringes) and part.steps >= MIN_STEPS_FOR_NOISE and (part.waveform == "sine" or part.steps % 2 == 0)


def noise_of_fringes(images: NDArray, shifts: Array, bits: int) -> TileNoise:
    """Temporal noise of a sequence of shifted fringes on any steady scene.

    A fringe and its first harmonics fill some of the n dimensions of a pixel's values; the others hold noise and errors of
    frames: gains, offsets and shifts. In each tile such an error is a combination of the offset A, of 1, and of harmonics
    B cos(m phase), B sin(m phase), which are fitted to each of those dimensions.

    Parameters
    ----------
    images : (n, h, w), DN
    shifts : (n,) rad
    bits : int
        Of the images. Tiles with a pixel that touches an end of their range are left out.

    Raises
    ------
    ValueError
        If there are too few images to leave a dimension for noise, or shifts leave the phase undetermined.
    """
    highest = min(LIMITS.harmonics, (len(shifts) - 2) // 2)
    if highest < 1 or len(shifts) != len(images):
        raise ValueError(f"expected n >= 4 images (n, h, w) and n shifts, found {images.shape} and {len(shifts)} shifts")
    return _noise_beside(images, shifts, design(shifts, highest), bits)


def noise_of_binary_fringes(images: NDArray, shifts: Array, bits: int) -> TileNoise:
    """Temporal noise of a sequence of binary fringes, as `noise_of_fringes`.

    A wave that is lit for half of its period has odd harmonics only, behind any blur and any gamma. Of an even number of steps
    these stay odd, so that the even ones hold noise and errors of frames.
    """
    if len(shifts) % 2 or len(shifts) < 4 or len(shifts) != len(images):
        raise ValueError(f"expected an even number of 4 or more images and shifts, found {len(images)} and {len(shifts)}")
    odd = np.arange(1, len(shifts) // 2 + 1, 2)
    angles = np.outer(shifts, odd)
    return _noise_beside(images, shifts, np.column_stack([np.ones(len(shifts)), np.cos(angles), np.sin(angles)]), bits)


def noise_of_inverses(images: NDArray, bits: int) -> TileNoise:
    """Temporal noise of binary patterns, each followed by its inverse, on any steady scene.

    The light of both adds up to that of a uniform image, whatever the blur and the projector's gamma. What a frame's gain and
    offset change in a tile of that sum is a combination of 1, the sum, and the sum where the first or the second was lit. Noise
    of the sum is that of two levels, whose variances lie on the line: half of it is the variance at the mean level.

    Parameters
    ----------
    images : (2 n, h, w), DN, n >= 3
        By a camera with a linear response.
    bits : int
        Of the images. Tiles with a pixel that touches an end of their range are left out.
    """
    if len(images) % 2 or len(images) < 2 * LIMITS.pairs:
        raise ValueError(f"expected {LIMITS.pairs} patterns or more with their inverses, found {len(images)} images")
    tiles = in_tiles(images)
    usable = (tiles.min(axis=(0, 2)) > 0) & (tiles.max(axis=(0, 2)) < 2**bits - 1)
    around = [cv2.filter2D(image, cv2.CV_32F, AROUND) for image in images]  # of light, without the pixel's own noise
    lit = np.stack([(one - other) / np.maximum(one + other, 1) for one, other in zip(around[0::2], around[1::2], strict=True)])
    sums, lit = tiles[0::2, usable] + tiles[1::2, usable].astype(np.float32), in_tiles(lit)[:, usable]
    scene, left = sums.mean(axis=0), np.empty_like(sums)
    for _ in range(ROUNDS):  # of the scene, which errors of frames add to, and of these
        for k in range(len(sums)):
            shapes = np.stack([np.ones_like(scene), scene, scene * lit[k]], axis=1)  # (tiles, 3, pixels)
            left[k] = _beside(sums[k] - scene, shapes)
        scene = scene + left.mean(axis=0)
    freedom = np.full(len(scene), (len(sums) - 1.0) * (TILE**2 - 3))
    variance = (left**2).sum(axis=(0, 2), dtype=float) / freedom  # of a sum
    shapes = np.stack([np.ones_like(scene), scene, scene * lit[-1]], axis=2)
    beside = _correlation(sum(map(_of_pairs, left)), variance * (len(sums) - 1), _orthonormal(shapes))
    return TileNoise(scene.mean(axis=1) / 2, variance / 2, freedom, beside)


def _beside(values: NDArray, shapes: NDArray) -> NDArray:
    """What is left of tiles' values (t, p) by least squares with shapes (t, m, p)."""
    inverse = np.linalg.pinv(shapes @ shapes.swapaxes(1, 2), hermitian=True)
    return values - ((shapes @ values[..., None]).swapaxes(1, 2) @ inverse @ shapes)[:, 0]


def _of_pairs(noise: NDArray) -> Array:
    """Mean products of neighbouring pixels' noise (..., p) : (..., 5), as in `TileNoise.beside`."""
    square = noise.reshape(*noise.shape[:-1], TILE, TILE)
    rows, columns = square[..., :, 1:] * square[..., :, :-1], square[..., 1:, :] * square[..., :-1, :]
    diagonals = square[..., 1:, 1:] * square[..., :-1, :-1] + square[..., 1:, :-1] * square[..., :-1, 1:]
    borders = rows[..., :, TILE // 2 - 1].mean(axis=-1) + columns[..., TILE // 2 - 1, :].mean(axis=-1)
    away = square[..., :, FAR:] * square[..., :, :-FAR], square[..., FAR:, :] * square[..., :-FAR, :]
    near = [one.mean(axis=(-2, -1), dtype=float) for one in (rows, columns, diagonals / 2)]
    far = (away[0].mean(axis=(-2, -1), dtype=float) + away[1].mean(axis=(-2, -1), dtype=float)) / 2
    return np.stack([*near, borders / 2, far], axis=-1)


def _correlation(pairs: Array, power: Array, basis: Array) -> Array:
    """Correlation : (t, 5) of neighbours by their products, and a pixel's variance, in the same number of residuals of a fit.

    What a fit with an orthonormal basis (t, p, m) takes from white noise correlates the rest, which is put right.
    """
    taken = _of_pairs(basis.swapaxes(1, 2)).sum(axis=1)
    return pairs / np.maximum(power, 1e-12)[:, None] + taken


def _noise_beside(images: NDArray, shifts: Array, waves: Array, bits: int) -> TileNoise:
    """Noise in the dimensions of a pixel's values beside those, (n, m), that fringes fill."""
    tiles = in_tiles(images)
    usable = (tiles.min(axis=(0, 2)) > 0) & (tiles.max(axis=(0, 2)) < 2**bits - 1)
    values = tiles[:, usable].astype(float)
    offset, c, s = np.tensordot(pseudo_inverse(shifts), values, 1)
    phasor, turn = c + 1j * s, np.exp(1j * np.angle(c + 1j * s))
    powers = [phasor * turn**m for m in range(LIMITS.locked)]
    shapes = np.stack([np.ones_like(offset), offset, *(part for z in powers for part in (z.real, z.imag))], axis=-1)
    left = np.linalg.svd(waves.T)[2][np.linalg.matrix_rank(waves) :]  # (dimensions, n), orthonormal, without the fringe
    basis = _orthonormal(shapes)
    noise = np.tensordot(left, values, 1)
    noise -= np.einsum("tpm,tqm,ktq->ktp", basis, basis, noise, optimize=True)
    free = 1 - (basis**2).sum(axis=2)  # of a pixel's noise, what the fit leaves: less of bright ones, which are noisier
    pixels = free.sum(axis=1)
    level = (free * offset).sum(axis=1) / pixels
    variance = (noise**2).sum(axis=(0, 2)) / (len(left) * pixels)
    beside = _correlation(_of_pairs(noise).mean(axis=0), variance, basis)
    return TileNoise(level, variance, len(left) * pixels, beside)


def _orthonormal(shapes: Array) -> Array:
    """Orthonormal bases : (t, p, m) of what shapes (t, p, m) span; zeros beyond its dimension."""
    u, size, _ = np.linalg.svd(shapes / np.maximum(np.linalg.norm(shapes, axis=1, keepdims=True), 1e-30), full_matrices=False)
    return u * (size > 1e-6 * size[:, :1])[:, None, :]


def transfer_line(noise: TileNoise) -> PhotonTransfer | None:
    """Fit the line of variance over level, with weights by itself.

    Its standard deviations are those by the tiles' degrees of freedom, times the tiles' scatter about it where that is larger,
    and by errors of the variances at its ends.
    None if too few tiles have a noise that hides the steps of whole numbers, or their levels don't differ.
    """
    x, y = noise.level, noise.variance - ROUNDING
    used, expected = y > LIMITS.dithered_dn**2, noise.variance
    line = None
    for _ in range(ROUNDS):
        if np.count_nonzero(used) < LIMITS.tiles:
            return None
        root = np.sqrt(noise.freedom[used] / 2) / expected[used]
        waves = np.stack([x[used], np.ones(len(root))], axis=1) * root[:, None]
        if np.linalg.cond(waves / np.linalg.norm(waves, axis=0)) > 1e4:
            return None
        (gain, intercept), *_ = np.linalg.lstsq(waves, y[used] * root, rcond=None)
        scatter = ((y[used] * root - waves @ [gain, intercept]) ** 2).sum() / (len(root) - 2)
        covariance = np.linalg.inv(waves.T @ waves) * max(scatter, 1.0)
        ends = np.array([x[used].min(), x[used].max()])
        by_ends = np.linalg.inv(np.stack([ends, np.ones(2)], axis=1)) * LIMITS.uneven * (intercept + gain * ends + ROUNDING)
        line = PhotonTransfer(float(gain), float(intercept), covariance + by_ends @ by_ends.T, *ends.tolist())
        expected = np.maximum(line.variance(x), ROUNDING)
        used = line.variance(x) - ROUNDING > LIMITS.dithered_dn**2
    return line
