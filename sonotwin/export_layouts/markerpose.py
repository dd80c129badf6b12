"""MarkerPose's folders: a data set's views and patches for its training, a film's frames for its example, and networks."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Literal

from recon.capture import stereo_frames
from recon.capture.layouts import markerpose
from recon.capture.manifest import CAMERAS
from recon.errors import InputError
from recon.model.calibration import Calibration
from sonotwin.export_layouts import Settings
from trainers import data_sets, markerpose_layout

TAKES = ("capture", "calibration", "sweep", "data", "networks")
ABOUT = "of frames and networks alone"
NETWORKS: Mapping[Literal["published_detector", "published_segmenter"], str] = {  # as their scripts load them
    "published_detector": "py_superpoint.pt",
    "published_segmenter": "py_ellipsegnet.pt",
}


def write(folder: Path, settings: Settings) -> list[str]:
    """Write what is given.

    Raises
    ------
    InputError
        If nothing is given, or a source is damaged or has nothing for the layout.
    """
    if not (settings.data or settings.capture or settings.networks):
        raise InputError("export: data: needs a value with layout=markerpose, or capture or networks does; give data=...")
    for name in ("calibration", "sweep"):
        if getattr(settings, name) and not settings.capture:
            raise InputError(f"export: {name}: expected none without capture, found {getattr(settings, name)}")
    lines = []
    if settings.data:
        views = data_sets.read_views(settings.data)
        lines.append(f"views       {markerpose_layout.write_views(folder, views)} of {len(views)}, those with all circles")
        lines += _write_patches(folder, settings.data)
    if settings.capture:
        film = stereo_frames.read_film(settings.source, settings.calibration, settings.sweep)
        optics = Calibration(dict(zip(CAMERAS, film.cameras, strict=True)))
        count = markerpose.write_film(folder, film.pairs(), film.depths, optics)
        lines.append(f"frames      {count} pairs, {markerpose.PARAMETERS}")
    if settings.networks:
        from trainers import export  # torch takes seconds to import

        lines.append(export.copy_published(settings.networks, folder, NETWORKS))
    return lines


def _write_patches(folder: Path, data: Sequence[Path]) -> list[str]:
    """Write the patches of those data sets that have them; returns lines about them, and about those that have none."""
    sources, lines = data_sets.with_patches(data), []
    if sources:
        patches = data_sets.read_patches(sources)
        lines.append(f"patches     {markerpose_layout.write_patches(folder, patches)} of {len(patches)}, those with a disc")
    without = ", ".join(str(source) for source in data if source not in sources)
    return [*lines, f"left out    patches: {without} has none, which frames=views writes"] if without else lines
