"""The paper's optics in one laboratory: a board, a plane and the sphere, measured by our method and by the paper's."""

from recon.files.metrics import Metrics
from twin.experiments import calibration_trial, lifelike_accuracy
from twin.experiments.experiment_runs import Experiment, Settings


def measure(settings: Settings, seed: int) -> Metrics:
    """Figures by both methods on the same images; the plane is one of the paper's five, in turn by the seed."""
    found = lifelike_accuracy.laboratory(calibration_trial.session(settings, seed), settings.patterns)
    figures: Metrics = {}
    for name, by, px in (("ours", found.ours, found.ours_px), ("paper", found.paper, found.paper_px)):
        figures[f"plane_rms_{name}_mm"] = by.plane_rms_mm
        figures[f"plane_form_{name}_mm"] = by.form_mm
        figures[f"sphere_radius_error_{name}_mm"] = by.radius_error_mm
        figures[f"sphere_rms_{name}_mm"] = by.sphere_rms_mm
        figures |= {f"reprojection_{device}_{name}_px": px[device] for device in lifelike_accuracy.DEVICES}
    figures["plane_limit_mm"], figures["sphere_limit_mm"] = found.limit_mm
    figures["error_over_sigma"] = found.squared**0.5
    return figures


EXPERIMENT = Experiment(
    (*calibration_trial.EXPERIMENT.reads, "patterns", "conditions.drift"),
    measure,
    {"plane_rms_ours_mm": "plane_limit_mm", "plane_rms_paper_mm": "plane_limit_mm", "sphere_rms_ours_mm": "sphere_limit_mm"},
    "noise alone",
)
