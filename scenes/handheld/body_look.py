"""What a tracked body looks like besides its target: kinds are modules of `scenes.handheld.looks`, found by their names.

Everything is in the target's frame, as in `handheld_assembly`: the board's front in z = 0, z to those who look at it.
"""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from recon import registry
from recon.model import circle_layout
from recon.model.part import Kinds
from recon.model.rig import Target
from scenes.handheld.mesh_parts import Part
from scenes.handheld.shaft import Shaft
from scenes.handheld.target_board import Board, build_board

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Stand:
    """Where a body is, from its target: who looks at it, what it stands on, and where there is room for an arm."""

    eyes: Array  # (n, 3) mm, places from which the circles are looked at
    up: Array  # (3,) unit, the normal of the table or skin below
    height_mm: float  # of the circles' middle above that, along `up`
    away: Array  # (3,) unit, where an arm leads to


class Look(Kinds):
    """Look of a body that carries a target."""

    PACKAGE = "scenes.handheld.looks"
    USUAL = "board"
    IN_A_HAND: ClassVar[bool] = False

    def parts(self, rng: np.random.Generator, target: Target, stand: Stand) -> tuple[Part, ...]:
        """All that moves with the target, its print first; what the look leaves open is drawn."""
        raise NotImplementedError

    def tip_mm(self, target: Target) -> Array | None:
        """The tip : (3,) mm of a pointed body, None of others."""
        return None

    def line_mm(self, target: Target) -> Array | None:
        """The middle line : (n, 3) mm of a part that is thinner than a few pixels, None without one."""
        return None

    def shaft(self, target: Target) -> Shaft | None:
        """The shaft by which sound meets it, in the target's frame; None of a body that stays outside."""
        return None


def look_of(name: str) -> Look:
    """The look of a body that nothing is said of: that of its name, if there is one, or a board."""
    return Look.model_validate({"kind": name if name in registry.names(Look.PACKAGE) else Look.USUAL})


def any_stand(rng: np.random.Generator) -> Stand:
    """One like others: two cameras in front, on something that lies behind, an arm to any side."""
    eyes = np.array([[-90.0, 0.0, 650.0], [90.0, 0.0, 650.0]]) @ Rotation.from_rotvec([0, 0, rng.uniform(0, np.pi)]).as_matrix()
    up = Rotation.from_rotvec([*np.deg2rad(rng.normal(0, 15, 2)), 0]).as_matrix()[:, 2]
    turn = rng.uniform(0, 2 * np.pi)
    return Stand(eyes, up, rng.uniform(60, 250), np.array([np.cos(turn), np.sin(turn), 0.0]))


def board_of(rng: np.random.Generator, target: Target, thickness_mm: tuple[float, float]) -> tuple[Board, list[Part]]:
    """The target's board as designed, its middle at the circles' middle."""
    middle, half = circle_layout.middle(target)[:2], np.array(target.board_mm) / 2
    return build_board(rng, middle - half, middle + half, thickness_mm)
