"""The scanner's parameters by its B-scans of even tissue, of the probe in air, and of steps across the image plane.

What shows what; all lengths across the depth are in wavelengths:

- even tissue: greys a dB, so `dynamic_range_db`; frequency x `bandwidth`; `receive_f_number`, and the transmit aperture and focus
  where the beam's waist lies in the tissue; `gain_db` plus the tissue's echo; `tgc_db_per_cm_mhz` less its attenuation
- the probe in air: `face_ring_mm` and `face_ring_db`, and with tissue `noise_db`, unless noise is under the last grey
- even tissue at steps across the plane: `elevation_mm` and `elevation_focus_mm`
- a tank's bottom: its repeats are R x `face_reflection` apart, but clip as the bottom does, and R is of the bottom

All of it rests on raw speckle. Behind a scanner that compounds or smooths, or whose grey map is bent, numbers would be off by up
to 30 standard deviations: they are named as unknown, and grains measured as displayed. Unsharp masks, which scale contrast alone,
look like another dynamic range.

A detected image holds no carrier: the frequency is read off the probe, and its uncertainty goes into all that is known in
wavelengths. The tissue's attenuation and echo are those of the phantom's sheet.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from recon.identification import displayed_speckle, grey_map, sound_beam, speckle
from recon.identification.estimates import Estimate, Findings
from recon.identification.grey_map import Levels, few
from recon.identification.sound_beam import Across, Along
from recon.identification.speckle import Grains

Array = NDArray[np.float64]
Images = NDArray[np.uint8]

NO_CARRIER = "detected images hold no carrier: read off the probe"
USUAL_BAND = 0.5  # of an echo over the frequency, where it isn't known
NO_TISSUE = "no B-scans of even tissue"
WITHIN = np.array([-1, 1]) / np.sqrt(12)  # of a band's depth, from its middle: places whose mean is the band's (Gauss's, two)
REACH_MM = 2.0  # across the plane, within which B-scans may show the same grains


@dataclass(frozen=True)
class Sheet:
    """What is read off the probe, the scanner's screen and the phantom's sheet."""

    mm_per_px: tuple[float, float]  # along the array, in depth, as shown
    frequency_mhz: Estimate  # centre of the echo
    attenuation: Estimate | None = None  # dB/cm/MHz, of the tissue
    echo_db: Estimate | None = None  # of the tissue's backscatter, over 1e-3 /cm/sr
    assumed_speed: float = 1540.0  # m/s


@dataclass(frozen=True)
class Recordings:
    """B-scans : (n, h, w) of one setting of the scanner, uncropped in depth: their first row is the probe's face."""

    tissue: Images | None = None  # even, each at another place
    air: Images | None = None  # of the probe in air
    steps: Images | None = None  # of even tissue, a fraction of the slice apart
    steps_world_from_image: Array | None = None  # (n, 4, 4) mm, their poses
    steps_errors_mm: Array | None = None  # (q, n) of places across the plane: q independent errors of 1 sigma


@dataclass(frozen=True)
class Settings:
    """Bands of the analysis, and what is assumed of scanners."""

    face_mm: float = 4.0  # left out: the ringing of the face
    near_mm: float = 7.0  # from which on a band's beam is that of two depths in it
    level_band_mm: float = 1.5  # over which the mean grey hardly changes
    grain_band_mm: float = 3.0  # over which grains are alike
    reach_mm: float = 1.5  # longest lag
    spread: float = 0.01  # relative error of a dB: speckle of few scatterers a cell has 2 % more or less variance
    level_db: float = 0.4  # error of a tissue's level: of what the gain makes up for besides attenuation
    beam: float = 0.01  # relative error of apertures by the closed forms: two depths for a band, Fresnel's approximation
    interpolated: tuple[float, float] = (1 / 6, 0.096)  # share of a neighbour's echo: evenly from none to twice a linear one's
    seen: float = 0.4  # of what was assumed beforehand: parameters known no better than by this are unknown
    relative: float = 0.3  # worse than by this, they are unknown
    clipped: float = 0.15  # share of black and white pixels in bands that show it, at most
    skew_off: float = 0.06  # of greys' skewness from raw speckle's, beyond which grains aren't raw; raw ones: 0.023 at most
    skew_sigmas: float = 4.0  # the same in standard deviations by bands; smoothed over half a column, it is off by 0.15
    nonblack: float = 0.02  # share of pixels, under which noise is below the last grey
    uneven_db: float = 2.0  # of the tissue's level from place to place, beyond which it isn't even


USUAL = Settings()
LIKELY = {  # mean and standard deviation of the logarithm, of linear arrays: broad, so that what is not seen stays unknown
    "receive_f_number": (np.log(2.2), 0.6),
    "transmit_f_number": (np.log(2.8), 0.6),
    "transmit_focus_mm": (np.log(22.0), 0.6),
    "aperture_mm": (np.log(22.0), 0.6),
    "elevation_mm": (np.log(5.0), 0.5),
    "elevation_focus_mm": (np.log(22.0), 0.6),
}


class _Adjusted(NamedTuple):
    """Parameters and their covariance."""

    values: Array
    covariance: Array
    cost: float

    def sigma(self, number: int) -> float:
        return float(np.sqrt(self.covariance[number, number]))


def identify(recordings: Recordings, sheet: Sheet, settings: Settings = USUAL) -> Findings:
    """Find the parameters of a scanner's description that recordings show, as `ultrasound.*`.

    Depths, widths and speeds are as the scanner shows them: `scale_mm_per_px` and `assumed_speed` are the sheet's.
    """
    found = Findings(unknown={"ultrasound.frequency_mhz": NO_CARRIER})
    if recordings.tissue is None:
        names = ("dynamic_range_db", "bandwidth", "receive_f_number", "gain_db", "tgc_db_per_cm_mhz", "noise_db")
        return found | Findings(unknown={f"ultrasound.{name}": NO_TISSUE for name in names})
    part = speckle.parts(recordings.tissue, sheet.mm_per_px)
    rows = speckle.bands(recordings.tissue.shape[1], sheet.mm_per_px[1], settings.face_mm, settings.level_band_mm)
    levels = _levels(recordings.tissue, rows, part, sheet)
    noise = None if recordings.air is None else air_levels(recordings.air, rows, sheet, levels.greys_a_db)
    uneven = unevenness_db(recordings.tissue, sheet, levels.greys_a_db, settings)
    greys, why = _greys(recordings.tissue, rows, part, levels, uneven, settings)
    found |= greys
    beam, focus = along(recordings.tissue, part, sheet, _share(levels, noise, settings), settings)
    found |= beam
    found |= _gains(levels, noise, focus, sheet, settings)
    if recordings.air is not None:
        found |= face_ring(recordings.air, sheet, levels, settings)
    if recordings.steps is not None and recordings.steps_world_from_image is not None:
        share = _share(levels, noise, settings)
        placed = recordings.steps, recordings.steps_world_from_image, recordings.steps_errors_mm
        found |= across(*placed, sheet, share, found, settings)
    if not why:
        return found
    first = int(settings.face_mm / sheet.mm_per_px[1])
    return _left_out(found, why) | displayed_speckle.summary(recordings.tissue[:, first:], sheet.mm_per_px)


def _left_out(found: Findings, why: str) -> Findings:
    """What would be known of even tissue with raw speckle, as a reason each."""
    seen = {name: f"{why}; else it had come out as {one.value:.3g}" for name, one in found.estimates.items()}
    return Findings(unknown=found.unknown | seen)


def unevenness_db(images: Images, sheet: Sheet, greys_a_db: float, settings: Settings = USUAL) -> float:
    """Standard deviation, dB, of the tissue's level from place to place, of B-scans : (n, h, w), beyond that of its speckle.

    Places are strips of columns by four bands of rows; a strip's own mean, such as of the array's ends, doesn't count.
    """
    rows = speckle.bands(images.shape[1], sheet.mm_per_px[1], settings.face_mm, settings.level_band_mm)
    strips = max(int(images.shape[2] * sheet.mm_per_px[0] / speckle.STRIP_MM), 1)
    edges = np.linspace(0, images.shape[2], strips + 1).astype(int)
    mean = np.array([[images[:, band, a:b].mean(axis=(1, 2)) for a, b in pairwise(edges)] for band in rows]) / greys_a_db
    mean = mean - mean.mean(axis=2, keepdims=True)  # (bands, strips, n)
    four = mean[: len(mean) // 4 * 4].reshape(-1, 4, *mean.shape[1:])
    by_speckle = four.var(axis=1, ddof=1).mean() / 4
    return float(np.sqrt(max(four.mean(axis=1).var() - by_speckle, 0.0)))


def _levels(images: Images, rows: list[slice], part: NDArray[np.int64], sheet: Sheet) -> Levels:
    counts = grey_map.histograms(images, rows, part)
    return grey_map.fit_line(_middles(rows, sheet.mm_per_px[1]), counts)


def _middles(rows: list[slice], row_mm: float) -> Array:
    return np.array([row_mm * (band.start + band.stop - 1) / 2 for band in rows])


def air_levels(images: Images, rows: list[slice], sheet: Sheet, greys_a_db: float) -> Levels:
    """Levels of the noise in bands of rows, of B-scans : (n, h, w) of the probe in air; minus infinity under the last grey."""
    width = images.shape[2]
    part = 4 * np.arange(len(images))[:, None] + 4 * np.arange(width) // width
    counts = grey_map.histograms(images, rows, part)
    found = grey_map.fit_line(_middles(rows, sheet.mm_per_px[1]), counts, greys_a_db)
    seen = 1 - counts[..., 0].sum(axis=0) / counts.sum(axis=(0, 2)) > USUAL.nonblack
    return found._replace(level_db=np.where(seen, found.level_db, -np.inf))


def _share(levels: Levels, noise: Levels | None, settings: Settings) -> Callable[[Array], Array]:
    """Share of the power that is the tissue's, by depth."""
    if noise is None:
        return lambda depth: np.ones_like(depth)
    share = np.clip(1 - 10 ** ((noise.level_db - levels.level_db) / 10), 0.01, 1)
    return lambda depth: np.interp(depth, levels.depth_mm, share)


def _greys(
    images: Images, rows: list[slice], part: NDArray[np.int64], levels: Levels, uneven_db: float, settings: Settings
) -> tuple[Findings, str]:
    """The grey map; and why nothing can be told, if tissue is uneven or grains aren't raw: skewed by other than a logarithm."""
    counts = grey_map.histograms(images, rows, part).sum(axis=0)
    clipped = (counts[:, 0] + counts[:, -1]) / counts.sum(axis=1)
    seen = clipped < settings.clipped
    name = "ultrasound.dynamic_range_db"
    if seen.sum() < 4:
        return Findings(unknown={name: "too much of the tissue is black or white to see whether its grains are raw"}), ""
    if uneven_db > settings.uneven_db:
        why = f"the tissue isn't even: its level differs by {uneven_db:.1f} dB from place to place"
        return Findings(unknown={name: why}), "the tissue isn't even"
    skewed, raw = (grey_map.skewness(shares[seen]) for shares in (counts, levels.shares()))
    off = float((skewed - raw).mean())
    error = float((skewed - raw).std(ddof=1) / np.sqrt(seen.sum()))
    if abs(off) > max(settings.skew_off, settings.skew_sigmas * error):
        why = f"grains aren't raw speckle, or the grey map is bent: skewed by {skewed.mean():.2f}, not {raw.mean():.2f}; "
        return Findings(
            unknown={name: why + f"if they were raw, a dB had {levels.greys_a_db:.2f} greys"}
        ), "grains aren't raw speckle"
    widened = (uneven_db / speckle.SPREAD_DB) ** 2 / 2  # of the spread, by levels that differ
    relative = float(np.linalg.norm([np.sqrt(levels.covariance[0, 0]), settings.spread, widened]))
    source = f"spread of the greys of {len(images)} B-scans of even tissue"
    return Findings({name: Estimate(levels.dynamic_range_db, levels.dynamic_range_db * relative, source)}), ""


def along(
    images: Images, part: NDArray[np.int64], sheet: Sheet, share: Callable[[Array], Array], settings: Settings = USUAL
) -> tuple[Findings, Estimate | None]:
    """Bandwidth and the beam along the array by grains : images (n, h, w); and the transmit focus, where it is seen.

    part : (n, w) of `speckle.parts`
    share : of the power that is the tissue's, by depth
    """
    sx, sy = sheet.mm_per_px
    rows = speckle.bands(images.shape[1], sy, settings.face_mm, settings.grain_band_mm)
    grains = speckle.measure(images, sheet.mm_per_px, rows, part, settings.reach_mm)
    source = f"grains of {len(images)} B-scans of even tissue"
    if len(grains.depth_mm) < 3:
        why = "too much of the tissue is black or white"
        names = ("bandwidth.0", "bandwidth.1", "receive_f_number", "transmit_f_number", "transmit_focus_mm", "aperture_mm")
        return Findings(unknown={f"ultrasound.{name}": why for name in names}), None
    known = share(grains.depth_mm)
    found = _band(grains, sy, sy * (images.shape[1] - 1), known, sheet, settings, source)
    deep = grains.depth_mm >= settings.near_mm
    if deep.sum() < 3:
        return found, None
    far = grains._replace(
        depth_mm=grains.depth_mm[deep],
        black=grains.black[deep],
        along=grains.along[deep],
        along_without=grains.along_without[:, deep],
    )
    beam, focus = _beam(far, sx, known[deep], sheet, settings, source)
    return found | beam, focus


def _band(grains: Grains, row_mm: float, end_mm: float, share: Array, sheet: Sheet, settings: Settings, source: str) -> Findings:
    """Bandwidth at the face and at the image's end, by the grains' length in depth."""
    lags = row_mm * np.arange(1, grains.deep.shape[1] + 1)

    def correlations(theta: Array, told: Array) -> Array:
        near, far = np.exp(theta)
        band = near + (far - near) * grains.depth_mm / end_mm
        alike = [
            sound_beam.interpolated(partial(sound_beam.alike_deep, own, sheet.assumed_speed), lags, row_mm / 2, told[0])
            for own in band
        ]
        return share[:, None] * np.array(alike)[None]

    f = sheet.frequency_mhz
    prior = np.array([[np.log(0.6 * f.value), 0.6], [np.log(0.5 * f.value), 0.6]])
    given = np.array([settings.interpolated])
    lags_seen = _informative(grains.deep)
    lags = lags[lags_seen]
    seen = grains.deep[:, lags_seen], grains.deep_without[..., lags_seen], grains.black
    fit = _adjusted(correlations, *seen, prior, given, [prior[:, 0]])
    estimates, unknown = {}, {}
    for number in (0, 1):
        name = f"ultrasound.bandwidth.{number}"
        product, sigma = float(np.exp(fit.values[number])), fit.sigma(number)
        if sigma > settings.relative or sigma > settings.seen * 0.6:
            unknown[name] = f"grains are shorter than a row of {row_mm:.3f} mm: frequency x bandwidth {product:.2g} MHz or more"
        else:
            relative = np.hypot(sigma, f.sigma / f.value)
            note = f"{source}, and the frequency: their product is {product:.3g} MHz to {100 * sigma:.1f} %"
            estimates[name] = Estimate(product / f.value, product / f.value * relative, note)
    return Findings(estimates, unknown)


def _beam(
    grains: Grains, column_mm: float, share: Array, sheet: Sheet, settings: Settings, source: str
) -> tuple[Findings, Estimate | None]:
    """Apertures and focus, by the grains' width along the array over depth."""
    names = ("receive_f_number", "transmit_f_number", "transmit_focus_mm", "aperture_mm")
    chosen = _informative(grains.along)
    lags = column_mm * (chosen + 1)
    f = sheet.frequency_mhz

    def correlations(theta: Array, told: Array) -> Array:
        receive, transmit, focus, widest = np.exp(theta)
        beam = Along(1e-3 * sheet.assumed_speed / np.exp(told[0]), focus, transmit, receive, widest)
        alike = [
            [sound_beam.interpolated(sound_beam.alike_along(beam, depth), lags, column_mm, told[1]) for depth in places]
            for places in grains.depth_mm + WITHIN[:, None] * settings.grain_band_mm
        ]
        return share[:, None] * np.array(alike)

    prior = np.array([LIKELY[name] for name in names])
    given = np.array([(np.log(f.value), f.sigma / f.value), settings.interpolated])
    starts = []
    for focus in (10.0, 16.0, 23.0, 32.0):
        for receive, transmit in ((1.8, 3.5), (2.6, 2.4)):
            starts.append(prior[:, 0].copy())
            starts[-1][:3] = np.log([receive, transmit, focus])
    seen = grains.along[:, chosen], grains.along_without[..., chosen], grains.black
    fit = _adjusted(correlations, *seen, prior, given, starts)
    estimates, unknown = {}, {}
    for number, name in enumerate(names):
        value, sigma = float(np.exp(fit.values[number])), fit.sigma(number)
        if sigma > min(settings.relative, settings.seen * LIKELY[name][1]):
            unknown[f"ultrasound.{name}"] = f"grains' widths over depth hardly depend on it: {value:.2g} to {100 * sigma:.0f} %"
        else:
            relative = float(np.hypot(sigma, settings.beam))
            estimates[f"ultrasound.{name}"] = Estimate(value, value * relative, source + ", and the frequency")
    return Findings(estimates, unknown), estimates.get("ultrasound.transmit_focus_mm")


def _informative(grey: Array) -> NDArray[np.int64]:
    """Numbers of lags up to the one after which grains have nothing in common; twelve at most."""
    low = np.flatnonzero(grey.mean(axis=0) < 0.04)
    last = min(int(low[0]) + 1 if len(low) else grey.shape[1], grey.shape[1])
    return np.unique(np.linspace(0, last - 1, min(last, 12)).astype(int))


def _adjusted(
    correlations: Callable[[Array, Array], Array],
    grey: Array,
    without: Array,
    black: Array,
    prior: Array,
    given: Array,
    starts: list[Array],
    by_band: bool = False,
) -> _Adjusted:
    """Fit field correlations : (d, b, m), at d places of a band, of parameters : (p,) and of what is given : (q,) to grey ones.

    Parameters
    ----------
    without : (k, b, m), grey correlations without a part each, whose scatter is the noise
    black : (b,) share of black pixels
    prior : (p, 2) mean and standard deviation of what was assumed of the parameters
    given : (q, 2) the same of what isn't fitted: small errors of the model would tell more of it than a label does
    by_band : whether parts of a band are independent of those of others, or go with them
    """
    k, told = len(without), given[:, 0]
    apart = without - without.mean(axis=0)
    shared = np.einsum("kbm,kbn->mn", apart, apart) * (k - 1) / k / len(grey)  # of a band's lags, alike in all bands
    shared = 0.85 * shared + (0.15 * np.diag(shared) + 1e-6) * np.eye(len(shared))
    whiten = np.linalg.inv(np.linalg.cholesky(shared))

    def residuals(theta: Array, told: Array = told) -> Array:
        alike = [speckle.grey_correlation(places, black) for places in correlations(theta, told)]
        rest = (np.mean(alike, axis=0) - grey) @ whiten.T
        return np.concatenate([rest.ravel(), (theta - prior[:, 0]) / prior[:, 1]])

    follow = partial(least_squares, residuals, method="trf", x_scale=prior[:, 1], ftol=1e-6)
    begun = sorted((follow(start, max_nfev=4) for start in starts), key=lambda fit: fit.cost)  # starts' own costs mislead
    best = min((follow(fit.x, max_nfev=25) for fit in begun[:2]), key=lambda fit: fit.cost)
    inverse = np.linalg.inv(best.jac.T @ best.jac)
    data = best.jac[: -len(prior)].reshape(*grey.shape, -1)
    moved = np.einsum("kbm,bmp->kbp", apart @ whiten.T, data) @ inverse
    moved, freedom = (moved.reshape(-1, len(prior)), (k - 1) * len(grey)) if by_band else (moved.sum(axis=1), k - 1)
    covariance = moved.T @ moved * (k - 1) / k * few(freedom) ** 2
    slopes = [(residuals(best.x, told + step) - residuals(best.x, told - step)) / 2 for step in np.diag(given[:, 1])]
    by_given = inverse @ best.jac.T @ np.transpose(slopes)  # of one standard deviation each
    covariance += by_given @ by_given.T + inverse @ np.diag(1 / prior[:, 1] ** 2) @ inverse
    return _Adjusted(best.x, covariance, float(best.cost))


def _gains(levels: Levels, noise: Levels | None, focus: Estimate | None, sheet: Sheet, settings: Settings) -> Findings:
    """Gain, gain over depth and noise by the levels of tissue and of air."""
    names = {name: f"ultrasound.{name}" for name in ("gain_db", "tgc_db_per_cm_mhz", "tgc_limit_db", "noise_db")}
    beneath = np.full(len(levels.depth_mm), -np.inf) if noise is None else noise.level_db
    tissue_power = 10 ** (levels.level_db / 10) - 10 ** (beneath / 10)
    clear = tissue_power > 0.2 * 10 ** (levels.level_db / 10)
    unclipped = (levels.level_db < -8) & (levels.level_db > -levels.dynamic_range_db + 12)
    used = np.flatnonzero(clear & unclipped)
    if len(used) < 4:
        return Findings(unknown=dict.fromkeys(names.values(), "too much of the tissue is black, white, or noise"))
    depth, level = levels.depth_mm[used], 10 * np.log10(tissue_power[used])
    grown = 10 ** (levels.level_db[used] / 10) / tissue_power[used]
    covariance = levels.covariance[1:, 1:][np.ix_(used, used)] * np.outer(grown, grown)
    line, line_covariance, bend = _line(depth, level, covariance)
    line_covariance[0, 0] += (settings.spread * line[0]) ** 2 + settings.level_db**2
    line_covariance[1, 1] += (settings.spread * line[1]) ** 2
    estimates, unknown = {}, {}
    source = "levels of even tissue"
    f, absorbed, echo = sheet.frequency_mhz, sheet.attenuation, sheet.echo_db
    if bend > 3.0:
        why = f"the tissue's level doesn't change evenly with depth, by {bend:.1f} dB: the limit of the gain, sliders, or layers"
        unknown[names["tgc_db_per_cm_mhz"]] = unknown[names["gain_db"]] = why
    elif absorbed is None:
        why = f"gain less attenuation is {5 * line[1]:.3f} dB/cm one way; the tissue's attenuation isn't given"
        unknown[names["tgc_db_per_cm_mhz"]] = why
    else:
        more = 5 * line[1] / f.value
        sigma = np.sqrt(absorbed.sigma**2 + 25 * line_covariance[1, 1] / f.value**2 + (more * f.sigma / f.value) ** 2)
        estimates[names["tgc_db_per_cm_mhz"]] = Estimate(float(absorbed.value + more), float(sigma), source + " over depth")
        unknown[names["tgc_limit_db"]] = f"the level is even down to {depth[-1]:.0f} mm: the limit is higher than what is used"
    if names["gain_db"] not in unknown:
        if echo is None:
            unknown[names["gain_db"]] = f"gain and the tissue's echo together are {line[0]:.1f} dB; its echo isn't given"
        else:
            sigma = float(np.hypot(np.sqrt(line_covariance[0, 0]), echo.sigma))
            estimates[names["gain_db"]] = Estimate(float(line[0] - echo.value), sigma, source)
    noisy = _noise(levels, noise, line, line_covariance, focus, sheet)
    if isinstance(noisy, str):
        unknown[names["noise_db"]] = noisy
    else:
        estimates[names["noise_db"]] = noisy
    return Findings(estimates, unknown)


def _line(depth: Array, level: Array, covariance: Array) -> tuple[Array, Array, float]:
    """Level at the face and slope : (2,) over depth, their covariance, and how far a smooth curve departs from the line, dB."""
    weight = 1 / np.diag(covariance)
    design = np.column_stack([np.ones_like(depth), depth])
    solve = np.linalg.inv(design.T @ (weight[:, None] * design)) @ (design.T * weight)
    line = solve @ level
    x = (depth - depth.mean()) / np.ptp(depth)
    bend = np.polynomial.polynomial.polyfit(x, level - design @ line, 2, w=np.sqrt(weight))[2] / 4
    return line, solve @ covariance @ solve.T, float(abs(bend))


def _noise(
    levels: Levels, noise: Levels | None, line: Array, covariance: Array, focus: Estimate | None, sheet: Sheet
) -> Estimate | str:
    """Noise under the tissue at the transmit focus, without its attenuation; or why it isn't known."""
    if noise is None:
        return "no B-scans of the probe in air"
    seen = np.isfinite(noise.level_db)
    if seen.sum() < 3:
        return f"noise is under the last grey: less than {-levels.dynamic_range_db:.0f} dB under white"
    if sheet.attenuation is None or sheet.echo_db is None:
        return "the tissue's attenuation and echo aren't given"
    if focus is None:
        return "the transmit focus isn't known"
    depth, f, absorbed = focus.value, sheet.frequency_mhz, sheet.attenuation
    if not levels.depth_mm[seen][0] - 2 < depth < levels.depth_mm[seen][-1] + 2:
        return f"at the focus, {depth:.0f} mm deep, noise is under the last grey"
    fit = np.polynomial.polynomial.polyfit(noise.depth_mm[seen], noise.level_db[seen], min(2, int(seen.sum()) - 1))
    there = float(np.polynomial.polynomial.polyval(depth, fit))
    rest = noise.level_db[seen] - np.polynomial.polynomial.polyval(noise.depth_mm[seen], fit)
    slope = float(np.polynomial.polynomial.polyval(depth, np.polynomial.polynomial.polyder(fit)))
    lost = 0.2 * absorbed.value * f.value  # dB a mm
    tissue = line[0] + line[1] * depth + lost * depth - sheet.echo_db.value
    sigma = np.sqrt(
        covariance[0, 0]
        + 2 * depth * covariance[0, 1]
        + depth**2 * covariance[1, 1]
        + (lost * depth) ** 2 * ((absorbed.sigma / max(absorbed.value, 1e-9)) ** 2 + (f.sigma / f.value) ** 2)
        + sheet.echo_db.sigma**2
        + ((slope - line[1] - lost) * focus.sigma) ** 2
        + rest.std() ** 2
        + (USUAL.spread * (there - line[0])) ** 2
    )
    return Estimate(there - float(tissue), float(sigma), "levels of the probe in air and of even tissue at the focus")


def face_ring(images: Images, sheet: Sheet, levels: Levels, settings: Settings = USUAL) -> Findings:
    """Ringing of the face in air : (n, h, w), by the first rows that are neither white nor noise: an exponential with a ripple.

    Source: its decay is a line in dB; a standing wave's ripple is let free.
    """
    names = ("ultrasound.face_ring_mm", "ultrasound.face_ring_db")
    rows = int(2.5 * settings.face_mm / sheet.mm_per_px[1])
    greys = images[:, :rows].astype(float)
    mean = greys.mean(axis=(0, 2))
    floor = mean[-rows // 4 :].mean() + 10 * levels.greys_a_db
    white = np.flatnonzero(mean > 250)
    first = int(white[-1]) + 1 if len(white) else 0
    low = np.flatnonzero(mean[first:] < max(floor, 6.0))
    last = first + (int(low[0]) if len(low) else rows - first)
    if last - first < 5:
        return Findings(unknown=dict.fromkeys(names, f"{last - first} rows show it between white and noise"))
    depth = sheet.mm_per_px[1] * np.arange(first, last)
    db = (mean[first:last] - 255) / levels.greys_a_db

    def rest(theta: Array) -> Array:
        ripple = 1 + np.tanh(theta[2]) * np.cos(2 * np.pi * depth / np.exp(theta[3]) + theta[4])
        return theta[0] - 8.686 * depth / np.exp(theta[1]) + 20 * np.log10(np.maximum(ripple, 1e-3)) - db

    def residuals(theta: Array) -> Array:
        return np.r_[rest(theta) / 0.3, (theta[2] - 0.3) / 0.3, theta[4] / 1.5]

    slope, start = np.polynomial.polynomial.polyfit(depth, db, 1)[::-1]
    if slope >= 0:
        return Findings(unknown=dict.fromkeys(names, "what the first rows show doesn't fade"))
    periods = np.geomspace(4 * sheet.mm_per_px[1], max(2 * np.ptp(depth), 6 * sheet.mm_per_px[1]), 10)
    fits = [
        least_squares(residuals, [start, np.log(-8.686 / slope), 0.3, np.log(period), 0.0], max_nfev=60) for period in periods
    ]
    best = min(fits, key=lambda fit: fit.cost)
    freedom = max(len(depth) - 5, 1)
    scale = max(1.0, 2 * best.cost / freedom)
    covariance = np.linalg.pinv(best.jac.T @ best.jac) * scale
    relative = float(np.hypot(np.sqrt(covariance[1, 1]), settings.spread))
    ring, level = float(np.exp(best.x[1])), float(best.x[0])
    if relative > settings.relative:
        return Findings(unknown=dict.fromkeys(names, f"too few rows show it: {ring:.2f} mm to {100 * relative:.0f} %"))
    source = f"{len(depth)} rows of {len(images)} B-scans in air"
    return Findings(
        {
            names[0]: Estimate(ring, ring * relative, source),
            names[1]: Estimate(level, float(np.hypot(np.sqrt(covariance[0, 0]), settings.spread * 20)), source),
        }
    )


def across(
    images: Images,
    world_from_image: Array,
    errors_mm: Array | None,
    sheet: Sheet,
    share: Callable[[Array], Array],
    found: Findings,
    settings: Settings = USUAL,
) -> Findings:
    """Height and focus of the elements by what is left of grains after steps across the plane.

    Parameters
    ----------
    world_from_image : (n, 4, 4) mm, of B-scans : (n, h, w) that are parallel, side by side
    errors_mm : (q, n) of their places, as of `Recordings`
    found : with the bandwidth, if that is known
    """
    names = ("elevation_mm", "elevation_focus_mm")
    offset = world_from_image[:, :3, 3] - world_from_image[0, :3, 3]
    local = offset @ world_from_image[0, :3, :3]
    first, second = np.nonzero(np.abs(local[:, None, 2] - local[:, 2]) < REACH_MM)
    turned = np.abs(world_from_image[first, :3, :3] - world_from_image[second, :3, :3]).max()
    if np.abs(local[first, :2] - local[second, :2]).max() > 0.1 or turned > 0.005:
        why = "B-scans aren't parallel side by side, within 0.1 mm and 0.3 degrees: other shifts take their share of the grains"
        return Findings(unknown={f"ultrasound.{name}": why for name in names})
    rows = speckle.bands(images.shape[1], sheet.mm_per_px[1], settings.face_mm, settings.grain_band_mm)
    rows = [band for band in rows if ((images[:, band] == 0) | (images[:, band] == 255)).mean() < speckle.CLIPPED]
    steps, grey, without = speckle.across(images, local[:, 2], sheet.mm_per_px, rows)
    shifts = speckle.lag_errors(local[:, 2], np.zeros((0, len(images))) if errors_mm is None else errors_mm)
    near = (steps > 0.02) & (steps < REACH_MM)
    if near.sum() < 3 or len(rows) < 3 or not (grey[:, near] > 0.1).any():
        return Findings(unknown={f"ultrasound.{name}": "no two B-scans show the same grains" for name in names})
    depth, steps, shifts = _middles(rows, sheet.mm_per_px[1]), steps[near], shifts[:, near]
    known, f = share(depth), sheet.frequency_mhz
    end = sheet.mm_per_px[1] * (images.shape[1] - 1)
    ends = [
        found.estimates[name].value for name in ("ultrasound.bandwidth.0", "ultrasound.bandwidth.1") if name in found.estimates
    ]
    band = np.interp(depth, [0, end], ends if len(ends) == 2 else [USUAL_BAND, USUAL_BAND])

    def correlations(theta: Array, told: Array) -> Array:
        slab = Across(1e-3 * sheet.assumed_speed / float(np.exp(told[0])), *np.exp(theta))
        alike = [
            [sound_beam.alike_across(slab, each, steps + told[1:] @ shifts, own) for each, own in zip(places, band, strict=True)]
            for places in depth + WITHIN[:, None] * settings.grain_band_mm
        ]
        return known[:, None] * np.array(alike)

    prior = np.array([LIKELY[name] for name in names])
    given = np.array([(np.log(f.value), f.sigma / f.value), *[(0.0, 1.0)] * len(shifts)])
    starts = [np.log([height, focus]) for height in (3.3, 4.6, 6.5) for focus in (12.0, 16.0, 21.0, 28.0)]
    black = np.array([(images[:, band] == 0).mean() for band in rows])
    fit = _adjusted(correlations, grey[:, near], without[..., near], black, prior, given, starts, by_band=True)
    estimates, unknown = {}, {}
    for number, name in enumerate(names):
        value, sigma = float(np.exp(fit.values[number])), fit.sigma(number)
        if sigma > settings.seen * LIKELY[name][1]:
            unknown[f"ultrasound.{name}"] = f"grains hardly depend on it: {value:.2g} mm to {100 * sigma:.0f} %"
        else:
            source = f"grains of {len(images)} B-scans side by side, and the frequency"
            estimates[f"ultrasound.{name}"] = Estimate(value, value * float(np.hypot(sigma, settings.beam)), source)
    return Findings(estimates, unknown)


def dark_columns(images: Images, sigmas: float = 6.0) -> Mapping[int, Estimate]:
    """Columns darker than those beside them in all B-scans : (n, h, w), as of dead elements, and their greys below these.

    Tissue moves on from image to image, columns stay: the scatter from image to image is the noise.
    """
    mean = images.astype(float).mean(axis=1)
    padded = np.pad(mean, [(0, 0), (4, 4)], mode="edge")
    sides = [np.median([padded[:, k : k + mean.shape[1]] for k in side], axis=0) for side in ((0, 1, 2), (6, 7, 8))]
    below = np.minimum(*sides) - mean  # of both sides: towards the array's ends, images get darker
    middle = below.mean(axis=0)
    spread = below.std(axis=0, ddof=1) / np.sqrt(len(below)) * few(len(below) - 1)
    spread = np.maximum(spread, np.median(spread))
    source = f"{len(images)} B-scans"
    dark = np.flatnonzero(middle > sigmas * spread)
    return {int(column): Estimate(float(middle[column]), float(spread[column]), source) for column in dark}
