"""Cameras and projector calibrated from rendered images of a board, compared with the true ones."""

from recon.files.metrics import Metrics
from recon.optical_calibration import figures_of_merit
from recon.optical_calibration.joint_calibration import calibrate
from twin import board_session
from twin.experiments import board_accuracy
from twin.experiments.board_sets import rendered
from twin.experiments.calibration_errors import DEPTHS
from twin.experiments.experiment_runs import Experiment, Settings
from twin.experiments.layout import laid_out
from twin.working_range import working_range

KEPT = ("point_sigma_mm", "shape_sigma_mm", "scale_sigma_ppm")


def measure(settings: Settings, seed: int) -> Metrics:
    """Figures of one calibration, of a board and poses of its own."""
    seen = rendered(session(settings, seed))
    result = calibrate(seen.sightings, seen.board, seen.sizes)
    found = figures_of_merit.measure(result, seen.truth)
    calibration = result.adjustment.calibration
    depths = [working_range(settings.rig).depth(z) for z in DEPTHS]
    return {
        "point_error_mm": found["point_error_rms_mm"],
        **{name: found[name] for name in KEPT},
        "plane_form_mm": board_accuracy.form(calibration, seen.truth, depths),
        "error_over_sigma": figures_of_merit.normalised_error(calibration, seen.truth),
        **{f"reprojection_rms_{name}_px": rms for name, rms in result.rms.items()},
        "poses_used": len(result.observations.poses),
    }


def session(settings: Settings, seed: int) -> board_session.Settings:
    """The board in the hands of one laboratory."""
    where = working_range(settings.rig)
    return board_session.Settings(
        laid_out(settings.rig, settings.layout),
        where.board(settings.board),
        where.poses(settings.poses).model_copy(update={"seed": settings.poses.seed + seed}),
        settings.board_patterns,
        board_session.CAMERAS,
        settings.tracing,
        settings.shooting,
        seed,
        settings.conditions,
    )


EXPERIMENT = Experiment(
    (
        *("rig", "layout.projector_mm", "layout.camera_mm", "board", "board_patterns", "poses"),
        *("conditions.board", "conditions.frames", "tracing", "shooting"),
    ),
    measure,
    {"point_error_mm": "point_sigma_mm", "plane_form_mm": ""},
    "predicted by the calibration's covariance",
)
