"""The data sets of US-Calibration, the rig authors' program for the probe: a folder a set, whose name holds `data`.

Each has `L`, `R` and `UScrop` (or `US`), stills of crossed wires, with `target_pose.npy` and `cross_point.npy` once their scripts
have made them. Beside the sets lie the cameras' file, `cam1_cam2.npz` or MATLAB's `Params.mat`, and the result, `USparams.npz`.
The scripts read `config.yaml` in their own folder, which names all these.
"""

import os
import re
from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from recon.capture import calibration_files, manifest, meza2021_sweep, probe_files
from recon.capture.image_formats import decode_image
from recon.capture.images import Size, natural_key
from recon.capture.layouts import STILLS_HZ, Known, meza2021
from recon.capture.manifest import SCANNER
from recon.capture.meza2021_sweep import AuthorsSweep
from recon.capture.writer import CaptureWriter
from recon.errors import InputError
from recon.files.regular import read_bytes
from recon.model.calibration import Calibration

Array = NDArray[np.float64]

TAKES = ("camera_hz", "purpose", "speed_m_s")
SET = "data"  # in the name of each set
CAMERAS = ("cam1_cam2.npz", "cam1_cam2_params.npz", "Params.mat", "StereoParams.xml")  # the first that is there; ours the first
RESULT = "USparams.npz"
CONFIG = "config.yaml"
NAMES = {"cam1": "L/left{}.png", "cam2": "R/right{}.png", SCANNER: "UScrop/US{}.png"}  # as their acquisition has them


def read_capture(folder: Path, known: Known) -> Callable[[CaptureWriter], list[str]]:
    """Read all sets, each a sweep for the probe's calibration, named as its folder in small letters.

    Raises
    ------
    InputError
        If there is no set, a file is damaged or doesn't fit the others, or frames have boxes drawn into them.
    """
    sets = read_sets(folder)
    sizes = sizes_of(sets)
    optics, about = read_cameras(folder, sizes)
    result = folder / RESULT
    probe = probe_files.read(result, known.speed_m_s) if os.path.lexists(result) else None

    def fill(capture: CaptureWriter) -> list[str]:
        if optics.cameras:
            capture.add_calibration(optics)
        lines = [about]
        for name, found in sets.items():
            pairs = f"pairs_{name}.csv"
            purpose = known.purpose or "probe"
            lines += meza2021.add_sweep(capture, found, known.camera_hz or STILLS_HZ, purpose, name, pairs)
        if probe is not None:
            capture.add_probe(probe)
            lines.append(f"probe       {RESULT}, taken as right for sound of {probe.speed_m_s:g} m/s")
        return lines

    return fill


def read_sets(folder: Path) -> dict[str, AuthorsSweep]:
    """Read the sets : name of the sweep -> frames, in natural order; raises as `read_capture` does, and if two have one name."""
    sets: dict[str, AuthorsSweep] = {}
    places = sorted((path for path in folder.iterdir() if path.is_dir()), key=natural_key) if folder.is_dir() else []
    for place in places:
        found = meza2021_sweep.read_sweep(place, (meza2021_sweep.CROPPED, "US")) if SET in place.name else None
        if found is None:
            continue
        if SCANNER not in found.images:
            raise InputError(f"{place}: expected B-scans in {meza2021_sweep.CROPPED}/ or US/, found none")
        check_grey(found)
        name = re.sub(r"[^a-z0-9_-]", "-", place.name.lower()).lstrip("0123456789_-")[:64]
        if name in sets:
            raise InputError(f"{place}: expected a name that differs from the others' in small letters, found {name} again")
        sets[name] = found
    if not sets:
        alone = meza2021_sweep.read_sweep(folder, (meza2021_sweep.CROPPED, "US"))
        found = (
            "none" if alone is None else f"{', '.join(alone.folders.values())} in it: layout=stereo_basler reads one recording"
        )
        raise InputError(
            f"{folder}: expected folders {SET}1, {SET}2, ... with L, R and UScrop, as of US-Calibration, found {found}"
        )
    return sets


def check_grey(frames: AuthorsSweep) -> None:
    """Refuse frames with their acquisition's green boxes, over the very rims; grey stored as colour is none."""
    for path in (path for device in manifest.CAMERAS for path in frames.images.get(device, ())):
        image = decode_image(path, read_bytes(path))
        if image.ndim == 3 and (image[..., 0] != image[..., 1]).any() and path.suffix.lower() not in (".jpg", ".jpeg"):
            raise InputError(
                f"{path}: expected grey, found colour: boxes of the live detection (key t)? Leave its images out of all folders"
            )


def sizes_of(sets: dict[str, AuthorsSweep]) -> dict[str, Size]:
    """Sizes of the devices' images, px; InputError if they differ between sets."""
    sizes: dict[str, Size] = {}
    for found in sets.values():
        for device, size in found.sizes.items():
            if sizes.setdefault(device, size) != size:
                expected = "x".join(map(str, sizes[device]))
                place = found.images[device][0].parent
                raise InputError(
                    f"{place}: expected images of {expected} px, as in {next(iter(sets))}, found {size[0]}x{size[1]}"
                )
    return sizes


def read_cameras(folder: Path, sizes: dict[str, Size]) -> tuple[Calibration, str]:
    """Cameras as of the first of `CAMERAS` that is there, and a line about them; none without frames of both."""
    path = next((path for name in CAMERAS if os.path.lexists(path := folder / name)), None)
    if path is None or not {"cam1", "cam2"} <= sizes.keys():
        return Calibration({}), f"optics      none: no {' or '.join(CAMERAS)} there"
    optics = calibration_files.read(path, {device: size for device, size in sizes.items() if device != SCANNER})
    return optics, f"optics      {', '.join(optics.cameras)}, {path.name}"


def write_set(
    folder: Path, number: int, images: Iterable[tuple[str, int, NDArray[np.uint8]]], poses: Array, crossings: Array | None
) -> str:
    """Write a set from 1 on; returns its name.

    Parameters
    ----------
    images : of (device, number of the frame, (h, w))
    poses : (n, 4, 4) mm
    crossings : (n, 2) px; None where they are still to be found
    """
    name = f"{SET}{number}"
    meza2021_sweep.write_sweep(folder / name, images, (), poses, crossings, NAMES)
    return name


def write_settings(folder: Path, size: Size, optics: Calibration | None) -> list[str]:
    """Write `config.yaml`, for B-scans of a size, to be copied to their scripts, and the cameras' file; returns the names."""
    lines = {
        "root_path": "dataset  # this folder, from where the scripts are run",
        "right_folder": "R",
        "left_folder": "L",
        "us_folder": meza2021_sweep.CROPPED,
        "params_file": CAMERAS[0],
        "w": size[0],
        "h": size[1],
    }
    (folder / CONFIG).write_text("".join(f"{name}: {value}\n" for name, value in lines.items()), encoding="utf-8")
    if optics is None or "cam2" not in optics.cameras:
        return [CONFIG]
    np.savez(folder / CAMERAS[0], **meza2021.parameters(optics, "cam2"))
    return [CONFIG, CAMERAS[0]]
