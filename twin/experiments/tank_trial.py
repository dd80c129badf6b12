"""The paper's tank in one laboratory: five calibrations of the probe, and two cylinders, by our method and by the paper's."""

from collections.abc import Sequence

import numpy as np
import trimesh
from numpy.typing import NDArray

from recon.errors import InputError
from recon.files.metrics import Metrics
from recon.freehand import scans as freehand_scans
from recon.freehand.scans import Unsure
from recon.geometry import rigid
from recon.geometry.primitives import Cylinder, fit_cylinder
from recon.model.probe import ProbeCalibration
from recon.probe_calibration import point_calibration, repeatability, sound_in_water
from recon.probe_calibration.tank_calibration import Result
from recon.segmentation import tube_cover
from recon.segmentation.tube_wall import Appearance
from recon.session import masses_step
from recon.session.masses_step import Method
from scenes.catalogue import build_scene
from twin import conditions
from twin.evaluation.surface_errors import rms
from twin.experiments import filmed_laboratory, probe_accuracy, tube_accuracy
from twin.experiments.baselines import published_probe
from twin.experiments.baselines.published_probe import Solved
from twin.experiments.drawn_session import WATER_C
from twin.experiments.experiment_runs import Experiment, Settings
from twin.experiments.filmed_laboratory import FilmedLaboratory
from twin.experiments.plane_and_sphere import as_published
from twin.experiments.tracked_sweep import TrackedSweep
from twin.experiments.tube_accuracy import WATER
from twin.ultrasound.sweep_session import calibration_of
from twin.ultrasound.timed_sweep import Clocks

Array = NDArray[np.float64]

CENTRE_MM = (4.0, -2.0, 670.29)  # of the inner cylinder's axis, where it lies in the outer one
INNER, OUTER = {"kind": "inner_cylinder", "centre_mm": CENTRE_MM}, {"kind": "cylinders"}
CAMERA_HZ = 20.0  # pairs of frames, in motion


def measure(settings: Settings, seed: int) -> Metrics:
    """Figures of one laboratory, by both methods."""
    ours, paper, images, clicks = list[Result](), list[Solved](), list[int](), np.random.default_rng([seed, 32])
    with filmed_laboratory.opened(settings, seed) as lab:
        for number in range(probe_accuracy.CALIBRATIONS):
            sweep = filmed_laboratory.wires(lab, number)
            found = filmed_laboratory.crossings(lab, sweep)
            images.append(len(found.usable))
            ours.append(filmed_laboratory.calibrated(lab, found))
            paper.append(filmed_laboratory.published(lab, found, sweep, clicks))
        mean = repeatability.average([one.calibration for one in paper])
        figures = probe_figures(lab, ours, paper) | cylinder_figures(lab, ours[-1].calibration, mean)
        return figures | {"images": float(np.mean(images))}


def probe_figures(lab: FilmedLaboratory, ours: Sequence[Result], paper: Sequence[Solved]) -> Metrics:
    """Repeatability of the calibrations, its expectation by their covariances, and their errors."""
    rig, life = lab.rig, lab.settings.conditions
    by_us, by_paper = [one.adjustment.calibration for one in ours], [one.calibration for one in paper]
    speed = float(sound_in_water.speed_of_sound(WATER_C + conditions.speeds(life.sound, lab.seed)[1]))
    scanner = calibration_of(rig, WATER)
    truth = sound_in_water.in_medium(scanner, scanner.speed_m_s, speed)
    points = repeatability.five_points(rig.probe.image_size)
    figures: Metrics = {}
    for name, found in (("ours", by_us), ("paper", by_paper)):
        for kind, values in (("cr1", repeatability.cr1(found, points)), ("cr2", repeatability.cr2(found, points))):
            figures |= {f"{kind}_{place}_{name}_mm": value for place, value in repeatability.at_places(values).items()}
        figures[f"probe_error_{name}_mm"] = rms(probe_accuracy.errors(found, truth, rig))
    expected = repeatability.expected_cr1(np.stack([point_calibration.point_covariance(one, points) for one in by_us]))
    figures |= {f"cr1_{place}_predicted_mm": value for place, value in repeatability.at_places(expected).items()}
    figures["equation_rms_ours_mm"] = rms(np.array([one.adjustment.rms_mm for one in ours]) / np.sqrt(3))
    figures["equation_rms_paper_mm"] = rms(np.array([one.rms_mm for one in paper]))
    return figures


def cylinder_figures(lab: FilmedLaboratory, ours: ProbeCalibration, paper: ProbeCalibration) -> Metrics:
    """Errors of both cylinders' diameters and of the wall between them, by light and ultrasound."""
    sweep, shot = stroke(lab), filmed_laboratory.by_light(lab, OUTER)
    surface = filmed_laboratory.meshed(shot, lab.optics.ours)
    water = float(sound_in_water.speed_of_sound(WATER_C))
    scans = freehand_scans.of_sweep(sweep.ours, ours, lab.latency_s, water, Unsure(lab.settings.noise.latency_s))
    found = masses_step.find(scans, Method(kind="tube", overlays=0), surface).figures
    plain = filmed_laboratory.meshed(as_published(shot, lab.settings.patterns), lab.optics.light)
    theirs = published_cylinders(sweep, paper, lab.latency_s, plain)
    (inner,), (outer, *_) = (cylinders_of(scene) for scene in (INNER, OUTER))
    wall = tube_cover.wall_between(outer, inner)
    true = {"tube_diameter": 2 * inner.radius, "cover_diameter": 2 * outer.radius, "cover_wall": wall}
    figures: Metrics = {"tube_diameter_predicted_mm": found["tube_diameter_sigma_mm"]}
    for name, value in true.items():
        figures[f"{name}_error_ours_mm"] = found[f"{name}_mm"] - value
        figures[f"{name}_error_paper_mm"] = theirs[name] - value
    return figures


def stroke(lab: FilmedLaboratory) -> TrackedSweep:
    """The probe along the inner cylinder, its array across."""
    clocks = Clocks(scanner_hz=tube_accuracy.rate_hz(tube_accuracy.SLICES), camera_hz=CAMERA_HZ)
    path = tube_accuracy.path_along(CENTRE_MM)
    return filmed_laboratory.swept(lab, "tube", INNER, path, clocks, WATER)


def published_cylinders(sweep: TrackedSweep, probe: ProbeCalibration, lag_s: float, surface: trimesh.Trimesh) -> dict[str, float]:
    """Diameters and wall by the published method: a cylinder through the masks' contours, another through the surface."""
    top_px = round(Appearance().top_mm / float(probe.scale[1]))
    points = []
    for image, matrix in zip(sweep.ours.images(), sweep.published_at(lag_s), strict=True):
        contour = published_probe.mask_contour(image, top_px)
        if len(contour) and np.isfinite(matrix).all():
            points.append(rigid.apply(matrix, probe.to_target(contour)))
    together = np.concatenate(points)
    tube = fit_cylinder(together).shape
    along = (together - tube.point) @ tube.axis
    ends = tube.point + np.outer([along.min(), along.max()], tube.axis)
    try:
        cover = tube_cover.fit_cover(surface, tube, ends)
    except InputError:  # its surface is no cylinder about its tube
        return {"tube_diameter": 2 * tube.radius, "cover_diameter": np.nan, "cover_wall": np.nan}
    return {"tube_diameter": 2 * tube.radius, "cover_diameter": 2 * cover.shape.radius, "cover_wall": cover.wall_mm}


def cylinders_of(scene: dict) -> list[Cylinder]:
    """Cylinders of a scene, the outer one first."""
    return [shape for shape in build_scene(scene).shapes if isinstance(shape, Cylinder)]


EXPERIMENT = Experiment(
    filmed_laboratory.READS,
    measure,
    {
        "cr1_mean_ours_mm": "cr1_mean_predicted_mm",
        "cr1_mean_paper_mm": "",
        "tube_diameter_error_ours_mm": "tube_diameter_predicted_mm",
    },
    "predicted by the software's covariances",
)
