"""A needle's tip in B-scans beside the same tip by tracking: their distance in the image's plane, and what may be its cause.

The tracked tip is `image_from_target @ target_from_body @ tip`, of the probe's calibration, both bodies' poses and the tip's own.
Its noise differs from frame to frame; what the calibrations leave open errs alike in all frames, and is predicted by their
covariances. Beyond these, four faults leave a mark each: a tip that lies elsewhere in the tool's frame, by a bent shaft or
another calibration; a probe that lies elsewhere in its target's frame; another speed of sound, by the depth; and B-scans that
are late, by the tip's motion in the image. Each is fitted by itself, and the one that explains most, by Schwarz's criterion, is
named. Chances are those of chi-square, or of F where the noise is more than predicted and so measured by the residuals.

Frames whose tip is far from all others' are outliers, by residuals about the robust fit of the fault that explains most.

How far the tip lies out of the plane isn't seen in a B-scan: of that, the tracked distance alone is known.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc, fdtrc

from recon.estimation.covariance import inverse, propagate, root, whitening
from recon.estimation.persistence import persistence
from recon.geometry import rigid
from recon.model.probe import NAMES, ProbeCalibration, place_slopes
from recon.model.tip import TIP, Tip

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

CHANCE = 1e-3  # of a fault as large by what is left open, below which it is named
LIKE = 6.0  # of Schwarz's criterion, within which another fault may be it as well
FAR = 4.7  # standard deviations, beyond which a frame is an outlier
TYPICAL = np.sqrt(2 * np.log(2))  # median length of two normal numbers
LEAST_FRAMES = 12  # with fewer an outlier can't be told from noise that is more than predicted
ROUNDS, LEAST_LENGTH = 30, 0.1  # of a robust fit; of a residual that is none
SHOWN, FREE = 1e-8, 1e6  # of the largest effect, what shows at all; standard deviation, rad and mm, of what doesn't
TOOL, PROBE, SOUND, LATE = "tool", "probe", "sound", "late"  # faults


class Seen(NamedTuple):
    """The tip in n B-scans, and the poses at which they were taken."""

    pixels: Array  # (n, 2) px
    pixel_covariance: Array  # (n, 2, 2) px^2
    poses: Array  # (n, 4, 4) body_from_target, mm
    covariance: Array  # (n, 6, 6) of each pose alone, as in recon.model.tracks
    shared: Array  # (n, 6, 6) of what errs alike in all
    rates: Array  # (n, 4, 4) change of the poses a second, by which a lag moves them back
    ahead_mm: float = 0.0  # of the echo before the tip
    ahead_sigma_mm: float = 0.0
    lag_sigma_s: float = 0.0


class Fault(NamedTuple):
    """A fault that was fitted, and the chance of as much without it."""

    values: (
        Array  # (k,) of a tool: the imaged tip less that of its file, mm in its frame; of a probe: its turn and shift since its
    )
    # file, rad and mm, as of rigid.moved; of sound: depth too large; of a lag: s
    covariance: Array  # (k, k) with what the calibrations leave open
    chance: float
    criterion: float  # Schwarz's, of the residuals that it leaves

    @property
    def size(self) -> float:
        """Length of the values, of a probe's turn and shift that of the shift."""
        return float(np.linalg.norm(self.values[-3:]))


@dataclass(frozen=True)
class Comparison:
    """The imaged tip less the tracked one in n B-scans, in the image's frame."""

    tracked: Array  # (n, 3) mm: along the array, in depth, and out of the plane
    tracked_sigma: Array  # (n, 3) mm, of all that counts
    off: Array  # (n, 2) mm, imaged less tracked
    covariance: Array  # (n, 2, 2) of these, of each frame alone
    outliers: Mask  # (n,) that what follows is without
    mean: Array  # (2,) mm, weighted
    mean_covariance: Array  # (2, 2) of the mean beside zero, with what the calibrations leave open
    chance: float  # of a mean as far from zero by what poses and calibrations leave open
    level: float  # scatter about the mean over the predicted
    faults: Mapping[str, Fault] = field(default_factory=dict)

    @property
    def distances(self) -> Array:
        """In the plane : (m,) mm, of those that are no outliers."""
        return np.linalg.norm(self.off[~self.outliers], axis=1)

    @property
    def normalised(self) -> Array:
        """Distances from the mean over their standard deviation : (n,); sqrt(2) of a typical frame."""
        left = self.off - self.mean
        return np.sqrt(np.einsum("ni,ni->n", left, np.linalg.solve(self.covariance, left[..., None])[..., 0]))

    @property
    def named(self) -> list[str]:
        """Faults that aren't explained by what is left open, the likeliest first, with those that may be it as well."""
        sure = {name: one for name, one in self.faults.items() if one.chance < CHANCE}
        order = sorted(sure, key=lambda name: sure[name].criterion)
        return [name for name in order if sure[name].criterion < sure[order[0]].criterion + LIKE]


def compare(seen: Seen, probe: ProbeCalibration, tip: Tip) -> Comparison:
    """Compare the tip in n >= 3 B-scans with the tracked one, by a probe's calibration for their medium."""
    target_from_image = probe.target_from_image
    to_image = target_from_image[:3, :3].T
    back = np.swapaxes(seen.poses[:, :3, :3], 1, 2)
    arms = tip.tip_mm - seen.poses[:, :3, 3]
    in_target = np.einsum("nij,nj->ni", back, arms)
    tracked = rigid.apply(rigid.invert(target_from_image), in_target)
    off = seen.pixels * probe.scale + [0, seen.ahead_mm] - tracked[:, :2]
    by_pose = to_image @ back @ np.concatenate([-rigid.cross(arms), np.tile(np.eye(3), (len(arms), 1, 1))], axis=-1)
    by_tip = -to_image @ back
    by_probe = to_image @ place_slopes(target_from_image, probe.scale, seen.pixels)
    motion = np.einsum("nij,nj->ni", seen.rates[:, :3, :3], in_target) + seen.rates[:, :3, 3]
    by_lag = np.einsum("nij,nj->ni", to_image @ back, motion)[..., None]
    tip_effects = by_tip @ root(tip.covariance_of(TIP))
    probe_effects = np.zeros((len(off), 3, 0))
    if probe.uncertainty is not None:
        probe_effects = by_probe @ root(probe.uncertainty.ordered(NAMES))
    shared = np.nanmean(seen.shared, axis=0)
    effects = np.concatenate(
        [
            tip_effects,
            probe_effects,
            by_pose @ root(shared),
            np.tile([[0.0], [seen.ahead_sigma_mm], [0.0]], (len(off), 1, 1)),
            seen.lag_sigma_s * by_lag,
        ],
        axis=-1,
    )
    by_poses = propagate(by_pose, seen.covariance)
    covariance = by_poses[:, :2, :2] + seen.pixel_covariance * np.outer(probe.scale, probe.scale)
    sigma = np.sqrt(np.diagonal(by_poses + propagate(effects, np.eye(effects.shape[-1])), axis1=1, axis2=2))
    depth = np.stack([np.zeros(len(off)), seen.pixels[:, 1] * probe.scale[1]], axis=-1)[..., None]
    slopes = {TOOL: -by_tip[:, :2], PROBE: -by_probe[:, :2, 2:], SOUND: depth, LATE: by_lag[:, :2]}
    return _compared(tracked, sigma, off, covariance, effects[:, :2], slopes)


def _compared(
    tracked: Array, sigma: Array, off: Array, covariance: Array, effects: Array, slopes: Mapping[str, Array]
) -> Comparison:
    """The mean, the scatter, and the faults by their slopes : (n, 2, k).

    effects : (n, 2, q) of what errs alike in all frames, of independent standard normal numbers.
    """
    whiten = whitening(covariance)
    left, common = (whiten @ off[..., None])[..., 0], whiten @ effects
    rows = {"mean": whiten, **{name: whiten @ each for name, each in slopes.items() if np.abs(each).max() > 0}}
    outliers = _outliers(rows, left)
    used = ~outliers
    fitted = {
        name: _fitted(each[used], left[used], common[used]) for name, each in rows.items() if 2 * used.sum() > each.shape[2]
    }
    mean = fitted.pop("mean")
    rest = (left - whiten @ mean.values)[used]
    level = float(np.sqrt((rest**2).sum() / max(rest.size - 2, 1)))
    return Comparison(tracked, sigma, off, covariance, outliers, mean.values, mean.covariance, mean.chance, level, fitted)


def _outliers(rows: Mapping[str, Array], left: Array) -> Mask:
    """Frames : (n,) far off, by faults' whitened slopes : (n, 2, k) and residuals : (n, 2).

    Each fault is fitted by the least sum of the residuals' lengths; that of the shortest ones, in the median, counts.
    """
    least, outliers = np.inf, np.zeros(len(left), bool)
    if len(left) < LEAST_FRAMES:
        return outliers
    for slopes in rows.values():
        freedom, lengths = 1 - slopes.shape[2] / left.size, np.ones(len(left))
        for _ in range(ROUNDS):
            weights = np.maximum(lengths, LEAST_LENGTH)[:, None] ** -0.5
            weighted = (weights[..., None] * slopes).reshape(left.size, -1)
            values = np.linalg.lstsq(weighted, (weights * left).ravel())[0]
            lengths = np.linalg.norm(left - slopes @ values, axis=1)
        scale = float(np.median(lengths)) / TYPICAL / np.sqrt(freedom)
        if scale < least:
            least, outliers = scale, lengths > FAR * max(scale, 1.0)
    return outliers


def _fitted(slopes: Array, left: Array, common: Array) -> Fault:
    """A fault by whitened slopes : (n, 2, k) and residuals : (n, 2), beside common effects : (n, 2, q)."""
    rows = slopes.reshape(left.size, -1)
    sizes, axes = np.linalg.svd(rows, full_matrices=False)[1:]
    axes, hidden = axes[sizes > SHOWN * sizes[0]], axes[sizes <= SHOWN * sizes[0]]  # what B-scans at one attitude show no part of
    k = len(axes)
    spread = (axes.T / sizes[:k] ** 2) @ axes
    values = spread @ rows.T @ left.ravel()
    rest = left - (slopes @ values[:, None])[..., 0]
    alike = persistence(rest)
    level = float((rest**2).sum()) / (left.size - k)
    moved = spread @ rows.T @ common.reshape(left.size, -1)
    covariance = max(level, 1.0) * alike * spread + moved @ moved.T
    shown = axes @ values
    squared = float(shown @ inverse(axes @ covariance @ axes.T) @ shown)
    chance = fdtrc(k, (left.size - k) / alike, squared / k) if level > 1 else chdtrc(k, squared)
    count = left.size / alike
    criterion = count * np.log(max(float((rest**2).sum()) / left.size, 1e-12)) + k * np.log(count)
    return Fault(values, covariance + FREE**2 * hidden.T @ hidden, float(chance), float(criterion))
