"""Mesh files: binary PLY in mm with normals and per-vertex sigma, and GLB in metres for viewers."""

from pathlib import Path

import numpy as np
import trimesh

from recon.files import atomic

# glTF is in metres with y up and the front towards +z; a camera's frame is in mm with y down and z away from it
GLTF_FROM_WORLD = np.diag([0.001, -0.001, -0.001, 1.0])


def write_ply(path: Path, mesh: trimesh.Trimesh) -> None:
    """Write binary little-endian PLY in mm: x y z, nx ny nz, every vertex attribute (such as sigma_mm), and triangles."""
    columns = [("x y z", mesh.vertices), ("nx ny nz", mesh.vertex_normals)]
    columns += [(name, np.asarray(values).reshape(-1, 1)) for name, values in mesh.vertex_attributes.items()]
    names = [name for group, _ in columns for name in group.split()]
    vertices = np.hstack([np.asarray(values, "<f4") for _, values in columns])
    faces = np.empty(len(mesh.faces), [("count", "u1"), ("corners", "<i4", 3)])
    faces["count"], faces["corners"] = 3, mesh.faces
    header = ["ply", "format binary_little_endian 1.0", "comment unit mm", f"element vertex {len(vertices)}"]
    header += [f"property float {name}" for name in names]
    header += [f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header", ""]
    with atomic.new_file(path) as temporary, temporary.open("wb") as file:
        file.write("\n".join(header).encode("ascii"))
        file.write(vertices.tobytes())
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
    with atomic.new_file(path) as temporary:
        temporary.write_bytes(trimesh.exchange.gltf.export_glb(trimesh.Scene(turned), include_normals=True))
