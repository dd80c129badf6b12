"""A recording of StereoBaslerUltrasound, the rig authors' acquisition: stills of both cameras and the scanner, one a key press.

`L/left0.bmp`, `R/right0.bmp`, `US/US0.bmp` (the scanner's whole screen) and `UScrop/US0.bmp` (the B-scan in it) belong together.
There are no time stamps. The cameras' file may lie beside them, as in US-Calibration's data sets.
"""

from collections.abc import Callable
from pathlib import Path

from recon.capture import meza2021_sweep
from recon.capture.layouts import STILLS_HZ, Known, meza2021, us_calibration
from recon.capture.manifest import SCANNER
from recon.capture.meza2021_sweep import CROPPED, FOLDERS
from recon.capture.writer import CaptureWriter
from recon.errors import InputError

TAKES = ("camera_hz", "purpose")
CROP = (247, 67, 321, 408)  # u, v, width, height px of the B-scan in their scanner's screen of 800x600


def read_capture(folder: Path, known: Known) -> Callable[[CaptureWriter], list[str]]:
    """Read the recording, with the cropped B-scans where they are there.

    Raises
    ------
    InputError
        If nothing of the layout is there, folders don't fit together, a file is damaged, or frames have boxes drawn into them.
    """
    found = meza2021_sweep.read_sweep(folder, (CROPPED, FOLDERS[SCANNER]))
    if found is None:
        sets = [path.name for path in folder.glob(f"*{us_calibration.SET}*") if path.is_dir()] if folder.is_dir() else []
        way = f": layout=us_calibration reads {', '.join(sorted(sets)[:2])}" if sets else ""
        raise InputError(
            f"{folder}: expected L, R and US or UScrop with images, as StereoBaslerUltrasound saves them, found none{way}"
        )
    us_calibration.check_grey(found)
    optics, about = us_calibration.read_cameras(folder, found.sizes)

    def fill(capture: CaptureWriter) -> list[str]:
        if optics.cameras:
            capture.add_calibration(optics)
        lines = [about, *meza2021.add_sweep(capture, found, known.camera_hz or STILLS_HZ, known.purpose)]
        if found.folders.get(SCANNER) == FOLDERS[SCANNER]:
            lines.append(
                f"uncropped   {FOLDERS[SCANNER]}/ is the scanner's screen; their program crops it to {list(CROP)}: give clip"
            )
        return lines

    return fill
