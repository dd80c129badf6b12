"""Figures of a reconstructed surface, and the lines that report its decoding."""

from collections.abc import Iterator

import numpy as np
import trimesh

from recon.files.metrics import Metrics
from recon.geometry.camera import Camera
from recon.model.patterns import Patterns
from recon.structured_light.decode import Linearity, ProjectorMap, Status
from recon.structured_light.phase_bend import DEFOCUS, LINEAR_LIGHT, Hidden
from recon.structured_light.plausibility import black_clipped
from recon.structured_light.triangulate import PointMap

ADVICE = {
    Status.DARK: "too dark: expose longer, or open the lens",
    Status.SATURATED: "saturated: expose for less, or dim the projector",
    Status.UNREACHABLE: "on surfaces that the centre line misses: use a sequence with Gray code or several pitches",
    Status.UNCERTAIN: "of uncertain order, near steps or in noise",
    Status.OUTSIDE: "out of the projector's image: check that the patterns are those projected",
}
HIDDEN: dict[Hidden, str] = {
    "few": "which too few periods are seen to show, saturated ones apart",
    "fine": "which periods of so few camera pixels don't show",
}
BENT_PX = 0.05  # projector px by which phases may be bent before it is said
FEWEST_STEPS = 3  # whose bend is that of one gamma; the same of four is that of two
SPARSE = 1 / 3  # of the lit pixels: a warning comes first where fewer are decoded


def measure(found: ProjectorMap, raw: PointMap, cleaned: PointMap) -> Metrics:
    """Figures of a reconstruction, each named with its unit."""
    before, after = np.isfinite(raw.points[..., 0]), np.isfinite(cleaned.points[..., 0])
    points = int(after.sum())
    bends = {
        "bend_undone_px": max((bend.most_px for bend in found.linearity.bends), default=0.0),
        "bend_left_px": max((bend.left_px for bend in found.linearity.bends), default=0.0),
    }
    return {
        "points": points,
        "coverage_of_lit": points / max(int(np.count_nonzero(found.lit)), 1),
        "removed_px": int(before.sum()) - points,
        "unreachable_px": found.summary["unreachable"],
        "uncertain_px": found.summary["uncertain"],
        "saturated_fraction": found.summary["saturated"] / found.status.size,
        "modulation_median_dn": float(np.median(found.modulation[after])),
        **(bends if found.linearity.bends else {}),
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
    """Lines: a warning of little coverage; modulation and saturation; bent phases; the unwrapping."""
    height, width = found.status.shape
    if found.summary["ok"] < SPARSE * np.count_nonzero(found.lit):
        yield _warn(found)
    lit = found.modulation[found.status != Status.DARK]
    strength = np.median(lit) if lit.size else 0.0
    saturated = 100 * found.summary["saturated"] / found.status.size
    yield f"decode      {patterns.count} images, {width}x{height}, modulation {strength:.0f} DN, {saturated:.1f} % saturated"
    yield from bent(found.linearity)
    yield f"unwrap      {describe_unwrapping(patterns, found)}"


def describe_unwrapping(patterns: Patterns, found: ProjectorMap) -> str:
    """Way of unwrapping, and what it left out, in words."""
    notes = [str(patterns.unwrap).replace("_", " ")]
    if "regions" in found.summary:
        regions, islands = _counted(found.summary["regions"], "region"), _counted(found.summary["islands"], "island")
        notes.append(f"{regions}, {islands} left out ({found.summary['unreachable']} px)")
    notes.append(f"{found.summary['uncertain']} px uncertain")
    return ", ".join(notes)


def bent(linearity: Linearity) -> Iterator[str]:
    """Warnings of phases that light bends which isn't linear: of those that were straightened, and those that don't show it."""
    black = f" ({clip}?)" if (clip := black_clipped(linearity.clipped)) else ""
    for bend in linearity.bends:
        if bend.most_px > BENT_PX:
            law = f", it goes with level^{bend.gamma:.1f} or so" if bend.steps == FEWEST_STEPS and bend.gamma else ""
            cause, way = f"light isn't linear{law}{black}", LINEAR_LIGHT
            if bend.waveform == "binary":
                cause, way = "binary fringes are no sines yet", DEFOCUS
            yield (
                f"linearity   {cause}: {bend.steps} steps of {bend.pitch:g} px were bent by up to "
                f"{bend.most_px:.2f} px, which is undone to {bend.left_px:.3f} px; {way}"
            )
    for part, why in linearity.unknown:
        cause, way = ("harmonics of binary fringes", DEFOCUS) if part.waveform == "binary" else ("a gamma", LINEAR_LIGHT)
        yield (
            f"linearity   {part.steps} steps of {part.pitch:g} px would be bent by {cause}, {HIDDEN[why]}; it isn't in "
            f"sigma: {way}"
        )


def _warn(found: ProjectorMap) -> str:
    """The share of lit pixels that was decoded, the commonest reason for the loss of others, and the way on."""
    outcomes = np.bincount(found.status[found.lit], minlength=len(Status))
    share = 100 * outcomes[Status.OK] / outcomes.sum()
    reason = max(ADVICE, key=lambda status: outcomes[status])
    return f"coverage    only {share:.0f} % of the pixels that show fringes are decoded; most others are {ADVICE[reason]}"


def _counted(number: int, thing: str) -> str:
    return f"{number} {thing}{'' if number == 1 else 's'}"
