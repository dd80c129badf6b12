"""Speckle of even tissue as scanners show it: the logarithm of a power that is exponentially distributed.

Echoes of many scatterers add to a circular Gaussian field, whatever the scatterers. Of two places whose fields correlate by rho,
the logarithms of the powers have the covariance `Li2(rho^2)`, Spence's dilogarithm, and the variance `Li2(1) = pi^2/6`. So greys
show |rho| whatever their scale, and grains' sizes need no greys a dB, as long as the map is linear in dB and nothing clips.

Source: the joint density of two such powers (Goodman, Speckle Phenomena in Optics, section 3.3), whose Laguerre series gives a
covariance of the logarithms of `sum rho^(2 n) / n^2`. Powers that are shown as black cut off the logarithm's long tail, which is
of small spots: 0.5 % of black pixels raise correlations of 0.7 to 0.9 by 0.014, eight standard deviations of a dozen B-scans.
"""

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import expn, spence

Array = NDArray[np.float64]
Images = NDArray[np.uint8]

WHOLE = np.pi**2 / 6  # variance of the logarithm of an exponentially distributed power
SPREAD_DB = 10 / np.log(10) * np.sqrt(WHOLE)  # 5.57 dB
STRIP_MM = 4.0  # width of the parts of an image that count as independent, at least
SAME_PLACE = 0.15  # correlation of two B-scans' grains, from which on they show the same tissue
ALIKE = np.linspace(0, 1, 2001)  # of fields, at which correlations of grey levels are tabulated
TERMS = 512  # of the Laguerre series; rho^1024 is under 1e-4 up to 0.991
CLIPPED = 0.02  # share of black and white pixels in a band, above which its grains are not measured


class Grains(NamedTuple):
    """Correlations of grey levels, whole and without each of k parts of the recording."""

    depth_mm: Array  # (b,) middles of the bands
    rows: list[slice]  # of each band
    black: Array  # (b,) share of black pixels
    deep: Array  # (b, m) at lags of 1 .. m rows
    along: Array  # (b, n) at lags of 1 .. n columns
    deep_without: Array  # (k, b, m)
    along_without: Array  # (k, b, n)
    shape: Array  # (b,) skewness: -1.14 of fully developed speckle


def grey_correlation(alike: Array, black: Array | float = 0.0) -> Array:
    """Correlation of grey levels of places whose fields correlate by |rho|.

    black : share of pixels that are shown as black; (b,) of the rows of alike : (b, m)
    """
    if not np.any(black):
        return spence(1 - np.clip(alike, 0, 1) ** 2) / WHOLE
    rows = np.atleast_2d(alike)
    tables = [_with_black(float(share)) for share in np.broadcast_to(black, len(rows))]
    return np.reshape([np.interp(row, ALIKE, table) for row, table in zip(rows, tables, strict=True)], np.shape(alike))


@lru_cache(maxsize=256)
def _with_black(share: float) -> Array:
    """Correlation of grey levels at `ALIKE`, with a share of black pixels.

    With L the Laguerre polynomials, the greys `ln max(p, c)` of powers p, of mean 1, have the coefficients
    `-1/n + int_0^c (L_(n-1)(p) - L_n(p)) exp(-p) / p dp`.
    """
    if share == 0:
        return grey_correlation(ALIKE)
    nodes, weights = np.polynomial.legendre.leggauss(64)
    end = -np.log1p(-share)
    p, part = end * (nodes + 1) / 2, end * weights / 2
    before, now, found = np.ones_like(p), 1 - p, np.empty(TERMS)
    for n in range(1, TERMS + 1):
        found[n - 1] = -1 / n + ((before - now) * np.exp(-p) / p) @ part
        before, now = now, ((2 * n + 1 - p) * now - n * before) / (n + 1)
    seen = np.log(end) + (np.log(50.0) - np.log(end)) * (nodes + 1) / 2  # logarithms of powers that aren't black
    above = (np.log(50.0) - np.log(end)) / 2 * ((seen - np.log(end)) ** 2 * np.exp(seen - np.exp(seen))) @ weights
    variance = above - float(expn(1, end)) ** 2
    powers = ALIKE[:, None] ** (2 * np.arange(1, TERMS + 1))
    return powers @ found**2 / variance


def field_correlation(grey: Array) -> Array:
    """The inverse of `grey_correlation` without black: |rho| by the correlation of grey levels; 0 of none or less."""
    return np.interp(grey, grey_correlation(ALIKE), ALIKE)


def bands(height: int, row_mm: float, first_mm: float, band_mm: float) -> list[slice]:
    """Bands of rows from a depth on, of at least 8 rows."""
    size, first = max(round(band_mm / row_mm), 8), int(np.ceil(first_mm / row_mm))
    return [slice(start, start + size) for start in range(first, height - size + 1, size)]


def parts(images: Images, mm_per_px: tuple[float, float]) -> NDArray[np.int64]:
    """Numbers : (n, w) of the independent parts of a recording : (n, h, w), by B-scan and column.

    Strips of B-scans are parts; those of successive B-scans whose grains are alike belong together.
    """
    count, _, width = images.shape
    strips = max(int(width * mm_per_px[0] / STRIP_MM), 1)
    grains = (images - images.mean(axis=2, keepdims=True))[:, images.shape[1] // 8 :]
    scene = np.zeros(count, int)
    for n in range(1, count):
        shared = float((grains[n] * grains[n - 1]).mean())
        alike = shared > SAME_PLACE * np.sqrt((grains[n] ** 2).mean() * (grains[n - 1] ** 2).mean())
        scene[n] = scene[n - 1] + (not alike)
    return scene[:, None] * strips + np.minimum(np.arange(width) * strips // width, strips - 1)


def measure(
    images: Images, mm_per_px: tuple[float, float], rows: list[slice], part: NDArray[np.int64], reach_mm: float
) -> Grains:
    """Measure the grains of even tissue.

    Parameters
    ----------
    images : (n, h, w)
    rows : bands over which the mean grey is nearly a line
    part : (n, w) of `parts`
    reach_mm : longest lag

    Bands that clip are left out.
    """
    sx, sy = mm_per_px
    lags = max(int(reach_mm / sy), 2), max(int(reach_mm / sx), 2)
    count = part.max() + 1
    kept, black, deep, along, shape = [], [], [], [], []
    for band in rows:
        greys = images[:, band]
        if ((greys == 0) | (greys == 255)).mean() > CLIPPED:
            continue
        grains = _detrended(greys)
        variance = _by_part(grains**2, part, count)
        kept.append(band)
        black.append((greys == 0).mean())
        deep.append([variance] + [_by_part(grains[:, k:] * grains[:, :-k], part, count) for k in range(1, lags[0] + 1)])
        along.append(
            [variance] + [_by_part(grains[..., k:] * grains[..., :-k], part[:, k:], count) for k in range(1, lags[1] + 1)]
        )
        shape.append((grains**3).mean() / (grains**2).mean() ** 1.5)
    depth = np.array([sy * (band.start + band.stop - 1) / 2 for band in kept])
    if not kept:
        none, left_out = np.zeros((0, 1)), np.zeros((count, 0, 1))
        return Grains(depth, kept, np.zeros(0), none, none, left_out, left_out, np.zeros(0))
    (deep_whole, deep_without), (along_whole, along_without) = (_ratios(np.array(sums)) for sums in (deep, along))
    return Grains(depth, kept, np.array(black), deep_whole, along_whole, deep_without, along_without, np.array(shape))


def lags(steps_mm: Array) -> tuple[Array, NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Distances : (s,) mm between two of n places : (n,) mm, to a hundredth; and of each pair its two places and its distance."""
    first, second = np.triu_indices(len(steps_mm), 1)
    distinct, pair = np.unique(np.round(np.abs(steps_mm[first] - steps_mm[second]) / 0.01), return_inverse=True)
    return 0.01 * distinct, first, second, pair


def lag_errors(places_mm: Array, errors_mm: Array) -> Array:
    """Errors : (q, s) mm of the distances of `lags`, each the mean over its pairs, by q errors of the places : (q, n)."""
    distinct, first, second, pair = lags(places_mm)
    longer = np.sign(places_mm[second] - places_mm[first]) * (errors_mm[:, second] - errors_mm[:, first])
    count = np.bincount(pair, minlength=len(distinct))
    return np.array([np.bincount(pair, each, len(distinct)) / count for each in longer]).reshape(len(errors_mm), len(distinct))


def across(images: Images, steps_mm: Array, mm_per_px: tuple[float, float], rows: list[slice]) -> tuple[Array, Array, Array]:
    """Correlations of grey levels of B-scans : (n, h, w) that stand at places : (n,) mm across their plane.

    Returns
    -------
    steps_mm : (s,) between B-scans, as of `lags`
    alike : (b, s) of each band
    without : (k, b, s) of all strips of columns but one
    """
    distinct, first, second, pair = lags(steps_mm)
    width = images.shape[2]
    strips = max(int(width * mm_per_px[0] / STRIP_MM), 2)
    strip = np.minimum(np.arange(width) * strips // width, strips - 1)
    sums = np.zeros((len(rows), 2, len(distinct), strips))
    for b, band in enumerate(rows):
        grains = _detrended(images[:, band])
        variance = (grains**2).mean(axis=(0, 1))
        for n, (i, j) in enumerate(zip(first, second, strict=True)):
            shared = (grains[i] * grains[j]).mean(axis=0)
            for values, kind in ((shared, 0), (variance, 1)):
                sums[b, kind, pair[n]] += np.bincount(strip, values, strips)
    total = sums.sum(axis=-1)
    left = total[..., None] - sums
    return distinct, total[:, 0] / total[:, 1], np.moveaxis(left[:, 0] / left[:, 1], -1, 0)


def _detrended(greys: NDArray) -> Array:
    """Greys : (n, h, w) less a line over depth."""
    row = np.arange(greys.shape[1])
    line = np.polynomial.polynomial.polyfit(row, greys.mean(axis=(0, 2)), 1)
    return greys - np.polynomial.polynomial.polyval(row, line)[:, None]


def _by_part(products: Array, part: NDArray[np.int64], count: int) -> Array:
    """Sums and numbers : (2, count) of products : (n, h, w) by part : (n, >= w); lags end where the part begins."""
    columns, rows = products.sum(axis=1), products.shape[1]
    label = part[:, : columns.shape[1]].ravel()
    return np.stack([np.bincount(label, columns.ravel(), count), rows * np.bincount(label, minlength=count)])


def _ratios(sums: Array) -> tuple[Array, Array]:
    """Correlations : (b, m), and without each part : (k, b, m), of sums and numbers : (b, 1 + m, 2, k)."""
    total = sums.sum(axis=-1)
    mean = total[..., 0] / total[..., 1]
    left = total[..., None] - sums
    without = left[:, :, 0] / np.maximum(left[:, :, 1], 1)
    return mean[:, 1:] / mean[:, :1], np.moveaxis(without[:, 1:] / without[:, :1], -1, 0)
