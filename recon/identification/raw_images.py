"""Signs that images aren't the raw ones of a linear camera, from their temporal noise: compressed, demosaiced, filtered, or bent.

Noise of a raw image is white, and its variance is a straight line over the level. JPEG, demosaicing, denoising and upscaling make
the noise of neighbouring pixels alike, sharpening makes it unlike, and JPEG ends that at borders of its blocks of 8 px. A gamma
of 1/g makes the variance a power `(2 g - 1) / g` of the level: bent, and falling for g < 1/2. Averages of pixels (binning) leave
noise white and the line straight: such an image is that of a sensor with larger pixels.

Sources: ITU-T T.81 (blocks); EMVA 1288, Release 4.0 (the line); the power follows from the gamma's slope.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from recon.identification.photon_transfer import LIMITS as TRANSFER
from recon.identification.photon_transfer import ROUNDING, PhotonTransfer, TileNoise

Array = NDArray[np.float64]


@dataclass(frozen=True)
class RawLimits:
    """When noise isn't that of raw images."""

    sure: float = 5.0  # standard deviations, by the scatter of tiles
    parts: int = 4  # of patterns' tiles by level, in all of which neighbours must be so, half as surely
    of_flats: float = 0.02  # correlation of neighbours
    of_patterns: float = 0.03  # the same
    blocks: float = 0.03  # of it, that ends at borders of blocks
    bent: float = 0.02  # of the variance, in the middle of the levels off the straight line between their ends
    wide: float = 0.3  # of the brightest level, that levels must span before a variance without a rise is no linear camera's
    known: float = 0.1  # of the variance, error of its rise over the levels at most then
    drift: float = 0.1  # of the light, from the darkest to the brightest of flat frames that rise or fall one after another
    ordered: float = 0.003  # chance that frames of a lamp that flickers are in such an order
    scattered: float = 0.5  # of the light, of flat frames in any order


LIMITS = RawLimits()
SET = "set raw grey images, gamma 1, no noise reduction or sharpening, PNG or TIFF files; or give processed=true"


def describe_processing(noise: TileNoise, line: PhotonTransfer | None, *, by_flats: bool) -> str | None:
    """What was done to the images, and how the camera is to be set, in words; None where they look raw, or show too little.

    Parameters
    ----------
    line : PhotonTransfer or None
        Of that noise.
    by_flats : bool
        Patterns leave some of their light in the noise, which grows faster than the level: such a bend isn't looked at then.
    """
    seen = noise.variance - ROUNDING > TRANSFER.dithered_dn**2
    if np.count_nonzero(seen) < TRANSFER.tiles:
        return None
    parts = np.array_split(noise.beside[seen][np.argsort(noise.level[seen])], 1 if by_flats else LIMITS.parts)
    along = [_least([part[:, k] - part[:, 4] for part in parts]) for k in range(3)]
    most = max(along, key=abs)
    if abs(most) > (LIMITS.of_flats if by_flats else LIMITS.of_patterns):
        blocks = _least([part[:, :2].mean(axis=1) - part[:, 3] for part in parts]) > LIMITS.blocks
        if most < 0:
            return f"noise of neighbouring pixels is opposed (correlation {most:.2f}), as by sharpening, denoising or JPEG: {SET}"
        cause = "JPEG" if blocks else "demosaiced colours, denoising, JPEG, upscaling" + ("" if by_flats else " or a gamma")
        return f"noise of neighbouring pixels is alike (correlation {most:.2f}), as by {cause}: {SET}"
    if line is not None and _without_rise(line):
        return f"noise doesn't rise with the level, as by a gamma: {SET}"
    bend, sigma = _bend(noise, seen)
    if (abs(bend) if by_flats else bend) > max(LIMITS.sure * sigma, LIMITS.bent):
        return f"noise over level isn't a straight line (its middle is {100 * bend:+.0f} % off), as by a gamma: {SET}"
    return None


def describe_drift(flats: Sequence[NDArray]) -> str | None:
    """That frames (n, h, w) of one light aren't of one exposure, in words; None where they may be, under a lamp that flickers."""
    for frames in flats:
        light = frames.mean(axis=(1, 2))
        change = light.max() / max(light.min(), 1.0) - 1
        ordered = change > LIMITS.drift and stats.kendalltau(np.arange(len(light)), light).pvalue < LIMITS.ordered
        if ordered or change > LIMITS.scattered:
            course = "drift" if ordered else "scatter"
            cause = "auto exposure, auto gain or a cold lamp: fix them, let the lamp warm up; or give processed=true"
            return f"flat frames of one light {course} by {100 * change:.0f} %, as by {cause}"
    return None


def _least(parts: Sequence[Array]) -> float:
    """The mean nearest to zero of tiles of all parts of the range; none where one of them isn't sure, or has another sign.

    What light leaves grows with it, and reaches far; a filter is the same everywhere.
    """
    means = np.array([part.mean() for part in parts])
    sigmas = np.array([part.std(ddof=1) / np.sqrt(len(part)) for part in parts])
    alike = np.abs(np.sign(means).sum()) == len(parts) and (np.abs(means) > LIMITS.sure / np.sqrt(len(parts)) * sigmas).all()
    return float(means[np.abs(means).argmin()]) if alike else 0.0


def _without_rise(line: PhotonTransfer) -> bool:
    """Whether the variance is known well, over levels far enough apart, not to grow."""
    span, sigma = line.brightest - line.darkest, np.sqrt(line.covariance[0, 0])
    variance = line.variance((line.darkest + line.brightest) / 2)
    return bool(
        span > LIMITS.wide * line.brightest and line.gain < LIMITS.sure * sigma and sigma * span < LIMITS.known * variance
    )


def _bend(noise: TileNoise, seen: NDArray[np.bool_]) -> tuple[float, float]:
    """Height of a parabola's middle over the chord of its ends, of the variance there, and its standard deviation."""
    x, y, freedom = noise.level[seen], noise.variance[seen] - ROUNDING, noise.freedom[seen]
    low, high = x.min(), x.max()
    u = 2 * (x - low) / max(high - low, 1e-9) - 1  # from -1 to 1
    waves = np.stack([np.ones_like(u), u, 1 - u**2], axis=1)
    expected = y
    for _ in range(3):
        root = np.sqrt(freedom / 2) / (np.maximum(expected, 0) + ROUNDING)
        scaled = waves * root[:, None]
        if np.linalg.cond(scaled / np.linalg.norm(scaled, axis=0)) > 1e4:
            return 0.0, np.inf
        solution = np.linalg.lstsq(scaled, y * root, rcond=None)[0]
        expected = waves @ solution
    scatter = ((y - expected) ** 2 * root**2).sum() / max(len(y) - 3, 1)
    sigma = np.sqrt(np.linalg.inv(scaled.T @ scaled)[2, 2] * max(scatter, 1.0))
    middle = max(solution[0] + solution[2], ROUNDING)
    return float(solution[2] / middle), float(sigma / middle)
