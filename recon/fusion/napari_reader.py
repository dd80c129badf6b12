"""A result in napari: volumes, surfaces and masses with their uncertainty, all in the frame of camera 1.

`napari outputs/result` or File, Open Folder. napari finds this module by `napari.yaml`, an entry point of the package; nothing
here imports napari. Its axes are z, y, x, in mm.
"""

from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray

from recon.files import meshes, volumes
from recon.files.volumes import Volume
from recon.segmentation import left_out, mass_files
from recon.segmentation.mass_files import FoundMass

Layer = tuple[Any, dict[str, Any], str]  # data, what napari is told of it, its kind
Array = NDArray[np.float64]

AXES = np.eye(4)[[2, 1, 0, 3]]  # from x, y, z to z, y, x
VOLUMES = {"volume": "gray", "sigma": "magma", "seen": "green"}  # files of `sonotwin freehand` and `segment`, and their colours
SURFACES = {"surface": "gray", "skin": "bop orange"}
NINETY_FIVE = 1.96
FROM_TOP = 2  # folders below the one that is opened in which results may lie
MARK_MM = 3.0  # size of a mark where something was left out, or a centre is of unknown uncertainty


def find(path: str | list[str]) -> Callable[[str | list[str]], list[Layer]] | None:
    """The reader of a folder with results; None of anything else, as napari asks."""
    if isinstance(path, list):
        return None
    return read if any(_named(Path(path))) else None


def read(path: str | list[str]) -> list[Layer]:
    """Layers of a folder's results.

    Raises
    ------
    InputError
        If a file is damaged.
    """
    assert isinstance(path, str)
    layers, folders = list[Layer](), set[Path]()
    for file in _named(Path(path)):
        if file.suffix == ".nrrd":
            layers.append(volume_layer(file.stem, volumes.read_volume(file)))
        elif file.stem in SURFACES:
            layers.append(surface_layer(file.stem, meshes.read_ply(file, "a surface"), SURFACES[file.stem]))
        else:
            folders.add(file.parent)
    for folder in sorted(folders):
        masses = mass_files.read_masses(folder)
        layers += [surface_layer(name, mass.mesh, "red") for name, mass in masses.items()]
        layers += centres_layers(masses)
        if missing := left_out.read(folder / left_out.FILE):
            places = np.array([one.centre_mm for one in missing])[:, ::-1]
            told = {"reason": [one.reason for one in missing], "text": [one.text for one in missing]}
            looks = {"size": MARK_MM, "face_color": "yellow", "symbol": "cross", "text": "{reason}"}
            layers.append((places, {"name": "left out", "features": told, **looks}, "points"))
    return layers


def _named(folder: Path) -> Iterator[Path]:
    """Files of results in a folder and those below, by their names."""
    if not folder.is_dir():
        return
    for depth in range(FROM_TOP + 1):
        for file in sorted(folder.glob("/".join(["*"] * depth + ["*.*"]))):
            known = SURFACES if file.suffix == ".ply" else VOLUMES if file.suffix == ".nrrd" else ()
            if file.stem in known or file.name == left_out.FILE or (file.suffix == ".ply" and file.stem.startswith("mass")):
                yield file


def volume_layer(name: str, volume: Volume) -> Layer:
    """Voxels in the world."""
    looks = {"colormap": VOLUMES.get(name, "gray"), "blending": "additive", "rendering": "mip", "visible": name == "volume"}
    return volume.voxels, {"name": name, "affine": AXES @ volume.world_from_voxel @ AXES, **looks}, "image"


def surface_layer(name: str, mesh: trimesh.Trimesh, colour: str) -> Layer:
    """Triangles in the world."""
    data = np.asarray(mesh.vertices)[:, ::-1], np.asarray(mesh.faces)[:, ::-1]
    return data, {"name": name, "colormap": colour, "shading": "smooth", "opacity": 0.7}, "surface"


def centres_layers(masses: Mapping[str, FoundMass]) -> Iterator[Layer]:
    """Masses' centres, as balls that hold the true ones with 95 % or more; as crosses where that isn't known.

    A ball's radius is 1.96 times the root of the covariance's trace: 95 % if all errors are along one line, more else. The
    masses' figures are features.
    """
    sigmas = {name: float(mass.figures.get("centre_sigma_mm") or np.nan) for name, mass in masses.items()}
    known = {name: mass for name, mass in masses.items() if sigmas[name] > 0}
    unknown = {name: mass for name, mass in masses.items() if name not in known}
    if known:
        size = [2 * NINETY_FIVE * sigmas[name] for name in known]
        yield _centres(known, "centres, 95 %", {"size": size, "face_color": "cyan", "opacity": 0.6})
    if unknown:
        yield _centres(unknown, "centres, uncertainty unknown", {"size": MARK_MM, "face_color": "magenta", "symbol": "x"})


def _centres(masses: Mapping[str, FoundMass], name: str, looks: dict[str, Any]) -> Layer:
    centres = np.array([mass.mesh.center_mass for mass in masses.values()])[:, ::-1]
    shared = sorted(set.intersection(*(set(mass.figures) for mass in masses.values())))
    told = {"mass": list(masses), **{figure: [mass.figures[figure] for mass in masses.values()] for figure in shared}}
    return centres, {"name": name, "features": told, "text": "{mass}", **looks}, "points"
