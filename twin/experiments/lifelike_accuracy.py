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
from twin.experiments import board_accuracy, surface_accuracy
from twin.experiments.baselines import opencv_peer
from twin.experiments.board_sets import BoardSet, drawn, rendered
from twin.experiments.experiment_setup import Figures, Setup
from twin.experiments.plane_and_sphere import Measured, as_published, measured
from twin.experiments.surface_accuracy import Experiment
from twin.optics.surface_session import Shooting, calibration_of
from twin.working_range import working_range

Array = NDArray[np.float64]

SEEDS = range(300, 310)  # unseen seeds of laboratories
COUNT = 12  # poses of the board
DEVICES = ("cam1", "cam2", "projector")


@dataclass(frozen=True)
class Laboratory:
    """One seed: a board, its calibrations, and what they measure."""

    squared: float  # error of our calibration's parameters over its expectation, a parameter
    ours: Measured
    paper: Measured
    ours_px: Mapping[str, float]  # device: reprojection RMS
    paper_px: Mapping[str, float]
    limit_mm: tuple[float, float]  # RMS of plane and sphere that the sensor's noise leaves


def laboratories(setup: Setup) -> Figures:
    """Planes and a sphere by both methods, and the reprojection by the paper's."""
    found = [laboratory(session(setup, seed), setup.sequences["paper_surface"]) for seed in SEEDS]
    figures: Figures = {"laboratories": len(found), "poses": COUNT, "squared": np.mean([one.squared for one in found])}
    for name in ("plane_rms_mm", "form_mm", "radius_error_mm", "sphere_rms_mm"):
        ours, paper = (
            np.abs([getattr(by, name) for by in of]) for of in ([one.ours for one in found], [one.paper for one in found])
        )
        figures |= {f"{name}_largest": ours.max(), f"{name}_paper": paper.mean()}
    return figures | {f"{name}_paper_px": np.mean([one.paper_px[name] for one in found]) for name in DEVICES}


def laboratory(session: board_session.Settings, patterns: Patterns) -> Laboratory:
    """Render a board, a plane and a sphere in one laboratory, and measure them by both methods.

    session : the board, with the seed and the conditions of all
    patterns : over plane and sphere
    """
    seen = rendered(session)
    observations = (result := calibrate(seen.sightings, seen.board, seen.sizes)).observations
    pair = opencv_peer.stereo(observations, "projector", np.zeros_like(observations.pixels))
    shots = shoot(session, patterns)
    reprojected = {name: opencv_peer.reprojection_rms(observations, name) for name in DEVICES}
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
        setup.conditions("lifelike"),
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


def shares(setup: Setup, cause: str) -> Figures:
    """Reprojection by the paper's method, and form by both, of boards of one condition alone, of none, or of all together."""
    errors, truth = setup.conditions("lifelike").board, calibration_of(setup.rig)
    alone = {field: BoardPrint(**{field: getattr(errors, field)}) for field in BoardPrint.model_fields}
    chosen = ({"flat, exact board": BoardPrint(), "all of them": errors} | alone)[cause]
    ours, paper, px = [], [], []
    for seed in SEEDS:
        seen = sighted(setup.rig, chosen, seed)
        result = calibrate(seen.sightings, seen.board, seen.sizes)
        pair = opencv_peer.stereo(result.observations, "projector", np.zeros_like(result.observations.pixels))
        px.append(opencv_peer.reprojection_rms(result.observations, "cam1"))
        ours.append(board_accuracy.form(result.adjustment.calibration, truth))
        paper.append(board_accuracy.form(pair, truth))
    return {"paper_px": rms(np.array(px)), "paper_form_mm": rms(np.array(paper)), "our_form_mm": rms(np.array(ours))}


def sighted(rig: Rig, errors: BoardPrint, seed: int) -> BoardSet:
    """Sightings of a board, drawn with the noise of rendered ones."""
    truth, design = calibration_of(rig), board.design(board.Config())
    poses = random_poses(Poses(count=COUNT, seed=seed), design, list(truth.cameras.values()))
    printed = printed_board(board.Config(), errors, seed)
    points = np.stack([board.printed_centres(flexed(printed, errors, seed, k)) for k in range(COUNT)])
    return drawn(truth, design, poses, board_accuracy.NOISE_PX, np.random.default_rng([seed, 6]), points)
