"""The ultrasound probe from B-scans of a phantom: the settings of the step, the step, and the files of its result."""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter
from typing import Annotated, Final

import numpy as np
from numpy.typing import NDArray
from pydantic import model_validator

from recon import registry
from recon.capture import lag_files, probe_files, sweep_tables
from recon.capture.lag_files import LagFile
from recon.capture.sweep_part import SweepCapture
from recon.errors import InputError
from recon.files import atomic, metrics
from recon.files.metrics import Metrics
from recon.freehand import sequence_sweep
from recon.freehand.scans import ASSUMED
from recon.freehand.sequence_sweep import SequenceFields, SequenceSweep
from recon.freehand.sequences import FrameNames
from recon.freehand.volume_compounding import Clip, Rectangle
from recon.model import tracks
from recon.model.rig import NotNegative, Probe, Rig
from recon.model.tracks import FreeLagSeconds
from recon.probe_calibration import free_lag, latency, lateness, phantom_frames, probe_figures, sound_in_water, tank_calibration
from recon.probe_calibration.free_lag import FreeLag
from recon.probe_calibration.lateness import Lateness
from recon.probe_calibration.phantom_frames import NO_POSE, PHANTOMS, STYLUS, PhantomFrames
from recon.probe_calibration.point_calibration import Noise
from recon.probe_calibration.probe_checks import Misread
from recon.probe_calibration.tank_calibration import Result
from recon.registry import Choice
from recon.session.settings import ScaleFields
from recon.session.watch import SILENT, Watch

BY = "calibrate-probe"  # who writes
PROBE = "probe.yaml"
FRAMES = "frames.csv"
FREE: Final = "free"  # lag_s that is found

Array = NDArray[np.float64]
Sweep = SweepCapture | SequenceSweep


class Settings(ScaleFields, SequenceFields, tank_calibration.Settings):
    """Sources, and all that is known beforehand."""

    rig: Annotated[Rig, Choice("meza2021")]
    """rig.probe is the design: where the bracket holds the probe to some 30 deg and 30 mm, the scanner's mm/px. Of another
    probe give temperature_c, and with pairs rig.probe.image_size; its bracket needs no design"""
    capture: Path | None = None
    """a capture folder with a sweep over a phantom at rest. Or else:"""
    sweep: str = ""
    """its name, of a capture that holds several; "" takes the only one for the probe"""
    pairs: Path | None = None
    """CSV file of poses and pixels, one pair a line: m00 to m23 of world_from_target in mm, u, v in px"""
    runs: tuple[Path, ...] = ()
    """several calibrations of one probe, for their repeatability and mean: captures, each with a sweep or more for the probe, CSV
    files as of pairs, and results of before, as files or folders. rig, temperature_c and wire_radius_mm hold for all of them"""
    earlier: Path | None = None
    """an earlier calibration of the same probe, probe.yaml: whether it moved in its bracket since"""
    clip: Rectangle | None = None
    """[u, v, width, height] px, the part of each B-scan that is looked at, of an uncropped screen; null is all of it. The
    calibration holds for the whole images all the same"""
    lag_s: FreeLagSeconds | None = None
    """s, delay of the B-scans' time stamps, as of `sonotwin measure-lag`; free finds it with the probe, which must keep moving;
    null takes none, of a capture to 0.1 s"""
    lag_sigma_s: NotNegative | None = None
    """s, standard deviation of the former, 0 where that is given; it counts where the probe moved as B-scans were taken"""

    @model_validator(mode="after")
    def _one_source(self) -> "Settings":
        given = [name for name in ("capture", "sequence", "pairs", "runs") if getattr(self, name) not in (None, ())]
        if len(given) != 1:
            raise ValueError(f"expected one of capture, sequence, pairs and runs, found {' and '.join(given) or 'none'}")
        if self.runs and self.sweep:
            raise ValueError(f"sweep: expected none with runs, which takes all sweeps for the probe, found {self.sweep}")
        for name, value in (("clip", self.clip), ("lag_s", self.lag_s or None), ("lag_sigma_s", self.lag_sigma_s or None)):
            if self.pairs is not None and value is not None:
                raise ValueError(f"{name}: expected none with pairs, which come without images and times, found {value}")
        if self.body is not None and self.capture is None:
            way = "; reference=FRAME has that of a sequence" if self.sequence is not None else ""
            raise ValueError(f"body: expected none without a capture, found {self.body}{way}")
        if self.pairs is not None and self.phantom != phantom_frames.CROSSED_WIRES:
            raise ValueError(f"phantom: expected none with pairs, which are of one point, found {self.phantom}")
        if self.lag_s == FREE and self.runs:
            raise ValueError(f"lag_s: expected a number with runs, found {FREE}: find it by one of them")
        if self.lag_s == FREE and self.lag_sigma_s is not None:
            raise ValueError(f"lag_sigma_s: expected none with lag_s={FREE}, which finds both, found {self.lag_sigma_s}")
        if self.lag_s == FREE and not hasattr(registry.kind(PHANTOMS, self.phantom), "misfit"):
            raise ValueError(f"lag_s: expected a number with phantom={self.phantom}, by which none is found, found {FREE}")
        return self

    @property
    def taken_lag_s(self) -> float:
        """Of the poses at first: the lag that is given, else none."""
        return 0.0 if self.lag_s is None or self.lag_s == FREE else self.lag_s

    @property
    def lag_sigma(self) -> float:
        """Standard deviation of the lag, s, wider of one that isn't given but assumed."""
        assumed = (self.capture is not None or self.runs) and self.lag_s is None
        return ASSUMED.lag_s if self.lag_sigma_s is None and assumed else self.lag_sigma_s or 0.0


@dataclass(frozen=True)
class CalibratedProbe:
    """A probe with the covariance of its calibration, and the outcome of each frame."""

    frames: PhantomFrames
    result: Result
    figures: Metrics


def run(settings: Settings, out: Path, usual: Probe, watch: Watch = SILENT) -> None:
    """Find the phantom in all frames, calibrate, judge and write.

    Parameters
    ----------
    usual : the probe of the usual rig, beside which it shows whether a scale was given

    Raises
    ------
    InputError
        If the input is incomplete or damaged, doesn't determine the calibration, or `out` can't be written to.
    """
    sources = (
        settings.capture,
        settings.sequence,
        settings.pairs,
        settings.earlier,
        settings.tracker,
        settings.wires,
        settings.tip,
    )
    atomic.check_folder(out, BY, inputs=sources)
    earlier = None if settings.earlier is None else probe_files.read(settings.earlier)
    if settings.temperature_c is not None:
        sound_in_water.speed_of_sound(settings.temperature_c)  # a mistake shows before the work
    design, start, sweep = settings.rig.probe, perf_counter(), None
    if settings.pairs is not None:
        frames = phantom_frames.of_pairs(str(settings.pairs), design.image_size, *sweep_tables.read_pairs(settings.pairs))
    else:
        sweep = sequence_sweep.read_source(settings, settings.capture, settings.sweep, "probe")
        if settings.body is not None and isinstance(sweep, SweepCapture):
            sweep = sweep.from_body(settings.body)
        say_assumed(settings, watch)
        reference = None if settings.sequence is None else settings.frame_names(FrameNames()).reference
        frames = look(sweep, settings, settings.taken_lag_s, settings.clip, watch, settings.lag_sigma, reference)
    seconds = {"seconds_find": round(perf_counter() - start, 3)}
    for line in probe_figures.describe_frames(frames, seconds["seconds_find"]):
        watch.say(line)
    lag = None
    if sweep is not None and settings.lag_s == FREE:
        lag = find_lag(frames, sweep, settings)
        frames = at_lag(frames, sweep, lag.seconds, lag.sigma_s, lag.jitter_s, settings.noise)
    try:
        found = calibrate(frames, design, settings, settings.scanner_sy(design, usual), watch)
    except InputError as error:
        late = "" if sweep is None else name_lag(frames, sweep, settings)
        fault = error.fault if late and isinstance(error, Misread) else error  # which a lag explains
        raise InputError(f"{fault}{late}") from None
    figures = found.figures
    if lag is not None:
        figures = figures | measure_lag(lag, found)
        watch.say(describe_lag(figures))
    if earlier is not None:
        figures = figures | probe_figures.compare(found.result.calibration, earlier)
        watch.say(probe_figures.describe_comparison(figures, settings.earlier))
    written = write(out, found, figures | seconds, lag)
    watch.say(f"wrote       {out}/{{{','.join(written)}}}")


def say_assumed(settings: Settings, watch: Watch) -> None:
    """Say the lag that is assumed where none is given."""
    if settings.lag_s is None and settings.lag_sigma:
        sigma = f"± {1e3 * settings.lag_sigma:g} ms (1 sigma), of which rest alone is free"
        watch.say(f"assumed     no lag of the B-scans, {sigma}; measure-lag finds it, give lag_s")


def look(
    sweep: Sweep,
    settings: tank_calibration.Settings | None = None,
    lag_s: float = 0.0,
    clip: Rectangle | None = None,
    watch: Watch = SILENT,
    lag_sigma_s: float = 0.0,
    reference: str | None = None,
) -> PhantomFrames:
    """Find the phantom in the B-scans of a sweep, read one by one.

    Parameters
    ----------
    lag_s : s, of the B-scans behind the poses
    clip : part of each B-scan that is looked at; None for all of it
    lag_sigma_s : s, standard deviation of the lag
    reference : frame of a sequence in which its poses are, None for a capture's world
    """
    chosen, part = settings or tank_calibration.Settings(), Clip(*clip) if clip else Clip(0, 0, *sweep.size)
    kind = registry.kind(PHANTOMS, chosen.phantom)
    known = kind.read(chosen, reference)
    images: Iterable = watch.follow(sweep.images(), len(sweep.frames), f"looking for the {kind.SHOWS}")
    return phantom_frames.look(
        sweep.name,
        (part.cut(image) for image in images),
        sweep.size,
        sweep.frames,
        sweep.poses(lag_s),
        sweep.pose_covariance(lag_s),
        chosen.appearance,
        part.corner,
        chosen.phantom,
        rates(sweep, lag_s) if lag_sigma_s or sweep.clocked else None,
        lag_sigma_s,
        known,
    )


def rates(sweep: Sweep, lag_s: float) -> Array:
    """Change of the B-scans' poses : (n, 4, 4) a second of lag, by poses whose noise is others'."""
    moments = sweep.track.times[sweep.track.found]
    apart_s = float(np.median(np.diff(moments))) * 1e-9 if len(moments) > 1 else 0.0
    step_s = min(max(lateness.RATE_S, apart_s), tracks.MAX_GAP_S)
    return tracks.rates_at(sweep.track, sweep.times, lag_s, step_s)


def at_lag(frames: PhantomFrames, sweep: Sweep, lag_s: float, lag_sigma_s: float, jitter_s: float, noise: Noise) -> PhantomFrames:
    """The frames of a sweep at poses of another lag, whose time stamps scatter by a standard deviation of some s."""
    poses, moving = tracks.poses_at(sweep.track, sweep.times, lag_s), rates(sweep, lag_s)
    covariance = sweep.pose_covariance(lag_s)
    if covariance is None:  # between two poses half as much
        shares = np.nan_to_num(tracks.neighbours_at(sweep.track, sweep.times, lag_s)[1], nan=1.0)
        own = noise.from_body(poses) if frames.phantom == STYLUS else noise.of_pose
        covariance = (shares**2).sum(axis=1)[:, None, None] * own
    turns = moving[:, :3, :3] @ np.swapaxes(poses[:, :3, :3], 1, 2)
    motion = np.column_stack([turns[:, 2, 1], turns[:, 0, 2], turns[:, 1, 0], moving[:, :3, 3]])
    covariance = covariance + jitter_s**2 * motion[:, :, None] * motion[:, None]
    return phantom_frames.at_poses(frames, poses, covariance, moving, lag_sigma_s)


def search_lag(frames: PhantomFrames, sweep: Sweep, settings: tank_calibration.Settings) -> tuple[float, float]:
    """The lag of the least misfit, and that misfit; as `free_lag.search`."""
    chosen = free_lag.few(np.array([each.reason in (None, NO_POSE) for each in frames.seen]))
    few, track, times = phantom_frames.some(frames, chosen), sweep.track, sweep.times[chosen]
    misfit = registry.kind(PHANTOMS, frames.phantom).misfit
    return free_lag.search(
        lambda lag_s: phantom_frames.at_poses(few, tracks.poses_at(track, times, lag_s)), lambda each: misfit(each, settings)
    )


def find_lag(frames: PhantomFrames, sweep: Sweep, settings: Settings) -> FreeLag:
    """Find the lag with the probe, by the phantom.

    Raises
    ------
    InputError
        If the sweep has no times, the frames are too few or contradict each other, or the motion doesn't determine the lag.
    """
    phantom_frames.refuse_few(frames)
    if not sweep.clocked:
        raise InputError(f"{frames.name}: lag_s: expected a number for B-scans without time stamps in order, found {FREE}")
    kind, expected = registry.kind(PHANTOMS, frames.phantom), settings.rig.probe.target_from_image.matrix()

    def adjust(each: PhantomFrames) -> Lateness:
        try:
            return kind.calibrate(each, settings, expected).late
        except InputError as error:
            first, last = latency.SEARCH_S
            raise InputError(f"{error}; of lags from {first:g} to {last:g} s, {start:.2f} s fits best") from None

    try:
        start, _ = search_lag(frames, sweep, settings)
        return free_lag.find(
            start,
            lambda lag_s, jitter_s: at_lag(frames, sweep, lag_s, 0.0, jitter_s, settings.noise),
            adjust,
        )
    except InputError as error:
        raise InputError(f"{frames.name}: {error}") from None


def name_lag(frames: PhantomFrames, sweep: Sweep, settings: Settings) -> str:
    """The lag at which frames that contradict each other would agree, in words; nothing without one."""
    kind, expected = registry.kind(PHANTOMS, frames.phantom), settings.rig.probe.target_from_image.matrix()
    if settings.lag_s == FREE or not sweep.clocked or not hasattr(kind, "misfit") or len(frames.usable) < kind.MIN_FRAMES:
        return ""
    speeds = np.linalg.norm(rates(sweep, settings.taken_lag_s)[frames.usable, :3, 3], axis=1)
    if np.median(speeds) < free_lag.STILL_MM_S:
        return ""
    try:
        lag_s, least = search_lag(frames, sweep, settings)
    except InputError:
        return ""
    here = kind.misfit(phantom_frames.at_poses(frames, tracks.poses_at(sweep.track, sweep.times, settings.taken_lag_s)), settings)
    if abs(lag_s - settings.taken_lag_s) < free_lag.STEPS_S[0] or least > here:
        return ""
    if here < free_lag.CONTRADICTS_MM2 or least > here / 2:  # late B-scans fit a phantom of another size, too
        try:
            kind.calibrate(at_lag(frames, sweep, lag_s, 0.0, 0.0, settings.noise), settings, expected)
        except InputError:
            return ""
    return f"; with lag_s={lag_s:.2f} they agree: give lag_s={FREE}"


def measure_lag(lag: FreeLag, found: CalibratedProbe) -> Metrics:
    """Figures of a lag that was found with the probe, and its correlation with each of the probe's parameters."""
    correlations = lag.correlations(found.result.adjustment.calibration)
    return {
        "lag_ms": 1e3 * lag.seconds,
        "lag_sigma_ms": 1e3 * lag.sigma_s,
        "jitter_ms": 1e3 * lag.jitter_s * max(found.result.adjustment.noise_factor, 1.0),
        **{f"lag_correlation_{name}": value for name, value in correlations.items()},
    }


def describe_lag(figures: Metrics) -> str:
    """One line: the lag, and the scatter of the time stamps."""
    strongest = max(abs(value) for name, value in figures.items() if name.startswith("lag_correlation_"))
    by = f"time stamps scatter by {figures['jitter_ms']:.1f} ms; correlation with the probe up to {strongest:.2f}"
    return f"lag         {figures['lag_ms']:.1f} ± {figures['lag_sigma_ms']:.1f} ms, the images after the poses; {by}"


def calibrate(
    frames: PhantomFrames,
    design: Probe,
    settings: tank_calibration.Settings,
    scanner_sy: float | None = None,
    watch: Watch = SILENT,
) -> CalibratedProbe:
    """Calibrate the probe by the phantom in its frames.

    Parameters
    ----------
    scanner_sy : mm/px in depth, as of `recon.probe_calibration.tank_calibration.calibrate`

    Raises
    ------
    InputError
        If the frames are too few, or don't determine the calibration.
    """
    phantom_frames.refuse_few(frames)
    start = perf_counter()
    result = tank_calibration.calibrate(frames, design, settings, scanner_sy)
    seconds = {"seconds_calibrate": round(perf_counter() - start, 3)}
    figures = probe_figures.measure(frames, result, design, settings)
    for line in probe_figures.describe(frames, result, figures, design, settings):
        watch.say(line)
    return CalibratedProbe(frames, result, figures | seconds)


def write(out: Path, found: CalibratedProbe, figures: Metrics, lag: FreeLag | None = None) -> list[str]:
    """Write all files, whole or not at all, with that of a lag that was found; returns their names."""
    with atomic.new_folder(out, BY) as folder:
        if lag is not None:
            file = LagFile(lag_s=lag.seconds, sigma_s=lag.sigma_s, interval_s=lag.interval_s, coverage=latency.COVERAGE)
            lag_files.write(folder / lag_files.FILE, file)
        probe_files.write(folder / PROBE, found.result.calibration)
        probe_files.write_authors(folder / probe_files.AUTHORS, found.result.calibration)
        rows = probe_figures.rows(found.frames, found.result.adjustment)
        sweep_tables.write_rows(folder / FRAMES, probe_figures.COLUMNS, rows)
        metrics.write(folder / metrics.FILE, figures)
    return [PROBE, probe_files.AUTHORS, FRAMES, *([] if lag is None else [lag_files.FILE]), metrics.FILE]
