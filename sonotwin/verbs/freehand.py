"""Put the B-scans of a freehand sweep into a volume.

Reads the sweep part of a capture folder, with the probe's calibration and the lag between scanner and tracker; or a tracked
sequence of the PLUS toolkit, reconstructed by the fields below or by its own configuration. Writes into the folder `out`:
volume.nrrd (in the world's frame, mm); of a capture also sequence.igs.mha, the B-scans with their poses for PLUS and 3D Slicer;
and metrics.json. Results that are there already are replaced. Takes a second for a hundred B-scans, and some seconds more when it
first compiles.

    sonotwin freehand capture=outputs/sweep/capture probe=outputs/probe/probe.yaml lag_s=0.0503 out=outputs/volume
    sonotwin freehand capture=outputs/sweep/capture spacing_mm=0.3 compounding=maximum out=outputs/volume
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

from recon import atomic, freehand, holes, metrics, plus_config, probe_files, sequences, sweep_capture, volumes
from recon.errors import InputError
from recon.freehand import Clip, Compounding, Interpolation, Reconstruction
from recon.metrics import Metrics
from recon.probe import ProbeCalibration
from recon.rig import Finite, Positive
from recon.sweep_capture import SweepCapture

VOLUME = "volume.nrrd"  # by which the folder of a volume is known
SEQUENCE = "sequence.igs.mha"

Array = NDArray[np.float64]


class Config(BaseModel):
    """Fields of `conf/freehand.yaml`: what is read and written, and how the volume is made."""

    model_config = ConfigDict(extra="forbid")

    out: Path
    capture: Path | None = None
    probe: Path | None = None
    lag_s: Finite = 0.0
    sequence: Path | None = None
    config: Path | None = None
    spacing_mm: Positive = 0.5
    extent: Literal["aligned", "principal"] = "principal"
    compounding: Compounding = "mean"
    interpolation: Interpolation = "nearest"
    clip: tuple[int, int, Annotated[int, Field(gt=0)], Annotated[int, Field(gt=0)]] | None = None
    hole_voxels: Annotated[int, Field(ge=0, le=1000)] = holes.MOST_VOXELS
    hole_sticks: Annotated[int, Field(ge=1, le=len(holes.STICKS))] = 1
    most_gib: Positive = freehand.MOST_BYTES / 2**30

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
        if self.compounding == "integer_mean" and self.interpolation == "linear":
            raise ValueError("interpolation: expected nearest with integer_mean, which counts whole pixels, found linear")
        return self


@dataclass(frozen=True)
class Scans:
    """n B-scans in space, whoever took them."""

    shape: tuple[int, int]  # height, width
    world_from_pixel: Array  # (n, 4, 4); NaN where there is no pose
    stream: Callable[[], Iterator[NDArray[np.uint8]]]  # the images (h, w), one by one, from the first at each call

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
        sweep = sweep_capture.read_sweep(config.capture)
        probe = probe_of(sweep, config)
        scans, transcript = scans_of_sweep(sweep, probe, config.lag_s), (sweep, probe)
    else:
        assert config.sequence is not None
        scans, transcript = scans_of_sequence(config.sequence, config.probe, config.config), None
    height, width = scans.shape
    count = len(scans.world_from_pixel)
    console.print(f"read        {count} B-scans, {width}x{height}, {scans.placed} with a pose", markup=False)

    start = perf_counter()
    with console.status("putting B-scans into the volume"):
        pasted, filled = reconstruct(scans, config)
    seconds = {"seconds_reconstruct": round(perf_counter() - start, 3)}
    figures = measure(scans, pasted, filled)
    for line in describe(filled, figures, config):
        console.print(line, markup=False)

    with console.status("writing"), atomic.new_folder(config.out, VOLUME) as folder:
        volumes.write_volume(folder / VOLUME, filled.volume)
        if transcript is not None:
            write_sequence(folder / SEQUENCE, *transcript, config.lag_s)
        metrics.write(folder / metrics.FILE, figures | seconds)
        written = [name for name in (VOLUME, SEQUENCE, metrics.FILE) if (folder / name).exists()]
    console.print(f"wrote       {config.out}/{{{','.join(written)}}}", markup=False)


def probe_of(sweep: SweepCapture, config: Config) -> ProbeCalibration:
    """The probe's calibration: that given, else that of the capture.

    Raises
    ------
    InputError
        If there is neither.
    """
    if config.probe is not None:
        return probe_files.read(config.probe)
    if sweep.probe is None:
        raise InputError(f"{config.capture}: expected the probe's calibration, found none; give probe=...")
    return sweep.probe


def scans_of_sweep(sweep: SweepCapture, probe: ProbeCalibration, lag_s: float) -> Scans:
    """The B-scans of a capture, in the world."""
    world_from_pixel = sweep.poses(lag_s) @ sequences.target_from_pixel(probe)
    return Scans(sweep.size[::-1], world_from_pixel, sweep.images)


def scans_of_sequence(path: Path, probe: Path | None, config: Path | None) -> Scans:
    """The B-scans of a PLUS sequence, in the frame of its reference."""
    frames, shape = sequences.read_tracking(path), sequences.image_shape(path)
    fixed, to, of = {}, "Reference", "Image"
    if probe is not None:
        fixed = {"ImageToProbe": sequences.target_from_pixel(probe_files.read(probe))}
    elif config is not None:
        wanted = plus_config.read_config(config)
        fixed, to, of = wanted.transforms, wanted.reference, wanted.image
    try:
        world_from_pixel = sequences.poses(frames, to, of, fixed)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    valid = frames.valid["Image"][:, None, None]
    return Scans(shape, np.where(valid, world_from_pixel, np.nan), lambda: sequences.stream_images(path))


def reconstruct(scans: Scans, config: Config) -> tuple[Reconstruction, Reconstruction]:
    """The volume before its holes are filled, and after."""
    if config.config is not None:
        assert config.sequence is not None
        return plus_config.reconstruct_sequence(config.sequence, plus_config.read_config(config.config))
    clip = None if config.clip is None else Clip(*config.clip)
    grid_along = freehand.aligned_grid if config.extent == "aligned" else freehand.principal_grid
    grid = grid_along(freehand.corners(scans.world_from_pixel, scans.shape, clip), config.spacing_mm)
    most_bytes = int(config.most_gib * 2**30)
    pasted = freehand.reconstruct(
        scans.stream(), scans.world_from_pixel, grid, config.compounding, config.interpolation, clip, most_bytes=most_bytes
    )
    if config.hole_voxels == 0:
        return pasted, pasted
    return pasted, holes.fill_holes(pasted, config.hole_voxels, config.hole_sticks)


def measure(scans: Scans, pasted: Reconstruction, filled: Reconstruction) -> Metrics:
    """Figures of a volume, each named with its unit."""
    volume = filled.volume
    nz, ny, nx = volume.voxels.shape
    return {
        "frames": len(scans.world_from_pixel),
        "frames_placed": scans.placed,
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
