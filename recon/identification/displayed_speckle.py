"""Speckle as a scanner displays it, of averaged looks and through a grey map of any form; and what it predicts.

A grey is `M(10 log10 P)` of a power P of n looks, a gamma variate. Of two places whose fields correlate by rho, functions of the
powers have the covariance `sum c_k^2 rho^(2 k)`, with their coefficients c_k by Laguerre polynomials of the order n - 1 (Kibble's
bivariate gamma density). So a map, a level and a field's correlation give mean, contrast and size of the grains in closed form.

Patches of even tissue don't tell more dB a grey from fewer looks by one level alone; overlapping levels do, by the shape of the
histograms, but not well: `looks` is a number that stands for compounding and smoothing alike.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter
from scipy.special import eval_genlaguerre, gammaln, roots_genlaguerre

from recon.identification import grey_map, speckle
from recon.identification.estimates import Estimate, Findings
from recon.identification.grey_map import Curve, few

Array = NDArray[np.float64]
Images = NDArray[np.uint8]

TERMS = 24  # of the series
START_LOOKS = 3.0  # what their mean is taken for: a map of any form fits more or fewer, and then has fewer or more dB
ROUNDS = 4
WIDEST_PX = 7  # between lines
NODES = 120  # of the quadrature over a power
GROUPS = 4  # of B-scans, by whose scatter figures are uncertain


@dataclass(frozen=True)
class PatchSettings:
    """Patches in which tissue counts as even."""

    size_mm: tuple[float, float] = (5.0, 3.0)  # along the array, in depth
    looks: tuple[float, ...] = (0.7, 1.0, 1.4, 2.0, 2.8, 4.0, 5.6, 8.0, 11.0)  # tried
    knots: int = 30  # of the grey map, at even shares of all greys
    reach_mm: float = 1.5  # of grains


class Displayed(NamedTuple):
    """Displayed speckle of a recording."""

    curve: Curve
    looks: Array  # (b,) of each row of patches, over their geometric mean times START_LOOKS
    depth_mm: Array  # (b,) of rows of patches
    level_db: Array  # (b, p) of the patches
    deep: Array  # (b, m) field correlation at lags of 1 .. m rows
    along: Array  # (b, n) at lags of 1 .. n columns


class Figures(NamedTuple):
    """Grains at some depths."""

    mean: Array  # (b,) greys
    contrast: Array  # (b,) standard deviation over mean grey, within patches
    deep_mm: Array  # (b,) full width at half maximum of the greys' autocorrelation
    along_mm: Array  # (b,)
    shares: Array  # (256,) of greys, up to each


def identify(images: Images, mm_per_px: tuple[float, float], settings: PatchSettings = PatchSettings()) -> Displayed:
    """Find grey map, looks and grains of B-scans : (n, h, w) of tissue that is even over patches, at any level."""
    tiles, counts = _patches(images, mm_per_px, settings)
    flat = counts.reshape(-1, 256)
    shares = np.cumsum(flat.sum(axis=0)) / flat.sum()
    knots = np.unique(np.searchsorted(shares, np.linspace(0.003, 0.997, settings.knots))) + 0.5
    looks = np.full(len(tiles), START_LOOKS)
    curve, level = grey_map.fit_curve(flat, knots, START_LOOKS)
    for _ in range(ROUNDS - 1):
        likely = np.array([_likelihoods(counts, curve, level.reshape(counts.shape[:2]), each) for each in settings.looks])
        looks = np.array(settings.looks)[likely.argmax(axis=0)]
        looks = looks * START_LOOKS / np.exp(np.log(looks).mean())
        curve, level = grey_map.fit_curve(flat, knots, np.repeat(looks, counts.shape[1]))
    levels = level.reshape(counts.shape[:2])
    db = curve.db_of(images.astype(float))
    deep, along = (
        np.array([field_correlation(row, own) for row, own in zip(each, looks, strict=True)])
        for each in _grains(db, tiles, mm_per_px, settings)
    )
    sy = mm_per_px[1]
    depth = np.array([sy * (tile.start + tile.stop - 1) / 2 for tile in tiles])
    return Displayed(curve, looks, depth, levels, deep, along)


def measure(images: Images, mm_per_px: tuple[float, float], settings: PatchSettings = PatchSettings()) -> Figures:
    """Figures of B-scans : (n, h, w), to be set beside predicted ones."""
    tiles, counts = _patches(images, mm_per_px, settings)
    greys = np.arange(256)
    total = counts.sum(axis=2)
    mean = counts @ greys / total
    variance = (counts @ greys**2 / total - mean**2).mean(axis=1)
    deep, along = _grains(images.astype(float), tiles, mm_per_px, settings)
    sx, sy = mm_per_px
    deep_mm, along_mm = (np.array([step * half_width(row) for row in each]) for each, step in ((deep, sy), (along, sx)))
    shares = np.cumsum(counts.sum(axis=(0, 1))) / counts.sum()
    return Figures(mean.mean(axis=1), np.sqrt(variance) / mean.mean(axis=1), deep_mm, along_mm, shares)


def summary(images: Images, mm_per_px: tuple[float, float], settings: PatchSettings = PatchSettings()) -> Findings:
    """Contrast and size of the grains as displayed, over all depths, of B-scans : (n, h, w), by which a picture can be set.

    And the distance of its lines, if columns between them are interpolated.
    """
    names, wide = ("contrast", "deep_mm", "along_mm"), mm_per_px[0] * images.shape[2]
    if wide < settings.size_mm[0]:
        why = f"images are {wide:.1f} mm wide, less than the {settings.size_mm[0]:g} mm of a patch"
        return Findings(unknown={f"speckle.{name}": why for name in names})
    groups = [measure(group, mm_per_px, settings) for group in np.array_split(images, min(GROUPS, len(images)))]
    source, found = f"greys of {len(images)} B-scans", dict[str, Estimate]()
    for name in names:
        each = np.array([getattr(group, name).mean() for group in groups])
        sigma = each.std(ddof=1) / np.sqrt(len(each)) * few(len(each) - 1)
        found[f"speckle.{name}"] = Estimate(float(each.mean()), float(sigma), source)
    if (spacing := line_spacing_px(images)) is not None:
        resolved = spacing**2 / images.shape[2]  # of a spectrum as long as a row; half of it is likely
        found["ultrasound.picture.line_mm"] = Estimate(mm_per_px[0] * spacing, mm_per_px[0] * resolved / 2, source)
    return Findings(found)


def predict(found: Displayed, mm_per_px: tuple[float, float]) -> Figures:
    """Figures in closed form, of the levels, the map and the fields' correlations that were found."""
    means, spreads, deep, along = [], [], [], []
    sx, sy = mm_per_px
    for levels, looks, own_deep, own_along in zip(found.level_db, found.looks, found.deep, found.along, strict=True):
        powers = np.array([coefficients(found.curve, level, looks) for level in levels])
        means.append(powers[:, 0].mean())
        terms = (powers[:, 1:] ** 2).mean(axis=0)
        spreads.append(terms.sum())
        k = np.arange(1, TERMS + 1)
        for own, lags, step in ((own_deep, deep, sy), (own_along, along, sx)):
            lags.append(step * half_width((own[:, None] ** (2 * k)) @ terms / terms.sum()))
    each = np.repeat(found.looks, found.level_db.shape[1])
    shares = found.curve.cumulative(found.level_db.ravel(), each).mean(axis=0)
    mean = np.array(means)
    return Figures(mean, np.sqrt(spreads) / mean, np.array(deep), np.array(along), shares)


def line_spacing_px(images: Images) -> float | None:
    """Distance, px, of a linear array's lines whose columns between are interpolated, by B-scans : (n, h, w); None if none shows.

    Both halves of the images must show it: smoothed grains bend with a period by chance, each time another one.
    """
    halves = [_bending_period_px(images[first::2]) for first in (0, 1)] if len(images) > 1 else [None]
    known = [one for one in halves if one is not None]
    if len(known) < len(halves) or np.ptp(known) > max(known) ** 2 / images.shape[2]:
        return None
    return float(np.mean(known))


def _bending_period_px(images: Images, least: float = 8.0) -> float | None:
    """Period with which rows bend.

    least : power of their rise and fall, over the strongest expected of as many columns without lines; 1 to 2 without

    Interpolation bends at lines: second differences along rows rise and fall with their distance, of 2 to 7 px.
    """
    bent = np.abs(np.diff(images.astype(float), 2, axis=2)).mean(axis=(0, 1))
    smooth = uniform_filter(bent, max(len(bent) // 12, 3), mode="nearest")
    count = 8 * len(bent)
    power = np.abs(np.fft.rfft((bent / np.maximum(smooth, 1e-9) - 1) * np.hanning(len(bent)), count)) ** 2
    first = count // WIDEST_PX  # beyond which grains' own bends are no noise
    top = first + int(power[first:].argmax())
    noise = np.median(power[first:]) / np.log(2)
    return count / top if power[top] > least * noise * np.log(len(bent)) else None


def coefficients(curve: Curve, level_db: float, looks: float) -> Array:
    """Mean, and coefficients : (1 + TERMS,) of a map of a power of a level, whose squares sum to the variance."""
    x, weights = roots_genlaguerre(NODES, looks - 1)
    weights = weights / weights.sum()
    greys = _grey_of(curve, level_db + 10 * np.log10(x / looks))
    return np.array([(weights * _polynomial(k, looks, x) * greys).sum() for k in range(TERMS + 1)])


def grey_correlation(alike: Array, looks: float) -> Array:
    """Correlation of logarithms of powers of looks, whose fields correlate by |rho|; Spence's function for one look."""
    k = np.arange(1, 200)
    terms = np.exp(gammaln(looks) + gammaln(k) - gammaln(looks + k)) / k
    return (np.clip(alike, 0, 1)[..., None] ** (2 * k)) @ terms / terms.sum()


def field_correlation(grey: Array, looks: float) -> Array:
    """The inverse."""
    alike = np.linspace(0, 1, 1001)
    return np.interp(grey, grey_correlation(alike, looks), alike)


def _likelihoods(counts: Array, curve: Curve, level_db: Array, looks: float) -> Array:
    """Log likelihood : (b,) of rows of patches under looks, at the levels that are likeliest with these."""
    moved = np.linspace(-3, 3, 25)
    shares = [np.diff(curve.cumulative(level_db + shift, looks), axis=-1, prepend=0.0) for shift in moved]
    return np.max([(counts * np.log(np.maximum(each, 1e-9))).sum(axis=-1) for each in shares], axis=0).sum(axis=-1)


def half_width(correlation: Array) -> float:
    """Full width, in lags, at half maximum of a correlation at lags of 1, 2, ...; the longest if it stays above."""
    values = np.concatenate([[1.0], correlation])
    below = np.flatnonzero(values < 0.5)
    k = int(below[0]) if len(below) else len(values) - 1
    return float(2 * (k - 1 + min((values[k - 1] - 0.5) / max(values[k - 1] - values[k], 1e-9), 1.0)))


def _polynomial(k: int, looks: float, x: Array) -> Array:
    """Laguerre's polynomial, of variance 1 for a power of looks."""
    scale = np.exp((gammaln(k + looks) - gammaln(looks) - gammaln(k + 1)) / 2)
    return eval_genlaguerre(k, looks - 1, x) / scale


def _grey_of(curve: Curve, power_db: Array) -> Array:
    """Grey of a power."""
    rising = curve.power_db + 1e-9 * np.arange(len(curve.power_db))
    return np.interp(power_db, rising, curve.greys)


def _patches(images: Images, mm_per_px: tuple[float, float], settings: PatchSettings) -> tuple[list[slice], Array]:
    """Rows of the patches, and their histograms : (b, p, 256)."""
    wide, high = (round(size / step) for size, step in zip(settings.size_mm, mm_per_px, strict=True))
    tiles = [slice(top, top + high) for top in range(0, images.shape[1] - high + 1, high)]
    columns = range(0, images.shape[2] - wide + 1, wide)
    counts = [
        [np.bincount(image[tile, left : left + wide].ravel(), minlength=256) for image in images for left in columns]
        for tile in tiles
    ]
    return tiles, np.array(counts, float)


def _grains(values: Array, tiles: list[slice], mm_per_px: tuple[float, float], settings: PatchSettings) -> tuple[Array, Array]:
    """Correlations : (b, m) in depth and : (b, n) along the array of what differs from a patch's mean."""
    (sx, sy), (wide, high) = mm_per_px, settings.size_mm
    slow = np.stack([uniform_filter(image, (round(high / sy), round(wide / sx))) for image in values])
    part = np.zeros((len(values), values.shape[2]), np.int64)
    part[:, values.shape[2] // 2 :] = 1
    grains = speckle.measure(values - slow + 128, mm_per_px, tiles, part, settings.reach_mm)
    return grains.deep, grains.along
