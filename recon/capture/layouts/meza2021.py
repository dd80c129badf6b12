"""The layout of the rig authors' public program: `SLdata/images`, `SLdata/mask.png` and the files of pairs of devices.

The images in natural order are the centre line, the eight fringe images and, last, perhaps the fully lit one; others in between
are left out. They may be of any kind that OpenCV reads, in colour too. Pitch 12 projector px, phase shifts 2 pi k / 8 for k = 1
to 8, projector column (width - 1) / 2 at phase zero.
"""

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from recon.capture import calibration_files, meza2021_sweep, probe_files, sweep_tables
from recon.capture.images import Size, image_files, read_grey, write_images
from recon.capture.layouts import Known
from recon.capture.manifest import SCANNER, Device, Purpose
from recon.capture.meza2021_sweep import AuthorsSweep
from recon.capture.surface_part import SurfaceCapture
from recon.capture.writer import CaptureWriter
from recon.errors import InputError, validated
from recon.files import json_text
from recon.geometry import rigid
from recon.geometry.camera import Array, Camera
from recon.model.calibration import Calibration
from recon.model.patterns import CentreLine, Fringes, Patterns, Uniform
from recon.model.probe import ProbeCalibration, Speed
from recon.model.rig import Part
from recon.model.tracks import Track

TAKES = ("camera_hz", "purpose", "projector_size", "speed_m_s")
STEPS = 8
PITCH = 12.0  # projector px
PROJECTOR_SIZE = (1280, 800)  # px; their files don't store it
PARAMETERS = "cam1_proj_params.npz"
STEREO_PARAMETERS = "cam1_cam2_params.npz"
STEREO_XML = "StereoParams.xml"  # the same, as OpenCV FileStorage
MARKER = "sonotwin-export.json"
PAIRS = "pairs.csv"
FILMED_HZ = 30.0  # frames/s; taken where none is given


def patterns(projector_size: Size = PROJECTOR_SIZE, lit: bool = True) -> Patterns:
    """Their sequence, as far as it is decoded: centre line, fringes, and perhaps fully lit."""
    fringes = Fringes(pitch=PITCH, steps=STEPS, first=1)
    parts = (CentreLine(), fringes, Uniform()) if lit else (CentreLine(), fringes)
    return Patterns(projector_size=projector_size, unwrap="centre_line", parts=parts)


def read(folder: Path, projector_size: Size = PROJECTOR_SIZE) -> tuple[SurfaceCapture, NDArray[np.bool_]]:
    """Read their folder, with the calibration of camera and projector.

    Parameters
    ----------
    projector_size : (width, height) px
        Of the projector that their calibration belongs to.

    Returns
    -------
    SurfaceCapture, mask
        The mask (h, w) is true where they reconstruct; everywhere, if there is no `mask.png`.

    Raises
    ------
    InputError
        If images or calibration are missing, too few, or damaged.
    """
    folder = Path(folder)
    images, sequence, mask = read_images(folder, projector_size)
    sizes = {"cam1": images.shape[:0:-1], "projector": projector_size}
    optics = calibration_files.read(folder / PARAMETERS, sizes=sizes)
    return SurfaceCapture(images, sequence, 8, optics, folder.resolve().name), mask


def read_images(folder: Path, projector_size: Size = PROJECTOR_SIZE) -> tuple[NDArray[np.uint8], Patterns, NDArray[np.bool_]]:
    """Read their fringe images : (n, h, w), with their patterns and the mask : (h, w); raises as `read` does."""
    images_dir = folder / "SLdata" / "images"
    paths = image_files(images_dir)
    fringes = patterns(lit=False).count
    if len(paths) < fringes:
        raise InputError(f"{images_dir}: expected at least {fringes} images, found {len(paths)}")
    sequence = patterns(projector_size, lit=len(paths) > fringes)
    paths = paths[:fringes] + paths[fringes:][-1:]
    height, width = read_grey(paths[0]).shape
    size = width, height
    images = np.stack([read_grey(path, size) for path in paths])
    mask = np.ones(images.shape[1:], bool)
    if (folder / "SLdata" / "mask.png").exists():
        mask = read_grey(folder / "SLdata" / "mask.png", size) > 0
    return images, sequence, mask


class _Mark(Part):
    """Content of `MARKER`."""

    layout: Literal["meza2021"] = "meza2021"
    speed_m_s: Speed | None = None


def read_capture(folder: Path, known: Known) -> Callable[[CaptureWriter], list[str]]:
    """Read what is there of SLdata, USdata and the files of calibrations; gives what writes it and returns lines about it.

    Raises
    ------
    InputError
        If nothing of the layout is there, a file is damaged, or parts don't fit together.
    """
    fringes = read_images(folder, known.projector_size) if (folder / "SLdata").is_dir() else None
    sweep = meza2021_sweep.read_sweep(folder / meza2021_sweep.FOLDER)
    if fringes is None and sweep is None:
        raise InputError(f"{folder}: expected SLdata/images or USdata/US, as in the rig authors' data set, found neither")
    optics, about_optics = _cameras(folder, known, None if fringes is None else fringes[0], sweep)
    probe = _read_probe(folder, known)

    def fill(capture: CaptureWriter) -> list[str]:
        lines = list(about_optics)
        if optics.cameras:
            capture.add_calibration(optics)
        if fringes is not None:
            lines.append(_add_surface(capture, *fringes[:2]))
        if sweep is not None:
            lines += add_sweep(capture, sweep, known.camera_hz or FILMED_HZ, known.purpose or "volume")
        if probe is not None:
            calibration, source = probe
            capture.add_probe(calibration)
            speed = f"{calibration.speed_m_s:g} m/s{source}"
            lines.append(f"probe       {probe_files.AUTHORS}, taken as right for sound of {speed}")
        return lines

    return fill


def _cameras(folder: Path, known: Known, fringes: NDArray | None, sweep: AuthorsSweep | None) -> tuple[Calibration, list[str]]:
    """All devices of both pairs in camera 1's frame, and lines about them; camera 1 is that of the pair with the projector."""
    found, lines = {}, []
    sizes = {} if sweep is None else {name: size for name, size in sweep.sizes.items() if name != SCANNER}
    stereo, projector = (folder / name for name in (STEREO_PARAMETERS, PARAMETERS))
    if stereo.exists() and {"cam1", "cam2"} <= sizes.keys():
        found |= calibration_files.read(stereo, sizes).cameras
    if fringes is not None and projector.exists():
        size = {"cam1": fringes.shape[:0:-1], "projector": known.projector_size}
        pair = dict(calibration_files.read(projector, size).cameras)
        first = found.get("cam1")
        if first is not None and not np.allclose(first.matrix, pair["cam1"].matrix, rtol=1e-6):
            apart = np.abs(first.matrix - pair["cam1"].matrix).max()
            lines.append(
                f"optics      camera 1 differs by up to {apart:.2g} px between both pairs, which were calibrated apart; it is "
                f"taken from {PARAMETERS}; to track, give calibration={stereo}"
            )
        found |= pair
    return Calibration(found), [f"optics      {', '.join(found) or 'none'}", *lines]


def _add_surface(capture: CaptureWriter, images: NDArray, patterns: Patterns) -> str:
    """Write the fringe images; returns a line about them."""
    height, width = images.shape[1:]
    devices = {"cam1": Device(size=(width, height)), "projector": Device(size=patterns.projector_size)}
    capture.add_surface({"cam1": images}, patterns, devices)
    return f"surface     {len(images)} images, {width}x{height}; mask.png is left out, as a surface finds its own"


def add_sweep(
    capture: CaptureWriter, sweep: AuthorsSweep, camera_hz: float, purpose: Purpose | None, name: str = "", pairs: str = PAIRS
) -> list[str]:
    """Write B-scans, frames and poses, at even times, and pairs of poses and crossings; returns lines about them."""
    times = np.rint(np.arange(sweep.count) * 1e9 / camera_hz).astype(np.int64)
    devices = {device: Device(size=size) for device, size in sweep.sizes.items()}
    track = None if sweep.poses is None else Track(times, sweep.poses)
    capture.add_sweep(dict.fromkeys(devices, times), _images(sweep), devices, track, name, purpose)
    held, rate = ", ".join(sweep.folders.values()), f"{camera_hz:g} a second"
    lines = [f"{name or 'sweep':11} {sweep.count} frames of {held}, {'with' if track else 'without'} poses, {rate}"]
    if sweep.poses is not None and sweep.crossings is not None:
        rows = ([*pose[:3].ravel().tolist(), *pixel.tolist()] for pose, pixel in zip(sweep.poses, sweep.crossings, strict=True))
        sweep_tables.write_rows(capture.folder / pairs, sweep_tables.PAIRS, rows)
        lines.append(f"pairs       {sweep.count} of a pose and a crossing, {pairs}")
    if sweep.masks:
        lines.append(f"left out    {len(sweep.masks)} masks of B-scans, for which captures have no place")
    return lines


def _read_probe(folder: Path, known: Known) -> tuple[ProbeCalibration, str] | None:
    """The probe's calibration, and where its speed of sound is from, for a console; None without one."""
    path = folder / probe_files.AUTHORS
    if not path.exists():
        return None
    exported = None if known.speed_m_s else speed_of(folder)
    read = probe_files.read(path, known.speed_m_s or exported)
    source = f", as {MARKER} says" if exported else " (speed_m_s)"
    return replace(read, speed_m_s=known.speed_m_s or read.speed_m_s), source


def _images(sweep: AuthorsSweep) -> Iterator[tuple[str, NDArray]]:
    for name, paths in sweep.images.items():
        for path in paths:
            yield name, read_grey(path, sweep.sizes[name])


def mark(folder: Path, speed_m_s: float | None = None) -> None:
    """Write what makes a folder one of ours, with the speed of sound that its `US_params.npz` is right for."""
    (folder / MARKER).write_text(_Mark(speed_m_s=speed_m_s).model_dump_json(exclude_none=True) + "\n", encoding="utf-8")


def speed_of(folder: Path) -> float | None:
    """The speed of sound, m/s, that a folder's `US_params.npz` is right for, if it is one of ours; theirs don't say.

    Raises
    ------
    InputError
        If our file is damaged, or can't be read.
    """
    path = folder / MARKER
    return validated(_Mark, json_text.read(path), path).speed_m_s if path.is_file() else None


def is_theirs(surface: SurfaceCapture) -> bool:
    """Whether a capture is of 8 bits, and of their patterns, with or without the fully lit one."""
    return surface.bits == 8 and surface.patterns in [patterns(surface.patterns.projector_size, lit) for lit in (True, False)]


def write(folder: Path, surface: SurfaceCapture, mask: NDArray[np.bool_]) -> None:
    """Write a surface capture of camera 1 into a folder that is there.

    Raises
    ------
    ValueError
        If the capture is not 8-bit or its patterns are not theirs.
    """
    if not is_theirs(surface):
        raise ValueError("expected an 8-bit capture of the authors' patterns")
    structured_light = folder / "SLdata"
    write_images([structured_light / "images" / f"{i}.png" for i in range(len(surface.images))], surface.images)
    write_images([structured_light / "mask.png"], np.where(mask, 255, 0).astype(np.uint8)[None])
    np.savez(folder / PARAMETERS, **parameters(surface.calibration))


def write_parameters(folder: Path, optics: Calibration) -> list[str]:
    """Write the files of all pairs of camera 1 with another device into a folder that is there; returns their names."""
    written = []
    if "projector" in optics.cameras:
        np.savez(folder / PARAMETERS, **parameters(optics))
        written.append(PARAMETERS)
    if "cam2" in optics.cameras:
        pair = parameters(optics, "cam2")
        np.savez(folder / STEREO_PARAMETERS, **pair)
        storage = cv2.FileStorage(".xml", cv2.FileStorage_WRITE | cv2.FileStorage_MEMORY)
        for name, value in pair.items():
            storage.write(name, np.ascontiguousarray(value))  # a view would lose its strides
        (folder / STEREO_XML).write_text(storage.releaseAndGetString(), encoding="utf-8")
        written += [STEREO_PARAMETERS, STEREO_XML]
    return written


def parameters(optics: Calibration, second: str = "projector") -> dict[str, Array]:
    """Their names for a pair of devices: K1, dist1, K2, dist2, R, t (second from camera 1, mm) and the fundamental matrix F."""
    first, other = optics.cameras["cam1"], optics.cameras[second]
    other_from_first = other.camera_from_world @ rigid.invert(first.camera_from_world)
    rotation, t = other_from_first[:3, :3], other_from_first[:3, 3]
    cross = np.array([[0, -t[2], t[1]], [t[2], 0, -t[0]], [-t[1], t[0], 0]])
    fundamental = np.linalg.inv(other.matrix).T @ cross @ rotation @ np.linalg.inv(first.matrix)
    return {
        "K1": first.matrix,
        "dist1": _distortion(first),
        "K2": other.matrix,
        "dist2": _distortion(other),
        "R": rotation,
        "t": t.reshape(3, 1),
        "F": fundamental / fundamental[2, 2],
    }


def _distortion(camera: Camera) -> Array:
    """Coefficients : (1, 4 or more). OpenCV's files can't hold an empty matrix, so no distortion is four zeros."""
    return camera.distortion.reshape(1, -1) if camera.distortion.size else np.zeros((1, 4))
