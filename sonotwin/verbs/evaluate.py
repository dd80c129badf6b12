"""Compare a reconstructed surface with the ground truth that the twin rendered beside the capture.

Reads points.npz, as `sonotwin surface` writes it, and the truth/ folder of `sonotwin render`. Writes metrics.json and
error_map.png into the folder `out`, by default evaluation/ in the surface's folder. Takes a few seconds.

    sonotwin evaluate surface=outputs/sphere/surface truth=outputs/sphere/truth
"""

from pathlib import Path

import numpy as np

from recon.files import atomic, metrics
from recon.files.metrics import Metrics, shown
from recon.model.rig import Part
from recon.reports import figures
from recon.session.skin_step import POINTS
from twin.evaluation import surface_errors
from twin.reports import error_report

ERROR_MAP = "error_map.png"


class Config(Part):
    """Fields of `sonotwin evaluate`."""

    surface: Path
    """folder with the points.npz that `sonotwin surface` wrote"""
    truth: Path
    """truth/ folder that `sonotwin render` wrote beside the capture"""
    out: Path | None = None
    """folder; gets metrics.json and error_map.png; null is evaluation/ in the surface's folder"""
    camera: str = "cam1"
    """whose view the surface was reconstructed from"""


def run(config: Config) -> None:
    """Compare a surface with its truth, report its errors, and write.

    Raises
    ------
    InputError
        If surface or truth are missing, damaged, or don't fit together; or `out` can't be written to.
    """
    out = config.out or config.surface / "evaluation"
    atomic.check_folder(out, "evaluate", inputs=(config.surface, config.truth))
    truth = surface_errors.read_truth(config.truth, config.camera)
    points, sigma = surface_errors.read_points(config.surface / POINTS)
    comparison = surface_errors.compare(points, sigma, truth)
    found = surface_errors.measure(points, comparison, truth)
    half_range = error_report.half_range(np.where(comparison.interior, comparison.error, np.nan), error_report.ERROR_MM)
    with atomic.new_folder(out, "evaluate") as folder:
        (folder / ERROR_MAP).write_bytes(figures.error_map_png(comparison.error, comparison.interior, half_range))
        metrics.write(folder / metrics.FILE, found)
    print(f"evaluate    {describe(found)}")
    print(f"wrote       {out}/{{{metrics.FILE},{ERROR_MAP}}}")


def describe(found: Metrics) -> str:
    """Accuracy beside its limit, and coverage, in one line."""
    everywhere, interior, limit = (
        shown(found[f"{name}_rms_mm"], ".3f", " mm") for name in ("surface", "surface_interior", "limit")
    )
    return (
        f"surface RMS {everywhere}, {interior} away from edges; the sensor's limit {limit}; "
        f"coverage {100 * found['coverage']:.1f} %, gross errors {100 * found['gross_error_fraction']:.3f} %"
    )
