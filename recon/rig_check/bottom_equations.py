"""Equations of probe and clock over a tank's flat bottom: all B-scans, put in space by the calibration, must show one plane.

An image's line of the bottom gives two numbers. Unknown are the plane's three, the clock's lag and a motion of the probe against
its target. A shift of the probe along its own depth is the height of an unknown plane: it shows by the tilts alone, and hardly.
Tilts to all sides show the other shifts and two turns; the third, within the image, shows where the probe is turned about its
depth.

What errs alike in all poses, by the cameras' and the target's calibration, erred so when the probe was calibrated, and is left
out.
"""

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from recon.errors import InputError
from recon.estimation.covariance import propagate, root, whitening
from recon.estimation.equations import eliminate
from recon.geometry import rigid
from recon.geometry.order_statistics import NORMAL_MAD
from recon.model import tracks
from recon.model.calibration import Uncertainty
from recon.model.probe import NAMES, ProbeCalibration, place_slopes
from recon.model.tracks import Track
from recon.probe_calibration import latency
from recon.rig_check import fault_tests
from recon.rig_check.fault_tests import Equations, Fault

Array = NDArray[np.float64]

PROBE, CLOCK = "probe", "clock"
USUAL_BEND = np.repeat([np.deg2rad(0.15), 0.2], 3)  # rad and mm: a bracket that was pushed
USUAL_LAG = np.array([0.01])  # s
SEARCH_S, STEP_S = 0.4, 0.01  # of the lag, about the one that is known
ROUNDS = 10
RATE_S = 0.02  # before and after a moment, over which a velocity is taken
OUTLYING = 4.0  # standard deviations
LEAST_SPREAD_MM = 0.01  # of distances from the plane
LEAST = 20  # B-scans
DEPTH_PX = 0.3  # standard deviation of a line's row at either point, before it is measured
ASSUMED = np.diag(np.repeat([np.deg2rad(0.05), 0.03], 3) ** 2)  # of a tracked pose, rad and mm, where a track has no covariance
SETTLED_S = 1e-6
FLAT = 0.03  # of the places' spread along the array, that across it must have to tell a slope
JITTER_S = 0.002  # standard deviation of the scanner's stamps
MOST = 400  # B-scans that are used


class Lines(NamedTuple):
    """The bottom in n B-scans, at two columns of each."""

    times: NDArray[np.int64]  # (n,) ns, the scanner's stamps
    pixels: Array  # (n, 2, 2) px; NaN where no bottom was found


class Known(NamedTuple):
    """What the calibration says."""

    probe: ProbeCalibration  # for the tank's water
    lag_s: float
    lag_sigma_s: float
    daily: Uncertainty | None = None  # of the probe, by what is other each day, as the thermometer's error


class Bottom(NamedTuple):
    """The plane and the lag that fit all B-scans best, as the probe is calibrated."""

    lag_s: float
    normal: Array  # (3,) in the world, towards the bottom
    offset_mm: float
    used: NDArray[np.bool_]  # (n,) B-scans with a line and a pose, and no outlier


class _Placed(NamedTuple):
    """The lines' points in the world, and what they are made of."""

    points: Array  # (n, 2, 3) mm
    poses: Array  # (n, 4, 4) world_from_target


def columns(size: tuple[int, int]) -> Array:
    """Columns : (2,) px at which a line's rows err independently: a standard deviation of even columns from the middle."""
    width = size[0]
    return (width - 1) / 2 + width / np.sqrt(12) * np.array([-1.0, 1.0])


def lines_of(images: Iterable[NDArray], times: NDArray[np.int64], size: tuple[int, int], top_px: int) -> Lines:
    """Find the bottom in n B-scans : (h, w), of which at most 400, evenly chosen, are looked at."""
    chosen = set(np.unique(np.linspace(0, len(times) - 1, min(MOST, len(times))).round().astype(int)).tolist())
    found = np.full((len(times), 2), np.nan)
    for k, image in enumerate(images):
        if k in chosen:
            found[k] = latency.bottom_line(image, top_px)
    across = columns(size)
    rows = found[:, :1] + found[:, 1:] * (across - (size[0] - 1) / 2)
    return Lines(times, np.stack([np.broadcast_to(across, rows.shape), rows], axis=-1))


def fit(lines: Lines, track: Track, known: Known) -> Bottom:
    """Fit plane and lag, outliers left out.

    Raises
    ------
    InputError
        If fewer than 20 B-scans show the bottom and have a pose, or the lag lies beyond those that are looked at.
    """
    lags = known.lag_s + np.arange(-SEARCH_S, SEARCH_S + STEP_S / 2, STEP_S)
    misfits = np.array([_misfit(lines, track, known.probe, lag) for lag in lags])
    if not np.isfinite(misfits).any():
        seen = np.isfinite(lines.pixels).all(axis=(1, 2)).sum()
        found = f"{seen} that show it, and {track.found.sum()} poses: another sweep, or other clocks?"
        raise InputError(f"bottom: expected at least {LEAST} B-scans that show a bottom and have a pose, found {found}")
    best = int(np.nanargmin(misfits))
    if best in (0, len(lags) - 1):
        found = f"the best at its end, {lags[best]:.2f} s"
        raise InputError(
            f"bottom: expected a lag within {SEARCH_S:g} s of {known.lag_s:g} s, found {found}; measure-lag finds it"
        )
    lag = float(lags[best])
    placed = _placed(lines, track, known.probe, lag)
    normal, offset = _plane(placed, known.probe, _whole(placed))
    for _ in range(ROUNDS):
        residuals = placed.points @ normal - offset
        spread = NORMAL_MAD * np.nanmedian(np.abs(residuals))
        used = np.abs(residuals).max(axis=1) < OUTLYING * max(spread, LEAST_SPREAD_MM)
        velocities = _velocities(lines, track, known.probe, lag)
        used &= np.isfinite(velocities).all(axis=(1, 2))
        if used.sum() < LEAST:
            raise InputError(f"bottom: expected at least {LEAST} B-scans that agree on one plane, found {used.sum()}")
        normal, offset = _plane(placed, known.probe, used)
        slopes = np.column_stack([placed.points[used].reshape(-1, 3), -np.ones(2 * used.sum())])
        slopes = np.column_stack([slopes @ _tangents(normal), -(velocities[used] @ normal).ravel()])
        left = placed.points[used] @ normal - offset
        step = -float(np.linalg.lstsq(slopes, left.ravel())[0][-1])
        if abs(step) < SETTLED_S:
            break
        lag += float(np.clip(step, -STEP_S, STEP_S))
        placed = _placed(lines, track, known.probe, lag)
    return Bottom(lag, normal, offset, used)


def equations(lines: Lines, track: Track, known: Known, bottom: Bottom) -> Equations:
    """Equations free of the plane, linear about the fit, with their faults: a moved probe, and a clock that is off."""
    used, probe, normal = bottom.used, known.probe, bottom.normal
    placed, n = _placed(lines, track, probe, bottom.lag_s), int(bottom.used.sum())
    points, turns = placed.points[used], placed.poses[used][:, :3, :3]
    by_lag = -(_velocities(lines, track, probe, bottom.lag_s)[used] @ normal)
    jacobian = place_slopes(probe.target_from_image, probe.scale, lines.pixels[used].reshape(-1, 2))
    by_probe = np.einsum("k,nkl,njlp->njp", normal, turns, jacobian.reshape(n, 2, 3, -1))
    by_plane = np.concatenate([points, -np.ones((n, 2, 1))], axis=2) @ _tangents(normal)
    missing = points @ normal - bottom.offset_mm + by_lag * (known.lag_s - bottom.lag_s)
    noise = _noise(placed, lines, track, known, bottom) + (JITTER_S * by_lag)[..., None] ** 2 * np.eye(2)
    whiten = whitening(noise)
    rest = whiten @ np.concatenate([-missing[..., None], by_probe, by_lag[..., None]], axis=2)
    free = eliminate((whiten @ by_plane).reshape(1, 2 * n, 3), rest.reshape(1, 2 * n, -1))[0]
    by_probe, by_lag = free[:, 1:-1], free[:, -1:]
    uncertain = [by_lag * known.lag_sigma_s]
    if probe.uncertainty is not None:
        uncertain.append(by_probe @ root(probe.uncertainty.ordered(NAMES)))
    daily = None if known.daily is None else by_probe @ root(known.daily.ordered(NAMES))
    faults = {PROBE: Fault(by_probe[:, 2:], USUAL_BEND), CLOCK: Fault(by_lag, USUAL_LAG)}
    whole = Equations(free[:, 0], np.column_stack(uncertain), faults, daily)
    factor = fault_tests.noise_factor(whole)
    faults = {name: Fault(fault.slopes / factor, fault.usual) for name, fault in faults.items()}
    return Equations(whole.residuals / factor, whole.spread / factor, faults, None if daily is None else daily / factor)


def _noise(placed: _Placed, lines: Lines, track: Track, known: Known, bottom: Bottom) -> Array:
    """Covariances : (n, 2, 2) mm^2 of the used points' distances from the plane, by poses and rows."""
    used, probe, normal = bottom.used, known.probe, bottom.normal
    arms = np.einsum("nij,nkj->nki", placed.poses[used][:, :3, :3], probe.to_target(lines.pixels[used]))
    by_pose = np.einsum("k,njkl->njl", normal, rigid.slopes(arms))
    own = tracks.covariance_at(track, lines.times[used], bottom.lag_s)
    if own is None:
        own = np.broadcast_to(ASSUMED, (used.sum(), 6, 6))
    by_row = probe.scale[1] * (placed.poses[used][:, :3, :3] @ probe.target_from_image[:3, 1]) @ normal
    return propagate(by_pose, own) + (DEPTH_PX * by_row)[:, None, None] ** 2 * np.eye(2)


def _misfit(lines: Lines, track: Track, probe: ProbeCalibration, lag_s: float) -> float:
    """Median distance, mm, from the plane at a lag; NaN where too few B-scans have a pose."""
    placed = _placed(lines, track, probe, lag_s)
    if (whole := _whole(placed)).sum() < LEAST:
        return np.nan
    normal, offset = _plane(placed, probe, whole)
    return float(np.median(np.abs(placed.points[whole] @ normal - offset)))


def _whole(placed: _Placed) -> NDArray[np.bool_]:
    """B-scans : (n,) with a line and a pose."""
    return np.isfinite(placed.points).all(axis=(1, 2))


def _placed(lines: Lines, track: Track, probe: ProbeCalibration, lag_s: float) -> _Placed:
    poses = tracks.poses_at(track, lines.times, lag_s)
    return _Placed(_points(poses, probe, lines), poses)


def _velocities(lines: Lines, track: Track, probe: ProbeCalibration, lag_s: float) -> Array:
    """Of the lines' points : (n, 2, 3) mm/s."""
    before, after = (_points(tracks.poses_at(track, lines.times, lag_s + step), probe, lines) for step in (RATE_S, -RATE_S))
    return (after - before) / (2 * RATE_S)


def _points(poses: Array, probe: ProbeCalibration, lines: Lines) -> Array:
    """Places : (n, 2, 3) mm of the lines' points."""
    return np.einsum("nij,nkj->nki", poses[:, :3, :3], probe.to_target(lines.pixels)) + poses[:, None, :3, 3]


def _plane(placed: _Placed, probe: ProbeCalibration, used: NDArray[np.bool_]) -> tuple[Array, float]:
    """Normal, downwards, and offset of the plane of least squares through the points of some B-scans : (n,).

    Heights are fitted over the places across: a probe that is moved straight up and down shows one place, and any upright plane
    is through all its points.
    """
    points = placed.points[used].reshape(-1, 3)
    down = (placed.poses[used][:, :3, :3] @ probe.target_from_image[:3, 1]).mean(axis=0)
    down /= np.linalg.norm(down)
    middle, across = points.mean(axis=0), np.linalg.svd(down[None])[2][1:]
    slopes = np.linalg.lstsq((points - middle) @ across.T, (points - middle) @ down, FLAT)[0]
    normal = down - slopes @ across
    normal /= np.linalg.norm(normal)
    return normal, float(normal @ middle)


def _tangents(normal: Array) -> Array:
    """Derivatives : (4, 3) of a plane's normal and offset by its three numbers."""
    across = np.linalg.svd(normal[None])[2][1:]
    tangents = np.zeros((4, 3))
    tangents[:3, :2], tangents[3, 2] = across.T, 1.0
    return tangents


def displacements(motion: Array, probe: ProbeCalibration, pixels: Array) -> Array:
    """Displacement : (k, 3) mm of pixels : (k, 2) of the B-scan caused by a motion : (6,) of the probe."""
    moved = ProbeCalibration(rigid.moved(probe.target_from_image, motion), probe.scale)
    return moved.to_target(pixels) - probe.to_target(pixels)
