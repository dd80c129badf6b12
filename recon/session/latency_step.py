"""The scanner's lag behind the tracker, from a flat bottom: the settings of the step, the step, and the files of its result."""

import logging
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, field_validator, model_validator

from recon.capture import lag_files, sweep_tables
from recon.capture.lag_files import LagFile
from recon.capture.sweep_part import SweepCapture
from recon.clips import fan_region, image_region
from recon.errors import InputError
from recon.files import atomic, metrics
from recon.files.metrics import Metrics
from recon.freehand import scan_checks, sequence_sweep
from recon.freehand.sequence_sweep import SequenceFields, SequenceSweep
from recon.freehand.volume_compounding import Clip, Rectangle
from recon.model.fan import Fan, Sector
from recon.model.rig import Finite, Part
from recon.probe_calibration import latency
from recon.probe_calibration.latency import Lag
from recon.session.watch import SILENT, Watch

log = logging.getLogger(__name__)

BY = "measure-lag"  # who writes
LAG = lag_files.FILE
DEPTHS = "depths.csv"
MOSTLY = 0.5  # share of images with a bottom; with less, it is looked for in a part of a screen
HEADER = ("frame", "time_ns", "depth_px", "residual_px", "used")

Array = NDArray[np.float64]
Sweep = SweepCapture | SequenceSweep


class Method(Part):
    """Where the bottom and the lag are looked for."""

    clip: Rectangle | None = None
    """[u, v, width, height] px, the part of each B-scan that is looked at, of an uncropped screen; null is all of it"""
    fan: Sector | None = None
    """[u, v, first, last, left, right], a curved array's fan in the image, as of `sonotwin freehand`; or find"""
    search_s: tuple[Finite, Finite] = latency.SEARCH_S
    """s, lags looked at; around the difference of the starts where the clocks have nothing in common"""
    top_px: Annotated[int, Field(ge=0)] = 40
    """rows at the probe's face, from the clip's first or the fan's arc on, that are left out, where reverberation ends"""

    @field_validator("search_s")
    @classmethod
    def _in_order(cls, value: tuple[float, float]) -> tuple[float, float]:
        if not 0 < value[1] - value[0] <= 1e3:
            raise ValueError(
                f"expected two lags, the less one first and at most 1000 s apart, found {value[0]:g} and {value[1]:g}"
            )
        return value


class Settings(Method, SequenceFields):
    """Sources, and settings of the method."""

    capture: Path | None = None
    """a capture folder with a sweep, up and down over a flat bottom. Or else:"""
    sweep: str = ""
    """its name, of a capture that holds several; "" takes the only one for the latency"""

    @model_validator(mode="after")
    def _one_source(self) -> "Settings":
        if (self.capture is None) == (self.sequence is None):
            raise ValueError(f"expected capture or sequence, found {'neither' if self.capture is None else 'both'}")
        return self


@dataclass(frozen=True)
class Latency:
    """The lag of a scanner with its standard deviation and interval, and the depths that it is known by."""

    lag: Lag
    depths: Array  # (n,) px, NaN where there is no bottom
    figures: Metrics


def run(settings: Settings, out: Path, watch: Watch = SILENT) -> None:
    """Find the bottom in all B-scans, compare its depth with the probe's height, and write.

    Raises
    ------
    InputError
        If the input is incomplete or damaged, the motion doesn't determine the lag, or `out` can't be written to.
    """
    sources = (settings.capture, settings.sequence, settings.tracker)
    atomic.check_folder(out, BY, inputs=sources)
    sweep = read(settings)
    found = measure(sweep, settings, watch)
    watch.say(f"wrote       {out}/{{{','.join(write(out, sweep, found))}}}")


def measure(sweep: Sweep, settings: Method | None = None, watch: Watch = SILENT) -> Latency:
    """Measure the lag of the B-scans behind the poses.

    Raises
    ------
    InputError
        If the motion doesn't determine the lag.
    """
    chosen, start = settings or Method(), perf_counter()
    with watch.busy("looking for the bottom"):
        whole = Clip(0, 0, *sweep.size)
        given = None if chosen.fan is None or isinstance(chosen.fan, str) else Fan(*chosen.fan)
        fan = fan_region.find(sweep.images(), sweep.name) if chosen.fan == "find" else given
        depths = bottom_depths(sweep, Clip(*chosen.clip) if chosen.clip else whole, chosen.top_px, fan)
        known = chosen.clip is not None or fan is not None or np.isfinite(depths).mean() > MOSTLY
        screen = None if known else part_of_screen(sweep, chosen.top_px)
        depths = depths if screen is None else bottom_depths(sweep, screen, chosen.top_px)
    seconds = perf_counter() - start
    if screen is not None:
        part = f"[{screen.u},{screen.v},{screen.width},{screen.height}]"
        watch.say(f"screen      looked in what changes from image to image, clip={part}")
    if chosen.fan == "find":
        watch.say(f"fan         in what changes from image to image, {fan}")
    found_in = f"bottom in {np.isfinite(depths).sum()} of {len(depths)} B-scans"
    watch.say(f"find        {found_in}, {len(sweep.track.times)} poses, {seconds:.0f} s")
    try:
        lag = latency.estimate(sweep.times, depths, sweep.track, chosen.search_s)
    except InputError as error:
        raise InputError(f"{sweep.name}: {error}") from None
    if line := scan_checks.frozen(sweep.images(), sweep.poses(lag.seconds)):
        log.warning("%s: %s", sweep.name, line)
    if abs(lag.trend_mm) > latency.FAR_MM:
        cause = "a bracket that slips, or a bottom that isn't level and still?"
        log.warning("%s: the bottom moved by %+.1f mm against the probe during the sweep: %s", sweep.name, lag.trend_mm, cause)
    figures = latency.measure(depths, lag) | {"seconds_find": round(seconds, 3)}
    for line in describe(figures):
        watch.say(line)
    return Latency(lag, depths, figures)


def read(settings: Settings) -> Sweep:
    """Open the sweep; of a sequence its B-scans with a time stamp."""
    sweep = sequence_sweep.read_source(settings, settings.capture, settings.sweep, "latency")
    return sweep.timed() if isinstance(sweep, SequenceSweep) else sweep


def bottom_depths(sweep: Sweep, clip: Clip, top_px: int, fan: Fan | None = None) -> Array:
    """Depths of the bottom : (n,) px, in the whole images, NaN where there is none in their part."""
    part = None if fan is None else clip.cut(fan.mask(sweep.size[::-1]))
    return np.array([latency.bottom_depth(clip.cut(image), top_px, part) for image in sweep.images()]) + clip.corner[1]


def part_of_screen(sweep: Sweep, top_px: int) -> Clip | None:
    """The part of a screen that changes, with the rows above it that are left out anyway; None if that is all, or nothing."""
    try:
        u, v, width, height = image_region.find_below_ringing(sweep.images(), sweep.name, "clip=[u,v,width,height]")
    except InputError:
        return None
    above = min(v, top_px)
    part = Clip(u, v - above, width, height + above)
    return None if (part.width, part.height) == sweep.size else part


def describe(figures: Metrics) -> Iterator[str]:
    """Lines: the lag with its interval, and the scatter about it."""
    interval = f"{figures['lag_low_ms']:.1f} to {figures['lag_high_ms']:.1f} ms"
    yield f"lag         {figures['lag_ms']:.1f} ms, {interval} ({100 * latency.COVERAGE:.0f} %), the images after the poses"
    scatter = f"{figures['depth_sigma_px']:.2f} px of depth, {figures['jitter_ms']:.1f} ms of the time stamps"
    yield f"scatter     {scatter} (1 sigma); {figures['frames_used']} B-scans used"


def write(out: Path, sweep: Sweep, found: Latency) -> list[str]:
    """Write all files, whole or not at all; returns their names."""
    lag = found.lag
    file = LagFile(lag_s=lag.seconds, sigma_s=lag.sigma_s, interval_s=lag.interval_s, coverage=latency.COVERAGE)
    with atomic.new_folder(out, BY) as folder:
        lag_files.write(folder / LAG, file)
        sweep_tables.write_rows(folder / DEPTHS, HEADER, rows(sweep, found.depths, lag))
        metrics.write(folder / metrics.FILE, found.figures)
    return [LAG, DEPTHS, metrics.FILE]


def rows(sweep: Sweep, depths: Array, found: Lag) -> Iterator[Sequence[object]]:
    """A row a B-scan, in the order of HEADER; empty where there is no depth."""
    for frame, time, depth, residual, used in zip(sweep.frames, sweep.times, depths, found.residuals, found.used, strict=True):
        shown = ["" if np.isnan(value) else f"{value:.3f}" for value in (depth, residual)]
        yield frame, time, *shown, int(used)
