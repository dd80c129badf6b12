"""A folder that 3D Slicer shows in place: models, volumes, a transform and markups, all in the frame of camera 1.

World coordinates are written as they are and declared LPS, as in all files of volumes; 3D Slicer turns LPS into its own RAS for
models, volumes, markups and ITK's transforms alike, so what lies together in the world lies together there. Left, posterior and
superior mean nothing here: x is to the right in camera 1's image, y down, z away from it.
"""

import json
import shutil
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
import trimesh

from recon.files import meshes, volumes
from recon.files.volumes import Volume
from recon.fusion import probe_shape
from recon.fusion.fused_scene import STEP_MM, FusedScene, device_layer, evenly, merged, path_layer
from recon.fusion.scene_page import UNKNOWN, row_of
from recon.geometry import rigid
from recon.segmentation.mass_files import FoundMass

MARKUPS, LEFT_OUT, TRANSFORM = "masses.mrk.json", "left_out.mrk.json", "target_to_world.tfm"
SCRIPT, README, SEARCH = "show.py", "README.txt", "search.txt"
NINETY_FIVE = 1.96
TEMPLATES = Path(__file__).parent


def write(folder: Path, scene: FusedScene, voxels: Mapping[str, Path], scans: int) -> None:
    """Write the folder, which must not be there yet.

    voxels : volumes on disk, by the names that they are to have
    scans : number of B-scans that are written
    """
    folder.mkdir()
    for name, mesh in _models(scene):
        meshes.write_ply(folder / f"{name}.ply", mesh)
    for name, path in voxels.items():
        shutil.copyfile(path, folder / f"{name}.nrrd")
    for k in evenly(list(scene.images), scans):
        volumes.write_volume(folder / f"scan{k:04d}.nrrd", _slice_of(scene, k))
    if scene.middle is not None and scene.scans.probe is not None:
        write_transform(folder / TRANSFORM, scene.world_from_target[scene.middle])
        body, rings = probe_shape.of(scene.target, scene.scans.probe, scene.scans.shape[1])
        for name, mesh in (("target_probe", body), ("target_circles", rings)):
            meshes.write_ply(folder / f"{name}.ply", mesh)
    if scene.masses:
        _write(folder / MARKUPS, markups(scene.masses))
    if scene.left_out:
        _write(folder / LEFT_OUT, _points((one.reason, one.text, one.centre_mm) for one in scene.left_out))
    shutil.copyfile(TEMPLATES / f"slicer_{SCRIPT}.txt", folder / SCRIPT)
    told = (TEMPLATES / f"slicer_{README}.txt").read_text(encoding="utf-8")
    (folder / README).write_text(f"{told}\n{scene.search}\n", encoding="utf-8")
    (folder / SEARCH).write_text(f"{scene.search}\n", encoding="utf-8")


def _models(scene: FusedScene) -> Iterator[tuple[str, trimesh.Trimesh]]:
    """Models in the world, by the files' names."""
    if scene.skin is not None:
        yield "skin", scene.skin
    if scene.rest is not None:
        yield "table", merged(scene.rest, STEP_MM)
    for name, mass in (scene.masses or {}).items():
        yield name, mass.mesh
        if (sigma := mass.figures.get("centre_sigma_mm", np.nan)) > 0:
            ball = trimesh.creation.icosphere(radius=NINETY_FIVE * sigma)
            yield f"centre_{name}", ball.apply_translation(mass.mesh.center_mass)
    if scene.seen is not None and scene.seen.unseen is not None:
        yield "unseen", scene.seen.unseen
    if len(scene.path):
        yield "path", path_layer(scene.path)
    yield from ((name, device_layer(camera)) for name, camera in scene.devices.items())


def _slice_of(scene: FusedScene, k: int) -> Volume:
    """B-scan k as a volume of one slice where it was taken."""
    matrix = scene.scans.world_from_pixel[k]
    lengths = np.linalg.norm(matrix[:3, :2], axis=0)
    along = matrix[:3, :2] / lengths
    directions = np.column_stack([along, np.cross(along[:, 0], along[:, 1])])
    slice_mm = 0.5  # thickness of a B-scan as a volume of one slice
    return Volume(scene.images[k][None], matrix[:3, 3], np.append(lengths, slice_mm), directions)


def write_transform(path: Path, world_from_target: np.ndarray) -> None:
    """Write where the target stands, as ITK has it: by the transform that takes points of the world to the target.

    3D Slicer reads such a file as the transform of a node to its parent's frame, by its inverse.
    """
    inverse = rigid.invert(world_from_target)
    numbers = " ".join(_itk_number(value) for value in (*inverse[:3, :3].ravel(), *inverse[:3, 3]))
    header = "#Insight Transform File V1.0\n#Transform 0\nTransform: AffineTransform_double_3_3\n"
    path.write_text(f"{header}Parameters: {numbers}\nFixedParameters: 0 0 0\n", encoding="ascii", newline="\n")


def _itk_number(value: float) -> str:
    """The shortest text that is read back as the same number, in the form that ITK writes."""
    if value == 0:
        return "0"
    if abs(value) < 1e-6:
        return np.format_float_scientific(value, trim="-", exp_digits=1)
    return np.format_float_positional(value, trim="-")


def markups(masses: Mapping[str, FoundMass]) -> dict[str, object]:
    """Control points at the masses' centres, with their figures and uncertainties, as 3D Slicer's markups."""
    places = []
    for name, mass in masses.items():
        centre, volume, depth = row_of(mass)
        told = f"centre {centre} mm; volume {volume} mm3"
        told += f"; {depth} mm below the skin" if depth != UNKNOWN else ""
        places.append((name, told, np.asarray(mass.mesh.center_mass).tolist()))
    return _points(places)


def _points(places: Iterable[tuple[str, str, Sequence[float]]]) -> dict[str, object]:
    """Control points, each with its label, what is told of it and its place, mm, as 3D Slicer's markups."""
    points = [
        {"id": str(number), "label": label, "description": told, "position": list(place), "positionStatus": "defined"}
        for number, (label, told, place) in enumerate(places, 1)
    ]
    one = {"type": "Fiducial", "coordinateSystem": "LPS", "coordinateUnits": "mm", "controlPoints": points}
    schema = "https://raw.githubusercontent.com/slicer/slicer/master/Modules/Loadable/Markups/Resources/Schema/markups-schema-v1.0.3.json#"
    return {"@schema": schema, "markups": [one]}


def _write(path: Path, content: object) -> None:
    path.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
