"""Things that lie about in a laboratory, each in its own frame: standing on z = 0, about the origin."""

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from recon.geometry import rigid
from scenes.handheld import lofts
from scenes.handheld.mesh_parts import Part

Array = NDArray[np.float64]

THINGS = ("thing_a", "thing_b", "thing_c")


def phantom(rng: np.random.Generator) -> trimesh.Trimesh:
    """A breast phantom of about 170 x 130 x 55 mm: a dome, fuller on one side, with areola and nipple, its base closed."""
    length, width, height = np.array([170, 130, 55]) * rng.uniform(0.75, 1.1, 3)
    part = np.concatenate([np.linspace(1, 0.24, 20), np.linspace(0.225, 0.01, 16)])  # of the way from the apex to the rim
    steep = rng.uniform(1.9, 2.6)
    areola = 0.12 * np.array([length, width]).mean() / 2
    reach = part * (length + width) / 4
    nipple = rng.uniform(4, 7) / (1 + np.exp((reach - rng.uniform(3.5, 5)) / 0.7))
    nipple += 0.8 / (1 + np.exp((reach - 1.6 * areola) / 0.8))
    level = (height - 6) * (1 - part**steep) ** 0.6 + nipple
    turn = 2 * np.pi * np.arange(72) / 72
    apex, taper = rng.normal(0, 8, 2), rng.uniform(-0.15, 0.15)
    rings = []
    for p, z in zip(part, level, strict=True):
        x = length / 2 * p * np.cos(turn)
        y = width / 2 * p * np.sin(turn) * (1 + taper * np.cos(turn) * p)
        rings.append(np.column_stack([x + apex[0] * (1 - p), y + apex[1] * (1 - p), np.full(72, z)]))
    return lofts.loft(rings)


def cylinder(rng: np.random.Generator) -> list[Part]:
    """A standing or lying cylinder."""
    radius, length = rng.uniform(5, 40), rng.uniform(10, 140)
    mesh = lofts.rod(radius, length, 48, rng.uniform(0.4, 3))
    if rng.uniform() < 0.5:
        mesh = lofts.placed(mesh, rigid.from_rotation_vector([0, np.pi / 2, 0], [-length / 2, 0, radius]))
    return [Part(_slot(rng), mesh, True)]


def ball(rng: np.random.Generator) -> list[Part]:
    """A sphere."""
    radius = rng.uniform(8, 32)
    angle = np.linspace(-np.pi / 2, np.pi / 2, 24)
    profile = np.column_stack([radius * np.cos(angle), radius * (1 + np.sin(angle))])
    return [Part(_slot(rng), lofts.turned(profile, 48), True)]


def block(rng: np.random.Generator) -> list[Part]:
    """A box: sharp, or with rounded corners as a case has, sometimes with a lid of another colour."""
    size = np.exp(rng.uniform(np.log([15, 15, 4]), np.log([180, 120, 90])))
    outline = lofts.rounded(size[:2], rng.choice([0.3, rng.uniform(1, 15)]), 4)
    parts = [Part(_slot(rng), lofts.prism(outline, size[2], rng.uniform(0.3, 2)), False)]
    if rng.uniform() < 0.4:
        lid = lofts.prism(outline * rng.uniform(0.5, 1.04), rng.uniform(1, 6), 0.3)
        parts.append(Part(_slot(rng), _lift(lid, size[2] - 0.2), False))
    return parts


def tool(rng: np.random.Generator) -> list[Part]:
    """A screwdriver, a pen, or a spanner."""
    kind = rng.choice(["screwdriver", "pen", "spanner"])
    lying = rigid.from_rotation_vector([0, np.pi / 2, 0], [0, 0, 0])
    if kind == "screwdriver":
        thick, grip, blade = rng.uniform(8, 16), rng.uniform(60, 110), rng.uniform(50, 140)
        outline = lofts.superellipse((thick, thick), rng.choice([2, 3.5]), 30)
        path = np.linspace([0, 0, 0], [0, 0, grip], 9)
        scale = np.array([0.6, 0.85, 1, 1, 0.95, 0.92, 0.97, 0.8, 0.45])
        handle = lofts.tube(path, outline, scale)
        shaft = _lift(lofts.rod(rng.uniform(2, 4), blade, 16), grip - 2)
        up = rigid.transform(np.eye(3), [-grip, 0, thick]) @ lying
        return [Part(_slot(rng), lofts.placed(handle, up), True), Part("metal", lofts.placed(shaft, up), True)]
    if kind == "pen":
        radius, length = rng.uniform(3.5, 6), rng.uniform(110, 150)
        profile = [(0.8, 0), (radius, 14), (radius, 15), (radius, length), (radius * 0.8, length + 1)]
        up = rigid.transform(np.eye(3), [-length / 2, 0, radius]) @ lying
        return [Part(_slot(rng), lofts.placed(lofts.turned(profile, 24), up), True)]
    length, wide, thick = rng.uniform(90, 220), rng.uniform(9, 18), rng.uniform(3, 7)
    shaft = lofts.prism(lofts.rounded([length, wide], wide / 2), thick, 1)
    heads = [_ring(wide * rng.uniform(0.8, 1.2), wide * 0.55, thick + 1, [sign * length / 2, 0, 0]) for sign in (-1, 1)]
    return [Part("metal", lofts.joined([shaft, *heads]), False)]


def tin(rng: np.random.Generator) -> list[Part]:
    """A tin, jar, or cup: a wide cylinder with a rim, seen from above as rings."""
    radius, height, rim = rng.uniform(20, 50), rng.uniform(15, 110), rng.uniform(1.5, 5)
    deep = height * rng.choice([0.06, rng.uniform(0.3, 0.9)])
    profile = [(0, 0), (radius - 1, 0), (radius, 1), (radius, height - 1), (radius - 0.5, height)]
    profile += [(radius - rim, height), (radius - rim, height - 0.5), (radius - rim - 0.3, height - deep), (0, height - deep)]
    return [Part(_slot(rng), lofts.turned(profile, 56), False)]


def washer(rng: np.random.Generator) -> list[Part]:
    """A flat ring, which a circle detector might take for a circle of the target; sometimes on a plate."""
    radius = rng.uniform(5, 22)
    mesh = _ring(radius, radius * rng.uniform(0.25, 0.7), rng.uniform(0.8, 6), [0, 0, 0])
    if rng.uniform() < 0.6:
        return [Part(rng.choice(["metal", "thing_a", "thing_b"]), mesh, False)]
    plate = lofts.prism(lofts.rounded(rng.uniform(2.2, 4, 2) * radius, 2), 3, 0.3)
    return [Part(_slot(rng), plate, False), Part(_slot(rng), _lift(mesh, 2.8), False)]


def profile(rng: np.random.Generator) -> list[Part]:
    """A bar of an optical bench: grooved aluminium or a flat rail with holes' counterbores as dark discs."""
    length, wide = rng.uniform(150, 700), rng.choice([20, 30, 40, 60])
    if rng.uniform() < 0.6:
        half, slot, deep = wide / 2, wide * 0.14, wide * 0.2
        side = [(-half, -half), (-slot, -half), (-slot, -half + deep), (slot, -half + deep), (slot, -half)]
        turns = [np.array([[0, -1], [1, 0]])]
        outline, points = [], np.array(side, float)
        for _ in range(4):
            outline.append(points)
            points = points @ turns[0].T
        bar = _extrude(np.concatenate(outline), length)
        up = rigid.from_rotation_vector([0, np.pi / 2, 0], [-length / 2, 0, half])
        return [Part(rng.choice(["metal", "thing_a"]), lofts.placed(bar, up), False)]
    thick = rng.uniform(5, 20)
    parts = [Part(rng.choice(["thing_a", "thing_b", "metal"]), lofts.prism(lofts.rounded([length, wide], 1), thick, 0.5), False)]
    places = np.arange(-length / 2 + 20, length / 2 - 15, rng.uniform(25, 60))
    holes = [lofts.placed(lofts.rod(wide * 0.12, 1, 20, 0.2), rigid.transform(np.eye(3), [x, 0, thick - 0.7])) for x in places]
    return [*parts, Part(_slot(rng), lofts.joined(holes), True)]


def tank(rng: np.random.Generator) -> list[Part]:
    """An open water tank: a floor and four walls, perhaps filled."""
    length, width, height = rng.uniform([120, 90, 50], [260, 190, 130])
    wall = rng.uniform(3, 8)
    outer, inner = lofts.rounded([length, width], 6, 4), lofts.rounded([length - 2 * wall, width - 2 * wall], 4, 4)
    levels = [(outer, 0), (outer, height - 0.5), (outer, height), (inner, height), (inner, height - 0.5), (inner, wall)]
    mesh = lofts.loft([np.column_stack([ring, np.full(len(ring), z)]) for ring, z in levels])
    parts = [Part(rng.choice(THINGS), mesh, False)]
    if rng.uniform() < 0.5:
        water = lofts.prism(lofts.rounded([length - 2 * wall - 0.4, width - 2 * wall - 0.4], 4, 4), height * 0.6)
        parts.append(Part(rng.choice(THINGS), _lift(water, wall + 0.1), False))
    return parts


def screw(rng: np.random.Generator) -> list[Part]:
    """A few screws, nuts or rods of metal."""
    parts = []
    for _ in range(rng.integers(1, 5)):
        radius, length = rng.uniform(1.5, 4), rng.uniform(8, 60)
        shank = lofts.rod(radius, length, 16)
        socket = lofts.superellipse((1.9 * radius, 1.9 * radius), 2, int(rng.choice([6, 24])))
        head = _lift(lofts.prism(socket, 1.6 * radius, 0.3), -1.5 * radius)
        mesh = lofts.joined([shank, head])
        if rng.uniform() < 0.7:
            mesh = lofts.placed(mesh, rigid.from_rotation_vector([0, np.pi / 2, 0], [0, 0, 1.9 * radius]))
        else:
            mesh = lofts.placed(mesh, rigid.from_rotation_vector([np.pi, 0, 0], [0, 0, length]))
        turn = rigid.from_rotation_vector([0, 0, rng.uniform(0, 6.3)], [*rng.normal(0, 30, 2), 0])
        parts.append(Part("metal", lofts.placed(mesh, turn), False))
    return parts


def monitor(rng: np.random.Generator) -> list[Part]:
    """A slab with a panel set into it: a tablet lying flat, or a monitor that stands or leans."""
    size, thick = rng.uniform([120, 80], [320, 220]), rng.uniform(7, 25)
    case = lofts.prism(lofts.rounded(size, rng.uniform(2, 12), 4), thick, 1.5)
    panel = _lift(lofts.prism(lofts.rounded(size - rng.uniform(8, 24), 1), 1.0), thick - 0.6)
    pitch = rng.choice([0.0, rng.uniform(0.2, 1.3)])
    rotation = Rotation.from_rotvec([pitch, 0, 0]).as_matrix()
    pose = rigid.transform(rotation, [0, 0, size[1] / 2 * np.sin(pitch)])
    surfaces = [Part("thing_a", case, False), Part(rng.choice(["thing_b", "thing_c"]), panel, False)]
    return [Part(part.slot, lofts.placed(part.mesh, pose), part.smooth) for part in surfaces]


def wire(rng: np.random.Generator) -> list[Part]:
    """A cable or a tube that lies in loose bends."""
    radius, count = rng.uniform(1, 5), int(rng.integers(4, 9))
    heading = rng.uniform(0, 2 * np.pi) + np.cumsum(rng.normal(0, 0.7, count))
    steps = rng.uniform(30, 80, count)[:, None] * np.column_stack([np.cos(heading), np.sin(heading)])
    spots = np.cumsum(steps, axis=0)
    path = lofts.curve(np.column_stack([spots - spots.mean(axis=0), radius + rng.exponential(2, count)]), 20 * count)
    return [Part("cable", lofts.cord(path, radius, 12), True)]


def frame(rng: np.random.Generator) -> list[Part]:
    """A bracket of slotted plates: an open rectangle of bars, as a holder seen from above."""
    size, bar, thick = rng.uniform([60, 40], [200, 140]), rng.uniform(6, 22), rng.uniform(4, 30)
    bars = [lofts.box([size[0], bar, thick], [0, s * (size[1] - bar) / 2, thick / 2]) for s in (-1, 1)]
    bars += [lofts.box([bar, size[1] - 2 * bar, thick], [s * (size[0] - bar) / 2, 0, thick / 2]) for s in (-1, 1)]
    return [Part(_slot(rng), lofts.joined(bars), False)]


def _slot(rng: np.random.Generator) -> str:
    return str(rng.choice([*THINGS, "metal"], p=[0.3, 0.3, 0.25, 0.15]))


def _lift(mesh: trimesh.Trimesh, height: float) -> trimesh.Trimesh:
    return lofts.placed(mesh, rigid.transform(np.eye(3), [0, 0, height]))


def _ring(outer: float, inner: float, height: float, centre: list[float]) -> trimesh.Trimesh:
    """A flat ring with a hole, standing on z = 0: a rectangle turned about the axis, closed on itself."""
    edge = min(0.3, 0.2 * height)
    section = [
        (inner, 0),
        (outer, 0),
        (outer, height - edge),
        (outer - edge, height),
        (inner + edge, height),
        (inner, height - edge),
    ]
    turn = 2 * np.pi * np.arange(48) / 48
    rings = np.array([[(r * np.cos(a), r * np.sin(a), z) for r, z in section] for a in turn])
    n, k = rings.shape[:2]
    here = (k * np.arange(n)[:, None] + np.arange(k)).ravel()
    up = (k * np.arange(n)[:, None] + np.roll(np.arange(k), -1)).ravel()
    faces = np.concatenate(
        [np.stack([here, (here + k) % (n * k), (up + k) % (n * k)], 1), np.stack([here, (up + k) % (n * k), up], 1)]
    )
    mesh = trimesh.Trimesh(rings.reshape(-1, 3) + centre, faces, process=False)
    return mesh if mesh.volume > 0 else trimesh.Trimesh(mesh.vertices, faces[:, ::-1], process=False)


def _extrude(outline: Array, length: float) -> trimesh.Trimesh:
    """A star-shaped outline : (n, 2) about the origin, drawn along z."""
    return lofts.loft([np.column_stack([outline, np.full(len(outline), z)]) for z in (0.0, length)])
