"""The handheld assembly: the target's board, its bracket, the probe with its cable, and a hand or a robot that holds it.

Everything is in the target's frame: c0 at the origin, c1 on x, c2 on y, z to the viewer, the board's front exactly in z = 0. The
probe stands beside the board along z and points away from the viewer, as on the rig of Meza et al. 2021. `held` draws all of it,
for training; `as_designed` builds the body of a rig, whose array lies where its B-scans begin.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from recon.errors import InputError
from recon.geometry import rigid
from recon.model import circle_layout
from recon.model.circle_layout import circle_centres
from recon.model.rig import Probe, Target
from scenes.handheld import lofts
from scenes.handheld.hand import CLOSE_MM
from scenes.handheld.holders import grip, pinch, robot
from scenes.handheld.mesh_parts import Part
from scenes.handheld.probe_bodies import LENS_MM, Body, body, lens, parts_of, scaled
from scenes.handheld.target_board import CLEAR_MM, Board, build_board, covers, crosses, draw_front, hides, pierces, to_edge

Array = NDArray[np.float64]

BEHIND_MM = 1e-3  # from the board's middle: a probe behind it is beside it in no direction
IMAGE_FROM_BODY = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])  # the body's z is against the image's depth


@dataclass(frozen=True)
class Ranges:
    """Ranges of variants; fractions are of all variants."""

    board: float = 0.08  # relative change of each side of the board
    thickness_mm: tuple[float, float] = (1.5, 6.0)  # of the board
    gap_mm: tuple[float, float] = (10.0, 48.0)  # between the board's edge and the probe
    behind_mm: tuple[float, float] = (60.0, 125.0)  # the array behind the board's front
    tilt_deg: float = 9.0  # standard deviation of the probe's axis from the board's normal
    no_hand: float = 0.05  # neither a hand nor a robot
    robot: float = 0.08
    cable_in_front: float = 0.15
    finger_in_front: float = 0.13


def held(rng: np.random.Generator, target: Target, ranges: Ranges | None = None) -> tuple[Part, ...]:
    """One variant of all that moves rigidly with the target.

    The first part is the target: one rectangle of two triangles in z = 0, facing +z. All other parts are closed bodies.
    """
    ranges = ranges or Ranges()
    board_rng, probe_rng, bracket_rng, holder_rng, cable_rng, choice_rng = rng.spawn(6)
    holder, cable_in_front = _choices(choice_rng, ranges)
    board, parts = build_board(board_rng, *draw_front(board_rng, target, ranges.board), ranges.thickness_mm)
    target_from_body, probe, beside = _probe_pose(probe_rng, board, ranges)
    parts += [_move(part, target_from_body) for part in parts_of(probe, lens(probe_rng), probe_rng)]
    parts += _bracket(bracket_rng, board, probe, target_from_body)
    discs = circle_layout.circle_centres(target)[:, :2]
    if holder == "hand":
        parts += grip(holder_rng, probe, target_from_body, beside, lambda balls: covers(balls, board))
    elif holder == "pinch":
        parts += pinch(holder_rng, board, discs, target.outer_diameter_mm / 2, beside)
    elif holder == "robot":
        parts += robot(holder_rng, probe, target_from_body, beside)
    covered = discs[cable_rng.integers(len(discs))] if cable_in_front else None
    parts += _cable(cable_rng, probe, target_from_body, beside, covered, target.outer_diameter_mm / 2)
    return tuple(parts)


def as_designed(
    rng: np.random.Generator, target: Target, probe: Probe, eyes: Array, views: Array | None = None
) -> tuple[Part, ...]:
    """A body that a rig describes: its board about the circles' middle, its array at the B-scan's top line, held by a hand.

    Housing, bracket, hand and cable are drawn. Where no hand is found that leaves the circles free, there is none.

    Parameters
    ----------
    eyes : (n, 3) mm
        Places in the target's frame from which the circles are looked at.
    views : (m, 2, 3) mm
        Ends of further lines of sight that a hand leaves free, such as those to other bodies' circles.

    Raises
    ------
    InputError
        If no housing for such an array stands clear of the board.
    """
    board_rng, probe_rng, bracket_rng, holder_rng, cable_rng = rng.spawn(5)
    middle, half = circle_layout.middle(target)[:2], np.array(target.board_mm) / 2
    board, parts = build_board(board_rng, middle - half, middle + half, Ranges.thickness_mm)
    array_mm = probe.scale_mm_per_px[0] * (probe.image_size[0] - 1)
    face = rigid.transform(IMAGE_FROM_BODY, [array_mm / 2, 0, 0])
    target_from_body = probe.target_from_image.matrix() @ face @ rigid.transform(np.eye(3), [0, 0, LENS_MM])
    housing = _clear_of(board, probe_rng, target_from_body, array_mm)
    aside = target_from_body[:2, 3] - board.middle
    beside = np.append(lofts.unit(aside), 0.0) if np.linalg.norm(aside) > BEHIND_MM else np.array([1.0, 0.0, 0.0])
    lens_mm = np.array([array_mm + 2, lens(probe_rng)[1]])
    parts += [_move(part, target_from_body) for part in parts_of(housing, lens_mm, probe_rng)]
    parts += _bracket(bracket_rng, board, housing, target_from_body)
    discs = circle_centres(target)[:, :2]

    def in_the_way(balls: Array) -> bool:
        hidden = any(hides(balls, eye, discs, target.outer_diameter_mm / 2) for eye in eyes)
        return hidden or pierces(balls, board) or (views is not None and crosses(balls, views, target.outer_diameter_mm / 2))

    grips = 160  # of a hand that leaves the circles free
    any_grip = (0.15, 0.85)  # levels at which a probe close beside its board can be held, too
    parts += grip(holder_rng, housing, target_from_body, beside, in_the_way, any_grip, grips, CLOSE_MM)
    parts += _cable(cable_rng, housing, target_from_body, beside, None, target.outer_diameter_mm / 2)
    return tuple(parts)


def _clear_of(board: Board, rng: np.random.Generator, target_from_body: Array, array_mm: float) -> Body:
    """A housing for an array that doesn't pierce the board; InputError if none is found."""
    tries = 40  # of a housing that stands clear of the board
    for _ in range(tries):
        housing = scaled(body(rng), array_mm)
        levels = np.linspace(0, 1, 40)
        rings = np.concatenate([housing.outline_at(level) + np.array([0, 0, level * housing.length]) for level in levels])
        points = rigid.apply(target_from_body, rings)
        over = ((points[:, :2] > np.array(board.low) - CLEAR_MM) & (points[:, :2] < np.array(board.high) + CLEAR_MM)).all(axis=1)
        if not (over & (points[:, 2] > -board.thickness - CLEAR_MM)).any():
            return housing
    x, y, z = target_from_body[:3, 3]
    raise InputError(
        f"rig.probe.target_from_image: expected an array beside or behind the target's board, whose housing stands clear of it, "
        f"found its middle at ({x:.0f}, {y:.0f}, {z:.0f}) mm in the target's frame"
    )


def _choices(rng: np.random.Generator, ranges: Ranges) -> tuple[str, bool]:
    """Who holds the probe, and whether the cable covers a part of a circle."""
    draw = rng.uniform()
    limits = np.cumsum([ranges.no_hand, ranges.robot, ranges.finger_in_front])
    holder = ("none", "robot", "pinch", "hand")[int(np.searchsorted(limits, draw, side="right"))]
    other = 1 - ranges.robot - ranges.finger_in_front
    return holder, bool(holder in ("none", "hand") and rng.uniform() < ranges.cable_in_front / other)


def _move(part: Part, to_from: Array) -> Part:
    return Part(part.slot, lofts.placed(part.mesh, to_from), part.smooth)


def _probe_pose(rng: np.random.Generator, board: Board, ranges: Ranges) -> tuple[Array, Body, Array]:
    """Where the probe stands: `target_from_body` : (4, 4), its body, and the direction : (3,) from the board to it."""
    probe = body(rng)
    way = rng.choice([np.pi, np.pi / 2, -np.pi / 2, 0.0], p=[0.45, 0.35, 0.1, 0.1]) + rng.normal(0, 0.2)
    beside = np.array([np.cos(way), np.sin(way), 0.0])
    width_turn = way + np.pi / 2 + (rng.normal(0, 0.2) if rng.uniform() < 0.7 else rng.uniform(0, np.pi))
    behind, gap = rng.uniform(*ranges.behind_mm), rng.uniform(*ranges.gap_mm)
    tilt = np.append(rng.normal(0, np.deg2rad(ranges.tilt_deg), 2), 0)
    along = lofts.unit(np.array([tilt[0], tilt[1], 1.0]) + 0.1 * beside)
    turned = lofts.frame(np.zeros(3), along, [np.cos(width_turn), np.sin(width_turn), 0])
    reach = np.abs(beside[:2]) @ (board.size / 2)
    shape = rigid.rotate(turned, probe.outline_at(0.5)) @ beside
    aside = rng.normal(0, 8) * np.array([-beside[1], beside[0], 0])
    level = probe.length * rng.uniform(0.55, 0.95)  # of the body that the board is beside
    at_board = np.append(board.middle, 0) + (reach + gap - shape.min()) * beside + aside
    origin = at_board - along * min(level, behind)
    return rigid.transform(turned[:3, :3], origin), probe, beside


def _bracket(rng: np.random.Generator, board: Board, probe: Body, target_from_body: Array) -> list[Part]:
    """A clamp around the probe's body, an arm to the board, and screws."""
    axis, origin = target_from_body[:3, 2], target_from_body[:3, 3]
    level = np.clip((-board.thickness - rng.uniform(6, 18) - origin[2]) / axis[2], 0.3 * probe.length, 0.82 * probe.length)
    height = rng.uniform(10, 34)
    outline = probe.outline_at(level / probe.length)[:, :2]
    if rng.uniform() < 0.5:
        half = np.abs(outline).max(axis=0) + rng.uniform(2, 5)
        outline = lofts.rounded(2 * half, rng.uniform(1, 8), 5)
    else:
        outline = outline * (1 + rng.uniform(3, 7) / np.abs(outline).max(axis=0))
    clamp = lofts.placed(
        lofts.prism(outline, height, 0.8), target_from_body @ rigid.transform(np.eye(3), [0, 0, level - height / 2])
    )
    slot = "metal" if rng.uniform() < 0.3 else "bracket"
    parts = [Part(slot, clamp, True)]

    inward = np.append(board.middle, 0) - (origin + level * axis)
    inward[2] = 0
    inward = lofts.unit(inward) if np.linalg.norm(inward) > BEHIND_MM else np.array([1.0, 0.0, 0.0])
    reach = (rigid.rotate(target_from_body, np.column_stack([outline, np.zeros(len(outline))])) @ inward).max()
    start = origin + level * axis + (reach - 3) * inward
    end = np.append(board.middle, 0) - 0.25 * board.size.min() * inward * rng.uniform(0, 1)
    end[2] = -board.thickness - rng.uniform(3.5, 7)
    side = np.array([-inward[1], inward[0], 0])
    style = rng.choice(["bar", "rod", "two rods"], p=[0.55, 0.25, 0.2])
    if style == "bar":
        size = np.array([rng.uniform(8, 26), rng.uniform(4, 9)])
        arm = lofts.tube(np.stack([start, end]), lofts.rounded(size, 1.0, 2))
        along = lofts.unit(end - start)
        to_bar = lofts.frame(start, along, side)
        arm = lofts.placed(lofts.prism(lofts.rounded(size, 1.0, 2), float(np.linalg.norm(end - start)), 0.5), to_bar)
        parts.append(Part(slot, arm, False))
    else:
        shifts = [0.0] if style == "rod" else [-rng.uniform(8, 14), rng.uniform(8, 14)]
        radius = rng.uniform(2.5, 5)
        parts += [Part("metal", lofts.strut(start + s * side, end + s * side, radius), True) for s in shifts]
    end_block = lofts.prism(lofts.rounded([rng.uniform(14, 30), rng.uniform(14, 30)], 1.5, 3), -end[2] - board.thickness + 4, 0.5)
    parts.append(Part("bracket", lofts.placed(end_block, lofts.frame(end - [0, 0, 4], [0, 0, 1], inward)), False))
    parts += _screws(rng, outline, level, height, target_from_body)
    if rng.uniform() < 0.5:  # a block that stands up beside the board's edge, with a screw in it
        edge = to_edge(board, -inward)
        foot = np.append(board.middle - inward[:2] * (edge + rng.uniform(9, 12)), -board.thickness - 8)
        to_block = lofts.frame(foot, [0, 0, 1], inward)
        tall = board.thickness + 8 + rng.uniform(-6, 3)
        parts.append(Part("bracket", lofts.placed(lofts.prism(lofts.rounded([12, 14], 1, 2), tall, 0.5), to_block), False))
        screw = lofts.rod(rng.uniform(2.5, 4), 2.5, 20)
        parts.append(Part("metal", lofts.placed(screw, to_block @ rigid.transform(np.eye(3), [0, 0, tall - 0.5])), True))
    return parts


def _screws(rng: np.random.Generator, outline: Array, level: float, height: float, target_from_body: Array) -> list[Part]:
    """Screws through the clamp's ears, along its rim."""
    parts = []
    half = np.abs(outline).max(axis=0)
    for sign in (-1, 1):
        if rng.uniform() < 0.4:
            continue
        length, radius = rng.uniform(10, 24), rng.uniform(1.4, 2.5)
        centre = np.array([half[0] * rng.uniform(0.5, 0.9), sign * (half[1] + 0.5), level + height / 2 - rng.uniform(4, 8)])
        to_screw = target_from_body @ lofts.frame(centre, [0, sign, 0])
        shank = lofts.placed(lofts.rod(radius, length, 16), to_screw)
        head = lofts.placed(lofts.prism(lofts.superellipse((2 * radius, 2 * radius), 2, 6), 2.5), to_screw)
        parts += [Part("metal", shank, True), Part("metal", head, False)]
    return parts


def _cable(
    rng: np.random.Generator, probe: Body, target_from_body: Array, beside: Array, covered: Array | None, radius: float
) -> list[Part]:
    """The strain relief and the cable; the cable bends away from the board, or passes before the circle `covered` : (2,)."""
    axis = target_from_body[:3, 2]
    back = target_from_body[:3, 3] + probe.length * axis
    thick = rng.uniform(2.8, 4.6)
    ribs = np.linspace(0, rng.uniform(18, 34), 12)
    swell = 1 + 0.05 * (np.arange(12) % 2) * (rng.uniform() < 0.5)
    cone = lofts.turned(np.column_stack([np.linspace(probe.neck, thick + 1.2, 12) * swell, ribs - 4]), 32)
    relief = Part("cable" if rng.uniform() < 0.5 else "probe", lofts.placed(cone, lofts.frame(back, axis)), True)
    exit_point, side = back + (ribs[-1] - 8) * axis, np.cross(axis, beside)
    if covered is None:
        way = lofts.unit(beside * rng.uniform(0.25, 1) + rng.normal(0, 0.6) * side)
        rise = rng.uniform(20, 60)
        knots = [exit_point, exit_point + 14 * axis, exit_point + rise * axis + rng.uniform(15, 50) * way]
        fall = rng.uniform(-60, 30)
        knots.append(exit_point + (rise + 0.6 * fall) * axis + rng.uniform(80, 120) * way + rng.normal(0, 12) * side)
        knots.append(exit_point + (rise + 1.6 * fall) * axis + rng.uniform(170, 240) * way + rng.normal(0, 40) * side)
    else:
        turn = rng.uniform(0, 2 * np.pi)
        over = np.append(covered + rng.uniform(0.3, 1.0) * radius * np.array([np.cos(turn), np.sin(turn)]), rng.uniform(10, 35))
        high = max(float(exit_point[2]) + 20, over[2] + 10)
        lift = np.append((exit_point + 0.4 * (over - exit_point))[:2], high)
        onward = lofts.unit(np.append((over - exit_point)[:2], 0) + rng.normal(0, 12, 3) * [1, 1, 0])
        knots = [exit_point, exit_point + 10 * axis, lift, over]
        knots += [over + 60 * onward + [0, 0, rng.uniform(-10, 8)], over + 150 * onward - [0, 0, rng.uniform(0, 40)]]
        knots.append(over + 260 * onward + [*rng.normal(0, 40, 2), -rng.uniform(0, 90)])
    return [relief, Part("cable", lofts.cord(lofts.curve(np.array(knots), 56), thick, 14), True)]
