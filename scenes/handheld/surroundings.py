"""Still surroundings of the probe: a table on a bench, a phantom, tools, printed sheets, another hand.

Scene frame: the table's top is z = 0, z points up to the cameras, the origin is about where they look.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from recon.geometry import rigid
from scenes.handheld import clutter, lofts
from scenes.handheld import hand as hands
from scenes.handheld.mesh_parts import Part

Array = NDArray[np.float64]

BENCH_MM = 6000.0  # across: no ray of a camera that looks down misses it
FLOAT_MM = 0.2  # between a thing and what it lies on, so that no two surfaces coincide


@dataclass(frozen=True, eq=False)
class Poster:
    """A printed rectangle: its print lies in the plane z = 0 of its own frame, centred, visible from +z."""

    scene_from_poster: Array  # (4, 4)
    size: tuple[float, float]  # mm, along the poster's x and y


@dataclass(frozen=True, eq=False)
class Surroundings:
    """One variant: all parts, and where the prints of those in the slot "poster" lie, in the order of these parts."""

    parts: tuple[Part, ...]
    posters: tuple[Poster, ...]


def surroundings(rng: np.random.Generator) -> Surroundings:
    """One random variant."""
    ground_rng, thing_rng, poster_rng, hand_rng = rng.spawn(4)
    parts, half = _ground(ground_rng)
    if thing_rng.uniform() < 0.45:
        parts.append(_on_table(thing_rng, clutter.phantom(thing_rng), "phantom", 90, True))
    count = int(thing_rng.integers(2, 12))
    for _ in range(count):
        parts += _thing(thing_rng, half)
    posters = []
    for _ in range(int(poster_rng.choice([0, 1, 2, 3], p=[0.25, 0.3, 0.25, 0.2]))):
        part, poster = _poster(poster_rng, half)
        parts.append(part)
        posters.append(poster)
    if hand_rng.uniform() < 0.35:
        parts += _second_hand(hand_rng)
    return Surroundings(tuple(parts), tuple(posters))


def _ground(rng: np.random.Generator) -> tuple[list[Part], Array]:
    """Bench, and mostly a table above it; and half the extent : (2,) mm where things lie."""
    if rng.uniform() < 0.22:
        bench = lofts.box([BENCH_MM, BENCH_MM, 40], [0, 0, -20])
        return [Part("bench", bench, False)], np.array([260.0, 220.0])
    size, thick = rng.uniform([300, 250], [900, 650]), rng.uniform(8, 40)
    drop = rng.uniform(100, 800) if rng.uniform() < 0.6 else rng.uniform(thick + 5, 120)
    top = lofts.prism(lofts.rounded(size, rng.uniform(0.5, 12), 3), thick, rng.uniform(0.3, 3))
    middle = rng.normal(0, 0.12, 2) * size
    turn = rng.normal(0, 0.15) if rng.uniform() < 0.7 else rng.uniform(0, np.pi)
    to_table = rigid.from_rotation_vector([0, 0, turn], [*middle, -thick])
    parts = [Part("table", lofts.placed(top, to_table), False)]
    parts.append(Part("bench", lofts.box([BENCH_MM, BENCH_MM, 40], [0, 0, -drop - 20]), False))
    column = lofts.rod(rng.uniform(20, 60), drop - thick + 1, 32)
    parts.append(Part("metal", lofts.placed(column, rigid.transform(np.eye(3), [*middle, -drop - 0.5])), True))
    if rng.uniform() < 0.5:  # a carriage or a bracket that juts out from under the table, as on an optical bench
        way = rng.uniform(0, 2 * np.pi)
        plate = lofts.prism(lofts.rounded(rng.uniform([60, 50], [160, 120]), 2), rng.uniform(6, 16), 0.5)
        edge = 0.5 * size.min() + rng.uniform(-20, 60)
        spot = [*(middle + edge * np.array([np.cos(way), np.sin(way)])), -thick - 18]
        parts.append(Part("thing_a", lofts.placed(plate, rigid.from_rotation_vector([0, 0, way], spot)), False))
    return parts, np.minimum(0.46 * size, [280, 240])


def _pose(rng: np.random.Generator, spread: Array | float, height: float = 0.0, square: bool = False) -> Array:
    """A place on the table : (4, 4), turned about the vertical; `square` keeps to right angles, nearly."""
    spot = rng.uniform(-1, 1, 2) * spread
    turn = rng.integers(4) * np.pi / 2 + rng.normal(0, 0.1) if square else rng.uniform(0, 2 * np.pi)
    return rigid.from_rotation_vector([0, 0, turn], [*spot, height + FLOAT_MM])


def _on_table(rng: np.random.Generator, mesh: trimesh.Trimesh, slot: str, spread: Array | float, smooth: bool) -> Part:
    return Part(slot, lofts.placed(mesh, _pose(rng, spread)), smooth)


def _thing(rng: np.random.Generator, half: Array) -> list[Part]:
    """One thing on the table, of one or two surfaces."""
    makers: list[tuple[Callable[[np.random.Generator], list[Part]], float]] = [
        (clutter.cylinder, 3),
        (clutter.block, 3),
        (clutter.tool, 3),
        (clutter.tin, 1.5),
        (clutter.washer, 2),
        (clutter.profile, 2),
        (clutter.tank, 1),
        (clutter.screw, 2.5),
        (clutter.monitor, 1),
        (clutter.wire, 3),
        (clutter.frame, 1.5),
        (clutter.ball, 0.7),
    ]
    weights = np.array([weight for _, weight in makers])
    make = makers[int(rng.choice(len(makers), p=weights / weights.sum()))][0]
    pose = _pose(rng, half)
    return [Part(part.slot, lofts.placed(part.mesh, pose), part.smooth) for part in make(rng)]


def _poster(rng: np.random.Generator, half: Array) -> tuple[Part, Poster]:
    """A sheet or a card: it lies on the table, leans, or stands; closed but for the print, which is its front."""
    size = rng.uniform(60, 250, 2) if rng.uniform() < 0.6 else rng.uniform(60, 110, 2)
    style = rng.choice(["lies", "leans", "stands"], p=[0.7, 0.2, 0.1])
    pitch = {"lies": 0.0, "leans": rng.uniform(0.15, 0.9), "stands": rng.uniform(1.2, 1.5)}[str(style)]
    turn = rng.uniform(0, 2 * np.pi)
    rotation = (Rotation.from_rotvec([0, 0, turn]) * Rotation.from_rotvec([pitch, 0, 0])).as_matrix()
    lift = size[1] / 2 * np.sin(pitch) + rng.choice([0.4, rng.uniform(1, 3), rng.uniform(10, 60)], p=[0.6, 0.25, 0.15])
    scene_from_poster = rigid.transform(rotation, [*(rng.uniform(-0.9, 0.9, 2) * half), lift])
    x, y = np.array([-1, 1, 1, -1]) * size[0] / 2, np.array([-1, -1, 1, 1]) * size[1] / 2
    sheet = trimesh.Trimesh(np.column_stack([x, y, np.zeros(4)]), [[0, 1, 2], [0, 2, 3]], process=False)
    return Part("poster", lofts.placed(sheet, scene_from_poster), False), Poster(scene_from_poster, (size[0], size[1]))


def _second_hand(rng: np.random.Generator) -> list[Part]:
    """A hand that rests on the table or on the phantom, its forearm leading out of the view."""
    skeleton = hands.lying(rng, bool(rng.uniform() < 0.5))
    turn = rng.uniform(0, 2 * np.pi)
    spot = rng.uniform(20, 150) * np.array([np.sin(turn), -np.cos(turn)]) + rng.normal(0, 25, 2)
    rotation = Rotation.from_rotvec([0, 0, turn + rng.normal(0, 0.5)]).as_matrix()
    height = rng.uniform(0, 8) if rng.uniform() < 0.7 else rng.uniform(30, 65)
    return hands.clothed(rng, hands.turned(skeleton, rotation, [*spot, height]))
