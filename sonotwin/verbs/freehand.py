"""Put the B-scans of a freehand sweep into a volume.

Reads the sweep part of a capture folder, with the probe's calibration and the lag between scanner and tracker; or a tracked
sequence of the PLUS toolkit, reconstructed by the fields below or by its own configuration. Writes into the folder `out`:
volume.nrrd (in the world's frame, mm); of a capture also sigma.nrrd, the standard deviation of the place, mm, of what each voxel
shows, and sequence.igs.mha, the B-scans with their poses for PLUS and 3D Slicer; and metrics.json. Depths are as of the speed of
sound that the probe's calibration holds for, unless tissue_m_s is given. Results that are there already are replaced. Takes a
second for a hundred B-scans, and some seconds more when it first compiles.

    sonotwin freehand capture=outputs/sweep/capture probe=outputs/probe/probe.yaml lag_s=0.0503 out=outputs/volume
    sonotwin freehand capture=outputs/sweep/capture tissue_m_s=1450 spacing_mm=0.3 compounding=maximum out=outputs/volume
    sonotwin freehand sequence=sweep.igs.mha config=config.xml out=outputs/volume
"""

from collections.abc import Iterator
from pathlib import Path
from time import perf_counter
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field, model_validator
from rich.console import Console

from recon.capture import sweep_part
from recon.capture.sweep_part import SweepCapture
from recon.files import atomic, metrics, volumes
from recon.files.metrics import Metrics
from recon.freehand import hole_filling, plus_config, volume_compounding
from recon.freehand import scans as freehand_scans
from recon.freehand.scans import Extent, Scans, Unsure
from recon.freehand.volume_compounding import Clip, Compounding, Interpolation, Reconstruction
from recon.model.probe import Speed, SpeedSigma
from recon.model.rig import NotNegative
from recon.model.tracks import LagSeconds

VOLUME = "volume.nrrd"  # by which the folder of a volume is known
SIGMA, SEQUENCE = "sigma.nrrd", "sequence.igs.mha"


class Config(BaseModel):
    """Fields of `conf/freehand.yaml`: sources, target, and settings of the volume."""

    model_config = ConfigDict(extra="forbid")

    out: Path
    capture: Path | None = None
    sweep: str = ""
    probe: Path | None = None
    lag_s: LagSeconds = 0.0
    lag_sigma_s: NotNegative = 0.0
    tissue_m_s: Speed | None = None
    tissue_sigma_m_s: SpeedSigma = 25.0
    sequence: Path | None = None
    config: Path | None = None
    spacing_mm: Annotated[float, Field(ge=0.01, le=100)] = 0.5
    extent: Extent = "principal"
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
        for name, value in (("lag_s", self.lag_s), ("lag_sigma_s", self.lag_sigma_s)):
            if self.sequence is not None and value != 0:
                raise ValueError(f"{name}: expected none with a sequence, whose poses are those of its images, found {value:g}")
        if self.config is not None and self.probe is not None:
            raise ValueError("probe: expected none with a config, which has the calibration, found one")
        if self.config is not None and self.tissue_m_s is not None:
            raise ValueError(f"tissue_m_s: expected none with a config, which has the depths, found {self.tissue_m_s:g}")
        if self.compounding == "integer_mean" and self.interpolation == "linear":
            raise ValueError("interpolation: expected nearest with integer_mean, which counts whole pixels, found linear")
        return self


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
    sweep, scans = read(config)
    console.print(f"read        {freehand_scans.summary(scans)}", markup=False)
    if config.config is None:
        console.print(f"depth       {freehand_scans.depths(scans)}", markup=False)

    start = perf_counter()
    with console.status("putting B-scans into the volume"):
        pasted, filled = reconstruct(scans, config)
        sigma = freehand_scans.sigma_volume(scans, filled.volume, None if config.clip is None else Clip(*config.clip))
    seconds = {"seconds_reconstruct": round(perf_counter() - start, 3)}
    figures = freehand_scans.measure(scans, pasted, filled) | freehand_scans.measure_sigma(sigma)
    for line in describe(filled, figures, config):
        console.print(line, markup=False)

    with console.status("writing"), atomic.new_folder(config.out, VOLUME) as folder:
        volumes.write_volume(folder / VOLUME, filled.volume)
        if sigma is not None:
            volumes.write_volume(folder / SIGMA, sigma)
        if sweep is not None and scans.probe is not None:
            freehand_scans.write_sequence(folder / SEQUENCE, sweep, scans.probe, config.lag_s)
        metrics.write(folder / metrics.FILE, figures | seconds)
        written = [name for name in (VOLUME, SIGMA, SEQUENCE, metrics.FILE) if (folder / name).exists()]
    console.print(f"wrote       {config.out}/{{{','.join(written)}}}", markup=False)


def read(config: Config) -> tuple[SweepCapture | None, Scans]:
    """Read the sweep, if it is a capture's, and its B-scans in the world."""
    if config.capture is None:
        assert config.sequence is not None
        return None, freehand_scans.of_sequence(config.sequence, config.probe, config.config, config.tissue_m_s)
    sweep = sweep_part.read_sweep(config.capture, config.sweep, "volume")
    probe = freehand_scans.probe_of(sweep, config.capture, config.probe)
    unsure = Unsure(config.lag_sigma_s, config.tissue_sigma_m_s)
    return sweep, freehand_scans.of_sweep(sweep, probe, config.lag_s, config.tissue_m_s, unsure)


def reconstruct(scans: Scans, config: Config) -> tuple[Reconstruction, Reconstruction]:
    """The volume before its holes are filled, and after."""
    if config.config is not None:
        assert config.sequence is not None
        return plus_config.reconstruct_sequence(config.sequence, plus_config.read_config(config.config))
    clip = None if config.clip is None else Clip(*config.clip)
    grid, most_bytes = freehand_scans.grid_around(scans, config.extent, config.spacing_mm, clip), int(config.most_gib * 2**30)
    pasted = volume_compounding.reconstruct(
        scans.stream(), scans.world_from_pixel, grid, config.compounding, config.interpolation, clip, most_bytes=most_bytes
    )
    return pasted, freehand_scans.filled(pasted, config.hole_voxels, config.hole_sticks)


def describe(filled: Reconstruction, figures: Metrics, config: Config) -> Iterator[str]:
    """Lines: size of the volume, and the part of it that B-scans passed through."""
    size = "x".join(str(figures[f"voxels_{axis}"]) for axis in "xyz")
    spacing = "x".join(f"{step:g}" for step in dict.fromkeys(filled.volume.spacing.tolist()))
    how = f"by {config.config}" if config.config is not None else f"{config.extent}, {config.compounding}, {config.interpolation}"
    yield f"paste       {size} voxels of {spacing} mm, {how}: {100 * figures['pasted_fraction']:.1f} % seen"
    level = metrics.shown(figures["mean_level"], ".0f")
    yield f"fill        {100 * figures['filled_fraction']:.1f} % after filling holes, mean level {level}"
    if "place_sigma_median_mm" in figures:
        median, most = (figures[f"place_sigma_{name}_mm"] for name in ("median", "most"))
        yield f"place       known to {median:.2f} mm in the median, {most:.2f} mm at most, by its own prediction"
