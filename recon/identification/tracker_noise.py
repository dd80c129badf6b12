"""A tracker's noise and drop-outs over light and smear, against the noise that it predicts.

Frames of a target in a stand show all noise that is new in each frame, of centres and of poses; not what pixels, print and lens
do alike in all of them. In a hand no centre shows its noise, as all may move. But rays of one circle through both cameras meet
in any motion: the lengths by which they miss are noise, and jitter of triggers, which moves all circles by their speeds.
"""

import itertools
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from scipy.stats import binomtest

from recon.geometry.camera import Camera
from recon.identification.estimates import Estimate, Findings
from recon.identification.frame_scatter import NINETY_FIVE
from recon.identification.hand_motion import Gaps, Poses, runs
from recon.identification.variance_components import RANK, smooth_course
from recon.tracking.pose_fit import meet

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

CONTRASTS = (0.0, 8.0, 15.0, 30.0, 60.0, 120.0, 256.0)  # DN of 255, ends of the table's parts
SMEARS = (0.0, 1.0, 3.0, 6.0, 12.0, np.inf)  # px
FEW = 30  # values, or frames, of which a part of the table says nothing
STILL = ("centre_px", "centre_over_predicted", "noise_mm", "noise_deg", "pose_over_predicted")
SLOW_S = 0.25  # in which what pixels, print and lens do changes with the place
MOVED = 1.5  # times the rays' noise, over the prediction: a target whose poses scatter so isn't still
PIXEL = 0.05  # px, a step for slopes
LEAST_MM_S = 1e-3  # of all circles alike: of what rests, the mean gap is left out


class Recording(NamedTuple):
    """n pairs of frames of a target of k circles, tracked."""

    times: Array  # (n,) s
    poses: Array  # (n, 4, 4) mm, `world_from_target`; NaN without a pose
    covariance: Array  # (n, 6, 6) by each pair's own noise
    centres: Array  # (n, 2, k, 2) px, in both cameras; NaN of one that isn't seen
    centre_covariance: Array  # (n, 2, k, 2, 2) px^2
    contrast: Array  # (n, 2, k) DN of 255
    smear: Array  # (n, 2, k) px, path over the exposure
    in_view: Mask  # (n,) False where the tracker knows that the target has left a view

    @property
    def found(self) -> Mask:
        """Where there is a pose : (n,)."""
        return np.isfinite(self.poses).all(axis=(1, 2))

    @property
    def tracked(self) -> Poses:
        """Those poses."""
        return Poses(self.times[self.found], self.poses[self.found], self.covariance[self.found])

    @property
    def whole(self) -> Mask:
        """Where there is a pose by all circles in both views : (n,)."""
        return self.found & np.isfinite(self.centres).all(axis=(1, 2, 3))


def gaps_of(recording: Recording, cameras: tuple[Camera, Camera]) -> Gaps:
    """Gaps of both cameras' rays, with variances by the slopes of the gaps; an ellipse's centre counts as its circle's."""
    rows = recording.whole
    pixels, noise = np.moveaxis(recording.centres[rows], 1, 0), np.moveaxis(recording.centre_covariance[rows], 1, 0)
    count, circles = pixels.shape[1:3]

    def met(both: Array) -> tuple[Array, Array]:
        points, gaps = meet(cameras, both.reshape(2, -1, 2))
        return points.reshape(count, circles, 3), gaps.reshape(count, circles)

    points, gaps = met(pixels)
    variances = np.zeros((count, circles))
    for camera in range(2):
        slopes = np.empty((count, circles, 2))
        for axis in range(2):
            step = np.zeros((2, 1, 1, 2))
            step[camera, ..., axis] = PIXEL
            slopes[..., axis] = (met(pixels + step)[1] - met(pixels - step)[1]) / (2 * PIXEL)
        variances += np.einsum("nki,nkij,nkj->nk", slopes, noise[camera], slopes)
    first, second = (camera.rays(each) for camera, each in zip(cameras, pixels, strict=True))
    normals = np.cross(first, second)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    return Gaps(recording.times[rows], gaps, variances, normals, points)


def still_noise(recordings: Sequence[Recording], rays: Estimate | None, names: str) -> Findings:
    """Noise of centres and poses of a target in a stand, as it scatters about a straight course, and over the predicted one.

    Parameters
    ----------
    rays : their noise over the predicted one in the same recordings; by it one that isn't still is known

    Returns
    -------
    Findings
        `tracker.centre_px` along each axis; `noise_mm` and `noise_deg` over all directions, at the target's origin;
        `centre_over_predicted` and `pose_over_predicted`, 1 of a tracker that is as good as it says.
    """
    centres, poses = list[_Scatter](), list[_Scatter]()
    shifts, turns = list[_Scatter](), list[_Scatter]()
    for one in recordings:
        if one.found.sum() < FEW:
            continue
        rows, tracked = one.whole, one.tracked
        if rows.sum() >= FEW:
            centres.append(_scatter(one.times[rows], one.centres[rows].reshape(rows.sum(), -1, 2), one.centre_covariance[rows]))
        middle = tracked.poses[len(tracked.poses) // 2]
        steps = np.concatenate([_turns(tracked.poses, middle), tracked.poses[:, :3, 3] - middle[:3, 3]], axis=1)
        poses.append(_scatter(tracked.times, steps[:, None], tracked.covariance))
        turns.append(_scatter(tracked.times, steps[:, None, :3], tracked.covariance[:, :3, :3]))
        shifts.append(_scatter(tracked.times, steps[:, None, 3:], tracked.covariance[:, 3:, 3:]))
    if not poses:
        return Findings(unknown={f"tracker.{name}": f"needs {FEW} poses of a target in a stand" for name in STILL})
    source = f"{sum(int(one.found.sum()) for one in recordings)} poses in {names}"
    ratio = _ratio(poses, source)
    if rays is not None and ratio.value - NINETY_FIVE * ratio.sigma > MOVED * (rays.value + NINETY_FIVE * rays.sigma):
        why = f"moves in {names}: poses scatter by {ratio.value:.1f} times the predicted noise, rays by {rays.value:.1f} times"
        return Findings(unknown={f"tracker.{name}": why for name in STILL})
    found = {
        "noise_mm": _size(shifts, 3, 1.0, source),
        "noise_deg": _size(turns, 3, np.rad2deg(1), source),
        "pose_over_predicted": ratio,
    }
    if centres:
        found |= {"centre_px": _size(centres, 1, 1.0, source), "centre_over_predicted": _ratio(centres, source)}
    missing = {f"tracker.{name}": "no pair shows all circles" for name in STILL if name not in found}
    return Findings({f"tracker.{name}": one for name, one in found.items()}, missing)


class _Scatter(NamedTuple):
    """What a straight course leaves of m quantities of d numbers each, in n frames."""

    left: Array  # (n, m, d)
    whitened: Array  # (n, m, d) by the predicted covariances
    freedom: float  # of n, a number


def _scatter(times: Array, values: Array, covariance: Array) -> _Scatter:
    """Scatter of values : (n, m, d) with covariances : (n, ..., d, d)."""
    count, size = len(values), values.shape[-1]
    course, _ = np.linalg.qr(np.column_stack([np.ones(count), times - times.mean()]))
    left = values - np.einsum("np,qp,qmd->nmd", course, course, values)
    own = covariance.reshape(count, -1, size, size)
    return _Scatter(left, np.linalg.solve(np.linalg.cholesky(own), left[..., None])[..., 0], count - course.shape[1])


def _turns(poses: Array, middle: Array) -> Array:
    """Rotation vectors : (n, 3) rad from one pose to others."""
    return Rotation.from_matrix(poses[:, :3, :3] @ middle[:3, :3].T).as_rotvec()


def _ratio(parts: Sequence[_Scatter], source: str) -> Estimate:
    """Noise over the predicted one."""
    values = np.concatenate([part.whitened.ravel() for part in parts])
    freedom = sum(part.freedom * part.whitened[0].size for part in parts)
    return Estimate(*_root_mean_square(values, freedom), f"{source}, {freedom:.0f} numbers")


def _size(parts: Sequence[_Scatter], directions: int, unit: float, source: str) -> Estimate:
    """Noise in its unit, over some directions."""
    values = np.concatenate([part.left.ravel() for part in parts])
    size, sigma = _root_mean_square(values, sum(part.freedom * part.left[0].size for part in parts))
    return Estimate(unit * np.sqrt(directions) * size, unit * np.sqrt(directions) * sigma, source)


def _root_mean_square(values: Array, freedom: float) -> tuple[float, float]:
    """Standard deviation of values about zero, of which some freedom is left, and its own: by their fourth moment."""
    variance = float(values @ values) / freedom
    excess = max(float(np.mean(values**4)) / float(np.mean(values**2)) ** 2 - 3, 0.0)
    return float(np.sqrt(variance)), float(np.sqrt(variance * (2 + excess) / (4 * freedom)))


class _Cells(NamedTuple):
    """Values with the light and the smear that they were measured in."""

    contrast: Array
    smear: Array

    def parts(self) -> Iterator[tuple[str, Mask]]:
        """Names of the table's parts, and their values."""
        for low, high in itertools.pairwise(CONTRASTS):
            for near, far in itertools.pairwise(SMEARS):
                smear = f"smear_{near:g}_to_{far:g}_px" if np.isfinite(far) else f"smear_from_{near:g}_px"
                inside = (self.contrast >= low) & (self.contrast < high) & (self.smear >= near) & (self.smear < far)
                yield f"tracker.contrast_{low:g}_to_{high:g}_dn.{smear}", inside


def noise_table(recordings: Sequence[tuple[Recording, Gaps]], names: str) -> Findings:
    """Noise of centres over contrast and smear, by the gaps of rays: `centre_px` along an axis, and `over_predicted`."""
    rows = [part for one, gaps in recordings for part in _gap_scatter(one, gaps)]
    if not rows:
        return Findings()
    contrast, smear, square, freedom, predicted = np.concatenate(rows, axis=1)
    found = dict[str, Estimate]()
    for name, inside in _Cells(contrast, smear).parts():
        if freedom[inside].sum() >= FEW:
            values = np.sqrt(square[inside])
            ratio, sigma = _root_mean_square(values, float(freedom[inside].sum()))
            typical, source = float(np.sqrt(predicted[inside].mean())), f"{inside.sum()} gaps of rays of {names}"
            found[f"{name}.centre_px"] = Estimate(ratio * typical, sigma * typical, source)
            found[f"{name}.over_predicted"] = Estimate(ratio, sigma, source)
    return Findings(found)


def _gap_scatter(recording: Recording, gaps: Gaps) -> Iterator[Array]:
    """Of gaps, but for jitter : (5, m) contrast, smear, square over the predicted one, freedom, predicted variance in px^2."""
    rows = recording.whole
    contrast, smear = recording.contrast[rows].min(axis=1), recording.smear[rows].max(axis=1)
    pixels = np.trace(recording.centre_covariance[rows], axis1=3, axis2=4).mean(axis=1) / 2
    for some in runs(gaps.times):
        scale, course = 1 / np.sqrt(gaps.variances[some]), smooth_course(gaps.times[some], SLOW_S)
        late = scale * (gaps.speeds(some) + LEAST_MM_S)
        late /= np.linalg.norm(late, axis=1, keepdims=True)
        beside = np.eye(late.shape[1]) - late[:, :, None] * late[:, None, :]  # what jitter leaves, of each pair
        design = np.einsum("nab,nb,np->nabp", beside, scale, course).reshape(late.size, -1)
        axes, singular, _ = np.linalg.svd(design, full_matrices=False)
        axes = axes[:, singular > RANK * singular[0]]
        left = np.einsum("nab,nb->na", beside, scale * gaps.mm[some]).ravel()
        left -= axes @ (axes.T @ left)
        freedom = (1 - late**2).ravel() - (axes**2).sum(axis=1)
        yield np.stack([each.ravel() for each in (contrast[some], smear[some], left**2, freedom, pixels[some])])


def drop_outs(recordings: Sequence[Recording], names: str) -> Findings:
    """Shares of frames without a pose, of those in view, with Wilson's interval: of all, and over contrast and smear.

    Light and smear of a frame without a pose are those between its neighbours.
    """
    found = np.concatenate([one.found[one.in_view] for one in recordings])
    if not len(found):
        return Findings(unknown={"tracker.dropped": f"never in view in {names}"})
    left = sum(int((~one.in_view).sum()) for one in recordings)
    beside = f"; {left} out of view don't count" if left else ""
    told = {"tracker.dropped": _share(found, f"of {len(found)} pairs of {names}{beside}")}
    light = np.concatenate([_between(one, one.contrast)[one.in_view] for one in recordings])
    smear = np.concatenate([_between(one, one.smear)[one.in_view] for one in recordings])
    for name, inside in _Cells(light, smear).parts():
        if inside.sum() >= FEW:
            told[f"{name}.dropped"] = _share(found[inside], f"of {inside.sum()} pairs of {names}")
    return Findings(told)


def _share(found: Mask, of: str) -> Estimate:
    """Share without a pose: the middle of Wilson's interval, and half of its half."""
    lost = int((~found).sum())
    interval = binomtest(lost, len(found)).proportion_ci(0.95, "wilson")
    return Estimate((interval.low + interval.high) / 2, (interval.high - interval.low) / (2 * NINETY_FIVE), f"{lost} {of}")


def _between(recording: Recording, values: Array) -> Array:
    """Medians over circles and cameras : (n,) of values : (n, 2, k), from neighbours where there is no pose; NaN without any."""
    known = recording.found & np.isfinite(values).any(axis=(1, 2))
    if not known.any():
        return np.full(len(values), np.nan)
    middle = np.array([np.nanmedian(row) for row in values[known]])
    return np.interp(recording.times, recording.times[known], middle)
