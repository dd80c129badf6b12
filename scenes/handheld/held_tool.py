"""A tool in a hand: a steel shaft in a handle, the target's board on a bracket at its rear, and a hand that pinches it."""

from abc import abstractmethod
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, field_validator
from scipy.spatial.transform import Rotation
from trimesh import Trimesh

from recon.geometry import rigid
from recon.model import circle_layout
from recon.model.rig import Target, Vector
from scenes.handheld import hand as hands
from scenes.handheld import lofts
from scenes.handheld.body_look import Look, Stand, board_of
from scenes.handheld.mesh_parts import Part
from scenes.handheld.target_board import hides, pierces

Array = NDArray[np.float64]

THICKNESS_MM = 4.0  # of the board
HANDLE_MM, RADIUS_MM = 90.0, 8.0  # length and radius of the handle
BELOW_MM = 8.0  # from the board's back to the handle's rear end
GRIPPED = 0.8  # of the handle, where thumb and index hold it
TRIES = 80  # of a hand that leaves the circles free


class HeldTool(Look):
    """A straight tool in a hand."""

    IN_A_HAND = True
    length_mm: Annotated[float, Field(ge=10, le=400)] = 90.0
    """from the handle to the tip"""
    direction: Vector = (0.0, -0.66, -0.75)
    """from the handle to the tip, in the target's frame; behind the board's face"""

    @field_validator("direction")
    @classmethod
    def _behind_the_face(cls, value: Vector) -> Vector:
        length = float(np.linalg.norm(value))
        if not length or value[2] / length > -0.2:
            raise ValueError(
                f"expected one that leads behind the board's face, z at most -0.2 of its length, found {list(value)}"
            )
        return value

    def axis(self, target: Target) -> tuple[Array, Array]:
        """Rear end : (3,) mm of the handle, and direction : (3,) to the tip."""
        along = lofts.unit(self.direction)
        across = along[:2] / max(float(np.linalg.norm(along[:2])), 1e-9)
        start = circle_layout.middle(target)[:2] + 0.15 * min(target.board_mm) * across
        return np.append(start, -THICKNESS_MM - BELOW_MM - RADIUS_MM), along

    def tip_mm(self, target: Target) -> Array:
        """The tip : (3,) mm in the target's frame."""
        start, along = self.axis(target)
        return start + (HANDLE_MM + self.length_mm) * along

    def line_mm(self, target: Target) -> Array:
        """The shaft's ends : (2, 3) mm."""
        start, along = self.axis(target)
        return np.stack([start + HANDLE_MM * along, self.tip_mm(target)])

    def parts(self, rng: np.random.Generator, target: Target, stand: Stand) -> tuple[Part, ...]:
        """Board, bracket, handle, shaft, and the hand; none where no hand is found that leaves the circles free."""
        board, parts = board_of(rng, target, (THICKNESS_MM, THICKNESS_MM))
        start, along = self.axis(target)
        to_handle = lofts.frame(start, along)
        clamp = lofts.prism(lofts.superellipse([RADIUS_MM + 3.5] * 2, 3, 40), 16, 0.8)
        parts.append(Part("bracket", lofts.placed(clamp, to_handle @ rigid.transform(np.eye(3), [0, 0, 6])), True))
        below = np.append(board.middle, -board.thickness)
        arm = lofts.strut(below - [0, 0, 4], start + 14 * along, 4.5)
        block = lofts.prism(lofts.rounded([24, 20], 1.5, 3), 6, 0.5)
        parts.append(Part("bracket", arm, True))
        parts.append(Part("bracket", lofts.placed(block, rigid.transform(np.eye(3), below - [0, 0, 5.8])), False))
        grey = float(rng.uniform(0.12, 0.7))  # of the handle's plastic
        parts += [tinted("probe", lofts.placed(mesh, to_handle), shade) for mesh, shade in _handle(grey)]
        parts += self.steel(start + HANDLE_MM * along, along)
        discs, radius = circle_layout.circle_centres(target)[:, :2], target.outer_diameter_mm / 2

        def in_the_way(balls: Array) -> bool:
            return pierces(balls, board) or any(hides(balls, eye, discs, radius) for eye in stand.eyes)

        for _ in range(TRIES):
            skeleton = _pinching(rng, start, along, stand.away)
            if not in_the_way(_balls(skeleton)):
                return (*parts, *hands.clothed(rng, skeleton))
        return tuple(parts)

    @abstractmethod
    def steel(self, start: Array, along: Array) -> list[Part]:
        """The shaft, from the handle's front on."""


def open_side(along: Array, turn_deg: float) -> Array:
    """Direction : (3,) across a shaft that leans to the board's face, turned about the shaft."""
    up = np.array([0.0, 0.0, 1.0]) - along[2] * along
    length = np.linalg.norm(up)
    up = up / length if length > 1e-6 else np.array([1.0, 0.0, 0.0])
    return Rotation.from_rotvec(np.deg2rad(turn_deg) * along).apply(up)


def tinted(slot: str, mesh: Trimesh, reflectance: float) -> Part:
    """A part with one reflectance."""
    return Part(slot, mesh, True, np.full(len(mesh.vertices), reflectance, np.float32))


def _handle(grey: float) -> list[tuple]:
    """Barrel with grooves where it is pinched, and the hub at its front; along z, each with its reflectance."""
    levels = np.linspace(0, HANDLE_MM - 12, 120)
    rounded = 1 - 0.35 * np.exp(-levels / 2.5)
    grooves = 0.5 * (np.sin(2 * np.pi * levels / 5) > 0.3) * (levels > 0.55 * HANDLE_MM) * (levels < 0.85 * HANDLE_MM)
    barrel = lofts.turned(np.column_stack([RADIUS_MM * rounded - grooves, levels]), 40)
    cone = [(RADIUS_MM - 0.8, HANDLE_MM - 13), (RADIUS_MM - 1.5, HANDLE_MM - 9), (3.2, HANDLE_MM - 4), (2.6, HANDLE_MM)]
    return [(barrel, grey), (lofts.turned(cone, 40), min(1.5 * grey, 0.85))]


def _pinching(rng: np.random.Generator, start: Array, along: Array, away: Array) -> hands.Skeleton:
    """A hand that pinches the handle, its index towards the tip, its forearm leading away."""
    out = away + rng.normal(0, 0.35, 3)
    out = lofts.unit(out - (out @ along) * along)
    front = np.cross(along, out)
    left = bool(front[2] < 0)
    front = -front if left else front
    x = along if left else -along
    closed = hands.pinching(rng, left, 2 * RADIUS_MM)
    held = start + (GRIPPED + rng.normal(0, 0.03)) * HANDLE_MM * along
    return hands.turned(closed, np.column_stack([x, -out, front]), held + RADIUS_MM * front)


def _balls(skeleton: hands.Skeleton) -> Array:
    """Balls : (n, 4) of x, y, z, radius that fill the hand and the forearm."""
    arm = skeleton.wrist + np.linspace(0, 300, 20)[:, None] * skeleton.forearm
    return np.concatenate([skeleton.points(), np.column_stack([arm, np.full(20, 45.0)])])
