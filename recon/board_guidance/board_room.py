"""Room for the calibration board: the poses in which all devices see the whole of it, sharp and not too oblique."""

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import AfterValidator, Field
from scipy.spatial.transform import Rotation

from recon.errors import InputError
from recon.geometry.camera import Camera
from recon.model.boards import Board
from recon.model.rig import Lens, NotNegative, Optics, Part, Positive, Rig

Array = NDArray[np.float64]

BLUR_PX = {"camera": 2.5, "projector": 5.0}  # disc of a point out of focus; the paper's fringes have 2.3 to 5.2 (conf/rig)
SHARP_PX = {"camera": 1.0, "projector": 5.0}  # where things are measured, not just calibrated
FARTHEST = 3.0  # times the distance in focus, however small the aperture
LEVELS = 3  # of distance: both ends of the reach tell most, and the middle
ALIKE_MM, ALIKE_DEG = 10.0, 4.0  # from an earlier pose: what isn't noise, as the board's bend, errs in the same way there
BATCH, BATCHES = 1000, 20  # places drawn at once, and times at most


def _near_to_far(depths: tuple[float, float]) -> tuple[float, float]:
    if depths[0] >= depths[1]:
        raise ValueError(f"expected the nearest depth, then a farther one, found {depths[0]:g} and {depths[1]:g}")
    return depths


Depths = Annotated[tuple[Positive, Positive], AfterValidator(_near_to_far)]  # nearest and farthest, mm
Angle = Annotated[float, Field(ge=0, lt=90)]


class PoseLimits(Part):
    """Limits of poses, as a person gives them."""

    depth_mm: Depths | None = None
    """[nearest, farthest] mm, z of the board's middle; null: where all lenses are sharp enough, by the rig"""
    volume_mm: Depths | None = None
    """[nearest, farthest] mm, z of what will be measured, whose errors count; null: in focus"""
    tilt_deg: Angle = 40.0
    """deg, largest angle between the board's normal and camera 1's axis"""
    oblique_deg: Angle = 60.0
    """deg, largest angle between the board's normal and any device's view of it"""
    margin_px: NotNegative = 10.0
    """px, that the board keeps from every image's border"""


@dataclass(frozen=True)
class Reach:
    """Limits of poses that a person may be asked for; see `PoseLimits`."""

    depth_mm: tuple[float, float]
    volume_mm: tuple[float, float]
    tilt_deg: float
    oblique_deg: float
    margin_px: float


def reach_of(rig: Rig, limits: PoseLimits | None = None) -> Reach:
    """The limits that are given, and where none are those that a rig's lenses set: depths at which all of them are sharp enough.

    Raises
    ------
    InputError
        If a depth isn't given, and there is none at which all lenses are sharp.
    """
    limits = limits or PoseLimits()
    depth = limits.depth_mm or _sharp_depths(rig, BLUR_PX, "depth_mm")
    volume = limits.volume_mm or _sharp_depths(rig, SHARP_PX, "volume_mm")
    return Reach(depth, volume, limits.tilt_deg, limits.oblique_deg, limits.margin_px)


def _sharp_depths(rig: Rig, blur_px: Mapping[str, float], field: str) -> tuple[float, float]:
    """Nearest and farthest distance, mm, at which no device's discs of confusion are larger than those given.

    A thin lens of aperture A and focal length f px makes discs of `A f |1/z - 1/focus|` px.
    """
    parts: list[tuple[Optics, Lens, float]] = [
        (rig.cam1.optics, rig.cam1.lens, blur_px["camera"]),
        (rig.cam2.optics, rig.cam2.lens, blur_px["camera"]),
        (rig.projector.optics, rig.projector.lens, blur_px["projector"]),
    ]
    nearest, farthest = 0.0, np.inf
    for optics, lens, most in parts:
        change = most / (lens.aperture_mm * optics.focal_px[0])  # 1/mm
        nearest = max(nearest, 1 / (1 / lens.focus_mm + change))
        farthest = min(farthest, 1 / max(1 / lens.focus_mm - change, 1 / (FARTHEST * lens.focus_mm)))
    if nearest >= farthest:
        raise InputError(
            f"rig: expected a depth at which all lenses are sharp, found none (focus_mm {rig.cam1.lens.focus_mm:g}, "
            f"{rig.cam2.lens.focus_mm:g}, projector {rig.projector.lens.focus_mm:g}); correct these, or give reach.{field}"
        )
    return float(nearest), float(farthest)


def outline(board: Board) -> Array:
    """The rectangle around all of a board's discs or squares : (4 STEPS, 3) mm in the board's frame, from its first corner on."""
    points = board.points()[:, :2]
    low, high = points.min(axis=0) - board.rim_mm, points.max(axis=0) + board.rim_mm
    corners = np.array([low, (high[0], low[1]), high, (low[0], high[1]), low])
    steps = 8  # points a side of an outline: lenses bend it
    along = np.arange(steps)[:, None] / steps
    sides = [start + along * (end - start) for start, end in pairwise(corners)]
    return np.pad(np.concatenate(sides), ((0, 0), (0, 1)))


def middle(board: Board) -> Array:
    """The middle of a board's points : (3,) mm, in the board's frame."""
    points = board.points()
    return (points.min(axis=0) + points.max(axis=0)) / 2


def fits(poses: Array, board: Board, cameras: Mapping[str, Camera], reach: Reach) -> NDArray[np.bool_]:
    """Whether all devices see the whole board, from its front, in poses `world_from_board` : (p, 4, 4); as (p,)."""
    rim = outline(board) @ poses[:, :3, :3].swapaxes(1, 2) + poses[:, None, :3, 3]
    at, good = middles(poses, board), np.ones(len(poses), bool)
    for camera in cameras.values():
        pixels, low, high = camera.project(rim), reach.margin_px, np.array(camera.size) - 1 - reach.margin_px
        with np.errstate(invalid="ignore"):
            good &= ((pixels >= low) & (pixels <= high)).all(axis=(1, 2))
        sight = at - camera.centre
        facing = np.einsum("pi,pi->p", sight, poses[:, :3, 2]) / np.linalg.norm(sight, axis=1)
        good &= facing > np.cos(np.deg2rad(reach.oblique_deg))
    return good


def middles(poses: Array, board: Board) -> Array:
    """The middle of the board in the world : (p, 3) mm."""
    return poses[:, :3, :3] @ middle(board) + poses[:, :3, 3]


def apart(first: Array, second: Array, board: Board) -> tuple[Array, Array]:
    """Distances of the board's middles, mm, and angles, deg, between poses : (p, 4, 4) and (q, 4, 4), both as (p, q)."""
    shift = middles(first, board)[:, None] - middles(second, board)
    trace = np.einsum("pij,qij->pq", first[:, :3, :3], second[:, :3, :3])
    return np.linalg.norm(shift, axis=-1), np.rad2deg(np.arccos(np.clip((trace - 1) / 2, -1, 1)))


def candidates(board: Board, cameras: Mapping[str, Camera], reach: Reach, count: int, rng: np.random.Generator) -> Array:
    """Draw poses `world_from_board` : (m, 4, 4), m <= count, that a person can be asked for.

    The board stands upright or across, tilted to one of eight directions, at one of a few distances, anywhere in camera 1's view.

    Raises
    ------
    InputError
        If the board has no room in all views.
    """
    found: list[Array] = []
    for _ in range(BATCHES):
        poses = _draw(board, next(iter(cameras.values())), reach, rng)
        found.append(poses[fits(poses, board, cameras, reach)])
        if sum(map(len, found)) >= count:
            break
    if not any(map(len, found)):
        near, far = reach.depth_mm
        raise InputError(
            f"board: expected room for it in the views of {', '.join(cameras)} between {near:.0f} and {far:.0f} mm, found none: "
            "a smaller board, other depths (reach.depth_mm), or devices that are turned to each other"
        )
    return np.concatenate(found)[:count]


def _draw(board: Board, camera: Camera, reach: Reach, rng: np.random.Generator) -> Array:
    """Poses : (BATCH, 4, 4) whose middle lies in a camera's view."""
    depth = rng.choice(np.linspace(*reach.depth_mm, LEVELS), BATCH)
    rays = camera.rays(rng.uniform(size=(BATCH, 2)) * (np.array(camera.size) - 1.0))
    at = camera.centre + rays * ((depth - camera.centre[2]) / rays[:, 2])[:, None]
    ways = 8  # directions to tilt to
    turn, way = np.pi / 2 * rng.integers(2, size=BATCH), 2 * np.pi / ways * rng.integers(ways, size=BATCH)
    full = 0.5  # share of candidates that are tilted as far as allowed; the rest half as much, or not at all
    share = rng.choice([1.0, 0.5, 0.0], BATCH, p=[full, (1 - full) / 2, (1 - full) / 2])
    tilt = np.deg2rad(reach.tilt_deg) * share
    none = np.zeros(BATCH)
    tilts = Rotation.from_rotvec(tilt[:, None] * np.column_stack([np.cos(way), np.sin(way), none]))
    turned = (tilts * Rotation.from_rotvec(np.column_stack([none, none, turn]))).as_matrix()
    poses = np.zeros((BATCH, 4, 4))
    poses[:, :3, :3], poses[:, :3, 3], poses[:, 3, 3] = turned, at - turned @ middle(board), 1
    return poses
