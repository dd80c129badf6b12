"""A needle: a steel shaft in a handle, the target's board on a bracket at its rear, and a hand that pinches the handle."""

from dataclasses import replace
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, field_validator
from scipy.spatial.transform import Rotation

from recon.geometry import rigid
from recon.model import circle_layout
from recon.model.rig import Finite, NotNegative, Positive, Target, Vector
from scenes.acoustics import TISSUES, Tissue
from scenes.handheld import hand as hands
from scenes.handheld import lofts
from scenes.handheld.body_look import Look, Stand, board_of
from scenes.handheld.mesh_parts import Part
from scenes.handheld.shaft import Shaft
from scenes.handheld.target_board import hides, pierces

Array = NDArray[np.float64]

# outer and inner diameters, mm [ISO 9626, normal-walled tubing for needles]
DIAMETERS_MM = {14: 2.11, 15: 1.83, 16: 1.65, 17: 1.47, 18: 1.27, 19: 1.07, 20: 0.91, 21: 0.82, 22: 0.72, 23: 0.64, 25: 0.51}
BORES_MM = {14: 1.60, 15: 1.37, 16: 1.19, 17: 1.07, 18: 0.84, 19: 0.69, 20: 0.60, 21: 0.51, 22: 0.41, 23: 0.34, 25: 0.26}
AIR = Tissue(0.0004, 343.0, 0.0, None)
THICKNESS_MM = 4.0  # of the board
HANDLE_MM, RADIUS_MM = 90.0, 8.0  # length and radius of the handle
BELOW_MM = 8.0  # from the board's back to the handle's rear end
GRIPPED = 0.8  # of the handle, where thumb and index hold it
TRIES = 80  # of a hand that leaves the circles free


class Kind(Look):
    """A needle in a hand."""

    IN_A_HAND = True
    kind: Literal["needle"] = "needle"
    gauge: Annotated[int, Field(ge=14, le=25)] = 17
    """thickness of the shaft, by ISO 9626: 14 is 2.1 mm, 25 is 0.5 mm"""
    length_mm: Annotated[float, Field(ge=10, le=400)] = 90.0
    """from the handle to the tip"""
    direction: Vector = (0.0, -0.66, -0.75)
    """from the handle to the tip, in the target's frame; behind the board's face"""
    mark_mm: Positive = 10.0
    """from one mark on the shaft to the next"""
    bevel_deg: Annotated[float, Field(ge=8, le=80)] = 17.0
    """angle of the ground tip to the shaft: 11 of a regular bevel, 17 of a short one [ISO 7864]"""
    bevel_turn_deg: Finite = 0.0
    """of the side on which the bevel is open about the shaft, from that of the board's face"""
    filling: Literal["stylet", "water", "air"] = "stylet"
    """of the bore; a stylet makes it a solid rod"""
    roughness_um: Annotated[float, Field(ge=0, le=100)] = 1.0
    """standard deviation of the steel's surface, assumed for a drawn tube; what shines at no angle, sound scatters by this"""
    etched_mm: NotNegative = 0.0
    """length from the tip that is made rough, to be seen at any angle; 0 is none"""
    etched_um: Annotated[float, Field(ge=0, le=100)] = 20.0
    """standard deviation of that; a tenth of a wavelength scatters nearly all"""

    @field_validator("gauge")
    @classmethod
    def _made(cls, value: int) -> int:
        if value not in DIAMETERS_MM:
            raise ValueError(f"expected one of {', '.join(map(str, DIAMETERS_MM))}, found {value}")
        return value

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

    def shaft(self, target: Target) -> Shaft:
        """The tube, with its bevel's point at the tip."""
        _, along = self.axis(target)
        bore = 0.0 if self.filling == "stylet" else BORES_MM[self.gauge] / 2
        return Shaft(
            self.tip_mm(target), along, _open_side(along, self.bevel_turn_deg), self.length_mm, DIAMETERS_MM[self.gauge] / 2,
            replace(TISSUES["steel"], roughness=1e-3 * self.roughness_um), bore, AIR if self.filling == "air" else None,
            "bevel", np.deg2rad(self.bevel_deg), 0.0, self.etched_mm, 1e-3 * self.etched_um,
        )  # fmt: skip

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
        parts += [_tinted("probe", lofts.placed(mesh, to_handle), shade) for mesh, shade in _handle(grey)]
        parts += self._shaft(start + HANDLE_MM * along, along)
        discs, radius = circle_layout.circle_centres(target)[:, :2], target.outer_diameter_mm / 2

        def in_the_way(balls: Array) -> bool:
            return pierces(balls, board) or any(hides(balls, eye, discs, radius) for eye in stand.eyes)

        for _ in range(TRIES):
            skeleton = _pinching(rng, start, along, stand.away)
            if not in_the_way(_balls(skeleton)):
                return (*parts, *hands.clothed(rng, skeleton))
        return tuple(parts)

    def _shaft(self, start: Array, along: Array) -> list[Part]:
        """Steel tube with a pointed end, and dark marks on it."""
        radius = DIAMETERS_MM[self.gauge] / 2
        profile = [(radius, -3), (radius, self.length_mm - 5 * radius), (0.05, self.length_mm)]
        levels = np.concatenate([np.linspace(profile[k][1], profile[k + 1][1], 8)[k > 0 :] for k in (0, 1)])
        steel = lofts.turned(np.column_stack([np.interp(levels, *np.array(profile).T[::-1]), levels]), 20)
        marks = [
            lofts.placed(lofts.rod(radius + 0.02, 1.0, 20, 0.01), rigid.transform(np.eye(3), [0, 0, at]))
            for at in np.arange(self.mark_mm, self.length_mm - 6 * radius, self.mark_mm)
        ]
        to_shaft = lofts.frame(start, along)
        dark = [_tinted("metal", lofts.placed(mark, to_shaft), 0.05) for mark in marks]
        return [_tinted("metal", lofts.placed(steel, to_shaft), 0.45), *dark]


def _open_side(along: Array, turn_deg: float) -> Array:
    """Direction : (3,) across a shaft that leans to the board's face, turned about the shaft."""
    up = np.array([0.0, 0.0, 1.0]) - along[2] * along
    length = np.linalg.norm(up)
    up = up / length if length > 1e-6 else np.array([1.0, 0.0, 0.0])
    return Rotation.from_rotvec(np.deg2rad(turn_deg) * along).apply(up)


def _tinted(slot: str, mesh, reflectance: float) -> Part:
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
