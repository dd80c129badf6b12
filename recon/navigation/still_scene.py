"""The scene that stands still, from files: skin and masses, as coarse as a live picture needs them; probe and tools as bodies."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import NDArray

from recon.files import meshes
from recon.fusion import fused_scene, probe_shape, skin
from recon.model.probe import ProbeCalibration
from recon.model.rig import Target
from recon.model.tip import Tip
from recon.navigation.publishing import StillScene
from recon.segmentation import containment, mass_files

Array = NDArray[np.float64]

SHAFT_MM, TIP_MM, MOUNT_MM = 0.8, 1.5, 4.0  # radii of a tool that is drawn without a model


def read_scene(
    skin_file: Path | None,
    masses: Path | None,
    target: Target,
    probe: ProbeCalibration,
    width: int,
    part_table: bool = True,
    tools: Mapping[str, Tip | None] | None = None,
    plan: Array | None = None,
) -> StillScene:
    """Read what is known beforehand.

    Parameters
    ----------
    skin_file, masses : a surface as PLY, a folder of `sonotwin segment`
    width : of the B-scans, px
    part_table : leave out the plane that the skin stands on
    tools : tips of further bodies by name; None of one that isn't calibrated
    plan : (2, 3) mm, the planned path's entry and aim

    Raises
    ------
    InputError
        If a file is missing or damaged, or the folder has no masses of `sonotwin segment`.
    """
    tools = tools or {}
    body, rings = probe_shape.of(target, probe, width)
    found = {} if masses is None else mass_files.read_masses(masses)
    return StillScene(
        probe.target_from_image,
        None if skin_file is None else _coarse(skin_file, part_table),
        {name: mass.mesh for name, mass in found.items()},
        body,
        rings,
        tools,
        {name: tool_shape(name, tip) for name, tip in tools.items()},
        plan,
    )


def tool_shape(name: str, tip: Tip | None) -> trimesh.Trimesh:
    """A tool in its target's frame: its model, else a shaft from the target to the tip, else a ball at the target.

    Raises
    ------
    InputError
        If the model is missing or damaged.
    """
    if tip is not None and tip.model is not None:
        return meshes.read_model(tip.model, f"a model of the {name}")
    if tip is None or not tip.tip_mm.any():
        return trimesh.creation.icosphere(2, MOUNT_MM)
    shaft = trimesh.creation.cylinder(SHAFT_MM, segment=[np.zeros(3), tip.tip_mm], sections=16)
    end = trimesh.creation.icosphere(2, TIP_MM).apply_translation(tip.tip_mm)
    drawn = trimesh.util.concatenate([shaft, end])
    assert isinstance(drawn, trimesh.Trimesh)
    return drawn


def _coarse(path: Path, part_table: bool) -> trimesh.Trimesh:
    whole = containment.read_skin(path)
    parted = skin.by_plane(whole).skin if part_table else whole
    step_mm = 2.0  # of the skin's vertices, which are merged to that: 20 000 triangles of a breast
    return outside_out(fused_scene.merged(whole if parted is None else parted, step_mm))


def outside_out(skin: trimesh.Trimesh) -> trimesh.Trimesh:
    """A skin whose triangles have their front outside, towards camera 1; other programs may wind them otherwise.

    A closed skin, whose sides look everywhere alike, is left as it is.
    """
    areas = np.asarray(skin.area_faces)
    away = areas @ np.asarray(skin.face_normals) @ (skin.centroid / np.linalg.norm(skin.centroid))
    least_sided = 0.01  # of a skin's area, by which more of it looks away than towards camera 1, to be turned
    if away <= least_sided * areas.sum():
        return skin
    turned = skin.copy()
    turned.invert()
    return turned
