"""Figures of a probe's calibration, the lines that report them, and the table of its frames."""

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from scipy.special import chdtrc

from recon import registry
from recon.files.metrics import Metrics
from recon.geometry import rigid
from recon.model.probe import NAMES, ProbeCalibration
from recon.model.rig import Probe
from recon.probe_calibration import (
    misreadings,
    movement,
    phantom_frames,
    point_calibration,
    probe_checks,
    repeatability,
    sound_in_water,
)
from recon.probe_calibration.phantom_frames import PHANTOMS, Adjusted, PhantomFrames
from recon.probe_calibration.tank_calibration import Result, Settings

COLUMNS = ("frame", "status", "u", "v", "contrast_db", "residual_mm", "normalised", "reason")  # of the table of frames
FIVE_POINTS = ("centre", "top_left", "top_right", "bottom_left", "bottom_right")
WIDER, SURE = 0.015, 4.0  # relative, and standard deviations, of sx beyond the scanner's: to 1 % scanners have it
EDGE = 3  # frames at an end, of which it is said that all are outliers
SPEEDS_APART = 0.03  # relative; water 15 degrees colder, or a depth setting of 50 mm for one of 48
SHOWN_DEPTH_MM = 50.0  # at which the error of a wrong speed of sound is reported
NOISY = 3.0  # times the assumed noise, beyond which something else than noise is likely, though few frames don't show what
FREEZING_F = 32.0  # degrees Fahrenheit


def measure(frames: PhantomFrames, result: Result, design: Probe, settings: Settings) -> Metrics:
    """Figures of a calibration, each named with its unit."""
    found, calibration, uncertainty = result.adjustment, result.calibration, result.calibration.uncertainty
    assert uncertainty is not None
    expected = design.target_from_image.matrix()
    pixels = repeatability.five_points(frames.size)
    sigma = np.sqrt(np.trace(point_calibration.point_covariance(calibration, pixels), axis1=1, axis2=2))
    turn = Rotation.from_matrix(expected[:3, :3].T @ calibration.target_from_image[:3, :3]).magnitude()
    away = calibration.to_target(pixels[0]) - ProbeCalibration(expected, np.array(design.scale_mm_per_px)).to_target(pixels[0])
    return {
        "frames": len(frames.numbers),
        "frames_rejected": len(frames.numbers) - len(frames.usable),
        "frames_outliers": int(found.outliers.sum()),
        "frames_used": int((~found.outliers).sum()),
        "rms_mm": found.rms_mm,
        "noise_factor": found.noise_factor,
        "echo_ahead_mm": settings.echo_ahead_mm,
        **registry.kind(PHANTOMS, frames.phantom).figures(found),
        "sx_mm_per_px": float(calibration.scale[0]),
        "sy_mm_per_px": float(calibration.scale[1]),
        "sx_sigma_mm_per_px": uncertainty.sigma("sx"),
        "sy_sigma_mm_per_px": uncertainty.sigma("sy"),
        "sy_measured_mm_per_px": float(found.calibration.scale[1]),
        **{f"sigma_{name}_mm": float(value) for name, value in zip(FIVE_POINTS, sigma, strict=True)},
        "scanner_sy_mm_per_px": result.shown_sy,
        "implied_speed_m_per_s": result.implied_speed[0],
        "implied_speed_sigma_m_per_s": result.implied_speed[1],
        "water_speed_m_per_s": settings.water_speed,
        "speed_m_per_s": calibration.speed_m_s,
        "design_turn_deg": float(np.degrees(turn)),
        "design_centre_mm": float(np.linalg.norm(away)),
        "moved_mm": 0.0 if found.moved is None else found.moved.shift_mm,
        "moved_deg": 0.0 if found.moved is None else found.moved.turn_deg,
        "moved_chance": 1.0 if found.moved is None else found.moved.chance,
    }


def compare(calibration: ProbeCalibration, earlier: ProbeCalibration) -> Metrics:
    """Figures of the probe's movement against its target since an earlier calibration, both for sound of one speed.

    `since_chance`, of as much by what both leave open, is NaN where the earlier one has no covariance.
    """
    before = sound_in_water.for_tissue(earlier, calibration.speed_m_s)
    step = rigid.difference(before.target_from_image, calibration.target_from_image)
    covariance = sum((_of_pose(each) for each in (before, calibration)), np.zeros((6, 6)))
    squared = float(step @ np.linalg.pinv(covariance) @ step)
    return {
        "since_turn_deg": float(np.degrees(np.linalg.norm(step[:3]))),
        "since_shift_mm": float(np.linalg.norm(step[3:])),
        "since_chance": np.nan if earlier.uncertainty is None else float(chdtrc(len(step), squared)),
    }


def _of_pose(calibration: ProbeCalibration) -> NDArray[np.float64]:
    """Covariance : (6, 6) of the turn and the shift; zero if there is none."""
    known = calibration.uncertainty
    return np.zeros((6, 6)) if known is None else known.ordered(NAMES)[2:, 2:]


def describe_frames(frames: PhantomFrames, seconds: float) -> Iterator[str]:
    """Lines: number of frames with the phantom, and reasons of the others."""
    width, height = frames.size
    found, count = len(frames.usable), len(frames.numbers)
    shows = registry.kind(PHANTOMS, frames.phantom).SHOWS
    yield f"find        {count} frames, {width}x{height}: {shows} in {found}, {count - found} rejected, {seconds:.0f} s"
    told = [np.concatenate([frames.poses[k].ravel(), frames.seen[k].pixel]) for k in frames.usable]
    if again := len(told) - len(np.unique(told, axis=0)):
        yield f"warning     {again} frames repeat pose and pixel of others, and count again, so that sigma is too small"
    for reason, numbers in phantom_frames.rejected(frames).items():
        yield f"rejected    {len(numbers)} {reason}: frame{'s' if len(numbers) > 1 else ''} {_listed(numbers)}"


def describe(frames: PhantomFrames, result: Result, figures: Metrics, design: Probe, settings: Settings) -> Iterator[str]:
    """Lines: agreement of the frames, the probe with its uncertainty, and the speed of sound with its effect on depths."""
    found, expected = result.adjustment, design.target_from_image.matrix()
    numbers = frames.numbers[frames.usable][found.outliers].tolist()
    left_out = f", {len(numbers)} outlier{'s' if len(numbers) > 1 else ''} left out ({_listed(numbers)})" if numbers else ""
    rms, factor = figures["rms_mm"], figures["noise_factor"]
    yield f"calibrate   {figures['frames_used']} frames{left_out}; RMS {rms:.3f} mm, noise {factor:.2f} times the assumed"
    if factor > NOISY:
        likely = "a bracket that slipped, a phantom that was pushed, a lag, or a tracker that is less exact than noise= says"
        yield f"warning     the frames agree to {factor:.1f} times the assumed noise only: {likely}"
    yield from registry.kind(PHANTOMS, frames.phantom).describe(found, settings)
    scales = ", ".join(
        f"{name} {figures[f'{name}_mm_per_px']:.5f} ± {figures[f'{name}_sigma_mm_per_px']:.5f}" for name in ("sx", "sy")
    )
    turn, away = figures["design_turn_deg"], figures["design_centre_mm"]
    yield f"probe       {scales} mm/px; {turn:.1f} deg and {away:.1f} mm from its design"
    yield f"pose        {probe_checks.described(result.calibration)}"
    for doubt in probe_checks.doubts(found.calibration, frames.size, expected):
        yield f"warning     {doubt}"
    corners = [figures[f"sigma_{name}_mm"] for name in FIVE_POINTS[1:]]
    centre, edge = f"{figures['sigma_centre_mm']:.3f} mm", f"{min(corners):.3f} to {max(corners):.3f} mm"
    if (share := float(found.outliers.mean())) >= misreadings.MANY:
        cause = "something moved, or what was found is something else"
        yield f"warning     {100 * share:.0f} % of the frames are outliers: {cause}"
    for which, outliers, there in (("last", found.outliers[::-1], "before"), ("first", found.outliers, "after")):
        if (count := int(outliers.argmin())) >= EDGE:
            slipped = f"if the bracket slipped {there} them, the result is of {there}"
            yield f"warning     the {which} {count} frames are outliers: {slipped}"
    yield f"uncertain   image centre {centre}, corners {edge} (1 sigma, of the place in space)"
    yield from _describe_sound(figures, result.wider, settings)


def describe_comparison(figures: Metrics, earlier: object) -> str:
    """One line: whether the probe is where an earlier calibration had it."""
    by = f"{figures['since_turn_deg']:.2f} deg and {figures['since_shift_mm']:.2f} mm"
    if np.isnan(figures["since_chance"]):
        return f"earlier     {by} from {earlier}, which has no covariance to judge that by"
    if figures["since_chance"] > movement.CHANCE:
        return f"earlier     as in {earlier}: {by} from it, within what both calibrations leave open"
    return f"warning     the probe moved against its target by {by} since {earlier}: a bent bracket, or a target that slipped"


def _describe_sound(figures: Metrics, wider: float, settings: Settings) -> Iterator[str]:
    speed, sigma = figures["implied_speed_m_per_s"], figures["implied_speed_sigma_m_per_s"]
    shown_sy, assumed, in_water = figures["scanner_sy_mm_per_px"], settings.assumed_speed, figures["water_speed_m_per_s"]
    if abs(wider - 1) > max(WIDER, SURE * figures["sx_sigma_mm_per_px"] / figures["sx_mm_per_px"]):
        causes = "wrong lengths of the poses, or another depth setting or scanner, whose [sx,sy] it takes"
        yield f"warning     pixels are {wider:.3f} times as wide as rig.probe.scale_mm_per_px: {causes}"
    if np.isnan(shown_sy):
        yield "sound       not checked by sy, as the scanner's mm/px are unknown; rig.probe.scale_mm_per_px=[sx,sy] does"
    else:
        yield f"sound       {speed:.1f} ± {sigma:.1f} m/s by sy, if the scanner's is {shown_sy:g} mm/px for {assumed:g} m/s"
    if not settings.tank_known:
        same = f"as in the medium of the calibration, {figures['speed_m_per_s']:.0f} m/s, right for sweeps through the same"
        yield f"depth       {same}; temperature_c=... converts it"
        return
    if abs(speed / in_water - 1) > SPEEDS_APART:
        yield f"warning     not the tank's speed: {_other_speed(speed, settings.temperature_c)}"
    deep = float(sound_in_water.shown_too_deep(SHOWN_DEPTH_MM, in_water, assumed))
    shown = f"{abs(deep):.2f} mm too {'deep' if deep > 0 else 'shallow'} at {SHOWN_DEPTH_MM:g} mm"
    by = "" if settings.temperature_c is None else f"{settings.temperature_c:g} °C, "
    yield f"water       {by}{in_water:.1f} m/s: assuming {assumed:g}, the scanner shows echoes {shown}"
    scales = f"sy {figures['sy_measured_mm_per_px']:.5f} to {figures['sy_mm_per_px']:.5f} mm/px"
    yield f"depth       converted from this water to {settings.wanted_speed:g} m/s: {scales}"


def _other_speed(speed: float, temperature_c: float | None) -> str:
    """Why a tank's speed of sound, m/s, isn't that of its stated temperature."""
    if temperature_c is not None and temperature_c > FREEZING_F:
        celsius = (temperature_c - FREEZING_F) / 1.8
        if abs(speed / float(sound_in_water.speed_of_sound(celsius)) - 1) <= SPEEDS_APART:
            return f"is temperature_c={temperature_c:g} in degrees Fahrenheit? It would be {celsius:.0f} °C"
    return "another depth setting than of rig.probe.scale_mm_per_px, or poses not in mm?"


def rows(frames: PhantomFrames, found: Adjusted) -> Iterator[Sequence[object]]:
    """A row a frame, in the order of COLUMNS; empty where a frame has no such value."""
    place = {int(k): m for m, k in enumerate(frames.usable)}
    for k, (number, seen) in enumerate(zip(frames.numbers.tolist(), frames.seen, strict=True)):
        contrast = f"{seen.contrast_db:.1f}" if np.isfinite(seen.contrast_db) else ""
        if k not in place:
            yield number, "rejected", "", "", contrast, "", "", seen.reason
            continue
        m = place[k]
        status = "outlier" if found.outliers[m] else "used"
        pixel = [f"{value:.3f}" for value in seen.pixel]
        yield number, status, *pixel, contrast, f"{found.distances_mm[m]:.4f}", f"{found.normalised[m]:.3f}", ""


def _listed(numbers: Sequence[int], most: int = 10) -> str:
    more = f" and {len(numbers) - most} more" if len(numbers) > most else ""
    return ", ".join(map(str, numbers[:most])) + more
