"""The scanner's lag found together with the probe: from the same B-scans of a phantom at rest, over which the probe moves.

A lag is one more unknown of the adjustment. Over some tenths of a second a hand's motion isn't straight, so the poses are
interpolated anew at each round's lag, the probe is adjusted, and the lag goes on by the Gauss-Newton step that the residuals ask
for (see `lateness`). Where that step ends, the probe with the lag's uncertainty added along its change a second of lag is the
joint adjustment of both.

The first lag is that at which a quick, robust start fits best, of lags evenly over a range. The scatter of the time stamps along
the motion is measured in the same rounds, and weighs frames in fast motion less.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from recon.errors import InputError
from recon.model.probe import NAMES, ProbeCalibration
from recon.probe_calibration.latency import COVERAGE, MIN_OVERLAP, SEARCH_S
from recon.probe_calibration.lateness import Lateness
from recon.probe_calibration.phantom_frames import PhantomFrames

Array = NDArray[np.float64]

STEPS_S = (0.04, 0.01)  # of the search, at first and about the best
MOST_FRAMES = 40  # of the search, evenly over all
ROUNDS = 20
SETTLED, STEADY = 0.02, 0.05  # step of the lag over its standard deviation, and change of the jitter over itself, that end them
MOST_STEP_S = 0.05  # of the lag, a round
LEAST_JITTER_S = 1e-4  # that changes nothing
MAX_SIGMA_S = 0.005  # of a lag that the motion determines
STILL_MM_S = 3.0  # speed of the target below which it rests, but for noise
CONTRADICTS_MM2 = 0.25  # mean square misfit from which on another lag, of half of it, is named as a refusal's cause


@dataclass(frozen=True)
class FreeLag:
    """A lag, and what it leaves open of the probe."""

    seconds: float
    sigma_s: float
    jitter_s: float  # standard deviation of the time stamps, where noise is as assumed
    change: Array  # (8,) of sx, sy and the probe's pose a second of lag

    @property
    def interval_s(self) -> tuple[float, float]:
        """Of `latency.COVERAGE`, as of many frames."""
        reach = float(stats.norm.ppf((1 + COVERAGE) / 2)) * self.sigma_s
        return self.seconds - reach, self.seconds + reach

    def correlations(self, calibration: ProbeCalibration) -> dict[str, float]:
        """Correlation of the lag with sx, sy and the probe's pose, by name."""
        assert calibration.uncertainty is not None
        sigmas = [calibration.uncertainty.sigma(name) for name in NAMES]
        return dict(zip(NAMES, (self.sigma_s * self.change / sigmas).tolist(), strict=True))


def find(
    start: float,
    frames_at: Callable[[float, float], PhantomFrames],
    adjust: Callable[[PhantomFrames], Lateness],
) -> FreeLag:
    """Find the lag from a start that is right to some 10 ms, as of `search`.

    Parameters
    ----------
    frames_at : lag, s, and standard deviation of the time stamps, s -> frames
        With their poses then, and these' covariance and rates.
    adjust : frames -> what residuals show of a further lag

    Raises
    ------
    InputError
        If the motion doesn't determine the lag to MAX_SIGMA_S, or it doesn't settle.
    """
    lag, jitter = start, 0.0
    for _ in range(ROUNDS):
        late = adjust(frames_at(lag, jitter))
        wider = float(np.sqrt(max(jitter**2 + late.jitter_s2, 0.0)))
        steady = abs(wider - jitter) < max(STEADY * jitter, LEAST_JITTER_S)
        lag, jitter = lag + float(np.clip(late.seconds, -MOST_STEP_S, MOST_STEP_S)), wider
        if steady and abs(late.seconds) < SETTLED * late.sigma_s:
            break
    if late.sigma_s > MAX_SIGMA_S or abs(late.seconds) > late.sigma_s:
        found = "the probe at rest" if np.isinf(late.sigma_s) else f"{lag:.3f} ± {late.sigma_s:.3f} s"
        expected = f"expected a motion that determines it to {MAX_SIGMA_S:g} s (1 sigma)"
        way = "keep moving to all sides while recording, or use measure-lag and give lag_s"
        raise InputError(f"lag_s: free: {expected}, found {found}: {way}")
    return FreeLag(lag, late.sigma_s, jitter, late.change)


def few(seen: NDArray[np.bool_]) -> NDArray[np.intp]:
    """Frames that serve for the search : at most MOST_FRAMES of those in which the phantom was seen : (n,), evenly."""
    there = np.flatnonzero(seen)
    return there[np.unique(np.linspace(0, len(there) - 1, MOST_FRAMES).astype(int))] if len(there) else there


def search(frames_at: Callable[[float], PhantomFrames], misfit: Callable[[PhantomFrames], float]) -> tuple[float, float]:
    """The lag of the least misfit in `latency.SEARCH_S`, and this misfit.

    Raises
    ------
    InputError
        If it lies at the end of the search.
    """
    best, least = 0.0, np.inf
    for step, (first, last) in zip(STEPS_S, (SEARCH_S, (-STEPS_S[0], STEPS_S[0])), strict=True):
        lags = best + np.arange(first, last + step / 2, step)
        tried = [frames_at(float(lag)) for lag in lags]
        counts = np.array([len(each.usable) for each in tried])
        enough = counts >= max(MIN_OVERLAP * counts.max(), 1)
        misfits = np.array([misfit(each) if there else np.inf for each, there in zip(tried, enough, strict=True)])
        best, least = float(lags[misfits.argmin()]), float(misfits.min())
        if step == STEPS_S[0] and (not np.isfinite(least) or misfits.argmin() in (0, len(lags) - 1)):
            found = f"the best at its end, {best:g} s" if np.isfinite(least) else "too few frames with a pose at any"
            raise InputError(
                f"lag_s: free: expected the lag within {first:g} to {last:g} s, found {found}: are the clocks others?"
            )
    return best, least
