"""Put the B-scans of a freehand sweep into a volume.

Reads the sweep part of a capture folder, with the probe's calibration and the lag between scanner and tracker; or a tracked
sequence of the PLUS toolkit, reconstructed by the fields below and, where they aren't given, by its own configuration. Writes
into the folder `out`: volume.nrrd (in the world's frame, mm); of a capture also sigma.nrrd, the standard deviation of the place,
mm, of what each voxel shows, and sequence.igs.mha, the B-scans with their poses for PLUS and 3D Slicer; and metrics.json. Depths
are as of the speed of sound that the probe's calibration holds for, unless tissue_m_s is given. Results that are there already
are replaced. Takes a second for a hundred B-scans, and some seconds more when it first compiles.

    sonotwin freehand capture=outputs/sweep/capture probe=outputs/probe/probe.yaml lag_s=0.0503 out=outputs/volume
    sonotwin freehand capture=outputs/sweep/capture tissue_m_s=1450 spacing_mm=0.3 compounding=maximum out=outputs/volume
    sonotwin freehand sequence=sweep.igs.mha config=config.xml arithmetic=floating out=outputs/volume
    sonotwin freehand sequence=sweep.igs.mha probe=outputs/probe/probe.yaml reference=Tracker lag_s=0.0503 out=outputs/volume
    sonotwin freehand sequence=abdomen.igs.mha fan=find out=outputs/volume
"""

from collections.abc import Iterator
from dataclasses import fields, replace
from pathlib import Path
from time import perf_counter
from typing import Annotated, Any

import numpy as np
from pydantic import Field
from rich.console import Console

from recon.capture import probe_files, sweep_part
from recon.capture.sweep_part import SweepCapture
from recon.clips import fan_region
from recon.errors import InputError
from recon.files import atomic, metrics, volumes
from recon.files.metrics import Metrics
from recon.freehand import hole_filling, plus_config, volume_compounding
from recon.freehand import scans as freehand_scans
from recon.freehand.plus_arithmetic import Arithmetic
from recon.freehand.plus_config import PlusConfig
from recon.freehand.scans import Extent, Scans, ScansFields, VolumeSettings
from recon.freehand.sequences import FrameNames
from recon.freehand.volume_compounding import Clip, Compounding, Interpolation, Reconstruction, Rectangle
from recon.model.fan import Fan, Sector

VOLUME = "volume.nrrd"
ROOM = 1.1  # by which gaps may be wider than sticks reach, before it is said
SIGMA, SEQUENCE = "sigma.nrrd", "sequence.igs.mha"


class Config(ScansFields):
    """Fields of `sonotwin freehand`: sources, target, and settings of the volume."""

    out: Path
    """folder; gets volume.nrrd, sigma.nrrd and sequence.igs.mha (of a capture), metrics.json"""
    spacing_mm: Annotated[float, Field(ge=0.01, le=100)] | None = None
    """0.5 mm, of the voxels; 0.01 to 100"""
    extent: Extent | None = None
    """principal: along the axes of the sweep, smaller if it runs across; aligned: along the world's, as in PLUS"""
    compounding: Compounding | None = None
    """of the pixels in a voxel: mean, maximum, latest, weighted: the mean by `weights`"""
    interpolation: Interpolation | None = None
    """nearest: a pixel counts for the nearest voxel; linear: by its distance for the eight around it"""
    clip: Rectangle | None = None
    """[u, v, width, height] px, the part of each B-scan that is used; all of it. As far as the image goes, so that [0, 0,
    9999, 9999] is all of it whatever the configuration has"""
    fan: Sector | None = None
    """[u, v, first, last, left, right], the part of a curved array's B-scan that is used: where its sides meet, px, as a rule
    above the image, v < 0; radii at which it begins and ends, px; angles of its sides from straight down, deg, the left one
    negative. find: about what changes from image to image. none: all of it"""
    hole_voxels: Annotated[int, Field(ge=0, le=1000)] | None = None
    """9, the longest stick across a hole, in voxels, both ends included; 0 leaves holes open"""
    hole_sticks: Annotated[int, Field(ge=1, le=len(hole_filling.STICKS))] | None = None
    """1, the number of the shortest sticks that count"""
    arithmetic: Arithmetic | None = None
    """floating; plus_full, plus_partial, plus_none: that of PLUS by its setting Optimization, bit by bit, whose mean is
    rounded at each pixel and darker by some levels"""
    weights: Path | None = None
    """of compounding=weighted: an image of 8 bits as large as the B-scans with the weights of their pixels, of which those of
    0 don't count; PLUS's ImportanceMaskFilename"""
    most_gib: Annotated[float, Field(gt=0, le=1024)] = volume_compounding.MOST_BYTES / 2**30
    """GiB of memory that the volume may take, at 10 bytes a voxel"""

    @property
    def given(self) -> dict[str, Any]:
        """The settings of the volume that were given, by their names."""
        values = {field.name: getattr(self, field.name) for field in fields(VolumeSettings)}
        values["clip"] = None if self.clip is None else Clip(*self.clip)
        values["fan"] = None if self.fan is None or isinstance(self.fan, str) else Fan(*self.fan)
        return {name: value for name, value in values.items() if value is not None}


def run(config: Config) -> None:
    """Read, paste, fill and write.

    Raises
    ------
    InputError
        If the input is incomplete or damaged, has no poses, needs more memory than allowed, or `out` can't be written to.
    """
    console = Console(soft_wrap=True, highlight=False)
    plus = None if config.config is None else plus_config.read_config(config.config)
    settings = settings_of(config, plus)
    given = (config.capture, config.probe, config.sequence, config.tracker, config.config, settings.weights)
    inputs = [path for path in given if path is not None]
    atomic.check_folder(config.out, "freehand", inputs=inputs)
    sweep, scans = read(config, plus)
    console.print(f"read        {freehand_scans.summary(scans)}", markup=False)
    console.print(f"depth       {freehand_scans.depths(scans)}", markup=False)
    for line in config.assumptions(scans.speed_m_s, scans.poses_exact):
        console.print(f"assumed     {line}", markup=False)
    clip = settings.box(scans.shape)
    for line in freehand_scans.cautions(scans if clip is None else freehand_scans.cut(scans, clip)):
        console.print(f"warning     {line}", markup=False)
    if (config.fan == "find" or settings.fan) and scans.speed_m_s != scans.calibrated_m_s:
        expected = f"none with a fan, whose lines run to all sides, or {scans.calibrated_m_s:g} m/s as calibrated"
        raise InputError(f"freehand: tissue_m_s: expected {expected}, found {scans.speed_m_s:g} m/s")
    if config.fan == "find":
        fan = fan_region.find(scans.stream(), str(config.capture or config.sequence))
        console.print(f"fan         in what changes from image to image, {fan}", markup=False)
        settings = replace(settings, fan=fan)
    elif plus is not None and config.fan is None and settings.fan is not None:
        console.print(f"fan         of {config.config}, {settings.fan}; all of each B-scan by fan=none", markup=False)

    freehand_scans.check_size(scans, str(config.capture or config.sequence), settings.box(scans.shape), config.implausible)
    start = perf_counter()
    with console.status("putting B-scans into the volume"):
        pasted, filled = freehand_scans.volume(scans, settings, int(config.most_gib * 2**30))
        sigma = freehand_scans.sigma_volume(scans, filled.volume, settings)
    seconds = {"seconds_reconstruct": round(perf_counter() - start, 3)}
    figures = freehand_scans.measure(scans, pasted, filled) | freehand_scans.measure_sigma(sigma)
    for line in (*describe(filled, figures, settings, config), *advice(scans, settings)):
        console.print(line, markup=False)

    with console.status("writing"), atomic.new_folder(config.out, "freehand") as folder:
        volumes.write_volume(folder / VOLUME, filled.volume)
        if sigma is not None:
            volumes.write_volume(folder / SIGMA, sigma)
        if sweep is not None and scans.probe is not None:
            freehand_scans.write_sequence(folder / SEQUENCE, sweep, scans.probe, config.lag)
        metrics.write(folder / metrics.FILE, figures | seconds)
        written = [name for name in (VOLUME, SIGMA, SEQUENCE, metrics.FILE) if (folder / name).exists()]
    console.print(f"wrote       {config.out}/{{{','.join(written)}}}", markup=False)


def settings_of(config: Config, plus: PlusConfig | None) -> VolumeSettings:
    """The given settings of the volume; those of the PLUS configuration where none are given, and the usual ones else."""
    usual = VolumeSettings() if plus is None or plus.volume is None else plus.volume
    settings = replace(usual, **config.given)
    if settings.compounding != "weighted" and config.weights is None:
        settings = replace(settings, weights=None)  # of the configuration, whose compounding isn't taken
    return replace(settings, fan=None) if config.fan == "none" else settings


def read(config: Config, plus: PlusConfig | None) -> tuple[SweepCapture | None, Scans]:
    """Read the sweep, if it is a capture's, and its B-scans in the world."""
    if config.capture is None:
        assert config.sequence is not None
        names = config.frame_names(FrameNames() if plus is None else plus.names)
        probe = None if config.probe is None else probe_files.read(config.probe)
        fixed = {} if plus is None else plus.transforms
        return None, freehand_scans.of_sequence(
            config.sequence, names, probe, fixed, config.lag, config.tissue_m_s, config.tracker, config.implausible
        )
    sweep = sweep_part.read_sweep(config.capture, config.sweep, "volume", config.implausible)
    probe = freehand_scans.probe_of(sweep, config.capture, config.probe)
    return sweep, freehand_scans.of_sweep(sweep, probe, config.lag, config.tissue_m_s, config.unsure)


def advice(scans: Scans, settings: VolumeSettings) -> Iterator[str]:
    """A line on voxels so fine that gaps between B-scans stay empty; none as a rule."""
    left, right, top, bottom = (settings.box(scans.shape) or Clip(0, 0, *scans.shape[::-1])).bounds(scans.shape)
    corners = np.array([[u, v] for u in (left, right) for v in (top, bottom)], float)
    needed = hole_filling.spacing_that_fills(scans.world_from_pixel, corners, settings.hole_voxels)
    if needed > ROOM * np.max(settings.spacing_mm):
        gap = needed * max(settings.hole_voxels - 1, 1)
        give = f"give spacing_mm={np.ceil(20 * needed) / 20:.4g}, or a larger hole_voxels"
        yield f"advice      B-scans or pixels are up to {gap:.2g} mm apart, too far for such voxels to be filled; {give}"


def describe(filled: Reconstruction, figures: Metrics, settings: VolumeSettings, config: Config) -> Iterator[str]:
    """Lines: size of the volume, and the part of it that B-scans passed through."""
    size = "x".join(str(figures[f"voxels_{axis}"]) for axis in "xyz")
    spacing = "x".join(f"{step:g}" for step in dict.fromkeys(filled.volume.spacing.tolist()))
    how = f"{settings.extent}, {settings.compounding}, {settings.interpolation}"
    how += "" if config.config is None else f" by {config.config}"
    how += f" but for {', '.join(config.given)}" if config.config is not None and config.given else ""
    if settings.arithmetic != "floating" and settings.compounding in ("mean", "weighted"):
        how += f", rounded at each pixel as in PLUS, darker by some levels than by arithmetic=floating ({settings.arithmetic})"
    yield f"paste       {size} voxels of {spacing} mm, {how}: {100 * figures['pasted_fraction']:.1f} % seen"
    level = metrics.shown(figures["mean_level"], ".0f")
    filling = f"{100 * figures['filled_fraction']:.1f} % after filling holes" if settings.hole_voxels else "holes stay open"
    yield f"fill        {filling}, mean level {level}"
    if "place_sigma_median_mm" in figures:
        median, most = (figures[f"place_sigma_{name}_mm"] for name in ("median", "most"))
        yield f"place       known to {median:.2f} mm in the median, {most:.2f} mm at most, by its own prediction"
