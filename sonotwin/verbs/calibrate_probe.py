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

from collections.abc import Iterator
from pathlib import Path
from time import perf_counter
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationInfo, model_validator
from rich.console import Console

from recon.capture import probe_files, sweep_part, sweep_tables
from recon.capture.sweep_part import SweepCapture
from recon.files import atomic, metrics
from recon.files.metrics import Metrics
from recon.freehand import sequence_sweep
from recon.freehand.sequence_sweep import SequenceFields, SequenceSweep
from recon.freehand.sequences import FrameNames
from recon.freehand.volume_compounding import Clip, Rectangle
from recon.model.rig import Part, Rig
from recon.model.tracks import LagSeconds
from recon.probe_calibration import crossing_frames, probe_figures, sound_in_water, tank_calibration
from recon.probe_calibration.crossing_frames import CrossingFrames
from recon.probe_calibration.tank_calibration import Result, Settings
from sonotwin import choices
from sonotwin.config import Choice

PROBE = "probe.yaml"
FRAMES = "frames.csv"
OF_THE_SCALE = "rig.probe.scale_mm_per_px"


class ScaleFields(Part):
    """The field of a verb that reads rig.probe's scale, which counts otherwise where it was given."""

    scale_given: bool = False
    """whether rig.probe.scale_mm_per_px is the scanner's even where it is the usual rig's; true by itself where it is given"""

    @model_validator(mode="before")
    @classmethod
    def _knows_what_was_given(cls, values: Any, info: ValidationInfo) -> Any:
        names = {each.lstrip("+~").partition("=")[0] for each in (info.context or {}).get("overrides", ())}
        given = names & {"rig", "rig.probe", OF_THE_SCALE} and isinstance(values, dict)
        return {**values, "scale_given": True} if given else values


class Config(ScaleFields, SequenceFields, Settings):
    """Fields of `sonotwin calibrate-probe`: sources, target, and all that is known beforehand."""

    rig: Annotated[Rig, Choice("meza2021")]
    """rig.probe is the design: where the bracket holds the probe to some 30 deg and 30 mm, the scanner's mm/px. Of another
    probe give temperature_c, and with pairs rig.probe.image_size; its bracket needs no design"""
    out: Path
    """folder; gets probe.yaml, US_params.npz, frames.csv, metrics.json"""
    capture: Path | None = None
    """a capture folder with a sweep over the crossing of two wires at rest. Or else:"""
    sweep: str = ""
    """its name, of a capture that holds several; "" takes the only one for the probe"""
    pairs: Path | None = None
    """CSV file of poses and pixels, one pair a line: m00 to m23 of world_from_target in mm, u, v in px"""
    earlier: Path | None = None
    """an earlier calibration of the same probe, probe.yaml: whether it moved in its bracket since"""
    clip: Rectangle | None = None
    """[u, v, width, height] px, the part of each B-scan that is looked at, of an uncropped screen; null is all of it. The
    calibration holds for the whole images all the same"""
    lag_s: LagSeconds = 0.0
    """s, delay of the B-scans' time stamps, as of `sonotwin measure-lag`"""

    @model_validator(mode="after")
    def _one_source(self) -> "Config":
        given = [name for name in ("capture", "sequence", "pairs") if getattr(self, name) is not None]
        if len(given) != 1:
            raise ValueError(f"expected one of capture, sequence and pairs, found {' and '.join(given) or 'none'}")
        for name, value in (("clip", self.clip), ("lag_s", self.lag_s or None)):
            if self.pairs is not None and value is not None:
                raise ValueError(f"{name}: expected none with pairs, which come without images and times, found {value}")
        return self

    @property
    def scanner_sy(self) -> float | None:
        """The scanner's mm/px in depth: as given; NaN where only the size was, so of another scanner; None for the rig's."""
        given, usual = self.rig.probe, choices.read_rig().probe
        if self.scale_given or given.scale_mm_per_px != usual.scale_mm_per_px:
            return given.scale_mm_per_px[1]
        return None if given.image_size == usual.image_size else np.nan


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
