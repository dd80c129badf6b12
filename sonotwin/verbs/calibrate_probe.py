"""Calibrate the ultrasound probe: where the pixels of its B-scans lie in the frame of the target that it carries.

Reads the sweep part of a capture folder, or a tracked sequence of the PLUS toolkit: B-scans of the crossing of two wires at
rest in water, seen from many sides; or pairs of a pose and the crossing's pixel, found elsewhere. Writes into the folder `out`:
probe.yaml (with its covariance); the same in the rig authors' layout, US_params.npz; frames.csv, the outcome of each frame; and
metrics.json. A calibration that is there already is replaced. Takes a second for thirty B-scans.

Let the probe rest at each frame, or give the lag. Tilt it by 35 degrees, mostly forward and backward, roll it as far as the
target is seen, and bring the crossing near all corners of the image in turn.

    sonotwin calibrate-probe capture=outputs/wires/capture out=outputs/probe
    sonotwin calibrate-probe capture=outputs/wires/capture temperature_c=22.4 out=outputs/probe
    sonotwin calibrate-probe capture=outputs/wires/capture earlier=outputs/probe/probe.yaml out=outputs/probe_again
    sonotwin calibrate-probe sequence=wires.igs.mha reference=Tracker clip=[120,80,400,500] out=outputs/probe
    sonotwin calibrate-probe pairs=pairs.csv out=outputs/probe
    sonotwin calibrate-probe pairs=pairs.csv rig.probe.image_size=[640,480] temperature_c=22.4 out=outputs/probe
"""

from collections.abc import Iterator, Sequence
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import PrivateAttr, model_validator
from rich.console import Console

from recon.capture import probe_files, sweep_part, sweep_tables
from recon.capture.sweep_part import SweepCapture
from recon.files import atomic, metrics
from recon.files.metrics import Metrics
from recon.freehand import sequence_sweep
from recon.freehand.sequence_sweep import SequenceFields, SequenceSweep
from recon.freehand.sequences import FrameNames
from recon.freehand.volume_compounding import Clip, Rectangle
from recon.model.rig import Rig
from recon.model.tracks import LagSeconds
from recon.probe_calibration import crossing_frames, probe_figures, sound_in_water, tank_calibration
from recon.probe_calibration.crossing_frames import CrossingFrames
from recon.probe_calibration.tank_calibration import Result, Settings

PROBE = "probe.yaml"
FRAMES = "frames.csv"
OF_THE_SCALE, OF_THE_SIZE = "rig.probe.scale_mm_per_px", "rig.probe.image_size"


class Config(SequenceFields, Settings):
    """Fields of `conf/calibrate-probe.yaml`: sources, target, and all that is known beforehand."""

    rig: Rig
    out: Path
    capture: Path | None = None
    sweep: str = ""
    pairs: Path | None = None
    earlier: Path | None = None
    clip: Rectangle | None = None
    lag_s: LagSeconds = 0.0
    _overrides: Sequence[str] = PrivateAttr(())  # field=value as they were given

    @model_validator(mode="after")
    def _one_source(self) -> "Config":
        given = [name for name in ("capture", "sequence", "pairs") if getattr(self, name) is not None]
        if len(given) != 1:
            raise ValueError(f"expected one of capture, sequence and pairs, found {' and '.join(given) or 'none'}")
        for name, value in (("clip", self.clip), ("lag_s", self.lag_s or None)):
            if self.pairs is not None and value is not None:
                raise ValueError(f"{name}: expected none with pairs, which come without images and times, found {value}")
        return self

    def model_post_init(self, context: Any) -> None:
        """Keep the overrides, by which a scale that was given differs from the default rig's."""
        if context:
            self._overrides = context["overrides"]

    @property
    def scanner_sy(self) -> float | None:
        """The scanner's mm/px in depth: as given; NaN where only the size was, so of another scanner; None for the rig's."""
        given = {each.lstrip("+~").partition("=")[0] for each in self._overrides}
        if given & {"rig", "rig.probe", OF_THE_SCALE}:
            return self.rig.probe.scale_mm_per_px[1]
        return np.nan if OF_THE_SIZE in given else None


def run(config: Config) -> None:
    """Find the crossing in all frames, calibrate, judge and write.

    Raises
    ------
    InputError
        If the input is incomplete or damaged, doesn't determine the calibration, or `out` can't be written to.
    """
    console = Console(soft_wrap=True, highlight=False)
    source = config.capture or config.sequence or config.pairs
    assert source is not None
    inputs = [source, *(path for path in (config.earlier, config.tracker) if path is not None)]
    atomic.check_folder(config.out, "calibrate-probe", inputs=inputs)
    earlier = None if config.earlier is None else probe_files.read(config.earlier)
    if config.temperature_c is not None:
        sound_in_water.speed_of_sound(config.temperature_c)  # a mistake shows before the work
    start = perf_counter()
    frames = look(config, console)
    seconds = {"seconds_find": round(perf_counter() - start, 3)}
    for line in probe_figures.describe_frames(frames, seconds["seconds_find"]):
        console.print(line, markup=False)
    crossing_frames.refuse_few(frames)

    start = perf_counter()
    result = tank_calibration.calibrate(frames, config.rig.probe, config, config.scanner_sy)
    seconds["seconds_calibrate"] = round(perf_counter() - start, 3)
    figures = probe_figures.measure(frames, result, config.rig.probe, config)
    for line in probe_figures.describe(frames, result, figures, config.rig.probe, config):
        console.print(line, markup=False)
    if earlier is not None:
        figures |= probe_figures.compare(result.calibration, earlier)
        console.print(probe_figures.describe_comparison(figures, config.earlier), markup=False)
    written = write(config.out, frames, result, figures | seconds)
    console.print(f"wrote       {config.out}/{{{','.join(written)}}}", markup=False)


def look(config: Config, console: Console) -> CrossingFrames:
    """Read pairs, of images as large as the rig's, or find the crossing in the B-scans of a sweep, read one by one."""
    if config.pairs is not None:
        return crossing_frames.of_pairs(str(config.pairs), config.rig.probe.image_size, *sweep_tables.read_pairs(config.pairs))
    sweep = read(config)
    poses, covariance = sweep.poses(config.lag_s), sweep.pose_covariance(config.lag_s)
    clip = Clip(0, 0, *sweep.size) if config.clip is None else Clip(*config.clip)
    with console.status("") as status:

        def images() -> Iterator[NDArray[np.uint8]]:
            for number, image in enumerate(sweep.images()):
                status.update(f"looking for the crossing, B-scan {number + 1} of {len(sweep.frames)}")
                yield clip.cut(image)

        return crossing_frames.look(
            sweep.name, images(), sweep.size, sweep.frames, poses, covariance, config.appearance, clip.corner, config.phantom
        )


def read(config: Config) -> SweepCapture | SequenceSweep:
    """Open the sweep over the wires."""
    if config.capture is not None:
        return sweep_part.read_sweep(config.capture, config.sweep, "probe", config.implausible)
    assert config.sequence is not None
    return sequence_sweep.read_sequence_sweep(
        config.sequence, config.frame_names(FrameNames()), config.tracker, config.implausible
    )


def write(out: Path, frames: CrossingFrames, result: Result, figures: Metrics) -> list[str]:
    """Write all files, whole or not at all; returns their names."""
    with atomic.new_folder(out, "calibrate-probe") as folder:
        probe_files.write(folder / PROBE, result.calibration)
        probe_files.write_authors(folder / probe_files.AUTHORS, result.calibration)
        sweep_tables.write_rows(folder / FRAMES, probe_figures.COLUMNS, probe_figures.rows(frames, result.adjustment))
        metrics.write(folder / metrics.FILE, figures)
    return [PROBE, probe_files.AUTHORS, FRAMES, metrics.FILE]
