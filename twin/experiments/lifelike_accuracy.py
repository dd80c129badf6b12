"""The optics' whole way under conditions of life, by our method and by the paper's, and each condition's share in the figures.

The paper's method: pairs of devices calibrated apart by OpenCV with five coefficients each, on a board taken as designed, from
the middles of ellipses as they are; and the phase of fringe images as they are.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from recon.model.patterns import Patterns
from recon.model.rig import Rig
from recon.optical_calibration import figures_of_merit
from recon.optical_calibration.joint_calibration import calibrate
from scenes.board_poses import Config as Poses
from scenes.board_poses import random_poses
from scenes.kinds import board, plane, sphere
from twin import board_session
from twin.conditions import BoardPrint, drifted, flexed, printed_board
from twin.evaluation.surface_errors import rms
from twin.experiments import board_accuracy, lens_accuracy, paper_causes, surface_accuracy
from twin.experiments.baselines import opencv_peer
from twin.experiments.board_sets import BoardSet, drawn, rendered
from twin.experiments.plane_and_sphere import Measured, as_published, conditions_of, measured
from twin.experiments.surface_accuracy import Experiment
from twin.experiments.table_rows import Measurement, Row, Setup
from twin.optics.surface_session import Shooting, calibration_of
from twin.working_range import working_range

Array = NDArray[np.float64]

SEEDS = range(300, 310)  # of laboratories that nothing was tried on
COUNT = 12  # poses of the board
PAPER_PX = {"cam1": 0.138, "cam2": 0.151, "projector": 0.131}
PAPER_PLANE_MM, PAPER_SPHERE_MM = (0.101, 0.131), (0.045, 0.040)  # RMS; radius error and RMS
FACTOR = 1.5  # between the paper's figures and those of its method here


@dataclass(frozen=True)
class Laboratory:
    """One seed: a board, its calibrations, and what they measure."""

    squared: float  # error of our calibration's parameters over its expectation, a parameter
    ours: Measured
    paper: Measured
    ours_px: Mapping[str, float]  # device: reprojection RMS
    paper_px: Mapping[str, float]
    limit_mm: tuple[float, float]  # RMS of plane and sphere that the sensor's noise leaves


def measurements(setup: Setup) -> list[Measurement]:
    """The rows of the group, at full size."""
    return [
        lambda: board_accuracy.rows(setup),
        lens_accuracy.rows,
        lambda: rows(setup),
        lambda: shares(setup),
        lambda: paper_causes.rows(setup),
    ]


def rows(setup: Setup) -> list[Row]:
    """Rows g and h: planes and a sphere by both methods, and the reprojection by the paper's."""
    patterns = setup.sequences["paper_surface"]
    found = [laboratory(session(setup, seed), patterns) for seed in SEEDS]
    ours, paper = ([getattr(one, name) for one in found] for name in ("ours", "paper"))
    what = f"{len(found)} laboratories, {COUNT} poses"
    squared = float(np.mean([one.squared for one in found]))
    planes, spheres = (float(np.mean([getattr(one, name) for one in paper])) for name in ("plane_rms_mm", "sphere_rms_mm"))
    rows = [
        Row("g", f"{what}: planes, RMS, largest", max(one.plane_rms_mm for one in ours), 0.045, None, "mm"),
        Row("g", f"{what}: planes, form, largest", max(one.form_mm for one in ours), 0.01, None, "mm"),
        Row("g", f"{what}: sphere, radius error, largest", max(abs(one.radius_error_mm) for one in ours), 0.02, None, "mm"),
        Row("g", f"{what}: squared error of parameters over its expectation, at least", squared, 0.8, 1.0, "", at_least=True),
        Row("g", f"{what}: the same, at most", squared, 1.25, 1.0, ""),
    ]
    for name, published in PAPER_PX.items():
        px = float(np.mean([one.paper_px[name] for one in found]))
        rows += _beside(f"{what}, the paper's method, {name}: reprojection RMS (paper: {published:g}), mean", px, published, "px")
    middle = float(np.mean(PAPER_PLANE_MM))
    rows += _beside(f"{what}, the paper's method: planes, RMS (paper: 0.101 to 0.131), mean", planes, middle, "mm")
    radius = float(np.mean([abs(one.radius_error_mm) for one in paper]))
    rows += _beside(f"{what}, the paper's method: sphere, radius error (paper: 0.045), mean", radius, PAPER_SPHERE_MM[0], "mm")
    rows += _beside(f"{what}, the paper's method: sphere, RMS (paper: 0.04), mean", spheres, PAPER_SPHERE_MM[1], "mm")
    return rows


def laboratory(session: board_session.Settings, patterns: Patterns) -> Laboratory:
    """Render a board, a plane and a sphere in one laboratory, and measure them by both methods.

    session : the board, with the seed and the conditions of all
    patterns : over plane and sphere
    """
    seen = rendered(session)
    observations = (result := calibrate(seen.sightings, seen.board, seen.sizes)).observations
    pair = opencv_peer.stereo(observations, "projector", np.zeros_like(observations.pixels))
    shots = shoot(session, patterns)
    reprojected = {name: opencv_peer.reprojection_rms(observations, name) for name in PAPER_PX}
    ours = result.adjustment.calibration
    squared = figures_of_merit.normalised_error(ours, seen.truth) ** 2
    flat, ball = (as_published(shot, patterns) for shot in shots)
    limits = shots[0].metrics["plane_plate_limit_rms_mm"], shots[1].metrics["sphere_sphere_limit_rms_mm"]
    return Laboratory(squared, measured(shots, ours), measured((flat, ball), pair), result.rms, reprojected, limits)


def session(setup: Setup, seed: int) -> board_session.Settings:
    """A board in the hands of one laboratory."""
    return board_session.Settings(
        setup.rig,
        board.Config(),
        Poses(count=COUNT, seed=seed),
        setup.sequences["paper_calibration"],
        board_session.CAMERAS,
        surface_accuracy.TRACING,
        Shooting(),
        seed,
        conditions_of(setup),
    )


def shoot(session: board_session.Settings, patterns: Patterns) -> tuple[Experiment, Experiment]:
    """A plane and a sphere, rendered by devices that have drifted since they were calibrated, and decoded."""
    seed, life = session.seed, session.conditions
    where, ball = working_range(session.rig), sphere.Config()
    pose = where.plate(plane.PAPER_POSES[seed % len(plane.PAPER_POSES)])
    behind = None if ball.background_mm is None else where.depth(ball.background_mm)
    moved = ball.model_copy(update={"centre_mm": where.place(*ball.centre_mm), "background_mm": behind})
    scenes = plane.build(pose), sphere.build(moved)
    rig = drifted(session.rig, life.drift, seed)
    first, second = (
        surface_accuracy.experiment(rig, scene, patterns, seed, session.tracing, session.shooting, life) for scene in scenes
    )
    return first, second


def shares(setup: Setup) -> list[Row]:
    """Row h: each condition of the board alone, and all together: reprojection by the paper's method, form by both."""
    errors, rows, truth = conditions_of(setup).board, [], calibration_of(setup.rig)
    alone = {field: BoardPrint(**{field: getattr(errors, field)}) for field in BoardPrint.model_fields if field != "diameter_mm"}
    for name, chosen in {"flat, exact board": BoardPrint(), **alone, "all of them": errors}.items():
        kinds = [sighted(setup.rig, chosen, seed) for seed in SEEDS]
        ours, paper, px = [], [], []
        for seen in kinds:
            result = calibrate(seen.sightings, seen.board, seen.sizes)
            pair = opencv_peer.stereo(result.observations, "projector", np.zeros_like(result.observations.pixels))
            px.append(opencv_peer.reprojection_rms(result.observations, "cam1"))
            ours.append(board_accuracy.form(result.adjustment.calibration, truth))
            paper.append(board_accuracy.form(pair, truth))
        what = f"board: {name}, the paper's method"
        rows.append(Row("h", f"{what}: camera 1, reprojection RMS (paper: 0.138)", rms(np.array(px)), None, None, "px"))
        rows.append(Row("h", f"{what}: form of planes (limit: ours)", rms(np.array(paper)), None, rms(np.array(ours)), "mm"))
    return rows


def sighted(rig: Rig, errors: BoardPrint, seed: int) -> BoardSet:
    """Sightings of a board, drawn with the noise of rendered ones."""
    truth, design = calibration_of(rig), board.design(board.Config())
    poses = random_poses(Poses(count=COUNT, seed=seed), design, list(truth.cameras.values()))
    printed = printed_board(board.Config(), errors, seed)
    points = np.stack([board.printed_centres(flexed(printed, errors, seed, k)) for k in range(COUNT)])
    return drawn(truth, design, poses, board_accuracy.NOISE_PX, np.random.default_rng([seed, 6]), points)


def _beside(what: str, found: float, published: float, unit: str) -> list[Row]:
    """A figure of the paper's method, not further from the published one than by a factor."""
    return [
        Row("h", f"{what}, at least", found, published / FACTOR, published, unit, at_least=True),
        Row("h", f"{what}, at most", found, published * FACTOR, published, unit),
    ]
