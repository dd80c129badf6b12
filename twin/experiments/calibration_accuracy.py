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
from twin.experiments.table_rows import Measurement, Row, Setup
from twin.optics.light_transport import Tracing, render
from twin.optics.ray_world import move_things
from twin.optics.surface_session import Shooting, calibration_of
from twin.sensor import Exposure, auto_exposure, expose

TRACING = Tracing(samples=16, room_lux=20)
PAPER_RMS_PX = {"cam1": 0.138, "cam2": 0.151, "projector": 0.131}
DIAMETERS_MM, TILTS_DEG = (6.0, 9.0, 12.0), (0.0, 20.0, 40.0)
QUIET = {"cam1": 1e-4, "cam2": 1e-4, "projector": 1e-4}  # px, where noise is not the question
DRAWN_POSES = 20
DRAWS = 30  # calibrations whose errors are compared with the prediction

BROWN = Settings(distortion="brown")  # OpenCV's five coefficients
BENT_POSES = 16
BENT = board.Config(warp_mm=0.2, print_error_mm=0.02, roughness=0.2)


def measurements(setup: Setup) -> list[Measurement]:
    """The rows of the group, at full size."""
    return [
        lambda: against_truth(*calibrated(session(setup))),
        *(
            lambda diameter=diameter, tilt=tilt: [centre_bias(setup.rig, diameter, tilt)]
            for diameter in DIAMETERS_MM
            for tilt in TILTS_DEG
        ),
        *(
            lambda diameter=diameter, tilt=tilt: [baseline_bias(setup.rig, diameter, tilt)]
            for diameter in DIAMETERS_MM
            for tilt in TILTS_DEG[1:]
        ),
        lambda: honesty(redrawn(setup)),
        lambda: surfaces(setup, calibrated(session(setup))[1].adjustment.calibration),
        lambda: bad_board(setup),
        lambda: opencv_peer.in_many_draws(redrawn(setup)),
        lambda: opencv_peer.in_one_render(*calibrated(session(setup))),
    ]


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


def against_truth(seen: BoardSet, result: Result) -> list[Row]:
    """Row a: residuals and parameters; the limit is the prediction of detection and covariance."""
    found, what = result.adjustment.calibration, f"{len(result.observations.poses)} poses"
    rows = [
        Row(
            "a",
            f"{what}, {name}: reprojection RMS (paper: {PAPER_RMS_PX[name]})",
            rms,
            0.05,
            rms / result.adjustment.noise[name],
            "px",
        )
        for name, rms in result.rms.items()
    ]
    for name in list(found.cameras)[1:]:
        turn, shift = motion_error(found, seen.truth, name)
        sigmas = motion_sigma(found, name)
        rows.append(Row("a", f"{what}, {name} to cam1: rotation error", turn, 0.01, sigmas[0], "deg"))
        rows.append(Row("a", f"{what}, {name} to cam1: translation error", shift, 0.05, sigmas[1], "mm"))
    for name in found.cameras:
        error = focal_error(found, seen.truth, name)
        rows.append(Row("a", f"{what}, {name}: focal lengths, the larger error", error, 0.05, focal_sigma(found, name), "%"))
    return rows


def centre_bias(rig: Rig, diameter_mm: float, tilt_deg: float) -> Row:
    """Row b: how far detected centres lie from the true ones, along the direction in which the correction moves them."""
    turned = Rotation.from_euler("x", tilt_deg, degrees=True) * Rotation.from_euler("z", 90, degrees=True)
    config = board.Config(diameter_mm=diameter_mm, rotation_deg=tuple(turned.as_rotvec(degrees=True)))
    image, exposure = lit_board(rig, config)
    camera, pose, design = rig.cam1.optics.camera(), board.world_from_board(config), board.design(config)
    offsets = centre_offsets(camera, pose, design.points(), diameter_mm / 2)
    error = detect(image, design, full=2.0**exposure.bits - 1).pixels - camera.project(board.circle_centres(config))
    along = offsets / np.linalg.norm(offsets, axis=1, keepdims=True)
    before, after = (abs(float(np.nanmean((left * along).sum(axis=1)))) for left in (error, error - offsets))
    what = f"discs of {diameter_mm:g} mm, tilt {tilt_deg:g} deg: bias of corrected centres"
    return Row("b", what, after, 0.01, before, "px")


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


def baseline_bias(rig: Rig, diameter_mm: float, tilt_deg: float, count: int = DRAWN_POSES) -> Row:
    """Row b: the longer error of the two baselines without the correction; no noise."""
    truth, design = calibration_of(rig), board.design(board.Config(diameter_mm=diameter_mm))
    poses = random_poses(Poses(count=count, tilt_deg=tilt_deg), design, list(truth.cameras.values()))
    seen = drawn(truth, design, poses, QUIET, np.random.default_rng(1))
    corrected = calibrate(seen.sightings, design, seen.sizes, BROWN)
    ignored = adjust(corrected.observations, corrected.adjustment.estimate, free_of(corrected))
    after, before = (baseline_error(fit.calibration, truth) for fit in (corrected.adjustment, ignored))
    what = f"discs of {diameter_mm:g} mm, tilts up to {tilt_deg:g} deg: error of the baselines with the correction"
    return Row("b", what, after, 0.01, before, "mm")


def free_of(result: Result) -> dict[str, tuple[str, ...]]:
    """The parameters that a calibration adjusted."""
    return free_parameters(result.observations.devices, {name: MODELS[model] for name, model in result.model.items()})


def honesty(drawings: Sequence[tuple[BoardSet, Result]]) -> list[Row]:
    """Row c: errors of independent calibrations over their own predictions."""
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
    what = f"{len(drawings)} calibrations"
    ratio = sum(squares) / freedom
    rows = [
        Row("c", f"{what}: squared error of the parameters over its expectation, at least", ratio, low, 1.0, "", at_least=True),
        Row("c", f"{what}: the same, at most", ratio, high, 1.0, ""),
    ]
    for pair in PAIRS:
        share, between = float(np.mean(inside[pair])), " and ".join(pair)
        rows.append(
            Row("c", f"{what}: points of {between} in their 95 % region, at least", share, 0.90, REGION, "", at_least=True)
        )
        rows.append(Row("c", f"{what}: points of {between} in their 95 % region, at most", share, 0.98, REGION, ""))
    return rows


@dataclass(frozen=True)
class Remeasured:
    """A rendered scene, reconstructed with an estimated calibration."""

    measured: Array  # (m, 3) mm
    true: Array  # (m, 3) mm, of the same pixels
    metrics: Metrics


def surfaces(setup: Setup, found: Calibration) -> list[Row]:
    """Row d: the paper's planes and sphere through the estimated calibration."""
    planes = [remeasure(setup, plane.build(pose), found, seed) for seed, pose in enumerate(plane.PAPER_POSES)]
    rows = []
    for number, result in enumerate(planes, start=1):
        what, limit = f"plane {number} of 5, estimated calibration", result.metrics["limit_rms_mm"]
        flatness = result.metrics["plane_plate_rms_mm"]
        rows.append(Row("d", f"{what}: RMS about the fitted plane (paper: 0.101 to 0.131)", flatness, 0.06, limit, "mm"))
        rows.append(Row("d", f"{what}: error of scale", scale_error(result.measured, result.true), 0.02, scale_sigma(found), "%"))
    together = [np.concatenate([getattr(result, name) for result in planes]) for name in ("measured", "true")]
    rows.append(
        Row(
            "d", "5 planes together, estimated calibration: error of scale", scale_error(*together), 0.02, scale_sigma(found), "%"
        )
    )
    sphere = remeasure(setup, build_scene({"kind": "sphere"}), found, 10)
    radius = abs(sphere.metrics["sphere_sphere_radius_error_mm"])
    rows.append(Row("d", "sphere of 19.8 mm, estimated calibration: radius error (paper: 0.045)", radius, 0.02, None, "mm"))
    return rows


def remeasure(setup: Setup, scene: Scene, found: Calibration, seed: int) -> Remeasured:
    """Render a scene with the true devices, and reconstruct it with the estimated ones."""
    shot = surface_accuracy.experiment(setup.rig, scene, setup.sequences["paper_surface"], seed)
    camera, projector = found.cameras["cam1"], found.cameras["projector"]
    points = clean(triangulate(shot.found, camera, projector), camera, shot.found.modulation)
    comparison = surface_errors.compare(points.points, points.sigma, shot.truth)
    metrics = surface_errors.measure(points.points, comparison, shot.truth)
    used = surface_errors.fine_points(comparison) & comparison.interior
    return Remeasured(np.float64(points.points[used]), np.float64(shot.truth.points[used]), metrics)


def bad_board(setup: Setup) -> list[Row]:
    """Row e: a warped board with print errors and glare against a flat one in the same poses, taken as designed and as found."""
    flat = rendered(session(setup)).first(BENT_POSES)
    bent = rendered(session(setup, BENT, Poses(count=BENT_POSES)))
    return board_shape(flat, bent)


def board_shape(flat: BoardSet, bent: BoardSet) -> list[Row]:
    """Rows of a board unlike its design: taken as designed, its tolerances given, and with its shape found, as by default.

    Five coefficients a device, as a misfit of the board disturbs the choice of a lens model; the last row has the choice in.
    """
    known = Shape(released=False, in_plane_mm=BENT.print_error_mm, out_of_plane_mm=float(np.std(bent.points[:, 2])))
    found = {
        "flat": calibrate(flat.sightings, flat.board, flat.sizes, BROWN),
        "kept": calibrate(bent.sightings, bent.board, bent.sizes, Settings(distortion="brown", shape=known)),
        "released": calibrate(bent.sightings, bent.board, bent.sizes, BROWN),
        "chosen": calibrate(bent.sightings, bent.board, bent.sizes),
    }
    volume = uncertainty.working_volume(bent.truth, DEPTHS)
    error, predicted = {}, {}
    for name, result in found.items():
        error[name] = rms_length(point_errors(result.adjustment.calibration, bent.truth, PAIRS[1], volume))
        predicted[name] = expected_length(result.adjustment.calibration, PAIRS[1], volume)
    ratio = error["kept"] / predicted["kept"]
    left = {name: (error[name] - error["flat"]) / (error["kept"] - error["flat"]) for name in ("released", "chosen")}
    what = f"{len(bent.sightings)} poses, bent board"
    shares = f"{what}, shape released: share of the excess over a flat board that is left"
    return [
        Row("e", f"{what}: error of points over the predicted one, or its inverse", max(ratio, 1 / ratio), 2.0, 1.0, ""),
        Row("e", f"{what}: points, RMS error", error["kept"], 2 * predicted["kept"], predicted["kept"], "mm"),
        Row("e", f"{what}, shape released: points, RMS error", error["released"], error["kept"], predicted["released"], "mm"),
        Row("e", shares, left["released"], 0.5, 0.0, ""),
        Row("e", f"{shares}, lens models chosen", left["chosen"], 0.5, 0.0, ""),
    ]
