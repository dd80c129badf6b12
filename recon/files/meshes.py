"""Mesh files: binary PLY in mm with normals and per-vertex sigma, and GLB in metres for viewers, of a mesh or of named layers."""

import io
import struct
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import NDArray
from PIL import Image
from trimesh.visual import ColorVisuals
from trimesh.visual.material import PBRMaterial
from trimesh.visual.texture import TextureVisuals

from recon.errors import InputError, reason, short
from recon.files import atomic
from recon.files.regular import read_bytes

LUMA = np.array([0.299, 0.587, 0.114])  # BT.601
DAMAGE = (  # what trimesh raises on files damaged at random
    *(ValueError, LookupError, TypeError, AttributeError, OverflowError, MemoryError, EOFError, RuntimeError),
    *(NotImplementedError, AssertionError, ZeroDivisionError, NameError, struct.error),
)
# glTF is in metres with y up and the front towards +z; a camera's frame is in mm with y down and z away from it
GLTF_FROM_WORLD = np.diag([0.001, -0.001, -0.001, 1.0])


def greys_of(mesh: trimesh.Trimesh) -> NDArray[np.uint8] | None:
    """Grey levels : (n,) of the vertices; None where they have none."""
    visual = mesh.visual
    if not (isinstance(visual, ColorVisuals) and visual.kind == "vertex"):
        return None
    return np.uint8(np.rint(np.asarray(visual.vertex_colors)[:, :3] @ LUMA))


def set_greys(mesh: trimesh.Trimesh, greys: NDArray[np.uint8]) -> None:
    """Give the vertices grey levels : (n,)."""
    mesh.visual = ColorVisuals(mesh, vertex_colors=np.column_stack([greys, greys, greys, np.full_like(greys, 255)]))


def join(parts: Sequence[trimesh.Trimesh]) -> trimesh.Trimesh:
    """One mesh of several, with their normals, and the vertex attributes and grey levels that all of them have."""
    if len(parts) == 1:
        return parts[0]
    names = ("vertices", "faces", "vertex_normals")
    # plain arrays, since each use of trimesh's own makes it hash them anew
    places, faces, normals = ([np.asarray(getattr(part, name)) for part in parts] for name in names)
    starts = np.cumsum([0, *map(len, places)])
    faces = np.concatenate([corners + start for corners, start in zip(faces, starts, strict=False)])
    whole = trimesh.Trimesh(np.concatenate(places), faces, vertex_normals=np.concatenate(normals), process=False, validate=False)
    for name in [name for name in parts[0].vertex_attributes if all(name in part.vertex_attributes for part in parts)]:
        whole.vertex_attributes[name] = np.concatenate([part.vertex_attributes[name] for part in parts])
    greys = [greys_of(part) for part in parts]
    if len(shown := [grey for grey in greys if grey is not None]) == len(parts):
        set_greys(whole, np.concatenate(shown))
    return whole


def read_ply(path: Path, expected: str) -> trimesh.Trimesh:
    """Read triangles from PLY, as `write_ply` leaves them; every number a vertex beside place and normal is a vertex attribute.

    Vertices keep the file's order and number, those of no triangle included.

    expected : what the file is to be, for messages

    Raises
    ------
    InputError
        If the file is missing or damaged, of another kind, holds no triangles, or lacks a number for some vertices.
    """
    if path.suffix.lower() != ".ply":
        raise InputError(f"{path}: expected {expected} as PLY, found {path.suffix or 'no suffix'}")
    data = read_bytes(path, expected=f"{expected} as PLY")
    try:
        with warnings.catch_warnings(), np.errstate(all="ignore"):
            warnings.simplefilter("ignore")
            mesh = trimesh.load(io.BytesIO(data), file_type="ply", process=False, fix_texture=False, skip_materials=True)
    except DAMAGE as error:
        raise InputError(f"{path}: expected {expected} as PLY, found a damaged one: {reason(error)}") from None
    if not isinstance(mesh, trimesh.Trimesh) or not len(mesh.faces):
        raise InputError(f"{path}: expected {expected} of triangles, found none in it")
    _check_places(path, expected, mesh)
    stored = mesh.metadata["_ply_raw"]["vertex"]  # trimesh's own name, without a default: attributes would be lost in silence
    # of a vertex, for which meshes have their own places
    placed = ("x", "y", "z", "nx", "ny", "nz", "red", "green", "blue", "alpha")
    for name, kind in stored["properties"].items():
        if name in placed or "," in kind:  # a list
            continue
        try:  # fields of an array where the file is binary, a map of columns where it is text, short ones if rows are
            values = np.asarray(stored["data"][name], float).ravel()
        except (LookupError, TypeError, ValueError):
            values = np.empty(0)
        if len(values) != len(mesh.vertices):
            found = f"{len(values)} of {len(mesh.vertices)}: damaged?"
            raise InputError(f"{path}: expected {expected} with {short(name)} of each vertex, found {found}")
        mesh.vertex_attributes[name] = values
    return mesh


def read_model(path: Path, expected: str) -> trimesh.Trimesh:
    """Read triangles from STL, GLB or PLY as they stand in the file, in its unit and axes; parts of one become one mesh.

    expected : what the file is to be, for messages

    Raises
    ------
    InputError
        If the file is missing or damaged, of another kind, or holds no triangles.
    """
    kind = path.suffix.lower().removeprefix(".")
    if kind == "ply":
        return read_ply(path, expected)
    if kind not in ("stl", "glb"):
        raise InputError(f"{path}: expected {expected} as STL, GLB or PLY, found {path.suffix or 'no suffix'}")
    data = read_bytes(path, expected=f"{expected} as {kind.upper()}")
    try:
        with warnings.catch_warnings(), np.errstate(all="ignore"):
            warnings.simplefilter("ignore")
            mesh = trimesh.load(io.BytesIO(data), file_type=kind, force="mesh", process=False)
    except DAMAGE as error:
        raise InputError(f"{path}: expected {expected} as {kind.upper()}, found a damaged one: {reason(error)}") from None
    if not isinstance(mesh, trimesh.Trimesh) or not len(mesh.faces):
        raise InputError(f"{path}: expected {expected} of triangles, found none in it")
    _check_places(path, expected, mesh)
    return mesh


def _check_places(path: Path, expected: str, mesh: trimesh.Trimesh) -> None:
    farthest_mm = 1e7
    if not (np.abs(mesh.vertices) < farthest_mm).all():
        raise InputError(f"{path}: expected {expected} of finite places, below {farthest_mm:g} mm, found others among them")
    if mesh.faces.min() < 0 or mesh.faces.max() >= len(mesh.vertices):
        found = f"one of {mesh.faces.min()} to {mesh.faces.max()}"
        raise InputError(f"{path}: expected {expected} of triangles between its {len(mesh.vertices)} vertices, found {found}")


def write_ply(path: Path, mesh: trimesh.Trimesh) -> None:
    """Write binary little-endian PLY in mm: x y z, nx ny nz, every vertex attribute (such as sigma_mm), the vertices' grey, if
    there is one, and triangles.
    """
    columns = [("x y z", mesh.vertices), ("nx ny nz", mesh.vertex_normals)]
    columns += [(name, np.asarray(values).reshape(-1, 1)) for name, values in mesh.vertex_attributes.items()]
    names = [name for group, _ in columns for name in group.split()]
    greys = greys_of(mesh)
    table = np.empty(len(mesh.vertices), [("numbers", "<f4", (len(names),)), *([("grey", "u1", 3)] if greys is not None else [])])
    table["numbers"] = np.hstack([np.asarray(values, "<f4") for _, values in columns])
    if greys is not None:
        table["grey"] = greys[:, None]
    faces = np.empty(len(mesh.faces), [("count", "u1"), ("corners", "<i4", 3)])
    faces["count"], faces["corners"] = 3, mesh.faces
    header = ["ply", "format binary_little_endian 1.0", "comment unit mm", f"element vertex {len(table)}"]
    header += [f"property float {name}" for name in names]
    header += [f"property uchar {name}" for name in (("red", "green", "blue") if greys is not None else ())]
    header += [f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header", ""]
    with atomic.new_file(path) as temporary, temporary.open("wb") as file:
        file.write("\n".join(header).encode("ascii"))
        file.write(table.tobytes())
        file.write(faces.tobytes())


def write_glb(path: Path, mesh: trimesh.Trimesh) -> None:
    """Write GLB as the glTF standard has it: metres, y up; so x, y, z in mm become x/1000, -y/1000, -z/1000."""
    turned = trimesh.Trimesh(
        trimesh.transform_points(mesh.vertices, GLTF_FROM_WORLD),
        mesh.faces,
        vertex_normals=mesh.vertex_normals * (1, -1, -1),
        process=False,
        validate=False,
    )
    if (greys := greys_of(mesh)) is not None:
        set_greys(turned, greys)
    with atomic.new_file(path) as temporary:
        temporary.write_bytes(trimesh.exchange.gltf.export_glb(trimesh.Scene(turned), include_normals=True))


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
