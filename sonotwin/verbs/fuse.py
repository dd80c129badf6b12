"""Put skin, masses, B-scans, the probe's path and the devices into one picture, in the frame that they share.

Reads a capture's sweep with poses, as `sonotwin track` leaves it, with the probe's calibration and the lag; the skin of
`sonotwin surface`; the masses of `sonotwin segment`, and the volume of `sonotwin freehand`, as far as each is given. The skin is
parted from the table by a mask, or by the plane that it stands on. Writes into `out`: scene.html, a page with all in a view that
one can turn, and a slider along the sweep; scene.glb (metres, y up, as glTF has it) with the layers skin, table, mass0 ...,
scan0000 ... (some B-scans where they were taken), path, probe, circles, cam1, cam2 and projector, for any glTF viewer; slicer/, a
folder for 3D Slicer; and metrics.json. Nothing is registered: all of it is measured in the frame of camera 1. Takes some seconds.

    sonotwin fuse capture=result/poses/scan probe=result/probe/probe.yaml lag_s=0.05 surface=result/surface/surface.ply out=scene
    sonotwin fuse capture=result/poses/scan masses=result/masses/scan volume=result/volume/scan lag_s=0.05 out=scene
"""

from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, model_validator
from rich.console import Console

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
from recon.segmentation import containment, mass_files
from sonotwin.config import Choice
from sonotwin.verbs import freehand

SCENE, PAGE, SLICER = "scene.glb", "scene.html", "slicer"


class Config(Part):
    """Fields of `sonotwin fuse`."""

    rig: Annotated[Rig, Choice("meza2021")]
    """of it, the target's design, by which the probe is drawn"""
    capture: Path
    """a capture folder with a sweep that has poses, as `sonotwin track` leaves it"""
    out: Path
    """folder; gets scene.html, scene.glb, slicer/, metrics.json"""
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
    def _mask_of_a_surface(self) -> "Config":
        if self.mask is not None and self.surface is None:
            raise ValueError("mask: expected with a surface, which it parts, found without")
        return self


def run(config: Config) -> None:
    """Read what is given, and write the page, the layers and the folder.

    Raises
    ------
    InputError
        If the capture is incomplete or damaged, a given file is missing, or `out` can't be written to.
    """
    console = Console(soft_wrap=True, highlight=False)
    given = (config.probe, config.surface, config.masses, config.calibration, config.volume, config.mask)
    atomic.check_folder(config.out, "fuse", inputs=[config.capture, *(path for path in given if path is not None)])
    voxels = volumes(config)
    with console.status("putting it together"):
        scene = read(config)
        made = fused_scene.layers(scene, config.scans)
    with console.status("writing"), atomic.new_folder(config.out, "fuse") as folder:
        meshes.write_layers(folder / SCENE, made)
        scene_page.write(folder / PAGE, scene, config.capture.resolve().name)
        slicer_folder.write(folder / SLICER, scene, voxels, config.scans)
        counts = {"layers": len(made), "scans_shown": sum(name.startswith("scan") for name in made), "masses": len(scene.masses)}
        metrics.write(folder / metrics.FILE, counts)
    console.print(f"layers      {', '.join(made)}", markup=False)
    console.print(f"wrote       {config.out}/{{{PAGE},{SCENE},{SLICER},{metrics.FILE}}}", markup=False)


def read(config: Config) -> FusedScene:
    """All that is given, in the world."""
    sweep = sweep_part.read_sweep(config.capture, config.sweep, "volume", config.implausible)
    probe = freehand_scans.probe_of(sweep, config.capture, config.probe)
    scans = freehand_scans.of_sweep(sweep, probe, config.lag_s, config.tissue_m_s)
    placed = np.isfinite(scans.world_from_pixel).all(axis=(1, 2))
    shown = fused_scene.chosen(placed, max(config.scans, scene_page.SLIDES))
    optics = calibration_files.of_capture(config.capture, config.calibration)
    surface = Parted(None, None) if config.surface is None else parted(config, config.surface, optics)
    return FusedScene(
        {k: sweep.image(k) for k in shown},
        scans,
        sweep.poses(config.lag_s),
        config.rig.target,
        surface.skin,
        surface.rest,
        {} if config.masses is None else mass_files.read_masses(config.masses),
        {} if optics is None else optics.cameras,
    )


def parted(config: Config, surface: Path, optics: Calibration | None) -> Parted:
    """The surface in skin and table: by the mask, or by the plane that things stand on.

    Raises
    ------
    InputError
        If the surface or the mask is missing or damaged, or the mask is of an unknown camera or of another size.
    """
    whole = containment.read_skin(surface)
    if config.mask is None:
        return skin.by_plane(whole) if config.part_table else Parted(whole, None)
    if optics is None or config.camera not in optics.cameras:
        found = "no calibration" if optics is None else ", ".join(optics.cameras)
        raise InputError(f"{config.mask}: expected the calibration of {config.camera}, in whose image it is, found {found}")
    camera = optics.cameras[config.camera]
    made = skin.by_mask(whole, read_grey(config.mask, camera.size) > 0, camera)
    if made.skin is None:
        raise InputError(f"{config.mask}: expected some of the surface in it, found none: is it of another camera?")
    return made


def volumes(config: Config) -> dict[str, Path]:
    """Files of voxels, by name; InputError if the folder that is given has none of `sonotwin freehand`."""
    if config.volume is None:
        return {}
    names = (freehand.VOLUME, freehand.SIGMA)
    found = {Path(name).stem: config.volume / name for name in names if (config.volume / name).is_file()}
    if Path(freehand.VOLUME).stem not in found:
        raise InputError(f"{config.volume}: expected a folder of `sonotwin freehand`, found no {freehand.VOLUME} in it")
    for path in found.values():
        read_volume(path)  # damaged ones are refused here, not by who opens the result
    return found
