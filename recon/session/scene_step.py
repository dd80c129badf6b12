"""All that was found in one picture: the settings of the step, the step, and its files."""

from dataclasses import replace
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, model_validator

from recon.capture import calibration_files, sweep_part
from recon.capture.images import read_grey
from recon.errors import Implausible, InputError
from recon.files import atomic, meshes, metrics
from recon.files.volumes import read_volume
from recon.freehand import scans as freehand_scans
from recon.fusion import fused_scene, scene_page, skin, slicer_folder
from recon.fusion.fused_scene import FusedScene
from recon.fusion.skin import Parted
from recon.model.calibration import Calibration
from recon.model.probe import Speed
from recon.model.rig import Part, Rig
from recon.model.tracks import LagSeconds
from recon.registry import Choice
from recon.segmentation import containment, left_out, mass_files, seen_map
from recon.session import volume_step
from recon.session.watch import SILENT, Watch

BY = "fuse"  # who writes
SCENE, PAGE, SLICER = "scene.glb", "scene.html", "slicer"


class Settings(Part):
    """What is shown, and where it is read."""

    rig: Annotated[Rig, Choice("meza2021")]
    """of it, the target's design, by which the probe is drawn"""
    capture: Path
    """a capture folder with a sweep that has poses, as `sonotwin track` leaves it"""
    sweep: str = ""
    """its name, of a capture that holds several; "" takes the only one for the volume"""
    implausible: Implausible = "refuse"
    """poses that no hand makes: refuse leaves them out, and refuses if they are many; take uses all of them"""
    probe: Path | None = None
    """file: the probe's calibration, in place of the capture's own"""
    lag_s: LagSeconds = 0.0
    """s, delay of the B-scans' time stamps, as of `sonotwin measure-lag`"""
    tissue_m_s: Speed | None = None
    """m/s, of sound in what was scanned; null leaves depths as the probe is calibrated"""
    surface: Path | None = None
    """the skin, as of `sonotwin surface`, a .ply"""
    mask: Path | None = None
    """image, not black where the skin is, in the image of the camera below: in place of what follows"""
    camera: Literal["cam1", "cam2"] = "cam1"
    """whose image the mask is"""
    part_table: bool = True
    """part the skin from the plane that it stands on; false shows all of the surface as skin"""
    masses: Path | None = None
    """folder of `sonotwin segment`"""
    volume: Path | None = None
    """folder of `sonotwin freehand`, for slicer/"""
    calibration: Path | None = None
    """file: cameras and projector, in place of the capture's own"""
    scans: Annotated[int, Field(ge=0, le=1000)] = 12
    """B-scans that are shown where they were taken, evenly through the sweep"""

    @model_validator(mode="after")
    def _mask_of_a_surface(self) -> "Settings":
        if self.mask is not None and self.surface is None:
            raise ValueError("mask: expected with a surface, which it parts, found without")
        return self


def run(settings: Settings, out: Path, watch: Watch = SILENT, search_failed: str = "") -> None:
    """Read what is given, and write the page, the layers and the folder.

    search_failed : why there are no masses, where a search for them failed

    Raises
    ------
    InputError
        If the capture is incomplete or damaged, a given file is missing, or `out` can't be written to.
    """
    given = (settings.probe, settings.surface, settings.masses, settings.calibration, settings.volume, settings.mask)
    atomic.check_folder(out, BY, inputs=(settings.capture, *given))
    voxels = volumes(settings)
    with watch.busy("putting it together"):
        scene = replace(read(settings), search_failed=search_failed)
        made = fused_scene.layers(scene, settings.scans)
    with watch.busy("writing"), atomic.new_folder(out, BY) as folder:
        meshes.write_layers(folder / SCENE, made)
        scene_page.write(folder / PAGE, scene, settings.capture.resolve().name)
        slicer_folder.write(folder / SLICER, scene, voxels, settings.scans)
        counts = {"layers": len(made), "scans_shown": sum(name.startswith("scan") for name in made)}
        masses = np.nan if scene.masses is None else len(scene.masses)
        metrics.write(folder / metrics.FILE, counts | {"masses": masses, "masses_search_failed": int(bool(search_failed))})
    watch.say(f"layers      {', '.join(made)}")
    watch.say(f"search      {scene.search}")
    watch.say(f"wrote       {out}/{{{PAGE},{SCENE},{SLICER},{metrics.FILE}}}")


def read(settings: Settings) -> FusedScene:
    """All that is given, in the world."""
    sweep = sweep_part.read_sweep(settings.capture, settings.sweep, "volume", settings.implausible)
    probe = freehand_scans.probe_of(sweep, settings.capture, settings.probe)
    scans = freehand_scans.of_sweep(sweep, probe, settings.lag_s, settings.tissue_m_s)
    placed = np.isfinite(scans.world_from_pixel).all(axis=(1, 2))
    shown = fused_scene.chosen(placed, max(settings.scans, scene_page.SLIDES))
    optics = calibration_files.of_capture(settings.capture, settings.calibration)
    surface = Parted(None, None) if settings.surface is None else parted(settings, settings.surface, optics)
    missing = () if settings.masses is None else left_out.read(settings.masses / left_out.FILE)
    return FusedScene(
        {k: sweep.image(k) for k in shown},
        scans,
        sweep.poses(settings.lag_s),
        settings.rig.target,
        surface.skin,
        surface.rest,
        None if settings.masses is None else mass_files.read_masses(settings.masses),
        {} if optics is None else optics.cameras,
        left_out=[one for one in missing if one.reason not in left_out.UNLIKELY],
        seen=None if settings.masses is None else seen_map.read(settings.masses),
    )


def parted(settings: Settings, surface: Path, optics: Calibration | None) -> Parted:
    """The surface in skin and table: by the mask, or by the plane that things stand on.

    Raises
    ------
    InputError
        If the surface or the mask is missing or damaged, or the mask is of an unknown camera or of another size.
    """
    whole = containment.read_skin(surface)
    if settings.mask is None:
        return skin.by_plane(whole) if settings.part_table else Parted(whole, None)
    if optics is None or settings.camera not in optics.cameras:
        found = "no calibration" if optics is None else ", ".join(optics.cameras)
        raise InputError(f"{settings.mask}: expected the calibration of {settings.camera}, in whose image it is, found {found}")
    camera = optics.cameras[settings.camera]
    made = skin.by_mask(whole, read_grey(settings.mask, camera.size) > 0, camera)
    if made.skin is None:
        raise InputError(f"{settings.mask}: expected some of the surface in it, found none: is it of another camera?")
    return made


def volumes(settings: Settings) -> dict[str, Path]:
    """Files of voxels, by name; InputError if the folder that is given has none of `sonotwin freehand`."""
    mapped = None if settings.masses is None else settings.masses / seen_map.VOLUME
    of_masses = {} if mapped is None or not mapped.is_file() else {mapped.stem: mapped}
    if settings.volume is None:
        return of_masses
    names = (volume_step.VOLUME, volume_step.SIGMA)
    found = {Path(name).stem: settings.volume / name for name in names if (settings.volume / name).is_file()}
    if Path(volume_step.VOLUME).stem not in found:
        raise InputError(f"{settings.volume}: expected a folder of `sonotwin freehand`, found no {volume_step.VOLUME} in it")
    for path in found.values():
        read_volume(path)  # damaged ones are refused here, not by who opens the result
    return found | of_masses
