"""The rig authors' data sets: fringe images, B-scans with frames, poses and masks, and the files of all calibrations."""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Literal

import numpy as np
import trimesh
from numpy.typing import NDArray

from recon.capture import calibration_files, manifest, meza2021_sweep, probe_files, surface_part
from recon.capture.layouts import meza2021
from recon.capture.manifest import MANIFEST
from recon.errors import InputError
from recon.files import npz
from recon.freehand import scans as freehand_scans
from recon.probe_calibration import sound_in_water
from recon.segmentation import mass_files
from recon.segmentation.scan_masks import mask_of
from recon.session.skin_step import POINTS
from sonotwin import exported_scans
from sonotwin.export_layouts import Settings

TAKES = (
    *("capture", "calibration", "surface", "sweep", "implausible", "probe", "lag_s", "frames", "apart_s", "tissue_m_s"),
    *("masses", "networks"),
)
ABOUT = "of captures alone; layout=markerpose takes data sets"
NETWORKS: Mapping[Literal["published_detector", "published_segmenter"], str] = {  # as their scripts load them
    "published_detector": "superpoint.pt",
    "published_segmenter": "ellipsegnet.pt",
}


def write(folder: Path, settings: Settings) -> list[str]:
    """Write what the capture holds.

    Raises
    ------
    InputError
        If the capture is incomplete or damaged, or has nothing for the layout.
    """
    held, lines = manifest.read_manifest(settings.source), []
    meza2021.mark(folder)
    if held.surface is not None and "cam1" in held.surface.images:
        lines.append(_write_surface(folder, settings))
    elif settings.surface is not None:
        lines.append(f"left out    the mask by {settings.surface}: the capture has no fringe images of cam1")
    if held.sweep is not None or held.sweeps:
        lines += _write_sweep(folder, settings)
    if (optics := calibration_files.of_capture(settings.source, settings.calibration)) is not None:
        lines.append(f"optics      {', '.join(meza2021.write_parameters(folder, optics))}")
    if settings.networks:
        from trainers import export  # torch takes seconds to import

        lines.append(export.copy_published(settings.networks, folder, NETWORKS))
    if not lines:
        raise InputError(f"{settings.source / MANIFEST}: expected a surface of cam1, a sweep or a calibration, found none")
    if held.sweep is None and not held.sweeps:
        unused = [path for path in (settings.probe, settings.masses) if path is not None]
        lines += [f"left out    {path}: the capture has no sweep" for path in unused]
    return lines


def _write_surface(folder: Path, settings: Settings) -> str:
    """Write the fringe images and the mask; returns a line about them."""
    surface = surface_part.read_surface(settings.source, "cam1", settings.calibration)
    if not meza2021.is_theirs(surface):
        return "left out    surface: expected 8 bits, a centre line and 8 fringes of 12 px, whose shifts are numbered from one"
    mask = np.ones(surface.images.shape[1:], bool)
    if settings.surface is not None:
        path = settings.surface / POINTS
        mask = np.isfinite(npz.read(path, {"points": npz.Form("f", (*mask.shape, 3))})["points"]).all(axis=-1)
        if not mask.any():
            raise InputError(f"{path}: points: expected the point of some pixels, found none: no surface was found there?")
    meza2021.write(folder, surface, mask)
    return f"surface     {len(surface.images)} images, {100 * mask.mean():.1f} % of the pixels in the mask"


def _write_sweep(folder: Path, settings: Settings) -> list[str]:
    """Write the B-scans with their poses, frames and masks, and the probe's file; returns lines about them."""
    selected, about = exported_scans.read(settings, settings.source, "volume")
    sweep, lines = selected.sweep, [f"sweep       {about[0]}", *about[1:]]
    masks: Iterator[NDArray[np.uint8]] = iter(())
    probe = (
        None
        if settings.probe is None and sweep.probe is None
        else freehand_scans.probe_of(sweep, settings.source, settings.probe)
    )
    if probe is not None:
        converted = sound_in_water.for_tissue(probe, settings.tissue_m_s)
        probe_files.write_authors(folder / probe_files.AUTHORS, converted)
        meza2021.mark(folder, converted.speed_m_s)
        lines.append(f"probe       {probe_files.AUTHORS}, right for sound of {converted.speed_m_s:.0f} m/s")
    if settings.masses is not None and probe is not None:
        scans = freehand_scans.of_sweep(sweep, probe, settings.lag_s, settings.tissue_m_s)
        meshes = [mass.mesh for mass in mass_files.read_masses(settings.masses).values()]
        masks = _masks(meshes, scans.world_from_pixel[selected.scans], sweep.size)
    elif settings.masses is not None:
        raise InputError(f"{settings.masses}: expected probe, the calibration by which masses lie in B-scans, found none")
    meza2021_sweep.write_sweep(folder / meza2021_sweep.FOLDER, selected.images(), masks, selected.poses)
    return lines


def _masks(masses: list[trimesh.Trimesh], world_from_pixel: NDArray, size: tuple[int, int]) -> Iterator[NDArray[np.uint8]]:
    """A mask a B-scan, 255 inside a mass."""
    for placed in world_from_pixel:
        yield np.where(mask_of(masses, placed, size), 255, 0).astype(np.uint8)
