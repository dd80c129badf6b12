"""The whole way from the board to the tumours: what each step found, predicted and missed by, in one table."""

from collections.abc import Iterator

import numpy as np

from recon.files.metrics import Metrics, shown
from recon.reports import page
from recon.reports.page import Section

Line = tuple[str, str, str, str]  # step, found, predicted, off by

HEAD = ("", "found", "predicted", "off by")
CAPTION = (
    "Each step builds on the ones above it, by estimated calibrations and tracked poses alone. Predicted: one standard "
    "deviation, by the step’s own covariance. Off by: against the truth that the images were rendered from."
)


def sections(metrics: Metrics) -> Iterator[Section]:
    """The table, if there was a sweep."""
    if "tumours_true" in metrics:
        yield Section("From board to tumour", [page.table(HEAD, lines(metrics), CAPTION)])


def lines(metrics: Metrics) -> Iterator[Line]:
    """A line a step."""
    if "point_error_rms_mm" in metrics:
        poses = f"from {metrics['poses']:.0f} poses of the board"
        yield "Cameras and projector", poses, _mm(metrics, "point_sigma_mm"), _mm(metrics, "point_error_rms_mm")
    if "drift_skin_moved_mm" in metrics:
        moved = f"{_mm(metrics, 'drift_skin_moved_mm')} between skin and target"
        yield "Their drift since, corrected", moved, _mm(metrics, "drift_skin_sigma_mm"), ""
    points = f"{page.count(metrics['points'])} points"
    noise = np.hypot(metrics["predicted_rms_mm"], metrics.get("point_sigma_mm", 0.0))  # and the calibration's part
    yield "Surface", points, shown(float(noise), ".3f", " mm"), _mm(metrics, "surface_rms_mm")
    found = f"{metrics['track_found']} of {metrics['track_frames']} frames"
    yield "Probe’s places, median", found, _mm(metrics, "track_sigma_median_mm"), _mm(metrics, "track_shift_median_mm")
    late, sigma = (f"{metrics[name]:.1f} ms" for name in ("lag_ms", "lag_sigma_ms"))
    yield "Scanner’s lag", late, sigma, f"{abs(metrics['lag_error_ms']):.1f} ms"
    used = f"from {metrics['probe_frames_used']} B-scans of wires"
    yield (
        "Probe’s calibration, worst of five pixels",
        used,
        _mm(metrics, "probe_worst_sigma_mm"),
        _mm(metrics, "probe_worst_error_mm"),
    )
    predicted, off = (_mm(metrics, f"placement_{name}_mm", ".2f") for name in ("sigma", "rms"))
    yield "Places of the sweep’s pixels, without the speed of sound’s error", "B-scans in space", predicted, off
    yield from of_tumours(metrics)


def of_tumours(metrics: Metrics) -> Iterator[Line]:
    """Two lines a tumour that was found: centre and volume, and the depth of its nearest point."""
    for number in range(int(metrics["tumours_true"])):
        name = f"tumour{number}"
        if not np.isfinite(metrics.get(f"{name}_centre_error_mm", np.nan)):
            yield f"Tumour {number + 1}", "not found", "", ""
            continue
        volume, true = metrics[f"{name}_volume_mm3"], metrics[f"{name}_true_volume_mm3"]
        sigmas = f"{_mm(metrics, f'{name}_centre_sigma_mm', '.2f')}, {shown(metrics[f'{name}_volume_sigma_mm3'], '.0f', ' mm³')}"
        off = f"{_mm(metrics, f'{name}_centre_error_mm', '.2f')}, {volume - true:+.0f} mm³".replace("-", "−")
        yield f"Tumour {number + 1}: centre, volume", f"{volume:.0f} mm³", sigmas, off
        depth, under = metrics[f"{name}_under_skin_mm"], metrics[f"{name}_true_under_skin_mm"]
        beside = shown(abs(depth - under), ".2f", " mm")
        yield "… its depth below the skin", shown(depth, ".2f", " mm"), _mm(metrics, f"{name}_depth_sigma_mm", ".2f"), beside


def _mm(metrics: Metrics, name: str, form: str = ".3f") -> str:
    return shown(metrics[name], form, " mm")
