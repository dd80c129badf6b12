"""B-scans in a volume: the settings of the step, the step, and the files of its result."""

from collections.abc import Iterator
from dataclasses import dataclass, fields, replace
from pathlib import Path
from time import perf_counter
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from recon.capture import probe_files, sweep_part
from recon.capture.sweep_part import SweepCapture
from recon.clips import fan_region
from recon.errors import InputError
from recon.files import atomic, metrics, volumes
from recon.files.metrics import Metrics
from recon.files.volumes import Volume
from recon.freehand import hole_filling, plus_config, volume_compounding
from recon.freehand import scans as freehand_scans
from recon.freehand.plus_arithmetic import Arithmetic
from recon.freehand.plus_config import PlusConfig
from recon.freehand.scans import Extent, Scans, ScansFields, VolumeSettings
from recon.freehand.sequences import FrameNames
from recon.freehand.volume_compounding import Clip, Compounding, Interpolation, Reconstruction, Rectangle
from recon.model.fan import Fan, Sector
from recon.session.settings import Spacing
from recon.session.watch import SILENT, Watch

BY = "freehand"  # who writes
VOLUME = "volume.nrrd"
ROOM = 1.1  # by which gaps may be wider than sticks reach, before it is said
SIGMA, SEQUENCE = "sigma.nrrd", "sequence.igs.mha"


class Settings(ScansFields):
    """Sources, and settings of the volume."""

    spacing_mm: Spacing | None = None
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


@dataclass(frozen=True)
class Compounded:
    """A volume, and how well the place of what each voxel shows is known."""

    filled: Reconstruction
    sigma: Volume | None  # mm; None where nothing is known of the places
    figures: Metrics


def run(settings: Settings, out: Path, watch: Watch = SILENT) -> None:
    """Read, paste, fill and write.

    Raises
    ------
    InputError
        If the input is incomplete or damaged, has no poses, needs more memory than allowed, or `out` can't be written to.
    """
    plus = None if settings.config is None else plus_config.read_config(settings.config)
    chosen = volume_settings(settings, plus)
    given = (settings.capture, settings.probe, settings.sequence, settings.tracker, settings.config, chosen.weights)
    atomic.check_folder(out, BY, inputs=given)
    sweep, scans = read(settings, plus)
    for line in describe_source(scans, settings):
        watch.say(line)
    clip = chosen.box(scans.shape)
    for line in freehand_scans.cautions(scans if clip is None else freehand_scans.cut(scans, clip)):
        watch.say(f"warning     {line}")
    if (settings.fan == "find" or chosen.fan) and scans.speed_m_s != scans.calibrated_m_s:
        expected = f"none with a fan, whose lines run to all sides, or {scans.calibrated_m_s:g} m/s as calibrated"
        raise InputError(f"freehand: tissue_m_s: expected {expected}, found {scans.speed_m_s:g} m/s")
    if settings.fan == "find":
        fan = fan_region.find(scans.stream(), str(settings.capture or settings.sequence))
        watch.say(f"fan         in what changes from image to image, {fan}")
        chosen = replace(chosen, fan=fan)
    elif plus is not None and settings.fan is None and chosen.fan is not None:
        watch.say(f"fan         of {settings.config}, {chosen.fan}; all of each B-scan by fan=none")

    freehand_scans.check_size(scans, str(settings.capture or settings.sequence), chosen.box(scans.shape), settings.implausible)
    found = compound(scans, chosen, int(settings.most_gib * 2**30), watch)
    for line in (*describe(found.filled, found.figures, chosen, settings), *advice(scans, chosen)):
        watch.say(line)
    with watch.busy("writing"):
        written = write(out, found, sweep, scans, settings.lag)
    watch.say(f"wrote       {out}/{{{','.join(written)}}}")


def compound(
    scans: Scans,
    settings: VolumeSettings | None = None,
    most_bytes: int = volume_compounding.MOST_BYTES,
    watch: Watch = SILENT,
) -> Compounded:
    """Put B-scans into a volume.

    Raises
    ------
    InputError
        As `recon.freehand.scans.volume`.
    """
    chosen, start = settings or VolumeSettings(), perf_counter()
    with watch.busy("putting B-scans into the volume"):
        pasted, filled = freehand_scans.volume(scans, chosen, most_bytes)
        sigma = freehand_scans.sigma_volume(scans, filled.volume, chosen)
    seconds = {"seconds_reconstruct": round(perf_counter() - start, 3)}
    figures = freehand_scans.measure(scans, pasted, filled) | freehand_scans.measure_sigma(sigma)
    return Compounded(filled, sigma, figures | seconds)


def write(out: Path, found: Compounded, sweep: SweepCapture | None, scans: Scans, lag_s: float) -> list[str]:
    """Write all files, whole or not at all; returns their names."""
    with atomic.new_folder(out, BY) as folder:
        volumes.write_volume(folder / VOLUME, found.filled.volume)
        if found.sigma is not None:
            volumes.write_volume(folder / SIGMA, found.sigma)
        if sweep is not None and scans.probe is not None:
            freehand_scans.write_sequence(folder / SEQUENCE, sweep, scans.probe, lag_s)
        metrics.write(folder / metrics.FILE, found.figures)
        return [name for name in (VOLUME, SIGMA, SEQUENCE, metrics.FILE) if (folder / name).exists()]


def volume_settings(settings: Settings, plus: PlusConfig | None) -> VolumeSettings:
    """The given settings of the volume; those of the PLUS configuration where none are given, and the usual ones else."""
    usual = VolumeSettings() if plus is None or plus.volume is None else plus.volume
    chosen = replace(usual, **settings.given)
    if chosen.compounding != "weighted" and settings.weights is None:
        chosen = replace(chosen, weights=None)  # of the configuration, whose compounding isn't taken
    return replace(chosen, fan=None) if settings.fan == "none" else chosen


def read(settings: ScansFields, plus: PlusConfig | None) -> tuple[SweepCapture | None, Scans]:
    """Read the sweep, if it is a capture's, and its B-scans in the world."""
    if settings.capture is None:
        assert settings.sequence is not None
        names = settings.frame_names(FrameNames() if plus is None else plus.names)
        probe = None if settings.probe is None else probe_files.read(settings.probe)
        fixed = {} if plus is None else plus.transforms
        return None, freehand_scans.of_sequence(
            settings.sequence, names, probe, fixed, settings.lag, settings.tissue_m_s, settings.tracker, settings.implausible
        )
    sweep = sweep_part.read_sweep(settings.capture, settings.sweep, "volume", settings.implausible)
    probe = freehand_scans.probe_of(sweep, settings.capture, settings.probe)
    return sweep, freehand_scans.of_sweep(sweep, probe, settings.lag, settings.tissue_m_s, settings.unsure)


def describe_source(scans: Scans, settings: ScansFields) -> Iterator[str]:
    """Lines: what was read, and what is assumed of it."""
    yield f"read        {freehand_scans.summary(scans)}"
    yield f"depth       {freehand_scans.depths(scans)}"
    for line in settings.assumptions(scans.speed_m_s, scans.poses_exact):
        yield f"assumed     {line}"


def advice(scans: Scans, chosen: VolumeSettings) -> Iterator[str]:
    """A line on voxels so fine that gaps between B-scans stay empty; none as a rule."""
    left, right, top, bottom = (chosen.box(scans.shape) or Clip(0, 0, *scans.shape[::-1])).bounds(scans.shape)
    corners = np.array([[u, v] for u in (left, right) for v in (top, bottom)], float)
    needed = hole_filling.spacing_that_fills(scans.world_from_pixel, corners, chosen.hole_voxels)
    if needed > ROOM * np.max(chosen.spacing_mm):
        gap = needed * max(chosen.hole_voxels - 1, 1)
        give = f"give spacing_mm={np.ceil(20 * needed) / 20:.4g}, or a larger hole_voxels"
        yield f"advice      B-scans or pixels are up to {gap:.2g} mm apart, too far for such voxels to be filled; {give}"


def describe(filled: Reconstruction, figures: Metrics, chosen: VolumeSettings, settings: Settings) -> Iterator[str]:
    """Lines: size of the volume, and the part of it that B-scans passed through."""
    size = "x".join(str(figures[f"voxels_{axis}"]) for axis in "xyz")
    spacing = "x".join(f"{step:g}" for step in dict.fromkeys(filled.volume.spacing.tolist()))
    how = f"{chosen.extent}, {chosen.compounding}, {chosen.interpolation}"
    how += "" if settings.config is None else f" by {settings.config}"
    how += f" but for {', '.join(settings.given)}" if settings.config is not None and settings.given else ""
    if chosen.arithmetic != "floating" and chosen.compounding in ("mean", "weighted"):
        how += f", rounded at each pixel as in PLUS, darker by some levels than by arithmetic=floating ({chosen.arithmetic})"
    yield f"paste       {size} voxels of {spacing} mm, {how}: {100 * figures['pasted_fraction']:.1f} % seen"
    level = metrics.shown(figures["mean_level"], ".0f")
    filling = f"{100 * figures['filled_fraction']:.1f} % after filling holes" if chosen.hole_voxels else "holes stay open"
    yield f"fill        {filling}, mean level {level}"
    if "place_sigma_median_mm" in figures:
        median, most = (figures[f"place_sigma_{name}_mm"] for name in ("median", "most"))
        yield f"place       known to {median:.2f} mm in the median, {most:.2f} mm at most, by its own prediction"
