"""Figures of a measured target, and the lines that report them."""

from collections.abc import Iterator

import numpy as np

from recon.capture import target_files
from recon.files.metrics import Metrics, shown
from recon.model import circle_layout
from recon.model.rig import Target
from recon.target_calibration import target_poses
from recon.target_calibration.target_bundle import Adjusted
from recon.tracking import track_figures


def measure(adjusted: Adjusted, design: Target) -> Metrics:
    """Figures, each named with its unit."""
    pairs, target, sigma = adjusted.pairs, adjusted.target, np.sqrt(np.diag(adjusted.covariance))
    values = [*circle_layout.lengths(target).tolist(), target.outer_diameter_mm, *target.curvature_per_m]
    nominal = [*circle_layout.lengths(design).tolist(), design.outer_diameter_mm]
    names, (across, high) = target_files.parameters(target), target.board_mm
    return {
        "pairs": len(pairs),
        "pairs_used": int(adjusted.used.sum()),
        "tilt_sd_deg": target_poses.tilt_deg(pairs),
        "range_mm": target_poses.range_mm(pairs),
        "centre_rms_px": adjusted.centre_rms_px,
        "shape_rms_px": adjusted.shape_rms_px,
        "noise_over_predicted": adjusted.noise.centres,
        **dict(zip(names, values, strict=True)),
        **{f"sigma_{name}": float(value) for name, value in zip(names, sigma, strict=True)},
        **{f"design_{name}": value for name, value in zip(names, nominal, strict=False)},
        "bow_across_mm": 1e-3 * target.curvature_per_m[0] * across**2 / 8,
        "bow_along_mm": 1e-3 * target.curvature_per_m[2] * high**2 / 8,
    }


def found(adjusted: Adjusted) -> Iterator[str]:
    """Lines: pairs of the film, and a second target, if there is one."""
    pairs, collected = adjusted.pairs, adjusted.collected
    uneven = sum(not pair.even for pair in pairs)
    dim = f", {uneven} of them in uneven light: less exact" if uneven else ""
    count = f"{len(collected.seen)} of {len(collected.apart_mm)}"
    yield f"found       {count} pairs whole, {len(pairs)} poses that differ{dim}"
    yield from track_figures.second_target(collected.apart_mm)


def describe(figures: Metrics, design: Target) -> Iterator[str]:
    """Lines: residuals, lengths beside the design's, rims and bow."""
    used, count = figures["pairs_used"], figures["pairs"]
    yield (
        f"adjust      {used} of {count} poses; residuals of centres {figures['centre_rms_px']:.4f} px, "
        f"{shown(figures['noise_over_predicted'], '.2f')} times the predicted noise"
    )
    labels = (*(name.removesuffix("_mm").replace("_", " ") for name in design.LENGTHS), "rims")
    for name, label in zip(target_files.lengths_and_diameter(design), labels, strict=True):
        found, sigma, nominal = (figures[f"{part}{name}"] for part in ("", "sigma_", "design_"))
        yield f"{label:<11} {found:.4f} ± {sigma:.4f} mm, by design {nominal:g}: {1e3 * (found - nominal):+.0f} um"
    yield f"bow         {figures['bow_across_mm']:+.3f} mm across the board, {figures['bow_along_mm']:+.3f} mm along it"
