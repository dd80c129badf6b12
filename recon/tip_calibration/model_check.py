"""Check that a tool's mesh is the tool's: its tip lies on the mesh."""

from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import NDArray

from recon.errors import InputError

Array = NDArray[np.float64]

NEAR_MM = 2.0  # of the tip from the mesh, beside three standard deviations: meshes are coarse, and tips round
TOOL_MM = (10.0, 1000.0)  # that tools are long
UNITS = {"metres": 1000.0, "inches": 25.4, "centimetres": 10.0, "micrometres": 1e-3}  # in mm


def check(path: Path, mesh: trimesh.Trimesh, tip: Array, sigma_mm: float) -> float:
    """Distance, mm, of a tip : (3,) mm, known to a standard deviation, from a mesh's surface.

    Raises
    ------
    InputError
        If they are apart, with the likely cause.
    """
    away, most = distance(mesh, tip), NEAR_MM + 3 * sigma_mm
    if away <= most:
        return away
    longest = float(np.ptp(mesh.vertices, axis=0).max())
    likely = {name: size for name, size in UNITS.items() if TOOL_MM[0] < longest * size < TOOL_MM[1]}
    unit = next((name for name, size in likely.items() if distance(mesh, tip / size) * size <= most), None)
    cause = f"is it in {unit}? Write it in mm" if unit else "is it in another frame than the target's, or of another tool?"
    place = " ".join(f"{value:.1f}" for value in tip)
    raise InputError(
        f"{path}: expected a mesh with the tip [{place}] mm on it, to {most:.1f} mm, found it {away:.1f} mm away: {cause}"
    )


def distance(mesh: trimesh.Trimesh, point: Array) -> float:
    """Distance of a point : (3,) from a mesh's triangles."""
    nearest = trimesh.triangles.closest_point(mesh.triangles, np.tile(point, (len(mesh.faces), 1)))
    return float(np.linalg.norm(nearest - point, axis=1).min())
