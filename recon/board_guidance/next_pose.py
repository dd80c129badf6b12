"""Where to hold the calibration board next: the pose, of many that are possible, that lowers the errors of points most."""

from collections.abc import Collection, Mapping
from dataclasses import dataclass

import numpy as np

from recon.board_guidance import pose_information
from recon.board_guidance.board_room import ALIKE_DEG, ALIKE_MM, Array, Reach, apart, candidates, outline, reach_of
from recon.board_guidance.pose_information import Knowledge
from recon.board_guidance.pose_words import placed
from recon.geometry import rigid
from recon.geometry.camera import Camera
from recon.model.boards import Board
from recon.model.calibration import Calibration
from recon.model.rig import Rig

CANDIDATES = 600  # from which the best one is chosen
NOISE_PX = {"cam1": 0.01, "cam2": 0.01, "projector": 0.01}  # of a sighting before any was measured; rendered boards have half


@dataclass(frozen=True)
class Suggestion:
    """A pose to hold the board in."""

    world_from_board: Array  # (4, 4) mm
    outline: Array  # (m, 2) px of camera 1, closed by its first point: the rectangle around the board, to be drawn over the image
    points: Array  # (n, 2) px of camera 1, of the board's points; the first one tells which way round
    words: str  # for a person, as if no board were held yet; see `pose_words.moves` for one that is
    gain: float  # relative reduction of the points' standard deviations by it
    sigma_mm: Array  # (k,) root mean square standard deviation of points so far: in the world and within a shape, a pair each


def suggest(
    calibration: Calibration | None,
    poses: Array,
    rig: Rig,
    board: Board,
    rng: np.random.Generator,
    reach: Reach | None = None,
    noise: Mapping[str, float] = NOISE_PX,
) -> Suggestion:
    """Suggest the next pose of the board.

    Parameters
    ----------
    calibration : Calibration, optional
        By the poses so far, with its covariance; if there is none yet, the rig's description stands in for it.
    poses : (p, 4, 4) mm
        `world_from_board` of those so far.
    reach : Reach, optional
        Limits of the pose; those of the rig's lenses if not given.
    noise : device -> px
        Of a sighting of a point in u and v, of each device that is to be calibrated.

    Raises
    ------
    InputError
        If the board has no room in all views, or these don't overlap.
    """
    reach = reach or reach_of(rig)
    known = knowledge(calibration, poses, rig, board, reach, noise)
    choice = candidates(board, known.cameras, reach, CANDIDATES, rng)
    choice = _unlike(choice, np.reshape(poses, (-1, 4, 4)), board)
    gains = known.gains(choice, few(board.points()))
    best = int(np.argmax(gains))
    camera = next(iter(known.cameras.values()))
    rim, points = _in_image(camera, choice[best], board)
    return Suggestion(choice[best], rim, points, placed(choice[best], board), float(gains[best]), np.sqrt(known.variances))


def knowledge(
    calibration: Calibration | None, poses: Array, rig: Rig, board: Board, reach: Reach, noise: Mapping[str, float]
) -> Knowledge:
    """Knowledge of the devices' parameters so far; see `suggest`."""
    points = board.points()
    cameras = described(rig, noise) if calibration is None else calibration.cameras
    each = {device: noise[device] * np.sqrt(len(few(points)) / len(points)) for device in cameras}
    if calibration is None:
        return pose_information.of_rig(cameras, each, np.reshape(poses, (-1, 4, 4)), few(points), reach.volume_mm)
    return pose_information.of_calibration(calibration, each, reach.volume_mm)


def described(rig: Rig, names: Collection[str]) -> dict[str, Camera]:
    """The devices of these names as the rig's description has them, camera 1 first."""
    optics = {"cam1": rig.cam1.optics, "cam2": rig.cam2.optics, "projector": rig.projector.optics}
    return {name: one.camera() for name, one in optics.items() if name in names}


def _unlike(choice: Array, poses: Array, board: Board) -> Array:
    """Those of poses : (m, 4, 4) to choose from that are unlike all earlier ones : (p, 4, 4), though held a little off."""
    apart_mm, apart_deg = apart(choice, poses, board)
    off = 2.5  # times the distance of poses that are alike: that of asked poses from earlier ones
    new = ((apart_mm > off * ALIKE_MM) | (apart_deg > off * ALIKE_DEG)).all(axis=1)
    return choice[new] if new.any() else choice


def few(points: Array) -> Array:
    """Points : (m, 3) mm that stand for all of a board : (n, 3) mm, evenly chosen; all of a small one."""
    few_points = 24  # of a board: so many stand for all of a larger one
    return points[np.unique(np.linspace(0, len(points) - 1, min(few_points, len(points))).round().astype(int))]


def _in_image(camera: Camera, pose: Array, board: Board) -> tuple[Array, Array]:
    """A board's outline : (m, 2) px, closed, and its points : (n, 2) px in a camera's image."""
    rim = camera.project(rigid.apply(pose, outline(board)))
    return np.concatenate([rim, rim[:1]]), camera.project(rigid.apply(pose, board.points()))
