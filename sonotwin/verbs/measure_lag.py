"""Measure the lag of the scanner's images behind the poses of the tracker.

Reads the sweep part of a capture folder, or a tracked sequence of the PLUS toolkit: the probe moved up and down over a flat
bottom in water, by 10 mm or more, three times or more, at an uneven pace. Writes into the folder `out`: lag.json, with lag_s for
the other commands; depths.csv, the bottom's depth in each B-scan; and metrics.json. Results that are there already are replaced.
Takes seconds.

    sonotwin measure-lag capture=outputs/bottom/capture out=outputs/lag
    sonotwin measure-lag sequence=bottom.igs.mha reference=Tracker clip=[120,80,400,500] out=outputs/lag
    sonotwin freehand capture=outputs/sweep/capture lag_s=0.0503 out=outputs/volume
"""

import logging
from collections.abc import Iterator, Sequence
from pathlib import Path
from time import perf_counter
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, field_validator, model_validator
from rich.console import Console

from recon.capture import lag_files, sweep_part, sweep_tables
from recon.capture.lag_files import LagFile
from recon.capture.sweep_part import SweepCapture
from recon.clips import fan_region, image_region
from recon.errors import InputError
from recon.files import atomic, metrics
from recon.files.metrics import Metrics
from recon.freehand import scan_checks, sequence_sweep
from recon.freehand.sequence_sweep import SequenceFields, SequenceSweep
from recon.freehand.sequences import FrameNames
from recon.freehand.volume_compounding import Clip, Rectangle
from recon.model.fan import Fan, Sector
from recon.model.rig import Finite
from recon.probe_calibration import latency
from recon.probe_calibration.latency import Lag

log = logging.getLogger(__name__)

LAG = lag_files.FILE
DEPTHS = "depths.csv"
MOSTLY = 0.5  # share of images with a bottom; with less, it is looked for in a part of a screen
HEADER = ("frame", "time_ns", "depth_px", "residual_px", "used")

Array = NDArray[np.float64]


class Config(SequenceFields):
    """Fields of `sonotwin measure-lag`."""

    out: Path
    """folder; gets lag.json, depths.csv, metrics.json"""
    capture: Path | None = None
    """a capture folder with a sweep, up and down over a flat bottom. Or else:"""
    sweep: str = ""
    """its name, of a capture that holds several; "" takes the only one for the latency"""
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

    @model_validator(mode="after")
    def _one_source(self) -> "Config":
        if (self.capture is None) == (self.sequence is None):
            raise ValueError(f"expected capture or sequence, found {'neither' if self.capture is None else 'both'}")
        return self


def run(config: Config) -> None:
    """Find the bottom in all B-scans, compare its depth with the probe's height, and write.

    Raises
    ------
    InputError
        If the input is incomplete or damaged, the motion doesn't determine the lag, or `out` can't be written to.
    """
    console = Console(soft_wrap=True, highlight=False)
    atomic.check_folder(
        config.out, "measure-lag", inputs=[path for path in (config.capture, config.sequence, config.tracker) if path is not None]
    )
    sweep = read(config)
    start = perf_counter()
    with console.status("looking for the bottom"):
        whole = Clip(0, 0, *sweep.size)
        given = None if config.fan is None or isinstance(config.fan, str) else Fan(*config.fan)
        fan = fan_region.find(sweep.images(), sweep.name) if config.fan == "find" else given
        depths = bottom_depths(sweep, Clip(*config.clip) if config.clip else whole, config.top_px, fan)
        known = config.clip is not None or fan is not None or np.isfinite(depths).mean() > MOSTLY
        screen = None if known else part_of_screen(sweep, config.top_px)
        depths = depths if screen is None else bottom_depths(sweep, screen, config.top_px)
    seconds = perf_counter() - start
    if screen is not None:
        part = f"[{screen.u},{screen.v},{screen.width},{screen.height}]"
        console.print(f"screen      looked in what changes from image to image, clip={part}", markup=False)
    if config.fan == "find":
        console.print(f"fan         in what changes from image to image, {fan}", markup=False)
    found_in = f"bottom in {np.isfinite(depths).sum()} of {len(depths)} B-scans"
    console.print(f"find        {found_in}, {len(sweep.track.times)} poses, {seconds:.0f} s", markup=False)
    try:
        found = latency.estimate(sweep.times, depths, sweep.track, config.search_s)
    except InputError as error:
        raise InputError(f"{sweep.name}: {error}") from None
    if line := scan_checks.frozen(sweep.images(), sweep.poses(found.seconds)):
        log.warning("%s: %s", sweep.name, line)
    figures = latency.measure(depths, found) | {"seconds_find": round(seconds, 3)}
    for line in describe(figures):
        console.print(line, markup=False)
    written = write(config.out, sweep, depths, found, figures)
    console.print(f"wrote       {config.out}/{{{','.join(written)}}}", markup=False)


def read(config: Config) -> SweepCapture | SequenceSweep:
    """Open the sweep; of a sequence its B-scans with a time stamp."""
    if config.capture is not None:
        return sweep_part.read_sweep(config.capture, config.sweep, "latency", config.implausible)
    assert config.sequence is not None
    return sequence_sweep.read_sequence_sweep(
        config.sequence, config.frame_names(FrameNames()), config.tracker, config.implausible
    ).timed()


def bottom_depths(sweep: SweepCapture | SequenceSweep, clip: Clip, top_px: int, fan: Fan | None = None) -> Array:
    """Depths of the bottom : (n,) px, in the whole images, NaN where there is none in their part."""
    part = None if fan is None else clip.cut(fan.mask(sweep.size[::-1]))
    return np.array([latency.bottom_depth(clip.cut(image), top_px, part) for image in sweep.images()]) + clip.corner[1]


def part_of_screen(sweep: SweepCapture | SequenceSweep, top_px: int) -> Clip | None:
    """The part of a screen that changes, with the rows above it that are left out anyway; None if that is all, or nothing."""
    try:
        u, v, width, height = image_region.find(sweep.images(), sweep.name, "clip=[u,v,width,height]")
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


def write(out: Path, sweep: SweepCapture | SequenceSweep, depths: Array, found: Lag, figures: Metrics) -> list[str]:
    """Write all files, whole or not at all; returns their names."""
    lag = LagFile(lag_s=found.seconds, sigma_s=found.sigma_s, interval_s=found.interval_s, coverage=latency.COVERAGE)
    with atomic.new_folder(out, "measure-lag") as folder:
        lag_files.write(folder / LAG, lag)
        sweep_tables.write_rows(folder / DEPTHS, HEADER, rows(sweep, depths, found))
        metrics.write(folder / metrics.FILE, figures)
    return [LAG, DEPTHS, metrics.FILE]


def rows(sweep: SweepCapture | SequenceSweep, depths: Array, found: Lag) -> Iterator[Sequence[object]]:
    """A row a B-scan, in the order of HEADER; empty where there is no depth."""
    for frame, time, depth, residual, used in zip(sweep.frames, sweep.times, depths, found.residuals, found.used, strict=True):
        shown = ["" if np.isnan(value) else f"{value:.3f}" for value in (depth, residual)]
        yield frame, time, *shown, int(used)
