"""Put skin, masses, B-scans, the probe's path and the devices into one picture with layers, in the frame that they share.

Reads a capture's sweep with poses, as `sonotwin track` leaves it, with the probe's calibration and the lag; the skin of
`sonotwin surface`; and the masses of `sonotwin segment`, as far as each is given. Writes into `out`: scene.glb (metres,
y up, as glTF has it), with the layers skin, mass0 ..., scan0000 ... (some B-scans where they were taken), path, cam1, cam2 and
projector, for any glTF viewer; and metrics.json. Nothing is registered: all of it is measured in the frame of camera 1. Takes
seconds.

    sonotwin fuse capture=result/poses/scan probe=result/probe/probe.yaml lag_s=0.05 surface=result/surface/surface.ply out=scene
"""

from pathlib import Path
from typing import Annotated

import numpy as np
import trimesh
from pydantic import BaseModel, ConfigDict, Field
from rich.console import Console

from recon.capture import calibration_files, manifest, sweep_part
from recon.capture.manifest import SCANNER
from recon.errors import InputError
from recon.files import atomic, layers, metrics
from recon.freehand import scans as freehand_scans
from recon.model.probe import Speed
from recon.model.tracks import LagSeconds
from recon.segmentation import containment, fused_scene

SCENE = "scene.glb"  # by which the folder of a scene is known


class Config(BaseModel):
    """Fields of `conf/fuse.yaml`."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    capture: Path
    out: Path
    sweep: str = ""
    probe: Path | None = None
    lag_s: LagSeconds = 0.0
    tissue_m_s: Speed | None = None
    surface: Path | None = None
    masses: Path | None = None
    calibration: Path | None = None
    scans: Annotated[int, Field(ge=0, le=1000)] = 12


def run(config: Config) -> None:
    """Read what is given, and write the layers.

    Raises
    ------
    InputError
        If the capture is incomplete or damaged, a given file is missing, or `out` can't be written to.
    """
    console = Console(soft_wrap=True, highlight=False)
    given = (config.probe, config.surface, config.masses, config.calibration)
    atomic.check_folder(config.out, SCENE, inputs=[config.capture, *(path for path in given if path is not None)])
    made = inside(config)
    if config.surface is not None:
        made = {"skin": fused_scene.skin_layer(containment.read_skin(config.surface))} | made
    made |= devices(config)
    with console.status("writing"), atomic.new_folder(config.out, SCENE) as folder:
        layers.write_layers(folder / SCENE, made)
        counts = {"layers": len(made), "scans_shown": sum(name.startswith("scan") for name in made)}
        metrics.write(folder / metrics.FILE, counts | {"masses": sum(name.startswith("mass") for name in made)})
    console.print(f"layers      {', '.join(made)}", markup=False)
    console.print(f"wrote       {config.out}/{{{SCENE},{metrics.FILE}}}", markup=False)


def inside(config: Config) -> dict[str, trimesh.Trimesh]:
    """Layers by ultrasound: masses, some B-scans, the path of the array's face."""
    sweep = sweep_part.read_sweep(config.capture, config.sweep, "volume")
    probe = freehand_scans.probe_of(sweep, config.capture, config.probe)
    scans = freehand_scans.of_sweep(sweep, probe, config.lag_s, config.tissue_m_s)
    placed = np.isfinite(scans.world_from_pixel).all(axis=(1, 2))
    made = {path.stem: fused_scene.mass_layer(trimesh.load_mesh(path, process=False)) for path in masses(config.masses)}
    for k in fused_scene.chosen(placed, config.scans):
        made[f"scan{k:04d}"] = fused_scene.scan_layer(sweep.image(k), scans.world_from_pixel[k])
    if placed.sum() > 1:
        made["path"] = fused_scene.path_layer(fused_scene.faces_middle(scans.world_from_pixel[placed], sweep.size[0]))
    return made


def masses(folder: Path | None) -> list[Path]:
    """Files of masses, the largest first; InputError if the folder that is given has no figures of `sonotwin segment`."""
    if folder is None:
        return []
    if not (folder / metrics.FILE).is_file():
        raise InputError(f"{folder}: expected a folder of `sonotwin segment`, found no {metrics.FILE} in it")
    return sorted(folder.glob("mass*.ply"))


def devices(config: Config) -> dict[str, trimesh.Trimesh]:
    """Cameras and projector, where the capture or a given file has their calibration."""
    held = manifest.read_manifest(config.capture)
    path = config.calibration or (None if held.calibration is None else config.capture / held.calibration)
    if path is None:
        return {}
    sizes = {name: device.size for name, device in held.devices.items() if name != SCANNER}
    cameras = calibration_files.read(path, sizes).cameras
    return {name: fused_scene.device_layer(camera) for name, camera in cameras.items()}
