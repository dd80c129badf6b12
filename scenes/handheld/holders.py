"""Holders of the probe: a hand around it, a hand that pinches the board, a robot."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from recon.geometry import rigid
from scenes.handheld import hand as hands
from scenes.handheld import lofts
from scenes.handheld.mesh_parts import Part
from scenes.handheld.probe_bodies import Body
from scenes.handheld.target_board import Board, beyond

Array = NDArray[np.float64]

TRIES = 40  # of a pose for the hand that covers no circle


def grip(
    rng: np.random.Generator,
    probe: Body,
    target_from_body: Array,
    beside: Array,
    refused: Callable[[Array], bool],
    levels: tuple[float, float] = (0.3, 0.68),
    tries: int = TRIES,
    voxel: float = hands.VOXEL_MM,
) -> list[Part]:
    """A hand around the probe at a level, a part of its length, its forearm leading away from the board; none if all are refused.

    refused : whether a hand of balls : (n, 4) of x, y, z, radius is in the way.
    """
    left = bool(rng.uniform() < 0.4)
    for _ in range(tries):
        level = probe.length * rng.uniform(*levels)
        away = np.arctan2(*(target_from_body[:3, :3].T @ beside)[[1, 0]])
        outline = probe.outline_at(level / probe.length)[:, :2]
        closed = hands.gripping(rng, outline, left, away + rng.normal(0, 0.9))
        to_grip = target_from_body @ rigid.transform(np.eye(3), [0, 0, level])
        skeleton = hands.turned(closed, to_grip[:3, :3], to_grip[:3, 3])
        arm = skeleton.wrist + np.linspace(0, 300, 20)[:, None] * skeleton.forearm
        balls = np.concatenate([skeleton.points(), np.column_stack([arm, np.full(20, 45.0)])])
        if skeleton.forearm[2] < 0.75 and not refused(balls):
            return hands.clothed(rng, skeleton, voxel)
    return []


def pinch(rng: np.random.Generator, board: Board, discs: Array, radius: float, beside: Array) -> list[Part]:
    """A hand that holds the board by an edge, its thumb over a part of a circle."""
    edges = np.array([[-1, 0], [1, 0], [0, -1], [0, 1]], float)
    edges = edges[edges @ beside[:2] < 0.5]
    way = edges[rng.integers(len(edges))]
    reach = [beyond(board, disc, way) for disc in discs]
    disc = discs[int(np.argmin(reach))] if rng.uniform() < 0.8 else discs[rng.integers(3)]
    tip = disc + way * radius * rng.uniform(-0.6, 0.85) + rng.uniform(-0.5, 0.5) * radius * np.array([-way[1], way[0]])
    closed = hands.pinching(rng, bool(rng.uniform() < 0.5), board.thickness)
    turn = np.arctan2(way[1], way[0]) + np.pi / 2 + rng.normal(0, 0.25)
    cos, sin = np.cos(turn), np.sin(turn)
    rotation = np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]])
    return hands.clothed(rng, hands.turned(closed, rotation, [*tip, 0.0]))


def robot(rng: np.random.Generator, probe: Body, target_from_body: Array, beside: Array) -> list[Part]:
    """A robot's flange behind the probe and two links that lead away from the board."""
    axis = target_from_body[:3, 2]
    back = target_from_body[:3, 3] + 0.9 * probe.length * axis
    radius, slot = rng.uniform(26, 40), rng.choice(["metal", "bracket", "thing_a"])
    out = lofts.unit(beside + rng.normal(0, 0.25) * np.cross(axis, beside) + rng.uniform(0.0, 0.45) * axis)
    start = back + (radius - 0.5 * np.abs(probe.outline_at(0.9)).max()) * beside * 0.8
    flange = lofts.placed(lofts.rod(radius, 14, 48, 1.5), lofts.frame(start, axis))
    wrist = lofts.placed(lofts.rod(0.92 * radius, rng.uniform(50, 80), 48, 6), lofts.frame(start + 13 * axis, axis))
    joint = start + 50 * axis
    link = lofts.placed(lofts.rod(rng.uniform(0.75, 0.95) * radius, rng.uniform(250, 400), 48, 4), lofts.frame(joint, out))
    ring = lofts.placed(lofts.rod(radius * 1.02, 8, 48, 1), lofts.frame(joint + rng.uniform(60, 110) * out, out))
    bolts = []
    for turn in np.arange(6) * np.pi / 3 + rng.uniform(0, 1):
        to_flange = lofts.frame(start, axis)
        bolt = lofts.prism(lofts.superellipse((2.6, 2.6), 2, 12), 4, 0.5)
        spot = [0.84 * radius * np.cos(turn), 0.84 * radius * np.sin(turn), -3]
        bolts.append(lofts.placed(bolt, to_flange @ rigid.transform(np.eye(3), spot)))
    shell = lofts.joined([wrist, link])
    return [Part("metal", lofts.joined([flange, *bolts]), True), Part(str(slot), shell, True), Part("thing_b", ring, True)]
