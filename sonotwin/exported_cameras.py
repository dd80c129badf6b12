"""A calibration of cameras and projector as files of other programs: dialects that are written, in place of a layout."""

from pathlib import Path

from recon import registry
from recon.capture import calibration_files
from recon.errors import InputError
from sonotwin.export_layouts import Settings

TAKES = ("capture", "calibration")
ABOUT = "for the calibration of cameras alone"


def write(folder: Path, settings: Settings) -> list[str]:
    """Write the calibration of a capture, or of a file.

    Raises
    ------
    InputError
        If there is none, or one that the dialect has no place for.
    """
    if settings.capture:
        optics = calibration_files.of_capture(settings.source, settings.calibration)
    else:
        optics = None if settings.calibration is None else calibration_files.read(settings.calibration)
    if optics is None:
        raise InputError(f"export: calibration: expected one of cameras for layout={settings.layout}, found none")
    dialect = registry.kind(calibration_files.DIALECTS, settings.layout)
    names, devices = dialect.write(folder, optics), dialect.taken(optics)
    lost = [name for name in optics.cameras if name not in devices] + ["the covariance"] * (optics.uncertainty is not None)
    return [
        f"optics      {', '.join(devices)}: {', '.join(names)}",
        *([f"left out    {', '.join(lost)}: the layout has no place for it"] if lost else []),
    ]
