"""Accuracy of the optics calibration: against the twin's parameters, its own prediction, surfaces, bad boards, and OpenCV."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from recon.board_detection.detect import detect
from recon.geometry.camera import Array
from recon.geometry.circle_projection import centre_offsets
from recon.model.calibration import Calibration
from recon.model.patterns import Patterns
from recon.model.rig import Rig
from recon.optical_calibration import uncertainty
from recon.optical_calibration.adjustment import adjust, free_parameters
from recon.optical_calibration.distortion_selection import MODELS
from recon.optical_calibration.joint_calibration import Result, Settings, Shape, calibrate, deviation
from recon.structured_light.surface_mesh import clean
from recon.structured_light.triangulate import triangulate
from scenes.board_poses import Config as Poses
from scenes.board_poses import random_poses
from scenes.catalogue import build_scene
from scenes.kinds import board, plane
from scenes.scene_types import Scene
from twin import board_session
from twin.evaluation import surface_errors
from twin.evaluation.surface_errors import Metrics
from twin.experiments import surface_accuracy
from twin.experiments.baselines import opencv_peer
from twin.experiments.board_sets import BoardSet, drawn, measured_noise, recalibrated, rendered
from twin.experiments.calibration_errors import (
    DEPTHS,
    PAIRS,
    REGION,
    baseline_error,
    expected_length,
    focal_error,
    focal_sigma,
    inside_region,
    motion_error,
    motion_sigma,
    point_errors,
    rms_length,
    scale_error,
    scale_sigma,
    squared_length,
)
from twin.experiments.experiment_setup import Figures, Setup
from twin.optics.light_transport import Tracing, render
from twin.optics.ray_world import move_things
from twin.optics.surface_session import Shooting, calibration_of
from twin.sensor import Exposure, auto_exposure, expose

TRACING = Tracing(samples=16, room_lux=20)
QUIET = {"cam1": 1e-4, "cam2": 1e-4, "projector": 1e-4}  # px, where noise is not the question
DRAWN_POSES = 20
DRAWS = 30  # calibrations whose errors are compared with the prediction

BROWN = Settings(distortion="brown")  # OpenCV's five coefficients
BENT_POSES = 16
BENT = board.Config(warp_mm=0.2, print_error_mm=0.02, roughness=0.2)


def session(setup: Setup, design: board.Config | None = None, poses: Poses | None = None) -> board_session.Settings:
    """A session of the paper's protocol; its poses are those of `conf/poses/paper.yaml` if none are given."""
    patterns: Patterns = setup.sequences["paper_calibration"]
    cameras = board_session.CAMERAS
    return board_session.Settings(
        setup.rig, design or board.Config(), poses or Poses(), patterns, cameras, TRACING, Shooting(), seed=1
    )


@cache
def calibrated(settings: board_session.Settings) -> tuple[BoardSet, Result]:
    """Render a session and calibrate with it, as the commands do, without the files between."""
    seen = rendered(settings)
    return seen, calibrate(seen.sightings, seen.board, seen.sizes)


def redrawn(setup: Setup) -> tuple[tuple[BoardSet, Result], ...]:
    """Calibrations of independent sets with the noise that was measured on the rendered one."""
    return recalibrated(setup.rig, measured_noise(calibrated(session(setup))[1]), DRAWS, DRAWN_POSES)


def against_truth(setup: Setup, poses: int = Poses().count) -> Figures:
    """Residuals and parameters of a rendered session, beside the prediction of detection and covariance."""
    seen, result = calibrated(session(setup, poses=Poses(count=poses)))
    found, figures = result.adjustment.calibration, {"poses": len(result.observations.poses)}
    for name, rms in result.rms.items():
        figures |= {f"{name}_rms_px": rms, f"{name}_rms_limit_px": rms / result.adjustment.noise[name]}
        error, sigma = focal_error(found, seen.truth, name), focal_sigma(found, name)
        figures |= {f"{name}_focal_percent": error, f"{name}_focal_sigma_percent": sigma}
    for name in list(found.cameras)[1:]:
        turn, shift = motion_error(found, seen.truth, name)
        sigmas = motion_sigma(found, name)
        figures |= {f"{name}_turn_deg": turn, f"{name}_turn_sigma_deg": sigmas[0]}
        figures |= {f"{name}_shift_mm": shift, f"{name}_shift_sigma_mm": sigmas[1]}
    return figures


def centre_bias(setup: Setup, diameter_mm: float, tilt_deg: float) -> Figures:
    """How far detected centres lie from the true ones, along the direction in which the correction moves them."""
    turned = Rotation.from_euler("x", tilt_deg, degrees=True) * Rotation.from_euler("z", 90, degrees=True)
    config = board.Config(diameter_mm=diameter_mm, rotation_deg=tuple(turned.as_rotvec(degrees=True)))
    image, exposure = lit_board(setup.rig, config)
    camera, pose, design = setup.rig.cam1.optics.camera(), board.world_from_board(config), board.design(config)
    offsets = centre_offsets(camera, pose, design.points(), diameter_mm / 2)
    error = detect(image, design, full=2.0**exposure.bits - 1).pixels - camera.project(board.circle_centres(config))
    along = offsets / np.linalg.norm(offsets, axis=1, keepdims=True)
    before, after = (abs(float(np.nanmean((left * along).sum(axis=1)))) for left in (error, error - offsets))
    return {"bias_px": after, "uncorrected_px": before}


def lit_board(rig: Rig, config: board.Config) -> tuple[np.ndarray, Exposure]:
    """Camera 1's image of a board under even light : (h, w) DN, with the sensor's noise."""
    patterns = Patterns.model_validate(
        {
            "projector_size": rig.projector.optics.size,
            "unwrap": "centre_line",
            "parts": [{"kind": "centre_line"}, {"kind": "fringes", "pitch": 12, "steps": 8}],
        }
    )
    settings = board_session.Settings(rig, config, Poses(), patterns, ("cam1",), TRACING, Shooting(), seed=1)
    stage = board_session.set_up(settings)
    move_things(stage.world, stage.things, board.world_from_board(config))
    optics, light = stage.cameras["cam1"], board_session.fully_on(stage.patterns)
    radiance = render(stage.world, optics, stage.projector, light, TRACING, seed=1)
    board_session.refine_edges(radiance[0], stage, optics, TRACING, board.world_from_board(config), seed=2)
    wavelength = rig.projector.wavelength_nm
    exposure = Exposure(auto_exposure(radiance, rig.cam1, wavelength, level=Shooting().level), 1.0, 8)
    return expose(radiance, rig.cam1, wavelength, exposure, seed=3)[0], exposure


def baseline_bias(setup: Setup, diameter_mm: float, tilt_deg: float, count: int = DRAWN_POSES) -> Figures:
    """The longer error of the two baselines with and without the correction; no noise."""
    truth, design = calibration_of(setup.rig), board.design(board.Config(diameter_mm=diameter_mm))
    poses = random_poses(Poses(count=count, tilt_deg=tilt_deg), design, list(truth.cameras.values()))
    seen = drawn(truth, design, poses, QUIET, np.random.default_rng(1))
    corrected = calibrate(seen.sightings, design, seen.sizes, BROWN)
    ignored = adjust(corrected.observations, corrected.adjustment.estimate, free_of(corrected))
    after, before = (baseline_error(fit.calibration, truth) for fit in (corrected.adjustment, ignored))
    return {"error_mm": after, "uncorrected_mm": before}


def free_of(result: Result) -> dict[str, tuple[str, ...]]:
    """The parameters that a calibration adjusted."""
    return free_parameters(result.observations.devices, {name: MODELS[model] for name, model in result.model.items()})


def honesty(setup: Setup) -> Figures:
    """Errors of independent calibrations over their own predictions."""
    return over_predictions(redrawn(setup))


def over_predictions(drawings: Sequence[tuple[BoardSet, Result]]) -> Figures:
    """Squared errors of parameters over their expectation, with its interval, and shares of points in their regions."""
    truth = drawings[0][0].truth
    volume = uncertainty.working_volume(truth, DEPTHS)
    squares, numbers, inside = [], [], {pair: [] for pair in PAIRS}
    for _, result in drawings:
        found = result.adjustment.calibration
        assert found.uncertainty is not None
        squares.append(squared_length(deviation(found, truth), found.uncertainty.covariance))
        numbers.append(len(found.uncertainty.names))
        for pair in PAIRS:
            inside[pair].append(inside_region(found, truth, pair, volume))
    freedom = sum(numbers)
    low, high = chi2.ppf([(1 - REGION) / 2, (1 + REGION) / 2], freedom) / freedom
    figures = {"calibrations": len(drawings), "squared_error": sum(squares) / freedom, "low": low, "high": high}
    return figures | {f"{pair[1]}_inside": float(np.mean(inside[pair])) for pair in PAIRS}


@dataclass(frozen=True)
class Remeasured:
    """A rendered scene, reconstructed with an estimated calibration."""

    measured: Array  # (m, 3) mm
    true: Array  # (m, 3) mm, of the same pixels
    metrics: Metrics


def surfaces(setup: Setup, poses: int = Poses().count) -> Figures:
    """The paper's planes and sphere through an estimated calibration."""
    found = calibrated(session(setup, poses=Poses(count=poses)))[1].adjustment.calibration
    planes = [remeasure(setup, plane.build(pose), found, seed) for seed, pose in enumerate(plane.PAPER_POSES)]
    figures: Figures = {"scale_sigma_percent": scale_sigma(found)}
    for number, result in enumerate(planes, start=1):
        figures[f"plane{number}_rms_mm"] = result.metrics["plane_plate_rms_mm"]
        figures[f"plane{number}_limit_mm"] = result.metrics["limit_rms_mm"]
        figures[f"plane{number}_scale_percent"] = scale_error(result.measured, result.true)
    together = [np.concatenate([getattr(result, name) for result in planes]) for name in ("measured", "true")]
    sphere = remeasure(setup, build_scene({"kind": "sphere"}), found, 10)
    radius = abs(sphere.metrics["sphere_sphere_radius_error_mm"])
    return figures | {"planes_scale_percent": scale_error(*together), "sphere_radius_error_mm": radius}


def remeasure(setup: Setup, scene: Scene, found: Calibration, seed: int) -> Remeasured:
    """Render a scene with the true devices, and reconstruct it with the estimated ones."""
    shot = surface_accuracy.experiment(setup.rig, scene, setup.sequences["paper_surface"], seed)
    camera, projector = found.cameras["cam1"], found.cameras["projector"]
    points = clean(triangulate(shot.found, camera, projector), camera, shot.found.modulation)
    comparison = surface_errors.compare(points.points, points.sigma, shot.truth)
    metrics = surface_errors.measure(points.points, comparison, shot.truth)
    used = surface_errors.fine_points(comparison) & comparison.interior
    return Remeasured(np.float64(points.points[used]), np.float64(shot.truth.points[used]), metrics)


def bad_board(setup: Setup) -> Figures:
    """A warped board with print errors and glare against a flat one in the same poses, taken as designed and as found."""
    flat = rendered(session(setup)).first(BENT_POSES)
    return board_shape(flat, rendered(session(setup, BENT, Poses(count=BENT_POSES))))


def board_shape(flat: BoardSet, bent: BoardSet) -> Figures:
    """Errors with a board unlike its design: taken as designed, its tolerances given, and with its shape found, as by default.

    Five coefficients a device, as a misfit of the board disturbs the choice of a lens model; `chosen` has the choice in.
    """
    known = Shape(released=False, in_plane_mm=BENT.print_error_mm, out_of_plane_mm=float(np.std(bent.points[:, 2])))
    found = {
        "flat": calibrate(flat.sightings, flat.board, flat.sizes, BROWN),
        "kept": calibrate(bent.sightings, bent.board, bent.sizes, Settings(distortion="brown", shape=known)),
        "released": calibrate(bent.sightings, bent.board, bent.sizes, BROWN),
        "chosen": calibrate(bent.sightings, bent.board, bent.sizes),
    }
    volume = uncertainty.working_volume(bent.truth, DEPTHS)
    figures: Figures = {"poses": len(bent.sightings)}
    for name, result in found.items():
        calibration = result.adjustment.calibration
        figures[f"{name}_mm"] = rms_length(point_errors(calibration, bent.truth, PAIRS[1], volume))
        figures[f"{name}_predicted_mm"] = expected_length(calibration, PAIRS[1], volume)
    ratio, excess = figures["kept_mm"] / figures["kept_predicted_mm"], figures["kept_mm"] - figures["flat_mm"]
    left = {f"{name}_left": (figures[f"{name}_mm"] - figures["flat_mm"]) / excess for name in ("released", "chosen")}
    return figures | left | {"kept_ratio": max(ratio, 1 / ratio)}


def beside_opencv(setup: Setup) -> Figures:
    """Errors of many drawn calibrations beside OpenCV's."""
    return opencv_peer.in_many_draws(redrawn(setup))


def beside_opencv_once(setup: Setup) -> Figures:
    """Errors of the rendered session's calibration beside OpenCV's."""
    return opencv_peer.in_one_render(*calibrated(session(setup)))
