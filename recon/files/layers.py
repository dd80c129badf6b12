"""GLB files with named layers, each a mesh of one material, which viewers can show and hide; metres, y up."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import NDArray
from PIL import Image
from trimesh.visual.material import PBRMaterial
from trimesh.visual.texture import TextureVisuals

from recon.files import atomic
from recon.files.meshes import GLTF_FROM_WORLD


def write_layers(path: Path, layers: Mapping[str, trimesh.Trimesh]) -> None:
    """Write meshes in mm of the world as the named nodes of one file, turned as `meshes.write_glb` turns them."""
    scene = trimesh.Scene()
    for name, mesh in layers.items():
        turned = mesh.copy()
        turned.apply_transform(GLTF_FROM_WORLD)
        if isinstance(mesh.visual, TextureVisuals) and isinstance(turned.visual, TextureVisuals):
            for key, values in mesh.visual.vertex_attributes.items():  # which a copy leaves out
                turned.visual.vertex_attributes[key] = values
        scene.add_geometry(turned, node_name=name, geom_name=name)
    with atomic.new_file(path) as temporary:
        temporary.write_bytes(trimesh.exchange.gltf.export_glb(scene, include_normals=True))


def painted(mesh: trimesh.Trimesh, colour: tuple[int, int, int, int], greys: NDArray[np.uint8] | None = None) -> trimesh.Trimesh:
    """A mesh of one colour: red, green, blue and opacity, 0 to 255 each; both of its sides are seen.

    greys : (n,)
        Of the vertices, by which the colour is multiplied.
    """
    mode = "OPAQUE" if colour[3] == 255 else "BLEND"
    material = PBRMaterial(baseColorFactor=colour, metallicFactor=0.0, roughnessFactor=0.8, doubleSided=True, alphaMode=mode)
    visual = TextureVisuals(material=material)
    if greys is not None:
        visual.vertex_attributes["color"] = np.column_stack([greys, greys, greys, np.full_like(greys, 255)])
    return trimesh.Trimesh(mesh.vertices, mesh.faces, process=False, visual=visual)


def pictured(corners: NDArray[np.float64], image: NDArray[np.uint8]) -> trimesh.Trimesh:
    """A grey image : (h, w) on a quadrilateral : (4, 3) mm, from its upper left corner on clockwise."""
    uv = np.array([[0, 1], [1, 1], [1, 0], [0, 0]], float)
    material = PBRMaterial(baseColorTexture=Image.fromarray(image), metallicFactor=0.0, roughnessFactor=1.0, doubleSided=True)
    visual = TextureVisuals(uv=uv, material=material)
    return trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3]], process=False, visual=visual)
