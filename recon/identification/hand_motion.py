"""Motion of a hand and jitter of triggers, from the poses and rays of a tracked recording.

A frame's error and the hand's tremor look alike in a pose. They are told apart by their spectra: tremor lies in a band, noise is
white, what is led on purpose is slow. So a hand's motion beyond the band, up to half the frame rate, counts as noise, and
tremor of a frequency beyond half the frame rate isn't told from slower one. Where rays of both cameras miss each other no motion
shows, but one at a later time does: it grows with the speed across the rays' plane.
"""

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import make_interp_spline
from scipy.linalg import block_diag

from recon.geometry import rigid
from recon.identification.estimates import Estimate, Findings
from recon.identification.frame_scatter import scatter
from recon.identification.variance_components import Channel, Components, estimate, smooth_course

Array = NDArray[np.float64]

TREMOR, TURN, TRIGGER = (f"conditions.motion.{name}" for name in ("tremor_mm", "tremor_deg", "trigger_s"))
GIVE, GIVE_TURN = "conditions.motion.bracket_mm", "conditions.motion.bracket_deg"


@dataclass(frozen=True)
class MotionLimits:
    """What counts as tremor, and when it is measured."""

    band_hz: tuple[float, float] = (8.0, 12.0)  # physiological tremor [Elble & Koller 1990]
    led_hz: float = 5.5  # up to which a hand leads on purpose, or corrects what it does
    rate_hz: float = 27.0  # frames a second, at least: twice the band's end, and as much beyond as tells the noise
    gap_s: float = 0.1  # between frames, where a recording is parted; at least this many times a frame's own:
    gap_frames: float = 3.5
    free: float = 5.0  # frames between two knots of a course of gaps, at least
    least: int = 40  # frames without a gap
    most: int = 400  # that are taken together, as time grows with the third power
    tremor_mm: float = 5.0  # at most
    tremor_deg: float = 5.0
    trigger_s: float = 0.01
    bracket_mm: float = 5.0
    bracket_deg: float = 5.0
    shape: float = 0.03  # relative error of a tremor, by a spectrum that isn't even over the band, or ends elsewhere
    rough: float = 4.0  # times the predicted noise beside the band, from which on a hand isn't steady


LIMITS = MotionLimits()


class Poses(NamedTuple):
    """n poses in which the target was found, of one recording."""

    times: Array  # (n,) s
    poses: Array  # (n, 4, 4) mm, `world_from_target`
    covariance: Array  # (n, 6, 6) by each pair's own noise, as in `tracks.Track`


class Gaps(NamedTuple):
    """Signed lengths by which both rays of k circles miss each other in n pairs, along their common normals."""

    times: Array  # (n,) s
    mm: Array  # (n, k)
    variances: Array  # (n, k) mm^2, as predicted
    normals: Array  # (n, k, 3) unit, in the world
    places: Array  # (n, k, 3) mm, in the world

    def speeds(self, rows: slice) -> Array:
        """Speeds : (m, k) mm/s of the circles along the normals, in some rows one after the other."""
        speeds = make_interp_spline(self.times[rows], self.places[rows], k=5).derivative()(self.times[rows])
        return np.einsum("nki,nki->nk", speeds, self.normals[rows])


def runs(times: Array, limits: MotionLimits = LIMITS) -> Iterator[slice]:
    """Rows without a gap, as many as count, of times : (n,) s."""
    if len(times) < limits.least:
        return
    gap_s = max(limits.gap_s, limits.gap_frames / rate_of(times))
    starts = np.concatenate([[0], np.flatnonzero(np.diff(times) > gap_s) + 1, [len(times)]]).tolist()
    for first, end in itertools.pairwise(starts):
        parts = max(-(-(end - first) // limits.most), 1)
        edges = np.linspace(first, end, parts + 1).astype(int).tolist()
        yield from (slice(a, b) for a, b in itertools.pairwise(edges) if b - a >= limits.least)


def rate_of(times: Array) -> float:
    """Frames a second."""
    return 1 / float(np.median(np.diff(times)))


def find_tremor(recordings: Sequence[Poses], about_mm: Sequence[Array], names: str, limits: MotionLimits = LIMITS) -> Findings:
    """Standard deviations of a hand's tremor, of its shift and of its turn, in each axis.

    Parameters
    ----------
    recordings : of one hand, each at one frame rate
    about_mm : (3,) of each, in the target's frame: the point that is shifted, and about which it turns
    names : of the recordings, for people

    Returns
    -------
    Findings
        `conditions.motion.tremor_mm` and `tremor_deg`, and `tracker.moving_shift_over_predicted` and `..._turn_...`: noise
        beside the band, with any motion of the hand that is neither slow nor tremor.
    """
    usable = [(one, point) for one, point in zip(recordings, about_mm, strict=True) if _is_fast(one, limits)]
    parts = [(one, point, rows) for one, point in usable for rows in runs(one.times, limits)]
    if not parts:
        fastest = max((rate_of(one.times) for one in recordings if len(one.times) > 1), default=0.0)
        if recordings and not usable:
            needed = f"{limits.rate_hz:g} frames a second, more than twice the tremor's {limits.band_hz[1]:g} Hz"
            why = f"needs {needed}, found {fastest:.3g}"
        else:
            why = f"needs {limits.least} poses of a hand without a gap of {limits.gap_s:g} s, found none"
        return Findings(unknown=dict.fromkeys((TREMOR, TURN), why))
    groups = [_axes(one, point, rows, limits) for one, point, rows in parts]
    found = Findings()
    for name, noise, axes, unit, most in (
        (TURN, "tracker.moving_turn_over_predicted", range(3), np.rad2deg(1), limits.tremor_deg),
        (TREMOR, "tracker.moving_shift_over_predicted", range(3, 6), 1.0, limits.tremor_mm),
    ):
        known = estimate([[group[axis] for group in groups] for axis in axes], most / unit)
        found |= _told(name, noise, known, unit, f"{sum(rows.stop - rows.start for *_, rows in parts)} poses of {names}", limits)
    return found


def _is_fast(recording: Poses, limits: MotionLimits) -> bool:
    return len(recording.times) > 1 and rate_of(recording.times) >= limits.rate_hz


def _told(name: str, noise: str, known: Components, unit: float, source: str, limits: MotionLimits) -> Findings:
    """Tremor, and noise beside its band as the mean over axes; no tremor of a hand that moves as fast otherwise."""
    share = float(np.mean(known.noise))
    sigma = float(np.linalg.norm(known.noise_sigma) / len(known.noise))
    beside = {noise: Estimate(share, sigma, f"{source}, beside {limits.band_hz[0]:g} to {limits.band_hz[1]:g} Hz")}
    if share > limits.rough:
        why = f"moves beside {limits.band_hz[0]:g} to {limits.band_hz[1]:g} Hz, by {share:.1f} times the tracker's noise: hold it"
        return Findings(beside, {name: f"{why} as in a slow sweep"})
    text = f"{source}, {known.modes:.0f} independent numbers" + ("" if known.seen else "; none can't be excluded")
    sigma = unit * float(np.hypot(known.sigma, limits.shape * known.motion))
    return Findings({name: Estimate(unit * known.motion, sigma, text), **beside})


def _axes(recording: Poses, about_mm: Array, rows: slice, limits: MotionLimits) -> list[Channel]:
    """Six channels: turn, rad, and shift of the point, mm, about and along the world's axes."""
    times, poses = recording.times[rows], recording.poses[rows]
    first = poses[len(poses) // 2]
    arms = np.array([rigid.rotate(pose, about_mm) for pose in poses])
    steps = np.array([rigid.difference(first, pose) for pose in poses])
    steps[:, 3:] += arms - arms[len(poses) // 2]
    to_point = rigid.slopes(arms)
    shifts = to_point @ recording.covariance[rows] @ np.swapaxes(to_point, 1, 2)
    covariance = np.concatenate([_diagonal(recording.covariance[rows])[:, :3], _diagonal(shifts)], axis=1)
    shaken, course = band_covariance(times, limits.band_hz), smooth_course(times, 0.5 / limits.led_hz)
    return [Channel(steps[:, k], covariance[:, k], shaken, course) for k in range(6)]


def _diagonal(matrices: Array) -> Array:
    return np.diagonal(matrices, axis1=1, axis2=2)


def band_covariance(times: Array, band_hz: tuple[float, float]) -> Array:
    """Covariance : (n, n) of a process of unit variance whose power is even over a band, at times : (n,) s."""
    low, high = band_hz
    apart = times[:, None] - times
    return np.cos(np.pi * (low + high) * apart) * np.sinc((high - low) * apart)


def find_trigger(recordings: Sequence[Gaps], names: str, limits: MotionLimits = LIMITS) -> Findings:
    """Standard deviation of each camera's trigger, and the noise of the rays' gaps over the predicted one.

    Two cameras that expose at unlike times see a moving target at two places: rays miss each other by the speed along their
    normal times that difference. The noise is told from it by the gaps of single circles against their mean, in any motion.

    Returns
    -------
    Findings
        `conditions.motion.trigger_s`, unknown where nothing moves, and `tracker.rays_over_predicted`.
    """
    channels = [channel for one in recordings for rows in runs(one.times, limits) for channel in _gap_channels(one, rows, limits)]
    if not channels:
        why = f"needs {limits.least} poses in a row"
        return Findings(unknown={TRIGGER: why, "tracker.rays_over_predicted": why})
    known = estimate([channels], limits.trigger_s)
    source = f"gaps of rays in {sum(len(one.times) for one in recordings)} pairs of {names}"
    found = {"tracker.rays_over_predicted": Estimate(float(known.noise[0]), float(known.noise_sigma[0]), source)}
    if known.motion + known.sigma > limits.trigger_s / 2:
        why = f"needs a target that moves across the plane of both cameras' axes, found none in {names}"
        return Findings(found, {TRIGGER: why})
    text = source + ("" if known.seen else "; none can't be excluded")
    return Findings({TRIGGER: Estimate(known.motion, known.sigma, text), **found})


def _gap_channels(gaps: Gaps, rows: slice, limits: MotionLimits) -> Iterator[Channel]:
    """The mean gap of all circles, which jitter of both cameras moves most, and contrasts between circles, hardly moved."""
    times, values, variances = gaps.times[rows], gaps.mm[rows], gaps.variances[rows]
    course = smooth_course(times, max(0.5 / limits.led_hz, limits.free / rate_of(times)))
    speeds = gaps.speeds(rows)
    count = values.shape[1]
    contrasts = [np.concatenate([np.full(k, 1 / k), [-1.0], np.zeros(count - k - 1)]) for k in range(1, count)]  # Helmert's
    for weights in (np.full(count, 1 / count), *contrasts):
        yield Channel(values @ weights, variances @ weights**2, np.diag(2 * (speeds @ weights) ** 2), course)


def bracket_give(steps: Array, covariances: Array, source: str, limits: MotionLimits = LIMITS) -> Findings:
    """Standard deviations of a bracket's giving over a session, in each axis, from calibrations of the probe before and after.

    Few sessions have few numbers, three each, so that the interval of 95 % of one reaches from half to four times the value.

    Parameters
    ----------
    steps : (m, 6) rad and mm, from each session's first calibration to its last, as of `rigid.difference`
    covariances : (m, 6, 6) of these, by both calibrations' own errors

    Returns
    -------
    Findings
        `conditions.motion.bracket_mm` and `bracket_deg`.
    """
    found = {}
    for name, axes, unit, most in (
        (GIVE_TURN, slice(0, 3), np.rad2deg(1), limits.bracket_deg),
        (GIVE, slice(3, 6), 1.0, limits.bracket_mm),
    ):
        information = np.linalg.inv(block_diag(*covariances[:, axes, axes]))
        known = scatter(information, information @ steps[:, axes].ravel(), most / unit)
        found[name] = Estimate(unit * known.value, unit * known.sigma, source)
    return Findings(found)
