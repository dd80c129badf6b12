"""A board on a post that stands on the table or the phantom, as a patient's reference does."""

from typing import Literal

import numpy as np

from recon.geometry import rigid
from recon.model.rig import Positive, Target
from scenes.handheld import lofts
from scenes.handheld.body_look import Look, Stand, board_of
from scenes.handheld.mesh_parts import Part

BLOCK_MM = 14.0  # behind the board, where the post's joint begins


class Kind(Look):
    """A board on a post with a foot."""

    kind: Literal["board"] = "board"
    post_mm: Positive = 8.0
    """diameter of the post"""
    foot_mm: Positive = 44.0
    """side of its foot"""

    def parts(self, rng: np.random.Generator, target: Target, stand: Stand) -> tuple[Part, ...]:
        """Board, joint, post, and a foot with four screws in it."""
        board, parts = board_of(rng, target, (2.0, 4.0))
        middle, radius = np.append(board.middle, 0.0), self.post_mm / 2
        block = lofts.prism(lofts.rounded([22, 22], 2, 3), BLOCK_MM + 1, 0.5)
        to_block = rigid.transform(np.eye(3), middle - [0, 0, board.thickness + BLOCK_MM])
        parts.append(Part("bracket", lofts.placed(block, to_block), False))
        joint = middle - [0, 0, board.thickness + BLOCK_MM + 0.5 * radius]
        turn = np.linspace(-np.pi / 2, np.pi / 2, 20)
        ball = lofts.turned(1.7 * radius * np.column_stack([np.cos(turn), np.sin(turn)]), 32)
        parts.append(Part("metal", lofts.placed(ball, rigid.transform(np.eye(3), joint)), True))
        foot = joint - stand.up * max(stand.height_mm + (joint - middle) @ stand.up, 4 * radius)
        parts.append(Part("metal", lofts.strut(foot + 2 * stand.up, joint, radius), True))
        to_foot = lofts.frame(foot, stand.up, [np.cos(spin := rng.uniform(0, np.pi)), np.sin(spin), 0])
        plate = lofts.prism(lofts.rounded([self.foot_mm] * 2, 4, 4), 6, 0.8)
        parts.append(Part("bracket", lofts.placed(plate, to_foot), False))
        for x, y in np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * 0.36 * self.foot_mm:
            head = lofts.placed(lofts.rod(3.0, 3, 20), to_foot @ rigid.transform(np.eye(3), [x, y, 5.5]))
            parts.append(Part("metal", head, True))
        return tuple(parts)
