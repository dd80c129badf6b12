"""The lag of B-scans that an adjustment's residuals show: one more unknown, by which all poses move back along the motion.

The rates of the poses have noise, too. Of a probe at rest they are nothing else, and would seem to determine a lag. So the
information on it is taken less what this noise makes of it: rates are differences of poses 2 RATE_S apart or more, each with the
noise of a pose. Poses that far from the B-scan's don't share its noise either, which would pull the lag towards moments halfway
between two poses.

Time stamps of computers scatter by some ms, which is noise along the motion: fast frames err more. `Lateness.jitter_s2` is what
they err more than their covariance has of it, by the scatter of residuals along the motion beside that of all others.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from recon.estimation.persistence import persistence
from recon.files.metrics import Metrics
from recon.model.probe import NAMES

Array = NDArray[np.float64]

RATE_S = 0.05  # before and after a B-scan, at least, from which the rate of its pose is
SURE = 5.0  # standard deviations from which on a lag is told
NO_LAG_S = 0.005  # lag that isn't worth a word
LEAST_SHOWN = 1e-9  # of what a lag changes, that no other unknown explains: less is rounding


@dataclass(frozen=True)
class Lateness:
    """A lag beyond that of the poses."""

    seconds: float
    sigma_s: float  # infinite where the motion leaves it open
    change: Array  # (8,) of sx, sy and the probe's pose a second of it
    jitter_s2: float  # s^2, variance of the time stamps beyond that of the assumed covariance; may be negative

    @property
    def shown(self) -> bool:
        """Whether it is worth a word."""
        return abs(self.seconds) > max(SURE * self.sigma_s, NO_LAG_S)

    @property
    def corrected(self) -> str:
        """The lag, and what to add to it."""
        off = f"{'late' if self.seconds > 0 else 'early'} by {1e3 * abs(self.seconds):.0f} ± {1e3 * self.sigma_s:.0f} ms"
        return f"the B-scans are {off} beyond lag_s: add {self.seconds:+.3f} to it"

    @property
    def described(self) -> str:
        """The lag, and the ways on of a phantom that serves to find it."""
        return f"{self.corrected}, or give lag_s=free, or hold still"


def figures(late: Lateness | None) -> Metrics:
    """The lag and its standard deviation, s; NaN where it stays open."""
    if late is None or not np.isfinite(late.sigma_s):
        return {"more_lag_s": np.nan, "more_lag_sigma_s": np.nan}
    return {"more_lag_s": late.seconds, "more_lag_sigma_s": late.sigma_s}


def of_residuals(
    column: Array, left: Array, slopes: Array, known: Array, counted: Array, level: float, by_poses: float
) -> Lateness:
    """The lag by n frames' equations at their solution, in standard deviations.

    Parameters
    ----------
    column : (n, r)
        Slopes of the residuals by a second of lag.
    left, slopes : (n, r) and (n, r, g)
        Residuals, and their slopes by the other unknowns, of which the first are `recon.model.probe.NAMES`.
    known : (g,)
        Information on these beforehand.
    counted : (n,)
        Residuals of each frame that count, without outliers.
    level : float
        Noise of the poses over the assumed.
    by_poses : float
        Sum of the residuals' variances by noise of the poses.
    """
    rows, more = slopes.reshape(-1, slopes.shape[-1]), column.ravel()
    information = rows.T @ rows + np.diag(known)
    scale = 1 / np.sqrt(np.maximum(np.diag(information), np.finfo(float).tiny))
    spread = scale[:, None] * np.linalg.pinv(scale[:, None] * information * scale) * scale
    change = -spread @ (rows.T @ more)
    shown = float(more @ (more + rows @ change))
    if shown <= LEAST_SHOWN * float(more @ more):
        return Lateness(0.0, np.inf, change[: len(NAMES)], 0.0)
    seconds = -float(more @ left.ravel()) / shown
    alike = persistence(left + seconds * (column + slopes @ change))
    noise = by_poses * 2 / (2 * RATE_S) ** 2
    sigma = float(np.sqrt(alike * shown)) / (shown - noise) if shown > noise else np.inf
    jitter_s2 = _jitter(column, left, slopes, spread, counted) / level**2
    return Lateness(seconds, sigma, change[: len(NAMES)], jitter_s2)


def _jitter(column: Array, left: Array, slopes: Array, spread: Array, counted: Array) -> float:
    """Variance of the time stamps, s^2, by the scatter along the motion beyond that across it; one step of scoring."""
    squared = (column**2).sum(axis=1)
    moving = (squared > 0) & (counted > 1)
    if not moving.any():
        return 0.0
    column, left, slopes, squared, counted = (each[moving] for each in (column, left, slopes, squared, counted))
    along = column / np.sqrt(squared)[:, None]
    explained = np.einsum("ni,nij,jk,nlk,nl->n", along, slopes, spread, slopes, along, optimize=True)
    scatter = np.einsum("ni,ni->n", along, left) ** 2
    free = 1 - np.einsum("nij,jk,nik->", slopes, spread, slopes, optimize=True) / counted.sum()
    across = float(((left**2).sum(axis=1) - scatter).sum() / ((counted - 1).sum() * max(free, 0.1)))
    return float((squared * (scatter - across * (1 - explained))).sum() / (squared**2).sum())
