"""The target's board: its white front with the print, its body behind it, and what stands in the way of either."""

from dataclasses import dataclass

import numpy as np
import trimesh
from numpy.typing import NDArray

from recon.geometry import rigid
from recon.model import circle_layout
from recon.model.rig import Target
from scenes.handheld import lofts
from scenes.handheld.mesh_parts import Part

Array = NDArray[np.float64]

CLEAR_MM = 1.0  # between a disc and what is not to cover it


@dataclass(frozen=True)
class Board:
    """The white front: a rectangle in z = 0."""

    low: tuple[float, float]  # smallest x, y, mm
    high: tuple[float, float]
    thickness: float  # mm, with the plate behind it

    @property
    def middle(self) -> Array:
        """The middle of the front : (2,) mm."""
        return (np.array(self.low) + np.array(self.high)) / 2

    @property
    def size(self) -> Array:
        """Width and height : (2,) mm."""
        return np.array(self.high) - np.array(self.low)


def draw_front(rng: np.random.Generator, target: Target, spread: float) -> tuple[Array, Array]:
    """Corners of the board's front, smallest and largest : (2,), (2,) mm, with white around each disc.

    spread : largest relative change of each side.
    """
    margin_mm = 3.0  # of white around each disc, at least
    room = target.outer_diameter_mm / 2 + margin_mm
    needed_low, needed_high = -room * np.ones(2), circle_layout.extent(target) + room
    size = np.maximum(np.array(target.board_mm) * rng.uniform(1 - spread, 1 + spread, 2), needed_high - needed_low)
    low = needed_high - size + rng.beta(1.5, 1.5, 2) * (needed_low - needed_high + size)
    return low, low + size


def build_board(rng: np.random.Generator, low: Array, high: Array, thickness_mm: tuple[float, float]) -> tuple[Board, list[Part]]:
    """The print, the board's body behind it, and perhaps a mount plate that stands out all round."""
    size = high - low
    thickness = rng.uniform(*thickness_mm)
    x, y = np.array([low[0], high[0], high[0], low[0]]), np.array([low[1], low[1], high[1], high[1]])
    front = trimesh.Trimesh(np.column_stack([x, y, np.zeros(4)]), [[0, 1, 2], [0, 2, 3]], process=False)
    middle = np.append((low + high) / 2, 0)
    sheet_mm = 0.05  # the print lies this far in front of the board's body, so that no two surfaces coincide
    solid = lofts.box([*size, thickness - sheet_mm], middle - [0, 0, (thickness + sheet_mm) / 2])
    parts = [Part("target", front, False), Part("board", solid, False)]
    total = thickness
    if rng.uniform() < 0.45:
        plate = rng.uniform(1.5, 5.0)
        grown = size + 2 * rng.uniform(-4, 4) * (rng.uniform() < 0.8)
        outline = lofts.rounded(grown, rng.uniform(0.3, 4))
        mesh = lofts.prism(outline, plate, 0.4)
        shift = middle - [0, 0, thickness + plate + 0.02] + np.append(rng.normal(0, 0.6, 2), 0)
        parts.append(Part("bracket", lofts.placed(mesh, rigid.transform(np.eye(3), shift)), False))
        total += plate
    return Board((low[0], low[1]), (high[0], high[1]), total), parts


def to_edge(board: Board, way: Array) -> float:
    """Distance from the board's middle to its edge along a direction in its plane, mm."""
    return float((board.size / 2 / np.maximum(np.abs(way[:2]), 1e-6)).min())


def beyond(board: Board, disc: Array, way: Array) -> float:
    """Distance from a disc's centre to the board's edge along an axis, mm."""
    corner = np.where(way > 0, board.high, board.low)
    return float(abs((corner - disc) @ way))


def covers(points: Array, board: Board, margin: float = 1.0) -> bool:
    """Whether any ball : (n, 4) of x, y, z, radius lies over the board's front, or pierces the board."""
    x, y, z, radius = points.T
    low, high = np.array(board.low) - margin, np.array(board.high) + margin
    over = (x > low[0] - radius) & (x < high[0] + radius) & (y > low[1] - radius) & (y < high[1] + radius)
    return bool((over & (z > -board.thickness - radius - 1)).any())


def hides(points: Array, eye: Array, discs: Array, radius: float) -> bool:
    """Whether any ball : (n, 4) of x, y, z, radius before the print covers a part of a disc, seen from an eye : (3,)."""
    before = points[(points[:, 2] > -points[:, 3]) & (points[:, 2] < eye[2] / 2)]
    nearer = (eye[2] / (eye[2] - before[:, 2]))[:, None]
    shadow = eye[:2] + nearer * (before[:, :2] - eye[:2])
    away = np.linalg.norm(shadow[:, None] - discs, axis=-1)
    return bool((away < nearer * before[:, 3:] + radius + CLEAR_MM).any())


def pierces(points: Array, board: Board) -> bool:
    """Whether any ball : (n, 4) of x, y, z, radius touches the board."""
    low, high = np.array([*board.low, -board.thickness]), np.array([*board.high, 0.0])
    away = np.maximum(np.maximum(low - points[:, :3], points[:, :3] - high), 0)
    soft = 0.6  # of a finger's radius: what gives way where it is pressed against the board
    return bool((np.linalg.norm(away, axis=1) < soft * points[:, 3]).any())


def crosses(balls: Array, views: Array, radius: float) -> bool:
    """Whether balls : (n, 4) of x, y, z, radius come nearer than a radius to lines of sight : (m, 2, 3)."""
    start, way = views[:, 0], views[:, 1] - views[:, 0]
    to_ball = balls[:, None, :3] - start
    share = np.clip((to_ball * way).sum(axis=-1) / (way**2).sum(axis=-1), 0, 1)
    away = np.linalg.norm(to_ball - share[..., None] * way, axis=-1)
    return bool((away < balls[:, 3:] + radius).any())
