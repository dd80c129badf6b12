"""Accuracy of calibrations from guided poses of the board: a dozen beside two dozen random ones."""

from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from time import perf_counter
from typing import Literal, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from recon.board_guidance.board_room import fits, middle, middles, reach_of
from recon.board_guidance.next_pose import suggest
from recon.board_guidance.pose_progress import SoFar
from recon.board_guidance.pose_verdict import Observation, judge
from recon.geometry import rigid
from recon.geometry.camera import Array
from recon.model.calibration import Calibration
from recon.model.rig import Rig
from recon.optical_calibration import uncertainty
from recon.optical_calibration.joint_calibration import Settings, calibrate
from recon.optical_calibration.sightings import Sighting
from scenes.board_poses import Config as Poses
from scenes.board_poses import random_poses
from scenes.kinds import board
from twin import conditions
from twin.conditions import BoardPrint
from twin.experiments.board_sets import drawn
from twin.experiments.calibration_errors import DEPTHS, PAIRS, point_errors, rms_length
from twin.experiments.experiment_setup import Figures, Setup
from twin.optics.surface_session import calibration_of

GUIDED, RANDOM = 12, 24  # poses
SEEDS = range(16)  # eight alone scatter by 0.03
HELD_MM, HELD_DEG = 15.0, 8.0  # by which a person misses the asked pose, in any direction
NOISE = {"cam1": 0.004, "cam2": 0.004, "projector": 0.003}  # px, of rendered boards
TRIES = 200  # of a person, for a pose
FARTHER = (1.0, 2.0, 4.0)  # times as far off, where there is no room nearer
STEADY = 0.05  # times as far off, of a robot that holds the board


class Session(NamedTuple):
    """A laboratory's board, and the noise of one calibration."""

    rig: Rig
    errors: BoardPrint  # of the board
    seed: int
    missed: float = 1.0  # times HELD_MM and HELD_DEG, by which asked poses are missed

    @property
    def truth(self) -> Calibration:
        """The devices."""
        return calibration_of(self.rig)

    def sighting(self, pose: Array, number: int) -> Sighting:
        """What the detectors find of the board in one pose."""
        printed = conditions.printed_board(board.Config(), self.errors, self.seed)
        points = board.printed_centres(conditions.flexed(printed, self.errors, self.seed, number))
        rng = np.random.default_rng([self.seed, number, 31])
        seen = drawn(self.truth, board.design(board.Config()), pose[None], NOISE, rng, points[None])
        return replace(seen.sightings[0], name=f"{number:02d}")


class Guided(NamedTuple):
    """Sightings under guidance, and its course."""

    sightings: tuple[Sighting, ...]
    refused: int  # poses that were held and judged, and not kept
    seconds: tuple[float, ...]  # from a pose that is held to the next that is asked for


class Errors(NamedTuple):
    """Root mean squares over a volume and both pairs of devices, mm."""

    error: float  # of points in the world
    error_within: float  # of points within a shape
    predicted: float
    predicted_within: float


def against_random(setup: Setup, life: Literal["ideal", "lifelike"]) -> Figures:
    """Errors of points after guided poses over those after twice as many random ones; `steady`: poses held as asked."""
    errors = setup.conditions(life).board
    sessions = [Session(setup.rig, errors, seed) for seed in SEEDS]
    steady = [session._replace(missed=STEADY) for session in sessions]
    few, best = (over_seeds([figures(by_guidance(session), session) for session in each]) for each in (sessions, steady))
    many = over_seeds([figures(by_chance(session), session) for session in sessions])
    ratios = {"guided": GUIDED, "random": RANDOM}
    for ending, ours in (("", few), ("_steady", best)):
        ratios |= {f"{name}{ending}": mine / theirs for name, mine, theirs in zip(Errors._fields, ours, many, strict=True)}
    return ratios


def tries(setup: Setup) -> Figures:
    """The patience that a person needs: poses held for each that is kept."""
    refused = [guided(Session(setup.rig, BoardPrint(), seed)).refused for seed in SEEDS]
    return {"tries": 1 + np.mean(refused) / GUIDED, "held_mm": HELD_MM, "held_deg": HELD_DEG}


def by_guidance(session: Session) -> tuple[Sighting, ...]:
    """Sightings in guided poses."""
    return guided(session).sightings


def by_chance(session: Session) -> tuple[Sighting, ...]:
    """Sightings in random poses."""
    design = board.design(board.Config())
    poses = random_poses(Poses(count=RANDOM, seed=100 + session.seed), design, list(session.truth.cameras.values()))
    return tuple(session.sighting(pose, number) for number, pose in enumerate(poses))


@cache
def guided(session: Session) -> Guided:
    """Hold the board where it is asked for, as well as a person can, until enough poses are kept."""
    rng, design = np.random.default_rng([session.seed, 32]), board.design(board.Config())
    so_far, refused, seconds = SoFar(session.rig, design), 0, []
    asked = suggest(None, so_far.poses, session.rig, design, rng)
    while len(so_far.sightings) < GUIDED:
        pose = held_about(asked.world_from_board, session, rng)
        seen = Observation(session.sighting(pose, len(so_far.sightings)), asked_gain=asked.gain)
        start = perf_counter()
        verdict = judge(seen, so_far)
        so_far, refused = verdict.so_far, refused + (not verdict.accepted)
        asked = suggest(so_far.calibration, so_far.poses, session.rig, design, rng, noise=so_far.noise)
        seconds.append(perf_counter() - start)
    return Guided(so_far.sightings, refused, tuple(seconds))


def held_about(asked: Array, session: Session, rng: np.random.Generator) -> Array:
    """A pose near the one asked for, in which all devices see the board: a preview shows where they don't.

    Where the devices are hardly known yet, a pose may be asked for of which they see too little: then one farther off is held.
    """
    design, limits = board.design(board.Config()), reach_of(session.rig)
    at = middles(asked[None], design)[0]
    for farther in np.repeat([session.missed, *FARTHER], TRIES):
        shift, turn = (
            farther * size * axis / np.linalg.norm(axis)
            for size, axis in zip((HELD_MM, np.deg2rad(HELD_DEG)), rng.standard_normal((2, 3)), strict=True)
        )
        turned = Rotation.from_rotvec(turn).as_matrix() @ asked[:3, :3]
        pose = rigid.transform(turned, at + shift - turned @ middle(design))
        if fits(pose[None], design, session.truth.cameras, limits)[0]:
            return pose
    raise RuntimeError(f"expected room about the pose asked for, found none within {FARTHER[-1] * HELD_MM:.0f} mm")


def figures(sightings: Sequence[Sighting], session: Session) -> Errors:
    """Calibrate as the command does, and compare with the truth."""
    design, truth = board.design(board.Config()), session.truth
    sizes = {name: camera.size for name, camera in truth.cameras.items()}
    found = calibrate(sightings, design, sizes, Settings(distortion="brown")).adjustment.calibration
    volume = uncertainty.working_volume(truth, DEPTHS)
    errors = [point_errors(found, truth, pair, volume) for pair in PAIRS]
    predicted = [uncertainty.triangulation(found, *pair, volume) for pair in PAIRS]
    predicted_within = [uncertainty.shape(found, *pair, volume, volume) for pair in PAIRS]
    return Errors(
        rms_length(np.concatenate(errors)),
        rms_length(np.concatenate([within_shape(error, volume) for error in errors])),
        *(float(np.sqrt(np.trace(np.concatenate(each), axis1=1, axis2=2).mean())) for each in (predicted, predicted_within)),
    )


def within_shape(errors: Array, volume: Array) -> Array:
    """Errors : (k, 3) mm of a volume's points, less the rigid motion that explains most of them."""
    modes = uncertainty.rigid_modes(volume).reshape(-1, 6)
    return errors - (modes @ np.linalg.lstsq(modes, errors.ravel(), rcond=None)[0]).reshape(-1, 3)


def over_seeds(each: Sequence[Errors]) -> Errors:
    """Root mean squares over several calibrations."""
    return Errors(*np.sqrt(np.mean(np.square(each), axis=0)).tolist())
