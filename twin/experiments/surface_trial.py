"""A plane by fringe projection, with the true calibration: what patterns, light and layout come to, beside the closed form."""

import numpy as np

from recon.files.metrics import Metrics
from recon.geometry.primitives import Plane
from recon.model.rig import Rig
from scenes.kinds import plane
from twin.conditions import drifted
from twin.experiments import closed_forms, predicted_plane, surface_accuracy
from twin.experiments.experiment_runs import Experiment, Settings
from twin.experiments.layout import laid_out
from twin.experiments.predicted_plane import Measurement
from twin.experiments.surface_accuracy import Experiment as Surface
from twin.sensor import Exposure, electrons_per_radiance, number_per_electron
from twin.working_range import working_range


def measure(settings: Settings, seed: int) -> Metrics:
    """Figures of a plane, tilted as one of the paper's, in turn by the seed."""
    rig, pose = drifted(laid_out(settings.rig, settings.layout), settings.conditions.drift, seed), plate_of(settings, seed)
    result = surface_accuracy.experiment(
        rig, plane.build(pose), settings.patterns, seed, settings.tracing, settings.shooting, settings.conditions
    )
    seen, exposure = result.metrics, result.view.exposure
    brightness = float(np.median(result.found.offset[result.comparison.interior])) - rig.cam1.sensor.black_level_dn
    room = room_brightness(rig, settings, pose.reflectance, exposure)
    return {
        "plane_rms_mm": seen["plane_plate_rms_mm"],
        "plane_limit_mm": closed_form(rig, settings, result, brightness, room),
        "noise_limit_mm": seen["limit_rms_mm"],
        "predicted_rms_mm": seen["predicted_rms_mm"],
        "error_over_sigma": seen["z_std"],
        "coverage": seen["coverage"],
        "common_view": float(result.truth.lit.mean()),
        "gross_error_fraction": seen["gross_error_fraction"],
        "brightness_dn": brightness,
        "modulation_dn": float(np.median(result.found.modulation[result.comparison.interior])),
        "images": settings.patterns.count,
        "exposure_s": exposure.time_s,
        "images_s": settings.patterns.count * exposure.time_s,
    }


def plate_of(settings: Settings, seed: int) -> plane.Config:
    """The plane that a trial measures."""
    pose = working_range(settings.rig).plate(plane.PAPER_POSES[seed % len(plane.PAPER_POSES)])
    if settings.plane.depth_mm is None:
        return pose
    return pose.model_copy(update={"centre_mm": (*pose.centre_mm[:2], settings.plane.depth_mm)})


def predict(settings: Settings, seed: int) -> Metrics:
    """Those figures of the same plane that formulas give; errors of frames, drift and calibration aren't in them."""
    rig, patterns = laid_out(settings.rig, settings.layout).model_copy(update={"optics_covariance": None}), settings.patterns
    found = predicted_plane.predict(rig, Measurement(patterns, plate_of(settings, seed), settings.shooting, settings.tracing))
    return {
        "plane_rms_mm": found.rms_mm,
        "common_view": found.common_view,
        "modulation_dn": found.modulation_dn,
        "images": patterns.count,
        "exposure_s": found.exposure_s,
        "images_s": patterns.count * found.exposure_s,
    }


def room_brightness(rig: Rig, settings: Settings, reflectance: float, exposure: Exposure) -> float:
    """Brightness, DN, that the room's light alone gives a matt surface in camera 1: radiance `reflectance * room`."""
    electrons = electrons_per_radiance(rig.cam1, rig.projector.wavelength_nm) * exposure.time_s
    return reflectance * settings.tracing.room_radiance * electrons * number_per_electron(rig.cam1.sensor, exposure)


def closed_form(rig: Rig, settings: Settings, result: Surface, brightness_dn: float, room_dn: float) -> float:
    """RMS distance from the plane that noise and mirrors leave, mm, by formulas, from the images' mean brightness."""
    fringes = closed_forms.fringes_of(settings.patterns)
    (flat,) = (shape for shape in result.truth.shapes if isinstance(shape, Plane))
    modulation = (brightness_dn - room_dn) * closed_forms.contrast(rig, fringes, flat.point)
    noise = closed_forms.brightness_noise(rig.cam1, brightness_dn, result.view.exposure)
    phase = closed_forms.phase_sigma(fringes.steps, noise, modulation), closed_forms.raster_sigma(rig, fringes, flat.point)
    return closed_forms.plane_sigma(rig, flat, fringes.pitch / (2 * np.pi) * float(np.hypot(*phase)))


READS = ("rig", "layout.projector_mm", "patterns", "plane", "conditions.frames", "conditions.drift", "tracing", "shooting")
EXPERIMENT = Experiment(READS, measure, {"plane_rms_mm": "plane_limit_mm"}, predict=predict)
