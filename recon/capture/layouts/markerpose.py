"""The data set of MarkerPose's example: stills of the target, `images/L` and `images/R`, beside `StereoParams.xml`."""

from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np

from recon.capture import calibration_files, meza2021_sweep
from recon.capture.images import Images, write_images
from recon.capture.layouts import STILLS_HZ, Known, meza2021
from recon.capture.manifest import CAMERAS
from recon.capture.meza2021_sweep import FOLDERS
from recon.capture.writer import CaptureWriter
from recon.errors import InputError
from recon.model.calibration import Calibration

TAKES = ("camera_hz", "purpose")
IMAGES, PARAMETERS = "images", meza2021.STEREO_XML


def read_capture(folder: Path, known: Known) -> Callable[[CaptureWriter], list[str]]:
    """Read frames and cameras, for `sonotwin track`.

    Raises
    ------
    InputError
        If a camera has no frames, or a file is missing or damaged or doesn't fit the others.
    """
    place = folder / IMAGES
    found = meza2021_sweep.read_sweep(place, ())
    if found is None or set(CAMERAS) != found.images.keys():
        there = "none" if found is None else f"{', '.join(found.folders.values())} alone"
        way = "; its training data are read by train data=FOLDER" if (folder / "data_centers.csv").exists() else ""
        raise InputError(f"{place}: expected L and R with images, as of MarkerPose, found {there}{way}")
    optics = calibration_files.read(folder / PARAMETERS, found.sizes)

    def fill(capture: CaptureWriter) -> list[str]:
        capture.add_calibration(optics)
        about = f"optics      {', '.join(optics.cameras)}, {PARAMETERS}"
        return [about, *meza2021.add_sweep(capture, found, known.camera_hz or STILLS_HZ, known.purpose)]

    return fill


def write_film(folder: Path, frames: Iterable[tuple[Images, Images]], bits: tuple[int, int], optics: Calibration) -> int:
    """Write pairs of frames : (h, w) of some bits, taken one by one, as 8 bits, and the cameras; returns the number of pairs."""
    count = 0
    for count, pair in enumerate(frames, 1):
        for device, image, depth in zip(CAMERAS, pair, bits, strict=True):
            file = folder / IMAGES / FOLDERS[device] / f"{count - 1}.png"
            write_images([file], (image >> (depth - 8)).astype(np.uint8)[None])
    meza2021.write_parameters(folder, optics)
    return count
