"""Figures of a reconstructed surface, and the lines that report its decoding."""

from collections.abc import Iterator

import numpy as np
import trimesh

from recon.files.metrics import Metrics
from recon.geometry.camera import Camera
from recon.model.patterns import Patterns
from recon.structured_light.decode import ProjectorMap, Status
from recon.structured_light.triangulate import PointMap


def measure(found: ProjectorMap, raw: PointMap, cleaned: PointMap) -> Metrics:
    """Figures of a reconstruction, each named with its unit."""
    before, after = np.isfinite(raw.points[..., 0]), np.isfinite(cleaned.points[..., 0])
    points = int(after.sum())
    return {
        "points": points,
        "removed_px": int(before.sum()) - points,
        "unreachable_px": found.summary["unreachable"],
        "uncertain_px": found.summary["uncertain"],
        "saturated_fraction": found.summary["saturated"] / found.status.size,
        "modulation_median_dn": float(np.median(found.modulation[after])),
    }


def predicted_rms(mesh: trimesh.Trimesh, camera: Camera) -> float:
    """Root mean square of the predicted standard deviations across the surface, mm; NaN if there are none.

    Sigma lies along the camera's ray; its part along the vertex normal moves the surface.
    """
    offset = mesh.vertices - camera.centre
    cosine = (offset * mesh.vertex_normals).sum(axis=1) / np.linalg.norm(offset, axis=1)
    across = mesh.vertex_attributes["sigma_mm"].astype(float) * cosine
    known = across[np.isfinite(across)]
    return float(np.sqrt(np.mean(known**2))) if known.size else np.nan


def describe_decoding(patterns: Patterns, found: ProjectorMap) -> Iterator[str]:
    """Lines: modulation and saturation of the images; regions, islands and uncertain pixels of the unwrapping."""
    height, width = found.status.shape
    lit = found.modulation[found.status != Status.DARK]
    strength = np.median(lit) if lit.size else 0.0
    saturated = 100 * found.summary["saturated"] / found.status.size
    yield f"decode      {patterns.count} images, {width}x{height}, modulation {strength:.0f} DN, {saturated:.1f} % saturated"
    notes = [str(patterns.unwrap).replace("_", " ")]
    if "regions" in found.summary:
        regions, islands = _counted(found.summary["regions"], "region"), _counted(found.summary["islands"], "island")
        notes.append(f"{regions}, {islands} left out ({found.summary['unreachable']} px)")
    notes.append(f"{found.summary['uncertain']} px uncertain")
    yield f"unwrap      {', '.join(notes)}"


def _counted(number: int, thing: str) -> str:
    return f"{number} {thing}{'' if number == 1 else 's'}"
