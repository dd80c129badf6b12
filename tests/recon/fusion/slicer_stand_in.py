"""What 3D Slicer does with each kind of file, in few lines: where a point of the file comes to lie in its own frame, RAS.

Meshes and sequences after the sources of Slicer (vtkMRMLModelStorageNode) and of its extension SlicerIGSIO
(qSlicerSequenceIOReader, vtkSlicerIGSIOCommon, igsioTransformName); volumes, markups and ITK's transforms after their
documentation; with the formats' own readers below.
"""

import json
import re
from dataclasses import dataclass
from pathlib import Path

import nrrd
import numpy as np
import SimpleITK as sitk
import trimesh
from numpy.typing import NDArray

Array = NDArray[np.float64]

TURNED = np.diag([-1.0, -1.0, 1.0, 1.0])  # LPS, in which ITK gives places, to RAS


def of_volume(path: Path) -> Array:
    """RAS from voxels (i, j, k) : (4, 4). ITK reads either format to LPS, whatever it is declared in."""
    image = sitk.ReadImage(str(path))
    matrix = np.eye(4)
    matrix[:3, :3] = np.reshape(image.GetDirection(), (3, 3)) * image.GetSpacing()
    matrix[:3, 3] = image.GetOrigin()
    return TURNED @ matrix


def of_mesh(path: Path) -> Array:
    """Vertices : (n, 3) in RAS. A mesh is in LPS unless a comment in its head says SPACE=RAS."""
    head = path.read_bytes().partition(b"end_header")[0]
    turned = np.eye(4) if b"SPACE=RAS" in head else TURNED
    return np.asarray(trimesh.load_mesh(path, process=False).vertices) @ turned[:3, :3].T


def of_markups(path: Path) -> dict[str, Array]:
    """Control points in RAS by their labels, of a frame that the file names."""
    (one,) = json.loads(path.read_text(encoding="utf-8"))["markups"]
    turned = {"LPS": TURNED, "RAS": np.eye(4)}[one["coordinateSystem"]]
    return {point["label"]: turned[:3, :3] @ point["position"] for point in one["controlPoints"]}


def of_transform(path: Path) -> Array:
    """A node's transform to RAS : (4, 4): ITK's points the other way, in LPS."""
    read = sitk.AffineTransform(sitk.ReadTransform(str(path)).GetInverse())
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = np.reshape(read.GetMatrix(), (3, 3)), read.GetTranslation()
    return TURNED @ matrix @ TURNED


@dataclass(frozen=True)
class ShownSequence:
    """Nodes of a sequence: none is under another, so each is in RAS, until a person puts it under one."""

    transforms: dict[str, dict[int, Array]]  # by name and frame, (4, 4), to the node's parent
    images: dict[int, Array]  # by frame, (4, 4) from pixels to RAS


def of_sequence(path: Path) -> ShownSequence:
    """Nodes of a sequence by SlicerIGSIO. A field `TrackName` of the file goes before its name up to the first point."""
    if path.suffix == ".mha":
        image = sitk.ReadImage(str(path))
        fields = {name: image.GetMetaData(name) for name in image.GetMetaDataKeys()}
        count = image.GetSize()[2]
    else:
        pixels, header = nrrd.read(str(path), index_order="C")
        fields, count = {name: str(value) for name, value in header.items()}, len(pixels)
    track = fields.get("TrackName", path.name.partition(".")[0])
    place = re.sub("^.", lambda first: first[0].upper(), track) + "ToPhysical"
    transforms: dict[str, dict[int, Array]] = {}
    for name, text in fields.items():
        if match := re.fullmatch(r"Seq_Frame(\d+)_(\w+)Transform", name):
            transforms.setdefault(match[2], {})[int(match[1])] = np.array(text.split(), float).reshape(4, 4)
    places = transforms.pop(place, {})
    return ShownSequence(transforms, {k: places.get(k, np.eye(4)) for k in range(count)})
