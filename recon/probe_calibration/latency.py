"""Time calibration: the lag of the scanner's images behind the poses, from an up-and-down motion over a flat bottom.

The bottom's depth in the image follows the probe: `depth(t) = a + b . x(t - lag) + c t`, where x are six coordinates of its pose
and products of its turn with itself and with the height. Above all depth follows the height; but the target stands off from the
array, so that a hand that tilts by half a degree moves the one by a millimetre and not the other. Products are what tilts of some
degrees add; their slopes are held to the size that arms and beams have, and no calibrated probe is needed. The trend c, of 0.2 mm
or so, is of a bracket that gives, which would look like a lag of 2 ms. Both streams have time stamps of their own, so jitter and
dropped frames add errors of their own size only: the pose is interpolated at the moment of each image. The lag is the offset of
the clocks and the delays together; where the clocks drift against each other by 50 ppm it changes by 3 ms a minute, so calibrate
anew for long sessions.

Move the probe by 10 mm or more, three times or more, at an uneven pace: a periodic motion fits at more than one lag.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import stats
from scipy.interpolate import BSpline, make_lsq_spline
from scipy.spatial.transform import Rotation

from recon.errors import InputError
from recon.files.metrics import Metrics
from recon.geometry.order_statistics import NORMAL_MAD
from recon.model import tracks
from recon.model.tracks import Track
from recon.probe_calibration import echo_curve

Array = NDArray[np.float64]

SEARCH_S = (-0.5, 0.5)
STEP_S = 0.01  # of the search
MIN_FRAMES = 20
MIN_RANGE_MM = 4.0  # of the motion, between its 5th and 95th percentile
KNOT_S = 0.1  # of the spline through the motion: hands move below 3 Hz
STILL = 1e-9  # mm or rad: a coordinate that changes by less is left out
MIN_OVERLAP = 0.6  # of the images with a pose
MIN_CORRELATION = 0.6  # of depth and height, by ranks, outliers among them
MIN_AGREEMENT = 0.98  # their correlation without outliers
MAX_OUTLIERS = 0.4  # of the images
RIVAL = 0.98  # correlation of another lag, over the best, that makes the motion ambiguous
VALLEY = 0.8  # correlation between two such lags, over the best, that separates them
MOST_PAIRED = 1000  # images by whose pairs the fit begins
GATE = 4.0  # normalised residual of an outlier
ALIKE_S = 0.3  # within which errors go together: those of the spline, at least
TILTS_S = 5.5  # of a sweep from which products with the turn are told: a shorter one has fewer swings than slopes
ARM_MM = 150.0  # from the target to the bottom's echo: depth by a turn times a turn
BEAM = 0.5  # sine of the angle between beam and motion: depth by height times a turn
GIVES_MM = 0.2  # standard deviation of a bracket's giving over the sweep: one stroke alone doesn't tell it from a lag
COVERAGE = 0.95  # of the interval
FAR_MM = 1.0  # of a trend, that no bracket gives
BLOCK_PX = 8  # columns taken together
BOTTOM_CONTRAST = 30.0  # grey levels above the median of its columns
BOTTOM_NEAR_PX = 3.0  # of the line
BOTTOM_SHARE = 0.5  # of the columns, at least, on the line


@dataclass(frozen=True)
class Lag:
    """Delay of the images' time stamps: an image stamped t shows the probe as it stood at t - lag, of the poses' clock."""

    seconds: float
    sigma_s: float
    interval_s: tuple[float, float]  # of 95 %
    jitter_s: float  # of the time stamps: the part of the residuals that grows with speed
    depth_sigma: float  # the constant part, in units of the depths
    used: NDArray[np.bool_]  # (n,) images: with a pose and a depth, and no outlier
    residuals: Array  # (n,) in units of the depths; NaN without a pose or a depth
    trend_mm: float  # by which the bottom rose or sank against the probe over the sweep, as motions along the first direction are


def estimate(times: NDArray[np.int64], depths: Array, track: Track, search_s: tuple[float, float] = SEARCH_S) -> Lag:
    """Estimate the lag of an image stream.

    Parameters
    ----------
    times : (n,) int64, ns
        Of the images, of their own clock.
    depths : (n,) float
        Of the bottom in each image, in any unit, as of `bottom_depth`; NaN where there is none.
    search_s : (first, last) s
        Range of lags. For unrelated clocks give the difference of their starts, plus and minus its uncertainty.

    Raises
    ------
    InputError
        If there are too few images or poses, the motion is too small or periodic, the depths don't follow it at any lag, or
        the best lag lies at the end of the search.
    """
    times, depths = np.asarray(times), np.asarray(depths, float)
    seen = np.isfinite(depths)
    if seen.sum() < MIN_FRAMES:
        raise InputError(f"depths: expected at least {MIN_FRAMES} images that show the bottom, found {seen.sum()}")
    if track.found.sum() < MIN_FRAMES:
        raise InputError(f"track: expected at least {MIN_FRAMES} poses, found {track.found.sum()}")
    coordinates, sizes = _coordinates(track)
    origin = int(track.times[0])
    seconds = (times - origin) * 1e-9
    moments = (track.times[track.found] - origin) * 1e-9
    start = _search(seconds[seen], depths[seen], moments, coordinates[:, 0], search_s)
    return _refined(seconds, depths, moments, _smooth(moments, coordinates), sizes, start, search_s)


def measure(depths: Array, found: Lag) -> Metrics:
    """Figures of a lag, each named with its unit; depths : (n,) NaN where no bottom was found."""
    return {
        "frames": len(depths),
        "frames_with_bottom": int(np.isfinite(depths).sum()),
        "frames_used": int(found.used.sum()),
        "lag_ms": 1e3 * found.seconds,
        "lag_sigma_ms": 1e3 * found.sigma_s,
        "lag_low_ms": 1e3 * found.interval_s[0],
        "lag_high_ms": 1e3 * found.interval_s[1],
        "jitter_ms": 1e3 * found.jitter_s,
        "depth_sigma_px": found.depth_sigma,
        "trend_mm": found.trend_mm,
    }


def bottom_depth(image: NDArray, top_px: int = 40, part: NDArray[np.bool_] | None = None) -> float:
    """Depth in px of a flat bottom at the middle column of a B-scan : (h, w), 8-bit; NaN if there is none. See `bottom_line`."""
    return bottom_line(image, top_px, part)[0]


def bottom_line(image: NDArray, top_px: int = 40, part: NDArray[np.bool_] | None = None) -> tuple[float, float]:
    """Depth in px of a flat bottom at the middle column of a B-scan : (h, w), 8-bit, and its slope; NaN if there is none.

    Columns are averaged in blocks, and the brightest echo of each below `top_px`, where reverberation at the probe's face ends,
    is taken; the line is that through most of these echoes. Of a `part` : (h, w), such as a fan, the face is where it begins, and
    columns are left out in which it begins lower than in the middle, aside of the face.
    """
    level = np.asarray(image, np.float32)
    profiles = echo_curve.block_profiles(level, BLOCK_PX)
    blocks = profiles.shape[1]
    used = np.ones(level.shape, bool) if part is None else part
    seen = used[:, : blocks * BLOCK_PX].reshape(profiles.shape[0], blocks, BLOCK_PX).all(axis=2)
    begins = seen.argmax(axis=0)
    face = begins + top_px
    below = seen & (np.arange(len(seen))[:, None] >= face) & (begins <= begins[blocks // 2])
    below[:-1] &= seen[1:]
    below[-1:] = False
    columns = np.flatnonzero(below.sum(axis=0) >= 8)
    if len(columns) < 4:
        return np.nan, np.nan
    rows = np.where(below, profiles, -1).argmax(axis=0)[columns]
    before, peak, after = profiles[rows - 1, columns], profiles[rows, columns], profiles[rows + 1, columns]
    bend = np.minimum(before - 2 * peak + after, -1e-3)
    v = rows + np.clip((before - after) / (2 * bend), -0.5, 0.5)
    u = echo_curve.block_columns(blocks, BLOCK_PX)[columns] - (level.shape[1] - 1) / 2
    usual = np.nanmedian(np.where(seen, profiles, np.nan)[:, columns], axis=0)
    clear = (peak - usual > BOTTOM_CONTRAST) & (rows > face[columns])
    if clear.sum() < BOTTOM_SHARE * len(columns):
        return np.nan, np.nan
    return _line(u[clear], v[clear], len(columns))


def _line(u: Array, v: Array, blocks: int) -> tuple[float, float]:
    """Height at u = 0, and slope, of the line near most of the points; NaN if these are too few."""
    first, second = np.triu_indices(len(u), 1)
    slopes = (v[second] - v[first]) / (u[second] - u[first])
    starts = v[first] - slopes * u[first]
    near = np.abs(v - starts[:, None] - slopes[:, None] * u) < BOTTOM_NEAR_PX
    agreed = near[near.sum(axis=1).argmax()]
    if agreed.sum() < BOTTOM_SHARE * blocks:
        return np.nan, np.nan
    height, slope = np.polynomial.polynomial.polyfit(u[agreed], v[agreed], 1).tolist()
    return height, slope


def _coordinates(track: Track) -> tuple[Array, Array]:
    """Coordinates of the valid poses, about their mean : (n, 3 to 15), and the standard deviations of depth by each : (3 to 15,).

    The height along the main direction of the motion, mm, and the place across it; the turn, rad; of a sweep of 5.5 s and more
    products of turns, and the height times the turn. Constant ones are left out. Slopes by all but products are open.
    """
    poses = track.poses[track.found]
    places = poses[:, :3, 3] - poses[:, :3, 3].mean(axis=0)
    places = places @ np.linalg.svd(places, full_matrices=False)[2].T
    extent = np.subtract(*np.percentile(places[:, 0], [95, 5]))
    if extent < MIN_RANGE_MM:
        raise InputError(f"track: expected an up-and-down motion of at least {MIN_RANGE_MM:g} mm, found {extent:.1f} mm")
    rotations = Rotation.from_matrix(poses[:, :3, :3])
    turns = (rotations * rotations.mean().inv()).as_rotvec()
    first, second = np.triu_indices(3)
    coordinates = np.column_stack([places, turns, turns[:, first] * turns[:, second], places[:, :1] * turns])
    sizes = np.repeat([np.inf, ARM_MM, BEAM], [6, 6, 3])
    told = np.ptp(track.times[track.found]) > TILTS_S * 1e9
    used = (np.ptp(coordinates, axis=0) > STILL) & (told | np.isinf(sizes))
    return coordinates[:, used], sizes[used]


def _smooth(moments: Array, coordinates: Array) -> BSpline:
    """Motion by a cubic spline with a knot every KNOT_S, or at every other pose where there are fewer; least squares.

    An interpolating spline would carry the poses' noise, and less of it between poses than at them: lags at which images fall
    between poses would fit better than others.
    """
    step = max(2, round(KNOT_S / float(np.median(np.diff(moments)))))
    knots = moments[step:-step:step]
    return make_lsq_spline(moments, coordinates, np.r_[[moments[0]] * 4, knots, [moments[-1]] * 4], k=3)


def _within(moments: Array, wanted: Array) -> NDArray[np.bool_]:
    """Whether moments lie between two poses no more than `MAX_GAP_S` apart."""
    after = np.clip(np.searchsorted(moments, wanted), 1, len(moments) - 1)
    near = moments[after] - moments[after - 1] <= tracks.MAX_GAP_S
    return near & (wanted >= moments[0]) & (wanted <= moments[-1])


def _rank_correlation(depths: Array, heights: Array) -> float:
    """Spearman's, without its sign; 0 where either stays the same."""
    if np.ptp(depths) == 0 or np.ptp(heights) == 0:
        return 0.0
    return abs(float(np.corrcoef(stats.rankdata([depths, heights], axis=1))[0, 1]))


def _search(seconds: Array, depths: Array, moments: Array, heights: Array, search_s: tuple[float, float]) -> float:
    """The lag of the greatest rank correlation of depth and height."""
    lags = np.arange(search_s[0], search_s[1] + STEP_S / 2, STEP_S)
    agreement = np.zeros(len(lags))
    overlap = np.zeros(len(lags))
    for k, lag in enumerate(lags):
        inside = _within(moments, seconds - lag)
        overlap[k] = inside.mean()
        if inside.sum() >= MIN_FRAMES and overlap[k] >= MIN_OVERLAP:
            agreement[k] = _rank_correlation(depths[inside], np.interp(seconds[inside] - lag, moments, heights))
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


def _refined(
    seconds: Array,
    depths: Array,
    moments: Array,
    spline: BSpline,
    sizes: Array,
    start: float,
    search_s: tuple[float, float],
) -> Lag:
    """Weighted least squares over a, b, c and the lag, with variances of depth and of time estimated from the residuals."""
    lag, speed, trend = start, spline.derivative(), seconds - seconds.mean()
    seen = np.isfinite(depths)
    used = seen & _within(moments, seconds - lag)
    line = np.zeros(2 + spline(start).size)  # a, b, c
    some = np.flatnonzero(used)[:: -(-int(used.sum()) // MOST_PAIRED)]
    line[1::-1] = stats.theilslopes(depths[some], spline(seconds[some] - lag)[:, 0])[:2]
    variance = np.ones(len(depths))
    for round_ in range(15):
        inside = seen & _within(moments, seconds - lag)
        weights = np.where(used & inside, 1 / variance, 0)
        design = np.column_stack([np.ones_like(seconds), spline(seconds - lag), trend, -speed(seconds - lag) @ line[1:-1]])
        missing = np.where(seen, depths, 0) - design[:, :-1] @ line
        root, per_mm = np.sqrt(weights), max(abs(line[1]), 1e-9)
        held = np.diag(np.r_[0, 1 / (sizes * per_mm), np.ptp(seconds) / (GIVES_MM * per_mm), 0])
        left = np.append(missing * root, -held[:, :-1] @ line)
        step = np.linalg.lstsq(np.vstack([design * root[:, None], held]), left, rcond=None)[0]
        line, lag = line + step[:-1], lag + float(np.clip(step[-1], -0.05, 0.05))
        predicted = line[0] + spline(seconds - lag) @ line[1:-1] + trend * line[-1]
        residuals = np.where(inside, depths - predicted, np.nan)
        rates = (speed(seconds - lag) @ line[1:-1]) ** 2
        spread = NORMAL_MAD * np.nanmedian(np.abs(residuals))
        near = inside & (np.abs(residuals) < (8 * spread if round_ < 3 else GATE * np.sqrt(variance)))
        depth_variance, jitter = _two_variances(residuals[near], rates[near], spread)
        variance = depth_variance + jitter**2 * rates
        used = inside & (np.abs(residuals) < GATE * np.sqrt(variance))
        if used.sum() < MIN_FRAMES:
            raise InputError(f"depths: expected at least {MIN_FRAMES} images that agree on a lag, found {used.sum()}")
        if round_ > 4 and abs(step[-1]) < 1e-7:
            break
    without_products = spline(seconds - lag) @ np.where(np.isinf(sizes), line[1:-1], 0)
    _agree(without_products, depths - trend * line[-1], inside, used)
    sigma, freedom = _sigma(design[used], residuals[used], 1 / variance[used], seconds[used], held)
    if abs(step[-1]) > sigma:
        found = f"it still moving by {1e3 * abs(step[-1]):.1f} ms a round, {lag:.3f} s at last"
        raise InputError(f"depths: expected the lag to settle near {start:.2f} s, found {found}")
    if not search_s[0] <= lag <= search_s[1]:
        raise InputError(f"search_s: expected the lag within {search_s[0]:g} to {search_s[1]:g} s, found {lag:.3f} s")
    reach = float(stats.t.ppf((1 + COVERAGE) / 2, freedom)) * sigma
    gives = float(line[-1] * np.ptp(seconds) / abs(line[1]))
    return Lag(lag, sigma, (lag - reach, lag + reach), jitter, float(np.sqrt(depth_variance)), used, residuals, gives)


def _agree(predicted: Array, depths: Array, inside: NDArray[np.bool_], used: NDArray[np.bool_]) -> None:
    """Refuse depths that don't follow the height, or with too many outliers."""
    outliers = 1 - used.sum() / inside.sum()
    agreement = abs(np.corrcoef(predicted[used], depths[used])[0, 1])
    if agreement < MIN_AGREEMENT or outliers > MAX_OUTLIERS:
        found = f"a correlation of {agreement:.2f} with {100 * outliers:.0f} % outliers left out"
        raise InputError(f"depths: expected them to follow the probe's height, found {found}")


def _two_variances(residuals: Array, rates: Array, spread: float) -> tuple[float, float]:
    """Variance of the depth and standard deviation of the time, not negative, by least squares on the squared residuals."""
    floor = (0.1 * spread) ** 2 + 1e-12
    design = np.column_stack([np.ones_like(rates), rates])
    depth, time = np.linalg.lstsq(design, residuals**2, rcond=None)[0]
    if time < 0:
        return max(float((residuals**2).mean()), floor), 0.0
    if depth < floor:
        depth, time = floor, max(float((residuals**2 * rates).sum() / (rates**2).sum()), 0.0)
    return float(depth), float(np.sqrt(time))


def _sigma(design: Array, residuals: Array, weights: Array, seconds: Array, held: Array) -> tuple[float, float]:
    """Standard deviation of the lag from the residuals, each enlarged by its leverage, and their number of degrees of freedom.

    It is the larger of two sandwich estimates. The one takes errors as independent, the other as alike within `ALIKE_S` (Newey
    and West 1987); tremor, whose errors change sign from image to image, makes the second too small. To both is added what the
    sizes of slopes leave open, as `held`.
    """
    inverse = np.linalg.pinv(design.T @ (design * weights[:, None]) + held.T @ held)
    leverage = np.einsum("ni,ij,nj->n", design, inverse, design) * weights
    pulls = inverse[-1] @ (design * (weights * residuals / (1 - np.minimum(leverage, 0.9)))[:, None]).T
    alone = alike = float(pulls @ pulls)
    for k in range(1, len(pulls)):
        near = np.maximum(1 - np.abs(seconds[k:] - seconds[:-k]) / ALIKE_S, 0)
        if not near.any():
            break
        alike += 2 * float(pulls[k:] @ (near * pulls[:-k]))
    sigma = float(np.sqrt(max(alone, alike) + np.sum((held @ inverse[-1]) ** 2)))
    return sigma, float(len(residuals) - leverage.sum())
