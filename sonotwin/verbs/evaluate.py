"""Compare a reconstructed surface with the ground truth that the twin rendered beside the capture.

Reads points.npz, as `sonotwin surface` writes it, and the truth/ folder of `sonotwin render`. Writes metrics.json and
error_map.png into the folder `out`, by default evaluation/ in the surface's folder. Takes a few seconds.

    sonotwin evaluate surface=outputs/sphere/surface truth=outputs/sphere/truth
"""

import json
from pathlib import Path

from pydantic import BaseModel, ConfigDict

from recon import atomic
from twin import evaluate, figures

METRICS = "metrics.json"
ERROR_MAP = "error_map.png"


class Config(BaseModel):
    """Fields of `conf/evaluate.yaml`."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    surface: Path
    truth: Path
    out: Path | None = None
    camera: str = "cam1"


def run(config: Config) -> None:
    """Compare, say how far off the surface is, and write.

    Raises
    ------
    InputError
        If surface or truth are missing, damaged, or don't fit together; or `out` can't be written to.
    """
    out = config.out or config.surface / "evaluation"
    atomic.check_folder(out, METRICS)
    truth = evaluate.read_truth(config.truth, config.camera)
    points, sigma = evaluate.read_points(config.surface / "points.npz")
    comparison = evaluate.compare(points, sigma, truth)
    metrics = evaluate.measure(points, comparison, truth)
    with atomic.new_folder(out, METRICS) as folder:
        (folder / ERROR_MAP).write_bytes(figures.error_map_png(comparison.error, comparison.interior))
        (folder / METRICS).write_text(json.dumps(metrics, indent=2) + "\n", encoding="utf-8")
    print(f"evaluate    {describe(metrics)}")
    print(f"wrote       {out}/{{{METRICS},{ERROR_MAP}}}")


def describe(metrics: evaluate.Metrics) -> str:
    """Accuracy beside its limit, and coverage, in one line."""
    return (
        f"surface RMS {metrics['surface_rms_mm']:.3f} mm, {metrics['surface_interior_rms_mm']:.3f} mm away from edges; "
        f"the sensor's limit {metrics['limit_rms_mm']:.3f} mm; coverage {100 * metrics['coverage']:.1f} %, "
        f"gross errors {100 * metrics['gross_error_fraction']:.3f} %"
    )
