"""The tip of a tracked stylus or needle, at rest or led about, found by `needle_echo`.

In the frame of its target the tip is a point at rest, so that the probe, by poses in that frame, is calibrated as by crossed
wires. Its place there may be known, from `tip.yaml`: then the probe needs no turns.

Source: Muratore and Galloway 2001, Ultrasound in Medicine and Biology 27(5).
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc

from recon.capture import tip_files
from recon.errors import InputError
from recon.estimation.covariance import propagate
from recon.files.metrics import Metrics
from recon.geometry import rigid
from recon.model.tip import TIP, Tip
from recon.probe_calibration import movement, needle_echo, point_calibration, point_phantom
from recon.probe_calibration.cross_wire import Appearance
from recon.probe_calibration.needle_echo import NeedleEcho
from recon.probe_calibration.phantom_frames import PhantomFrames
from recon.probe_calibration.point_calibration import MIN_FRAMES, Adjustment, Sightings
from recon.probe_calibration.point_phantom import misfit
from recon.probe_calibration.tank_calibration import Settings

Array = NDArray[np.float64]

__all__ = ["MIN_FRAMES", "SHOWS", "WAYS", "calibrate", "describe", "figures", "find", "misfit", "read", "sight"]
SHOWS = "tip"
WAYS = {
    "no echo stands out": "another scanner? give appearance.min_contrast_db",
    "fades out": "hold the tip in the image's plane, and turn the shaft into it or well across",
    "ends at the image's border": "bring the tip into the image; is it a stylus, no wire?",
    "two candidates": "another needle, or a border? give clip=[u,v,width,height] without it",
}
ALL = slice(None)
CHANCE = 1e-5  # of a tip as far from tip.yaml's by what both leave open, below which it is another one
LEAST_MM = 1e-4  # of a tip's standard deviation
APART_MM = 0.5  # less than that is no other tip, but a bent shaft


def read(settings: Settings, reference: str | None) -> Tip | None:
    """The tip, where it is known."""
    if reference is None and settings.body is None:
        raise InputError("body: expected the stylus' name among the sweep's bodies, such as needle, found none")
    return None if settings.tip is None else tip_files.read(settings.tip, settings.body or "")


def find(image: NDArray, appearance: Appearance | None, known: Tip | None) -> NeedleEcho:
    """Find the tip."""
    del known
    return needle_echo.find(image, appearance)


def sight(
    seen: Sequence[NeedleEcho], poses: Array, covariance: Array | None, rates: Array | None, lag_sigma_s: float
) -> Sightings:
    """The tip in n frames."""
    pixels = np.array([each.pixel for each in seen]).reshape(-1, 2)
    own = np.array([each.covariance for each in seen]).reshape(-1, 2, 2)
    by_lag = lag_sigma_s * rates if lag_sigma_s and rates is not None else None
    return Sightings(poses, pixels, covariance, own, pose_by_lag=by_lag, pose_rates=rates)


@dataclass(frozen=True)
class StylusAdjustment(Adjustment):
    """An adjustment to a stylus' tip, its wire, about where the tip is known to be."""

    held_out_mm: float = np.nan  # RMS distance of the tip in half of the frames, by the other half


def calibrate(frames: PhantomFrames, settings: Settings, expected: Array) -> StylusAdjustment:
    """Calibrate by the tip, at the place where `tip.yaml` has it, or at any without one.

    Raises
    ------
    InputError
        As `point_calibration.calibrate`, or if the frames show another tip.
    """
    sightings: Sightings = frames.sightings
    if sightings.pose_covariance is None:
        sightings = replace(sightings, pose_covariance=settings.noise.from_body(sightings.poses))
    tip: Tip | None = frames.known
    if tip is None:
        return _adjust(frames, sightings, settings, expected, None)
    variances, axes = np.linalg.eigh(tip.covariance_of(TIP))
    there = _in_frame(sightings, rigid.invert(rigid.transform(axes * np.linalg.det(axes), tip.tip_mm)))
    free = wrong = None
    try:
        free = _calibrate(frames, there, settings, expected, None)
    except InputError as error:  # for lack of turns, of which a known tip needs none, or for what is wrong with that, too
        wrong = None if str(error).startswith("motion") else error
    if free is not None and free.wire_covariance is not None:
        _check_tip(free.wire, free.wire_covariance + np.diag(variances))
    try:
        return _adjust(frames, there, settings, expected, np.sqrt(np.maximum(variances, LEAST_MM**2)))
    except InputError as error:
        raise (wrong or error) from None


def _calibrate(
    frames: PhantomFrames, sightings: Sightings, settings: Settings, expected: Array, sigma: Array | None, some: slice = ALL
) -> Adjustment:
    """By some of the sightings, of a tip at the origin to a standard deviation along each axis, or of an unknown one."""
    return point_calibration.calibrate(
        sightings.of(some),
        frames.size,
        settings.noise,
        expected,
        settings.seed,
        settings.echo_ahead_mm,
        settings.echo_ahead_sigma_mm,
        settings.max_sigma_mm if some == ALL else np.inf,
        frames.numbers[frames.usable][some],
        sigma,
    )


def _adjust(
    frames: PhantomFrames, sightings: Sightings, settings: Settings, expected: Array, sigma: Array | None
) -> StylusAdjustment:
    """As `_calibrate` by all, and each half of the frames by the other half, where these suffice."""
    found = _calibrate(frames, sightings, settings, expected, sigma)
    behind, away = rigid.transform(np.eye(3), [0, settings.echo_ahead_mm, 0]), []
    for half, others in ((slice(0, None, 2), slice(1, None, 2)), (slice(1, None, 2), slice(0, None, 2))):
        try:
            one = _calibrate(frames, sightings, settings, expected, sigma, half)
        except InputError:
            away.append(np.full(1, np.nan))
            continue
        echo = replace(one.calibration, target_from_image=one.calibration.target_from_image @ behind)
        seen = sightings.of(others).of(~found.outliers[others])
        places = np.einsum("nij,nj->ni", seen.poses[:, :3, :3], echo.to_target(seen.pixels)) + seen.poses[:, :3, 3]
        away.append(np.linalg.norm(places - one.wire, axis=1))
    held_out = float(np.sqrt(np.mean(np.concatenate(away) ** 2)))
    values = {each.name: getattr(found, each.name) for each in fields(found)}
    return StylusAdjustment(**values, held_out_mm=held_out)


def _in_frame(sightings: Sightings, to_from: Array) -> Sightings:
    """The same with poses in another frame."""
    turn = np.kron(np.eye(2), to_from[:3, :3])
    assert sightings.pose_covariance is not None
    turned = rigid.transform(to_from[:3, :3], np.zeros(3))
    by_lag, rates = (None if each is None else turned @ each for each in (sightings.pose_by_lag, sightings.pose_rates))
    covariance = propagate(turn, sightings.pose_covariance)
    poses = to_from @ sightings.poses
    return replace(sightings, poses=poses, pose_covariance=covariance, pose_by_lag=by_lag, pose_rates=rates)


def _check_tip(off: Array, covariance: Array) -> None:
    """Refuse a tip that frames show elsewhere than it is known to be."""
    away = float(np.linalg.norm(off))
    if away > APART_MM and chdtrc(3, float(off @ np.linalg.solve(covariance, off))) < CHANCE:
        sigma = float(np.sqrt(np.linalg.eigvalsh(covariance).max()))
        found = f"it {away:.1f} ± {sigma:.1f} mm from there: another tool's file, a bent shaft, or a target that was moved?"
        raise InputError(f"tip: expected the tip in the B-scans where its file has it, found {found} tip=null finds it anew")


def figures(found: StylusAdjustment) -> Metrics:
    """The tip's distance from where it was known to be, or from the stylus' origin, and the error of held-out frames."""
    own = {"tip_off_mm": float(np.linalg.norm(found.wire)), "held_out_rms_mm": found.held_out_mm}
    return own | {name: value for name, value in point_phantom.figures(found).items() if name != "wires_apart_mm"}


def describe(found: StylusAdjustment, settings: Settings) -> Iterator[str]:
    """The held-out error, the tip, and what moved."""
    assert found.wire_covariance is not None
    sigma = float(np.sqrt(np.trace(found.wire_covariance)))
    if np.isfinite(found.held_out_mm):
        yield f"held out    {found.held_out_mm:.3f} mm (RMS of the tip, odd frames by even ones and back)"
    if settings.tip is None:
        place = " ".join(f"{value:.2f}" for value in found.wire)
        yield f"tip         [{place}] ± {sigma:.2f} mm in the stylus' frame, found with the probe; tip= takes it as known"
    else:
        yield f"tip         {np.linalg.norm(found.wire):.3f} mm from where {settings.tip} has it, ± {sigma:.3f} mm"
    if found.late is not None and found.late.shown:
        yield f"warning     {found.late.described}"
    if found.moved is not None and found.moved.what == movement.PROBE:
        yield f"warning     {found.moved.described}"
    elif found.moved is not None:
        cause = "a shaft that bends, or a target that slips"
        yield f"warning     the tip moved by {found.moved.shift_mm:.2f} mm in the stylus' frame from first to last: {cause}"
