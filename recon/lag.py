"""Time calibration: by how much the scanner's images lag behind the poses, from an up-and-down motion over a flat bottom.

The bottom's depth in the image follows the probe's height: `depth(t) = a + b height(t - lag)`. Both streams have time stamps of
their own, so neither jitter nor dropped frames matter beyond the errors that they are: the height is interpolated at the moment
that each image was taken. Wanted is an offset of the clocks and delays together; where the clocks drift against each other by
50 ppm it changes by 3 ms a minute, so calibrate anew for long sessions.

Move the probe by 10 mm or more, three times or more, at an uneven pace: a motion that repeats itself fits at more than one lag.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import stats
from scipy.interpolate import CubicSpline

from recon import tracks
from recon.errors import InputError
from recon.tracks import Track

Array = NDArray[np.float64]

SEARCH_S = (-0.5, 0.5)
STEP_S = 0.01  # of the search
MIN_FRAMES = 20
MIN_RANGE_MM = 4.0  # of the motion, between its 5th and 95th percentile
MIN_OVERLAP = 0.6  # of the images with a pose
MIN_CORRELATION = 0.6  # of depth and height, by ranks, outliers among them
MIN_AGREEMENT = 0.95  # their correlation without outliers
MAX_OUTLIERS = 0.4  # of the images
RIVAL = 0.98  # correlation of another lag, over the best, that makes the motion ambiguous
VALLEY = 0.8  # correlation between two such lags, over the best, that tells them apart
GATE = 4.0  # normalised residual of an outlier
COVERAGE = 0.95  # of the interval
BLOCK_PX = 8  # columns taken together
BOTTOM_SIGMA_PX = 1.5  # smoothing in depth
BOTTOM_CONTRAST = 30.0  # grey levels above the median of its columns
BOTTOM_NEAR_PX = 3.0  # of the line
BOTTOM_SHARE = 0.5  # of the columns that show it


@dataclass(frozen=True)
class Lag:
    """How late the images' time stamps are: an image stamped t shows the probe as it stood at t - lag, of the poses' clock."""

    seconds: float
    sigma_s: float
    interval_s: tuple[float, float]  # of 95 %
    jitter_s: float  # of the time stamps: what of the residuals grows with speed
    depth_sigma: float  # what doesn't, in units of the depths
    used: NDArray[np.bool_]  # (n,) images: with a pose and a depth, and no outlier
    residuals: Array  # (n,) in units of the depths; NaN without a pose or a depth


def estimate(times: NDArray[np.int64], depths: Array, track: Track, search_s: tuple[float, float] = SEARCH_S) -> Lag:
    """Estimate the lag of an image stream.

    Parameters
    ----------
    times : (n,) int64, ns
        Of the images, of their own clock.
    depths : (n,) float
        Of the bottom in each image, in any unit, as of `bottom_depth`; NaN where it isn't seen.
    search_s : (first, last) s
        Lags looked at. Where the clocks have nothing to do with each other, give the difference of their starts, and around it as
        much as is unsure.

    Raises
    ------
    InputError
        If there are too few images or poses, the motion is too small or repeats itself, the depths don't follow it at any lag, or
        the best lag lies at the end of the search.
    """
    times, depths = np.asarray(times), np.asarray(depths, float)
    seen = np.isfinite(depths)
    if seen.sum() < MIN_FRAMES:
        raise InputError(f"depths: expected at least {MIN_FRAMES} images that show the bottom, found {seen.sum()}")
    if track.found.sum() < MIN_FRAMES:
        raise InputError(f"track: expected at least {MIN_FRAMES} poses, found {track.found.sum()}")
    heights = _heights(track)
    origin = int(track.times[0])
    seconds = (times - origin) * 1e-9
    moments = (track.times[track.found] - origin) * 1e-9
    start = _search(seconds[seen], depths[seen], moments, heights, search_s)
    return _refined(seconds, depths, moments, CubicSpline(moments, heights), start)


def poses_at(track: Track, times: NDArray[np.int64], lag: Lag | float) -> Array:
    """Poses : (n, 4, 4) at which images of time stamps : (n,) ns were taken; NaN where the track has a gap."""
    seconds = lag.seconds if isinstance(lag, Lag) else lag
    return tracks.at(track, np.asarray(times, np.int64) - np.int64(round(seconds * 1e9)))


def bottom_depth(image: NDArray, top_px: int = 40) -> float:
    """Depth in px of a flat bottom at the middle column of a B-scan : (h, w), 8-bit; NaN if there is none.

    Every few columns the brightest echo below `top_px` counts, where reverberation at the probe's face ends; the line is the one
    that most columns agree on.
    """
    level = np.asarray(image, np.float32)
    blocks = level.shape[1] // BLOCK_PX
    profiles = level[:, : blocks * BLOCK_PX].reshape(level.shape[0], blocks, BLOCK_PX).mean(axis=2)
    profiles = cv2.GaussianBlur(profiles, (1, 0), sigmaX=1e-6, sigmaY=BOTTOM_SIGMA_PX) if blocks else profiles
    below = profiles[top_px:-1]
    if blocks < 4 or len(below) < 8:
        return np.nan
    rows = below.argmax(axis=0) + top_px
    columns = np.arange(blocks)
    before, peak, after = profiles[rows - 1, columns], profiles[rows, columns], profiles[rows + 1, columns]
    bend = np.minimum(before - 2 * peak + after, -1e-3)
    v = rows + np.clip((before - after) / (2 * bend), -0.5, 0.5)
    u = (columns + 0.5) * BLOCK_PX - 0.5 - (level.shape[1] - 1) / 2
    clear = (peak - np.median(profiles, axis=0) > BOTTOM_CONTRAST) & (rows > top_px)
    if clear.sum() < BOTTOM_SHARE * blocks:
        return np.nan
    return _line_at_zero(u[clear], v[clear], blocks)


def _line_at_zero(u: Array, v: Array, blocks: int) -> float:
    """Where the line that most points are near passes u = 0; NaN if too few are."""
    first, second = np.triu_indices(len(u), 1)
    slopes = (v[second] - v[first]) / (u[second] - u[first])
    starts = v[first] - slopes * u[first]
    near = np.abs(v - starts[:, None] - slopes[:, None] * u) < BOTTOM_NEAR_PX
    agreed = near[near.sum(axis=1).argmax()]
    if agreed.sum() < BOTTOM_SHARE * blocks:
        return np.nan
    return float(np.polynomial.polynomial.polyfit(u[agreed], v[agreed], 1)[0])


def _heights(track: Track) -> Array:
    """Where the probe stands along the main direction of its motion : (n,) mm, of the poses that were found."""
    places = track.poses[track.found, :3, 3]
    direction = np.linalg.svd(places - places.mean(axis=0), full_matrices=False)[2][0]
    heights = (places - places.mean(axis=0)) @ direction
    extent = np.subtract(*np.percentile(heights, [95, 5]))
    if extent < MIN_RANGE_MM:
        raise InputError(f"track: expected an up-and-down motion of at least {MIN_RANGE_MM:g} mm, found {extent:.1f} mm")
    return heights


def _within(moments: Array, wanted: Array) -> NDArray[np.bool_]:
    """Whether there are poses on both sides of a moment, near enough."""
    after = np.clip(np.searchsorted(moments, wanted), 1, len(moments) - 1)
    near = moments[after] - moments[after - 1] <= tracks.MAX_GAP_S
    return near & (wanted >= moments[0]) & (wanted <= moments[-1])


def _search(seconds: Array, depths: Array, moments: Array, heights: Array, search_s: tuple[float, float]) -> float:
    """The lag at which ranks of depth and height agree best."""
    lags = np.arange(search_s[0], search_s[1] + STEP_S / 2, STEP_S)
    agreement = np.zeros(len(lags))
    overlap = np.zeros(len(lags))
    for k, lag in enumerate(lags):
        inside = _within(moments, seconds - lag)
        overlap[k] = inside.mean()
        if inside.sum() >= MIN_FRAMES and overlap[k] >= MIN_OVERLAP:
            agreement[k] = abs(stats.spearmanr(depths[inside], np.interp(seconds[inside] - lag, moments, heights)).statistic)
    agreement = np.nan_to_num(agreement)
    if overlap.max() < MIN_OVERLAP:
        found = f"{100 * overlap.max():.0f} % at most: are the clocks others?"
        raise InputError(f"times: expected poses at {100 * MIN_OVERLAP:.0f} % of the images or more, found {found}")
    best = int(agreement.argmax())
    if agreement[best] < MIN_CORRELATION:
        found = f"a correlation of {agreement[best]:.2f} at most"
        raise InputError(f"depths: expected them to follow the probe's height, found {found}")
    if best in (0, len(lags) - 1):
        found = f"the best at its end, {lags[best]:g} s"
        raise InputError(f"search_s: expected the lag within {search_s[0]:g} to {search_s[1]:g} s, found {found}")
    alike = np.flatnonzero(agreement > RIVAL * agreement[best])
    rivals = [k for k in alike if agreement[min(k, best) : max(k, best) + 1].min() < VALLEY * agreement[best]]
    if rivals:
        found = f"one that repeats itself: {lags[best]:.2f} s and {lags[rivals[0]]:.2f} s fit alike"
        raise InputError(f"track: expected a motion at an uneven pace, found {found}")
    return float(lags[best])


def _refined(seconds: Array, depths: Array, moments: Array, spline: CubicSpline, start: float) -> Lag:
    """Weighted least squares over a, b and the lag, with variances of depth and of time that the residuals tell."""
    lag, speed = start, spline.derivative()
    used = np.isfinite(depths) & _within(moments, seconds - lag)
    variance = np.ones(len(depths))
    constant = slope = 0.0
    jitter = depth_variance = 0.0
    design, residuals = np.zeros((len(depths), 3)), np.full(len(depths), np.nan)
    for round_ in range(15):
        inside = np.isfinite(depths) & _within(moments, seconds - lag)
        heights = spline(seconds - lag)
        weights = np.where(used & inside, 1 / variance, 0)
        root = np.sqrt(weights)
        line = np.column_stack([np.ones_like(heights), heights])
        filled = np.where(np.isfinite(depths), depths, 0)
        if round_ == 0:
            constant, slope = stats.theilslopes(depths[used], heights[used])[1::-1]
        design = np.column_stack([line, -slope * speed(seconds - lag)])
        step = np.linalg.lstsq(design * root[:, None], (filled - constant - slope * heights) * root, rcond=None)[0]
        constant, slope, lag = constant + step[0], slope + step[1], lag + float(np.clip(step[2], -0.05, 0.05))
        residuals = np.where(inside, depths - constant - slope * spline(seconds - lag), np.nan)
        rates = (slope * speed(seconds - lag)) ** 2
        spread = 1.4826 * np.nanmedian(np.abs(residuals))
        near = inside & (np.abs(residuals) < (8 * spread if round_ < 3 else GATE * np.sqrt(variance)))
        depth_variance, jitter = _two_variances(residuals[near], rates[near], spread)
        variance = depth_variance + jitter**2 * rates
        used = inside & (np.abs(residuals) < GATE * np.sqrt(variance))
        if used.sum() < MIN_FRAMES:
            raise InputError(f"depths: expected at least {MIN_FRAMES} images that agree on a lag, found {used.sum()}")
        if round_ > 4 and abs(step[2]) < 1e-7:
            break
    _agree(heights, depths, inside, used)
    sigma = _sigma(design[used], residuals[used], 1 / variance[used])
    reach = float(stats.t.ppf((1 + COVERAGE) / 2, used.sum() - 3)) * sigma
    return Lag(lag, sigma, (lag - reach, lag + reach), jitter, float(np.sqrt(depth_variance)), used, residuals)


def _agree(heights: Array, depths: Array, inside: NDArray[np.bool_], used: NDArray[np.bool_]) -> None:
    """Refuse depths that don't follow the height, or of which too many don't."""
    outliers = 1 - used.sum() / inside.sum()
    agreement = abs(np.corrcoef(heights[used], depths[used])[0, 1])
    if agreement < MIN_AGREEMENT or outliers > MAX_OUTLIERS:
        found = f"a correlation of {agreement:.2f} with {100 * outliers:.0f} % outliers left out"
        raise InputError(f"depths: expected them to follow the probe's height, found {found}")


def _two_variances(residuals: Array, rates: Array, spread: float) -> tuple[float, float]:
    """Variance of the depth, and standard deviation of the time, by least squares on the squared residuals; neither negative."""
    floor = (0.1 * spread) ** 2 + 1e-12
    design = np.column_stack([np.ones_like(rates), rates])
    depth, time = np.linalg.lstsq(design, residuals**2, rcond=None)[0]
    if time < 0:
        return max(float((residuals**2).mean()), floor), 0.0
    if depth < floor:
        depth, time = floor, max(float((residuals**2 * rates).sum() / (rates**2).sum()), 0.0)
    return float(depth), float(np.sqrt(time))


def _sigma(design: Array, residuals: Array, weights: Array) -> float:
    """Of the lag, from the residuals as they are (a sandwich, each enlarged by its leverage), whatever the variances are."""
    inverse = np.linalg.inv(design.T @ (design * weights[:, None]))
    leverage = np.einsum("ni,ij,nj->n", design, inverse, design) * weights
    pulls = design * (weights * residuals / (1 - np.minimum(leverage, 0.9)))[:, None]
    return float(np.sqrt((inverse @ (pulls.T @ pulls) @ inverse)[2, 2]))
