"""Put the B-scans of a freehand sweep into a volume.

Reads the sweep part of a capture folder, with the probe's calibration and the lag between scanner and tracker; or a tracked
sequence of the PLUS toolkit, reconstructed by the fields below or by its own configuration. Writes into the folder `out`:
volume.nrrd (in the world's frame, mm); of a capture also sequence.igs.mha, the B-scans with their poses for PLUS and 3D Slicer;
and metrics.json. Depths are as of the speed of sound that the probe's calibration holds for, unless tissue_m_s is given. Results
that are there already are replaced. Takes a second for a hundred B-scans, and some seconds more when it first compiles.

    sonotwin freehand capture=outputs/sweep/capture probe=outputs/probe/probe.yaml lag_s=0.0503 out=outputs/volume
    sonotwin freehand capture=outputs/sweep/capture tissue_m_s=1450 spacing_mm=0.3 compounding=maximum out=outputs/volume
    sonotwin freehand sequence=sweep.igs.mha config=config.xml out=outputs/volume
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, model_validator
from rich.console import Console

from recon.capture import probe_files, sweep_part
from recon.capture.sweep_part import SweepCapture
from recon.errors import InputError
from recon.files import atomic, metrics, volumes
from recon.files.metrics import Metrics
from recon.freehand import hole_filling, plus_config, sequences, volume_compounding
from recon.freehand.volume_compounding import Clip, Compounding, Interpolation, Reconstruction
from recon.model.probe import ProbeCalibration, Speed
from recon.probe_calibration import sound_in_water
from recon.probe_calibration.sound_in_water import SCANNER_SPEED
from sonotwin.verbs.measure_lag import LagSeconds

VOLUME = "volume.nrrd"  # by which the folder of a volume is known
SEQUENCE = "sequence.igs.mha"

Array = NDArray[np.float64]


class Config(BaseModel):
    """Fields of `conf/freehand.yaml`: what is read and written, and how the volume is made."""

    model_config = ConfigDict(extra="forbid")

    out: Path
    capture: Path | None = None
    probe: Path | None = None
    lag_s: LagSeconds = 0.0
    tissue_m_s: Speed | None = None
    sequence: Path | None = None
    config: Path | None = None
    spacing_mm: Annotated[float, Field(ge=0.01, le=100)] = 0.5
    extent: Literal["aligned", "principal"] = "principal"
    compounding: Compounding = "mean"
    interpolation: Interpolation = "nearest"
    clip: tuple[int, int, Annotated[int, Field(gt=0)], Annotated[int, Field(gt=0)]] | None = None
    hole_voxels: Annotated[int, Field(ge=0, le=1000)] = hole_filling.MOST_VOXELS
    hole_sticks: Annotated[int, Field(ge=1, le=len(hole_filling.STICKS))] = 1
    most_gib: Annotated[float, Field(gt=0, le=1024)] = volume_compounding.MOST_BYTES / 2**30

    @model_validator(mode="after")
    def _one_source(self) -> "Config":
        if (self.capture is None) == (self.sequence is None):
            raise ValueError(f"expected capture or sequence, found {'neither' if self.capture is None else 'both'}")
        if self.capture is not None and self.config is not None:
            raise ValueError("config: expected a configuration with a sequence only, found one with a capture")
        if self.sequence is not None and self.lag_s != 0:
            raise ValueError(f"lag_s: expected none with a sequence, whose poses are those of its images, found {self.lag_s:g}")
        if self.config is not None and self.probe is not None:
            raise ValueError("probe: expected none with a config, which has the calibration, found one")
        if self.config is not None and self.tissue_m_s is not None:
            raise ValueError(f"tissue_m_s: expected none with a config, which has the depths, found {self.tissue_m_s:g}")
        if self.compounding == "integer_mean" and self.interpolation == "linear":
            raise ValueError("interpolation: expected nearest with integer_mean, which counts whole pixels, found linear")
        return self


@dataclass(frozen=True)
class Scans:
    """n B-scans in space, whoever took them."""

    shape: tuple[int, int]  # height, width
    world_from_pixel: Array  # (n, 4, 4); NaN where there is no pose
    stream: Callable[[], Iterator[NDArray[np.uint8]]]  # the images (h, w), one by one, from the first at each call
    speed_m_s: float  # of the sound for which the depths are
    calibrated_m_s: float  # of that for which the calibration is
    probe: ProbeCalibration | None = None  # converted likewise; None where the sequence has its own

    @property
    def placed(self) -> int:
        """How many have a pose."""
        return int(np.isfinite(self.world_from_pixel).all(axis=(1, 2)).sum())


def run(config: Config) -> None:
    """Read, paste, fill and write.

    Raises
    ------
    InputError
        If the input is incomplete or damaged, has no poses, needs more memory than allowed, or `out` can't be written to.
    """
    console = Console(soft_wrap=True, highlight=False)
    inputs = [path for path in (config.capture, config.probe, config.sequence, config.config) if path is not None]
    atomic.check_folder(config.out, VOLUME, inputs=inputs)
    if config.capture is not None:
        sweep = sweep_part.read_sweep(config.capture)
        probe = probe_of(sweep, config.capture, config.probe)
        scans = scans_of_sweep(sweep, probe, config.lag_s, config.tissue_m_s)
    else:
        assert config.sequence is not None
        sweep, scans = None, scans_of_sequence(config.sequence, config.probe, config.config, config.tissue_m_s)
    height, width = scans.shape
    count = len(scans.world_from_pixel)
    console.print(f"read        {count} B-scans, {width}x{height}, {scans.placed} with a pose", markup=False)
    if config.config is None:
        console.print(depths(scans), markup=False)

    start = perf_counter()
    with console.status("putting B-scans into the volume"):
        pasted, filled = reconstruct(scans, config)
    seconds = {"seconds_reconstruct": round(perf_counter() - start, 3)}
    figures = measure(scans, pasted, filled)
    for line in describe(filled, figures, config):
        console.print(line, markup=False)

    with console.status("writing"), atomic.new_folder(config.out, VOLUME) as folder:
        volumes.write_volume(folder / VOLUME, filled.volume)
        if sweep is not None and scans.probe is not None:
            write_sequence(folder / SEQUENCE, sweep, scans.probe, config.lag_s)
        metrics.write(folder / metrics.FILE, figures | seconds)
        written = [name for name in (VOLUME, SEQUENCE, metrics.FILE) if (folder / name).exists()]
    console.print(f"wrote       {config.out}/{{{','.join(written)}}}", markup=False)


def probe_of(sweep: SweepCapture, capture: Path, given: Path | None) -> ProbeCalibration:
    """The probe's calibration: that in the file that is given, else that of the capture.

    Raises
    ------
    InputError
        If there is neither.
    """
    if given is not None:
        return probe_files.read(given)
    if sweep.probe is None:
        raise InputError(f"{capture}: expected the probe's calibration, found none; give probe=...")
    return sweep.probe


def scans_of_sweep(sweep: SweepCapture, probe: ProbeCalibration, lag_s: float, tissue_m_s: float | None) -> Scans:
    """The B-scans of a capture, in the world; of tissue with a speed of sound other than the calibration's, if it is known."""
    converted = sound_in_water.for_tissue(probe, tissue_m_s)
    world_from_pixel = sweep.poses(lag_s) @ sequences.target_from_pixel(converted)
    return Scans(sweep.size[::-1], world_from_pixel, sweep.images, converted.speed_m_s, probe.speed_m_s, converted)


def scans_of_sequence(path: Path, probe: Path | None, config: Path | None, tissue_m_s: float | None) -> Scans:
    """The B-scans of a PLUS sequence, in the frame of its reference; its own calibration is taken to hold for 1540 m/s."""
    frames, shape = sequences.read_tracking(path), sequences.image_shape(path)
    fixed, to, of = {}, "Reference", "Image"
    given = None if probe is None else probe_files.read(probe)
    if given is not None:
        fixed = {"ImageToProbe": sequences.target_from_pixel(given)}
    elif config is not None:
        wanted = plus_config.read_config(config)
        fixed, to, of = wanted.transforms, wanted.reference, wanted.image
    try:
        world_from_pixel = sequences.poses(frames, to, of, fixed)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    valid = frames.valid["Image"][:, None, None]
    calibrated = SCANNER_SPEED if given is None else given.speed_m_s
    speed = tissue_m_s or calibrated
    matrices = sound_in_water.in_tissue(np.where(valid, world_from_pixel, np.nan), calibrated, speed)
    converted = None if given is None else sound_in_water.for_tissue(given, tissue_m_s)
    return Scans(shape, matrices, lambda: sequences.stream_images(path), speed, calibrated, converted)


def depths(scans: Scans) -> str:
    """A line that says which speed of sound the depths are for."""
    calibrated, speed = scans.calibrated_m_s, scans.speed_m_s
    how = "as calibrated" if speed == calibrated else f"converted from {calibrated:.0f} m/s, for which the probe is calibrated"
    return f"depth       right where sound makes {speed:.0f} m/s, {how}"


def reconstruct(scans: Scans, config: Config) -> tuple[Reconstruction, Reconstruction]:
    """The volume before its holes are filled, and after."""
    if config.config is not None:
        assert config.sequence is not None
        return plus_config.reconstruct_sequence(config.sequence, plus_config.read_config(config.config))
    clip = None if config.clip is None else Clip(*config.clip)
    grid_along = volume_compounding.aligned_grid if config.extent == "aligned" else volume_compounding.principal_grid
    grid = grid_along(volume_compounding.corners(scans.world_from_pixel, scans.shape, clip), config.spacing_mm)
    most_bytes = int(config.most_gib * 2**30)
    pasted = volume_compounding.reconstruct(
        scans.stream(), scans.world_from_pixel, grid, config.compounding, config.interpolation, clip, most_bytes=most_bytes
    )
    if config.hole_voxels == 0:
        return pasted, pasted
    return pasted, hole_filling.fill_holes(pasted, config.hole_voxels, config.hole_sticks)


def measure(scans: Scans, pasted: Reconstruction, filled: Reconstruction) -> Metrics:
    """Figures of a volume, each named with its unit."""
    volume = filled.volume
    nz, ny, nx = volume.voxels.shape
    return {
        "frames": len(scans.world_from_pixel),
        "frames_placed": scans.placed,
        "speed_m_per_s": scans.speed_m_s,
        **dict(zip(("voxels_x", "voxels_y", "voxels_z"), (nx, ny, nz), strict=True)),
        **{f"spacing_{axis}_mm": float(step) for axis, step in zip("xyz", volume.spacing, strict=True)},
        "pasted_fraction": float(pasted.filled.mean()),
        "filled_fraction": float(filled.filled.mean()),
        "mean_level": float(volume.voxels[filled.filled].mean()) if filled.filled.any() else np.nan,
    }


def describe(filled: Reconstruction, figures: Metrics, config: Config) -> Iterator[str]:
    """Lines that say how large the volume is, and how much of it was seen."""
    size = "x".join(str(figures[f"voxels_{axis}"]) for axis in "xyz")
    spacing = "x".join(f"{step:g}" for step in dict.fromkeys(filled.volume.spacing.tolist()))
    how = f"by {config.config}" if config.config is not None else f"{config.extent}, {config.compounding}, {config.interpolation}"
    yield f"paste       {size} voxels of {spacing} mm, {how}: {100 * figures['pasted_fraction']:.1f} % seen"
    level = metrics.shown(figures["mean_level"], ".0f")
    yield f"fill        {100 * figures['filled_fraction']:.1f} % after filling holes, mean level {level}"


def write_sequence(path: Path, sweep: SweepCapture, probe: ProbeCalibration, lag_s: float) -> None:
    """Write the B-scans with their poses as a PLUS sequence, by way of a file, so that they are never all in memory."""
    store = path.with_name("images.npy")
    images = np.lib.format.open_memmap(store, "w+", np.uint8, (len(sweep.paths), *sweep.size[::-1]))
    try:
        for stored, image in zip(images, sweep.images(), strict=True):
            stored[:] = image
        times_s = sweep.times * 1e-9 - lag_s
        sequences.write_sequence(path, sequences.sequence_of(images, sweep.poses(lag_s), probe, times_s))
    finally:
        del images
        store.unlink()
