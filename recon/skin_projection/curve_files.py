"""Curves on the skin as files: JSON of their points, and strips of triangles for any viewer of meshes."""

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import NDArray

from recon.files import atomic, meshes
from recon.skin_projection import skin_curve
from recon.skin_projection.projector_image import Lines
from recon.skin_projection.skin_curve import SkinCurve


def write_json(path: Path, curves: Sequence[SkinCurve]) -> None:
    """Write points of curves in mm of the world, a list for each piece that lies on the skin; whole or not at all."""
    digits = 4  # of mm
    listed = [
        {"name": curve.name, "kind": curve.kind, "pieces": [np.round(piece, digits).tolist() for piece in _pieces(curve.points)]}
        for curve in curves
    ]
    schema = "sonotwin-curves/1"
    content = {"schema": schema, "unit": "mm", "frame": "camera 1", "curves": listed}
    with atomic.new_file(path) as temporary:
        temporary.write_text(json.dumps(content) + "\n", encoding="utf-8")


def write_ply(path: Path, curves: Sequence[SkinCurve], lines: Lines) -> None:
    """Write all curves as strips of their widths, a little above the skin."""
    whole = trimesh.util.concatenate(list(strips(curves, lines).values()))
    assert isinstance(whole, trimesh.Trimesh)
    meshes.write_ply(path, whole)


def strips(curves: Sequence[SkinCurve], lines: Lines) -> dict[str, trimesh.Trimesh]:
    """Strips by the curves' names, of those that have any piece."""
    above_mm = 0.2  # the skin, so that strips don't sink into it
    made = {curve.name: skin_curve.strip(curve, lines.of(curve).width_mm, above_mm) for curve in curves}
    return {name: strip for name, strip in made.items() if len(strip.faces)}


def _pieces(points: NDArray[np.float64]) -> list[NDArray[np.float64]]:
    """Runs of two points and more without a missing one, of a chain : (n, 3)."""
    known = np.isfinite(points).all(axis=1)
    bounds = np.flatnonzero(np.diff(known.astype(int), prepend=0, append=0))
    return [points[first:end] for first, end in zip(bounds[::2], bounds[1::2], strict=True) if end - first > 1]
