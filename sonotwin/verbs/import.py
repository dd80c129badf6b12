"""Read another group's folder into a capture, which all other verbs take.

`layout=meza2021` is that of the rig's authors: SLdata/images, USdata/L, R and US, target_pose.npy, cross_point.npy, and the files
of their calibrations, each as far as it is there. Images of any common kind become grey PNG. Their frames have no time stamps:
frame k of all devices is taken at one moment, `camera_hz` a second. Rotations that are off by up to 2 % are taken as the nearest
ones, and a negative scale as the same map, each with a warning. Writes the capture folder `out`; where poses and crossings of
wires are there, pairs.csv in it, for `calibrate-probe`. A capture that is there already is replaced. Takes seconds.

    sonotwin import folder=dataset out=session/capture
    sonotwin import folder=dataset speed_m_s=1488 purpose=probe out=wires/capture
"""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from rich.console import Console

from recon.capture import calibration_files, meza2021, meza2021_sweep, probe_files, sweep_tables
from recon.capture.images import read_grey
from recon.capture.manifest import SCANNER, Device, Purpose
from recon.capture.meza2021_sweep import AuthorsSweep
from recon.capture.writer import CaptureWriter, new_capture
from recon.errors import InputError
from recon.files import atomic
from recon.model.calibration import Calibration
from recon.model.patterns import Patterns
from recon.model.probe import ProbeCalibration, Speed
from recon.model.rig import Part, Positive
from recon.model.tracks import Track

PAIRS = "pairs.csv"
Pixels = Annotated[int, Field(ge=8, le=20000)]


class Config(Part):
    """Fields of `sonotwin import`."""

    layout: Literal["meza2021"] = "meza2021"
    """meza2021: the rig authors' data sets"""
    folder: Path
    """folder with SLdata/, USdata/ and files of calibrations, as far as they are there"""
    out: Path
    """the capture folder to write"""
    camera_hz: Positive = 30.0
    """frames/s; their frames have no time stamps, and all devices' count as taken at once"""
    purpose: Purpose = "volume"
    """of the sweep: probe, of crossed wires; latency, of a flat bottom; volume"""
    projector_size: tuple[Pixels, Pixels] = meza2021.PROJECTOR_SIZE
    """px; their files don't store it"""
    speed_m_s: Speed | None = None
    """m/s, of sound for which US_params.npz is right; their file doesn't say. Of wires in water of 22 deg C: 1488. null: as a
    file of ours says, or its export, else 1540, with a warning"""


def run(config: Config) -> None:
    """Read what is there, and write the capture.

    Raises
    ------
    InputError
        If nothing of the layout is there, a file is damaged, parts don't fit together, or `out` can't be written to.
    """
    console = Console(soft_wrap=True, highlight=False)
    atomic.check_folder(config.out, "import", inputs=[config.folder])
    fringes = meza2021.read_images(config.folder, config.projector_size) if (config.folder / "SLdata").is_dir() else None
    sweep = meza2021_sweep.read_sweep(config.folder)
    if fringes is None and sweep is None:
        raise InputError(f"{config.folder}: expected SLdata/images or USdata/US, as in the rig authors' data set, found neither")
    images = None if fringes is None else fringes[0]
    optics, lines = cameras(config, images, sweep)
    probe = read_probe(config)
    with console.status("writing"), new_capture(config.out, config.folder.resolve().name, by="import") as capture:
        if optics.cameras:
            capture.add_calibration(optics)
        if fringes is not None:
            lines.append(add_surface(capture, *fringes[:2]))
        if sweep is not None:
            lines += add_sweep(capture, sweep, config)
        if probe is not None:
            calibration, known = probe
            capture.add_probe(calibration)
            speed = f"{calibration.speed_m_s:g} m/s{known}"
            lines.append(f"probe       {probe_files.AUTHORS}, taken as right for sound of {speed}")
    for line in lines:
        console.print(line, markup=False)
    console.print(f"wrote       {config.out}", markup=False)


def cameras(config: Config, fringes: NDArray | None, sweep: AuthorsSweep | None) -> tuple[Calibration, list[str]]:
    """All devices of both pairs in camera 1's frame, and lines about them; camera 1 is that of the pair with the projector."""
    found, lines = {}, []
    sizes = {} if sweep is None else {name: size for name, size in sweep.sizes.items() if name != SCANNER}
    stereo, projector = (config.folder / name for name in (meza2021.STEREO_PARAMETERS, meza2021.PARAMETERS))
    if stereo.exists() and {"cam1", "cam2"} <= sizes.keys():
        found |= calibration_files.read(stereo, sizes).cameras
    if fringes is not None and projector.exists():
        size = {"cam1": fringes.shape[:0:-1], "projector": config.projector_size}
        pair = dict(calibration_files.read(projector, size).cameras)
        first = found.get("cam1")
        if first is not None and not np.allclose(first.matrix, pair["cam1"].matrix, rtol=1e-6):
            apart = np.abs(first.matrix - pair["cam1"].matrix).max()
            lines.append(
                f"optics      camera 1 differs by up to {apart:.2g} px between both pairs, which were calibrated apart; it is "
                f"taken from {meza2021.PARAMETERS}; to track, give calibration={stereo}"
            )
        found |= pair
    return Calibration(found), [f"optics      {', '.join(found) or 'none'}", *lines]


def add_surface(capture: CaptureWriter, images: NDArray, patterns: Patterns) -> str:
    """Write the fringe images; returns a line about them."""
    height, width = images.shape[1:]
    devices = {"cam1": Device(size=(width, height)), "projector": Device(size=patterns.projector_size)}
    capture.add_surface({"cam1": images}, patterns, devices)
    return f"surface     {len(images)} images, {width}x{height}; mask.png is left out, as a surface finds its own"


def add_sweep(capture: CaptureWriter, sweep: AuthorsSweep, config: Config) -> list[str]:
    """Write B-scans, frames and poses, at even times, and pairs of poses and crossings; returns lines about them."""
    times = np.rint(np.arange(sweep.count) * 1e9 / config.camera_hz).astype(np.int64)
    devices = {name: Device(size=size) for name, size in sweep.sizes.items()}
    track = None if sweep.poses is None else Track(times, sweep.poses)
    capture.add_sweep(dict.fromkeys(devices, times), _images(sweep), devices, track, purpose=config.purpose)
    held = ", ".join(meza2021_sweep.FOLDERS[name] for name in devices)
    lines = [f"sweep       {sweep.count} frames of {held}, {'with' if track else 'without'} poses, {config.camera_hz:g} a second"]
    if sweep.poses is not None and sweep.crossings is not None:
        rows = ([*pose[:3].ravel().tolist(), *pixel.tolist()] for pose, pixel in zip(sweep.poses, sweep.crossings, strict=True))
        sweep_tables.write_rows(capture.folder / PAIRS, sweep_tables.PAIRS, rows)
        lines.append(f"pairs       {sweep.count} of a pose and a crossing, {PAIRS}")
    if sweep.masks:
        lines.append(f"left out    {len(sweep.masks)} masks of B-scans, for which captures have no place")
    return lines


def read_probe(config: Config) -> tuple[ProbeCalibration, str] | None:
    """The probe's calibration, and where its speed of sound is from, for a console; None without one."""
    path = config.folder / probe_files.AUTHORS
    if not path.exists():
        return None
    exported = None if config.speed_m_s else meza2021.speed_of(config.folder)
    read = probe_files.read(path, config.speed_m_s or exported)
    known = f", as {meza2021.MARKER} says" if exported else " (speed_m_s)"
    return replace(read, speed_m_s=config.speed_m_s or read.speed_m_s), known


def _images(sweep: AuthorsSweep) -> Iterator[tuple[str, NDArray]]:
    for name, paths in sweep.images.items():
        for path in paths:
            yield name, read_grey(path, sweep.sizes[name])
