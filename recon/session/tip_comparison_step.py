"""A needle's tip in B-scans beside the tracked one: the settings of the step, the step, and the files of its result."""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from recon.capture import probe_files, sweep_tables, tip_files
from recon.capture.sweep_part import SweepCapture
from recon.errors import InputError
from recon.files import atomic, metrics
from recon.files.metrics import Metrics
from recon.freehand import sequence_sweep
from recon.freehand.sequence_sweep import SequenceFields, SequenceSweep
from recon.freehand.volume_compounding import Clip, Rectangle
from recon.geometry import rigid
from recon.model import tracks
from recon.model.probe import ProbeCalibration, Speed
from recon.model.rig import NotNegative
from recon.model.tip import Tip
from recon.model.tracks import LagSeconds
from recon.probe_calibration import needle_echo, sound_in_water
from recon.probe_calibration.cross_wire import Appearance
from recon.probe_calibration.needle_echo import Expected, NeedleEcho
from recon.probe_calibration.point_calibration import NO_POSE, Noise
from recon.probe_calibration.probe_figures import NOISY
from recon.session.watch import SILENT, Watch
from recon.tip_calibration import imaged_tip
from recon.tip_calibration.imaged_tip import LATE, PROBE, SOUND, TOOL, Comparison, Fault, Seen

BY = "compare-tip"  # who writes
FRAMES = "frames.csv"
HEADER = (
    *("frame", "status", "u", "v", "tracked_u", "tracked_v", "off_x_mm", "off_y_mm", "beside_mm"),
    *("sigma_x_mm", "sigma_y_mm", "sigma_beside_mm", "normalised", "reason"),
)
BESIDE = "out of the plane by tracking"  # kind of a reason
LEAST = 5  # B-scans with a tip
WAYS = {
    needle_echo.FAR: "another tool's tip.yaml, another probe's calibration, or clocks that differ? measure-lag finds lag_s",
    BESIDE: "lead the tip in the plane; if it is seen there, it lies elsewhere in the tool's frame: beside_mm=3 measures it",
    "no echo stands out": "another scanner? give appearance.min_contrast_db",
}
CAUSES: Mapping[str, tuple[str, str]] = {  # of faults: what is off, and the likely cause
    TOOL: ("the tip lies {mm:.2f} mm elsewhere in the tool's frame", "a bent shaft, a target that slipped, or another tip.yaml"),
    PROBE: ("the probe lies {mm:.2f} mm elsewhere in its target's frame", "a bracket that moved since its calibration"),
    SOUND: ("the image is {percent:+.1f} % too deep", "sound of another speed: give tissue_m_s"),
    LATE: ("the B-scans are {ms:+.0f} ms later than lag_s has it", "measure the lag"),
}

Array = NDArray[np.float64]


class Settings(SequenceFields):
    """Sources, and what is known beforehand."""

    capture: Path | None = None
    """a capture folder, best of `sonotwin track`, with a sweep in which a tracked needle's tip is seen. Or else:"""
    sweep: str = ""
    """its name, of a capture that holds several"""
    body: str | None = None
    """of a capture: the needle's name among the tracked bodies; null takes the only one. Of a sequence reference= is its frame"""
    tip: Path
    """the needle's tip.yaml, of `sonotwin calibrate-tip`"""
    probe: Path | None = None
    """file of the probe's calibration, instead of the capture's own"""
    lag_s: LagSeconds = 0.0
    """s, delay of the B-scans' time stamps, as of `sonotwin measure-lag`"""
    lag_sigma_s: NotNegative = 0.0
    """s, its standard deviation"""
    tissue_m_s: Speed | None = None
    """m/s, of sound in what the needle is in: 1488 in water of 22 deg C; null leaves depths as the probe is calibrated"""
    tip_radius_mm: Annotated[float, Field(ge=0, le=10)] = 0.0
    """mm, by which the echo comes from before the tip: the radius of a ball, or of a shaft that is cut off square"""
    tip_radius_sigma_mm: NotNegative = 0.1
    """mm, its standard deviation; assumed: it depends on the tip's cut"""
    beside_mm: Annotated[float, Field(gt=0, le=50)] = 0.5
    """mm, most distance of the tracked tip from the image's plane: beyond it, another part of the shaft is seen to end"""
    clip: Rectangle | None = None
    """[u, v, width, height] px, the part of each B-scan that is looked at, of an uncropped screen; null is all of it"""
    appearance: Appearance = Appearance()
    """what an echo looks like"""
    noise: Noise = Noise()
    """standard deviations of poses that have no covariance"""

    @model_validator(mode="after")
    def _one_source(self) -> "Settings":
        if (self.capture is None) == (self.sequence is None):
            raise ValueError(f"expected capture or sequence, found {'neither' if self.capture is None else 'both'}")
        if self.sequence is not None and self.body is not None:
            raise ValueError(f"body: expected none with a sequence, found {self.body}; reference=FRAME names the needle's")
        return self


@dataclass(frozen=True)
class Compared:
    """The tip in all B-scans, and the comparison by those that are used."""

    name: str  # of the source, for messages
    numbers: NDArray[np.int64]  # (n,) of the frames
    tips: tuple[NeedleEcho, ...]  # (n,)
    used: NDArray[np.int64]  # (m,) places among them, those of outliers too
    comparison: Comparison  # of m


def run(settings: Settings, out: Path, watch: Watch = SILENT) -> int:
    """Find the tip in all B-scans, compare, and write; returns 1 if it isn't where tracking has it, or scatters too much.

    Raises
    ------
    InputError
        If the input is incomplete or damaged, too few B-scans show the tip, or `out` can't be written to.
    """
    sources = (settings.capture, settings.sequence, settings.tracker, settings.tip, settings.probe)
    atomic.check_folder(out, BY, inputs=sources)
    sweep, body = _source(settings)
    tip = tip_files.read(settings.tip, body)
    probe = sound_in_water.for_tissue(_probe(settings, sweep), settings.tissue_m_s)
    found = compare(sweep, probe, tip, settings, watch)
    figures = measure(found.comparison, len(found.numbers))
    for line in describe(found, figures):
        watch.say(line)
    with atomic.new_folder(out, BY) as folder:
        sweep_tables.write_rows(folder / FRAMES, HEADER, rows(found, probe))
        metrics.write(folder / metrics.FILE, figures)
    watch.say(f"wrote       {out}/{{{FRAMES},{metrics.FILE}}}")
    return int(bool(found.comparison.named) or found.comparison.level > NOISY)


def _source(settings: Settings) -> tuple[SweepCapture | SequenceSweep, str]:
    """The sweep by poses in the needle's frame, and the needle's name; empty of a sequence."""
    if settings.sequence is not None and settings.reference is None:
        raise InputError(f"reference: expected the needle's frame in {settings.sequence}, such as Needle, found none")
    sweep = sequence_sweep.read_source(settings, settings.capture, settings.sweep, "volume")
    if not isinstance(sweep, SweepCapture):
        return sweep, ""
    if settings.body is None and len(sweep.bodies) != 1:
        there = ", ".join(sweep.bodies) or "none: `sonotwin track` finds those of rig.bodies"
        raise InputError(f"{sweep.name}: body: expected the needle's name among those tracked, {there}; found none")
    body = settings.body or next(iter(sweep.bodies))
    return sweep.from_body(body), body


def _probe(settings: Settings, sweep: SweepCapture | SequenceSweep) -> ProbeCalibration:
    own = sweep.probe if isinstance(sweep, SweepCapture) else None
    if settings.probe is not None:
        return probe_files.read(settings.probe)
    if own is None:
        raise InputError(f"{sweep.name}: probe: expected the probe's calibration, found none; give probe=FILE")
    return own


def compare(
    sweep: SweepCapture | SequenceSweep, probe: ProbeCalibration, tip: Tip, settings: Settings, watch: Watch = SILENT
) -> Compared:
    """Find the tip in the B-scans of a sweep with poses `body_from_target`, and compare it with the tracked one.

    Raises
    ------
    InputError
        If too few B-scans show the tip.
    """
    lag, poses = settings.lag_s, sweep.poses(settings.lag_s)
    own, shared = sweep.pose_covariance(lag), None
    if isinstance(sweep, SweepCapture):
        shared = sweep.shared_covariance(lag)
    covariance = settings.noise.from_body(poses) if own is None else own
    in_target = np.einsum("nji,nj->ni", poses[:, :3, :3], tip.tip_mm - poses[:, :3, 3])
    tracked = rigid.apply(rigid.invert(probe.target_from_image), in_target)
    part = Clip(*settings.clip) if settings.clip else Clip(0, 0, *sweep.size)
    pixels = (tracked[:, :2] - [0, settings.tip_radius_mm]) / probe.scale - part.corner
    directions: Sequence[Array | None] = [None] * len(poses)
    if tip.axis is not None:
        directions = np.einsum("nji,j->ni", poses[:, :3, :3], tip.axis) @ probe.target_from_image[:3, :2] / probe.scale
    tips = []
    for k, image in enumerate(watch.follow(sweep.images(), len(sweep.frames), "looking for the tip")):
        expected = Expected(pixels[k], np.diag(probe.scale**-2.0), directions[k]) if np.isfinite(pixels[k]).all() else None
        seen = needle_echo.find(part.cut(image), settings.appearance, expected).shifted(part.corner)
        tips.append(_judged(seen, tracked[k, 2], settings.beside_mm))
    used = np.flatnonzero([one.found for one in tips])
    if len(used) < LEAST:
        reasons = Counter(one.reason.partition(":")[0] for one in tips if one.reason)
        common = [
            f" (most often: {reason}, {count} of {len(tips)}{f'; {WAYS[reason]}' if reason in WAYS else ''})"
            for reason, count in reasons.most_common(1)
        ]
        found = f"found {len(used)}{''.join(common) or ' in all'}"
        raise InputError(f"{sweep.name}: expected {LEAST} B-scans or more with a pose and the tip, {found}")
    rates = tracks.rates_at(sweep.track, sweep.times, lag) if sweep.clocked else np.zeros((len(poses), 4, 4))
    alike = np.zeros((len(poses), 6, 6)) if shared is None else shared
    seen = Seen(
        np.array([tips[k].pixel for k in used]),
        np.array([tips[k].covariance for k in used]),
        poses[used],
        covariance[used],
        alike[used],
        rates[used],
        settings.tip_radius_mm,
        settings.tip_radius_sigma_mm,
        settings.lag_sigma_s,
    )
    return Compared(sweep.name, sweep.frames, tuple(tips), used, imaged_tip.compare(seen, probe, tip))


def _judged(seen: NeedleEcho, beside: float, most: float) -> NeedleEcho:
    """The same, rejected where the tracked tip has no place, or one some mm beside the plane."""
    if np.isnan(beside):
        return replace(seen, reason=seen.reason or NO_POSE)
    return replace(seen, reason=f"{BESIDE}: {beside:.1f} mm") if abs(beside) > most else seen


def _cause(name: str, fault: Fault) -> str:
    off, cause = CAUSES[name]
    value = float(fault.values[0])
    return f"{off.format(mm=fault.size, percent=100 * value, ms=1e3 * value)}: {cause}"


def measure(found: Comparison, count: int) -> Metrics:
    """Figures of a comparison, each named with its unit."""
    sigma = np.sqrt(np.diag(found.mean_covariance))
    tool = found.faults[TOOL]
    return {
        "frames": count,
        "frames_outliers": int(found.outliers.sum()),
        "frames_used": int((~found.outliers).sum()),
        "off_median_mm": float(np.median(found.distances)),
        "off_95_mm": float(np.percentile(found.distances, 95)),
        "tracked_sigma_mm": float(np.median(np.linalg.norm(found.tracked_sigma[:, :2], axis=1))),
        "beside_rms_mm": float(np.sqrt(np.mean(found.tracked[:, 2] ** 2))),
        "beside_sigma_mm": float(np.median(found.tracked_sigma[:, 2])),
        **{f"mean_{axis}_mm": float(value) for axis, value in zip("xy", found.mean, strict=True)},
        **{f"mean_sigma_{axis}_mm": float(value) for axis, value in zip("xy", sigma, strict=True)},
        "mean_chance": found.chance,
        **{f"tool_{axis}_mm": float(value) for axis, value in zip("xyz", tool.values, strict=True)},
        **{f"tool_sigma_{axis}_mm": float(value) for axis, value in zip("xyz", np.sqrt(np.diag(tool.covariance)), strict=True)},
        "noise_factor": found.level,
        **{f"{name}_chance": one.chance for name, one in found.faults.items()},
    }


def describe(found: Compared, figures: Metrics) -> Iterator[str]:
    """Lines: the B-scans, distances in the plane and out of it, the systematic part, and its likely cause."""
    reasons = Counter((one.reason or "").partition(":")[0] for one in found.tips)
    del reasons[""]
    left = "".join(f"; {count} {reason}" for reason, count in reasons.most_common(3))
    far = f", {figures['frames_outliers']} of them far from all others and left out" if figures["frames_outliers"] else ""
    yield f"find        the tip in {len(found.used)} of {len(found.tips)} B-scans{far}{left}"
    plane = f"{figures['off_median_mm']:.2f} mm (median), {figures['off_95_mm']:.2f} mm (95 %)"
    known = f"tracking is known to {figures['tracked_sigma_mm']:.2f} mm (1 sigma)"
    yield f"off         imaged and tracked tip {plane} apart in the plane; {known}"
    beside = f"{figures['beside_rms_mm']:.2f} mm (rms) by tracking, ± {figures['beside_sigma_mm']:.2f} mm"
    yield f"beside      {beside}: how far the tip lies out of the plane isn't seen in a B-scan"
    parts = [f"{figures[f'mean_{axis}_mm']:.2f} ± {figures[f'mean_sigma_{axis}_mm']:.2f}" for axis in "xy"]
    tool = [f"{figures[f'tool_{axis}_mm']:.2f} ± {figures[f'tool_sigma_{axis}_mm']:.2f}" for axis in "xyz"]
    yield f"systematic  {parts[0]} mm along the array, {parts[1]} mm in depth; in the tool's frame [{', '.join(tool)}] mm"
    yield f"scatter     about that {figures['noise_factor']:.2f} times the predicted"
    if not found.comparison.named and found.comparison.level > NOISY:
        cause = "other echoes than the tip's, poses of more noise than assumed, or clocks that differ?"
        yield f"warning     no verdict: a scatter of over {NOISY:g} times the predicted hides what may be off: {cause}"
        return
    if not found.comparison.named:
        yield "verdict     within what tracking, tip and probe are known to"
        return
    first, *others = (_cause(name, found.comparison.faults[name]) for name in found.comparison.named)
    yield f"warning     the imaged tip isn't where tracking has it: {first}{''.join(f'; or {other}' for other in others)}"


def rows(found: Compared, probe: ProbeCalibration) -> Iterator[Sequence[object]]:
    """A row a frame, in the order of HEADER; empty where a frame has no such value."""
    place, comparison = {int(k): m for m, k in enumerate(found.used)}, found.comparison
    for k, (number, tip) in enumerate(zip(found.numbers.tolist(), found.tips, strict=True)):
        if k not in place:
            yield number, "rejected", *[""] * (len(HEADER) - 3), tip.reason
            continue
        m = place[k]
        pixels = [f"{value:.2f}" for value in (*tip.pixel, *(comparison.tracked[m, :2] / probe.scale))]
        lengths = [f"{value:.4f}" for value in (*comparison.off[m], comparison.tracked[m, 2], *comparison.tracked_sigma[m])]
        status = "outlier" if comparison.outliers[m] else "used"
        yield number, status, *pixels, *lengths, f"{comparison.normalised[m]:.3f}", ""
