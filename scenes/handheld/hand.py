"""Hands: a skeleton of tapered capsules with skin over it, posed around a probe, pinching a plate, or lying on a table.

The skin is the zero level of the capsules' distance, joined by a smooth minimum: fingers meet the palm in webs, not in seams.
"""

from dataclasses import dataclass

import numpy as np
import trimesh
from numpy.typing import ArrayLike, NDArray
from skimage.measure import marching_cubes

from scenes.handheld import lofts
from scenes.handheld.mesh_parts import Part
from scenes.noise import smooth_noise

Array = NDArray[np.float64]

VOXEL_MM = 3.5  # some 13 000 triangles a hand
CLOSE_MM = 1.5  # of a hand that is looked at closely, whose creases and nails are resolved: some 80 000
SKIN = (0.25, 0.5)  # reflectance of a hand that is looked at closely
SEGMENTS_MM = np.array([[46, 27, 22], [50, 31, 23], [46, 28, 23], [36, 21, 20]], float)  # index to little finger of an adult
RADII_MM = np.array([9.2, 9.4, 8.8, 7.8])  # of the fingers at their roots
THUMB_MM = np.array([34.0, 28.0])
SPACING_MM = 20.0  # between neighbouring knuckles
DEGREES = np.linspace(0, 2 * np.pi, 361)[:-1]  # a round, rad
STUMP_MM = 70.0  # of the forearm that belongs to the skin's field; the rest is a tapered tube


@dataclass(frozen=True, eq=False)
class Bone:
    """A tapered capsule."""

    start: Array  # (3,), mm
    end: Array  # (3,), mm
    radii: tuple[float, float]  # mm, at the start and at the end
    blend: float  # mm, over which it melts into what was there before


@dataclass(frozen=True, eq=False)
class Skeleton:
    """A hand's bones, and the line of its forearm."""

    bones: tuple[Bone, ...]
    wrist: Array  # (3,), mm
    forearm: Array  # (3,), unit, from the wrist to the elbow
    broad: Array  # (3,), unit, along which the forearm is broad
    size: float  # 1 for a man's hand of average size

    @property
    def digits(self) -> list[tuple[Bone, ...]]:
        """Bones of the thumb's two free joints, and of each finger, index to little finger."""
        return [self.bones[10:12], *(self.bones[first : first + 3] for first in range(12, 24, 3))]

    def points(self) -> Array:
        """Points along the bones : (n, 4), x y z and the radius there, mm."""
        start = np.array([(*bone.start, bone.radii[0]) for bone in self.bones])
        end = np.array([(*bone.end, bone.radii[1]) for bone in self.bones])
        steps = np.linspace(0, 1, 6)[:, None]
        return (start[:, None] + steps * (end - start)[:, None]).reshape(-1, 4)


def gripping(rng: np.random.Generator, outline: Array, left: bool, turn: float) -> Skeleton:
    """A hand around a rod along z, its middle at z = 0 and the thumb's side up.

    Parameters
    ----------
    rng : np.random.Generator
    outline : (n, 2) float, mm
        The rod's convex cross-section about the origin.
    left : bool
        Mirrors the hand.
    turn : float, rad
        Where around the rod the palm lies.
    """
    size = rng.uniform(0.86, 1.08)
    sign = -1.0 if left else 1.0
    spread, slack, slope = rng.uniform(0.95, 1.12), rng.uniform(0.0, 4.0), rng.normal(0, 0.12)
    cos, sin = np.cos(turn), np.sin(turn)
    to_rod = np.array([[cos, -sin * sign], [sin, cos * sign]])  # palm's frame (out of the palm's back, to the knuckles)
    around = outline @ to_rod
    rod = _round(around)
    heights = (1.5 - np.arange(4)) * SPACING_MM * size * spread * np.array([0.95, 1, 1, 1])

    bones, knuckles = [], []
    palm = _support(around, 0.0) + 15 * size
    wrist = np.array([palm + rng.uniform(6, 22), -rng.uniform(52, 66) * size, rng.normal(0, 8)])
    start_angle = rng.uniform(0.75, 1.05)
    for k in range(4):
        radius = RADII_MM[k] * size
        away = radius + slack * rng.uniform(0.3, 1) + np.array([8.5, 6, 3.5, 1]) * size
        lengths = SEGMENTS_MM[k] * size * rng.uniform(0.93, 1.03)
        chain = _walk(rod, away, start_angle + rng.normal(0, 0.05), lengths, 1)
        drop = slope * np.linspace(0, 80, 4) + rng.normal(0, 1.5, 4) * [0, 1, 1, 1]
        joints = np.column_stack([chain, heights[k] + drop])
        knuckles.append(joints[0])
        bones += _finger(joints, radius)
    thumb_radius = 10.5 * size
    away = thumb_radius + slack + np.array([6.5, 4.5, 1]) * size
    chain = _walk(rod, away, -rng.uniform(0.9, 1.3), THUMB_MM * size, -1)
    joints = np.column_stack([chain, heights[0] + np.array([-8, 4, 9])])
    joints[:, 2] += rng.uniform(-6, 14)
    root = wrist + np.array([-6, 10, 14 * size])
    thumb = [Bone(root, joints[0], (15 * size, 12.5 * size), 12), *_finger(joints, thumb_radius)]
    out = lofts.unit([rng.uniform(0.1, 0.9), -1, rng.normal(0.0, 0.3)])
    hand = _hand(bones, thumb, np.array(knuckles), wrist, out, np.array([0, 0, 1.0]), size)
    turning = np.eye(3)
    turning[:2, :2] = to_rod
    return turned(hand, turning, np.zeros(3))


def pinching(rng: np.random.Generator, left: bool, gap: float) -> Skeleton:
    """A hand that holds a plate `gap` mm thick between thumb and index, the thumb's tip above the origin.

    The plate's front is z = 0; the hand comes from -y. The thumb lies in front, the fingers behind.
    """
    size = rng.uniform(0.86, 1.08)
    sign = -1.0 if left else 1.0
    wrist = np.array([sign * rng.uniform(10, 40), -rng.uniform(120, 140), -rng.uniform(20, 45)]) * size
    knuckles, bones = [], []
    for k in range(4):
        radius = RADII_MM[k] * size
        across = sign * (k * 19.0 - 6) * size
        knuckle = np.array([across + sign * 10, -62 - 5 * k, -gap - 26 - 3 * k + rng.normal(0, 2)]) * [1, size, 1]
        tip = np.array([across * 0.9, -2 + rng.uniform(-8, 6) - 6 * k, -gap - radius - 1.0])
        lengths = SEGMENTS_MM[k] * size
        chain = _bent(knuckle, tip, lengths, np.array([0, 0.2, -1.0]))
        knuckles.append(knuckle)
        bones += _finger(chain, radius)
    radius = 10.5 * size
    tip = np.array([0, 0, radius * 0.85 + 0.8])
    root = np.array([sign * 4, -66, -4 + rng.normal(0, 4)]) * size
    joints = np.stack([root, np.array([sign * 3, -33 + rng.normal(0, 3), radius + rng.uniform(5, 12)]) * size, tip])
    base = wrist + np.array([-sign * 12, 18, 14]) * size
    thumb = [Bone(base, root, (16 * size, 12.5 * size), 12), *_finger(joints, radius)]
    out = lofts.unit([sign * rng.uniform(-0.2, 0.5), -1, -rng.uniform(-0.1, 0.5)])
    return _hand(bones, thumb, np.array(knuckles), wrist, out, np.array([1.0, 0, 0]), size)


def lying(rng: np.random.Generator, left: bool) -> Skeleton:
    """A hand on the plane z = 0, its back up, fingers along +y, the middle of the knuckles near the origin."""
    size = rng.uniform(0.86, 1.08)
    sign = -1.0 if left else 1.0
    curl, fan = rng.uniform(0.05, 0.5), rng.uniform(0.02, 0.14)
    wrist = np.array([0, -88 * size, 24 * size])
    knuckles, bones = [], []
    for k in range(4):
        radius = RADII_MM[k] * size
        knuckle = np.array([sign * (k - 1.5) * SPACING_MM, (6, 9, 4, -6)[k], 22 + 8 * curl]) * size
        pitch = np.array([0.1, 0.35 + 0.5 * curl, 0.55 + 0.9 * curl]) + rng.normal(0, 0.06, 3)
        yaw = sign * (k - 1.5) * fan + rng.normal(0, 0.03)
        joints = [knuckle]
        for angle, length in zip(pitch, SEGMENTS_MM[k] * size, strict=True):
            step = length * np.array([np.cos(angle) * np.sin(yaw), np.cos(angle) * np.cos(yaw), -np.sin(angle)])
            joints.append(joints[-1] + step)
        joints = np.array(joints)
        joints[:, 2] = np.maximum(joints[:, 2], radius * np.array([1, 1, 0.9, 0.8]))
        knuckles.append(knuckle)
        bones += _finger(joints, radius)
    radius = 10.5 * size
    aside = rng.uniform(0.4, 1.0)
    root = np.array([-sign * (30 + 6 * aside), -42, 17]) * size
    along = np.array([-sign * np.sin(aside), np.cos(aside), -0.1])
    bend = lofts.unit(along + np.array([sign * 0.15, 0, 0]))
    joints = np.stack([root, root + THUMB_MM[0] * size * along, root + THUMB_MM.sum() * size * bend])
    joints[1:, 2] = np.maximum(joints[1:, 2], 0.9 * radius)
    thumb = [Bone(wrist + np.array([-sign * 16, 14, -4]) * size, root, (15 * size, 12.5 * size), 12), *_finger(joints, radius)]
    out = lofts.unit([rng.normal(0, 0.25), -1, rng.uniform(0.05, 0.25)])
    return _hand(bones, thumb, np.array(knuckles), wrist, out, np.array([1.0, 0, 0]), size)


def turned(hand: Skeleton, rotation: Array, translation: ArrayLike) -> Skeleton:
    """A skeleton moved by a rotation (or reflection) : (3, 3) and a translation : (3,) mm."""
    shift = np.asarray(translation, float)
    bones = tuple(Bone(rotation @ b.start + shift, rotation @ b.end + shift, b.radii, b.blend) for b in hand.bones)
    return Skeleton(bones, rotation @ hand.wrist + shift, rotation @ hand.forearm, rotation @ hand.broad, hand.size)


def skin(hand: Skeleton, arm_mm: float, voxel: float = VOXEL_MM) -> trimesh.Trimesh:
    """The skin over a skeleton, with a bare forearm of `arm_mm` beyond the wrist: closed, two bodies that overlap."""
    low = np.min([np.minimum(b.start, b.end) - max(b.radii) for b in hand.bones], axis=0) - 2 * voxel
    high = np.max([np.maximum(b.start, b.end) + max(b.radii) for b in hand.bones], axis=0) + 2 * voxel
    shape = np.ceil((high - low) / voxel).astype(int) + 1
    reach_mm = 14.0  # how far from a capsule its distance matters to the smooth minimum
    field = np.full(shape, reach_mm, np.float32)
    for bone in hand.bones:
        margin = max(bone.radii) + reach_mm
        first = np.maximum(np.floor((np.minimum(bone.start, bone.end) - margin - low) / voxel).astype(int), 0)
        last = np.minimum(np.ceil((np.maximum(bone.start, bone.end) + margin - low) / voxel).astype(int) + 1, shape)
        here = tuple(slice(a, b) for a, b in zip(first, last, strict=True))
        axes = [(low[k] + voxel * np.arange(first[k], last[k])).astype(np.float32) for k in range(3)]
        field[here] = _smooth_minimum(field[here], _distance(bone, axes), bone.blend)
    if voxel <= CLOSE_MM:  # a level that passes next to a corner of a voxel leaves slivers there, whose normals show as specks
        field = np.copysign(np.maximum(np.abs(field), np.float32(0.1 * voxel)), field)
    vertices, faces, _, _ = marching_cubes(field, 0.0, spacing=(voxel,) * 3)
    hand_mesh = trimesh.Trimesh(vertices.astype(float) + low, faces, process=False)
    if hand_mesh.volume < 0:
        hand_mesh = trimesh.Trimesh(hand_mesh.vertices, faces[:, ::-1], process=False)
    if arm_mm <= STUMP_MM:
        return hand_mesh
    return lofts.joined([hand_mesh, _cuff(hand, STUMP_MM - 25, arm_mm, 0.3)])


def _cuff(hand: Skeleton, start_mm: float, end_mm: float, thick_mm: float) -> trimesh.Trimesh:
    """A closed tube about the forearm from `start_mm` to `end_mm` beyond the wrist: bare arm, sleeve, glove or watch strap."""
    edge = min(0.3 * (end_mm - start_mm), max(thick_mm, 0.4))
    middle = np.linspace(start_mm + edge, end_mm - edge, max(4, int((end_mm - start_mm) / 12)))
    along = np.concatenate([[start_mm, start_mm + 0.3 * edge], middle, [end_mm - 0.3 * edge, end_mm]])
    path = hand.wrist + along[:, None] * hand.forearm
    across = np.cross(hand.forearm, hand.broad)
    wide, thick = _arm(along, hand.size)
    inset = np.zeros(len(along))
    inset[[0, -1]], inset[[1, -2]] = 1.0, 0.3
    extra = thick_mm - inset * edge
    turn = 2 * np.pi * np.arange(36) / 36
    broad = lofts.unit(hand.broad - (hand.broad @ hand.forearm) * hand.forearm)
    across = np.cross(hand.forearm, broad)
    rings = (
        path[:, None]
        + ((wide + extra)[:, None] * np.cos(turn))[..., None] * broad
        + ((thick + extra)[:, None] * np.sin(turn))[..., None] * across
    )
    return lofts.loft(rings)


def look(rng: np.random.Generator, hand: Skeleton, mesh: trimesh.Trimesh) -> tuple[trimesh.Trimesh, NDArray[np.float32]]:
    """The skin with creases at the joints, tendons over the back of the hand and nails, and its reflectance : (vertices,).

    Creases are paler within and darker along their bottoms, nails paler and knuckles darker than the rest, which is mottled.
    """
    vertices, normals = np.asarray(mesh.vertices), np.asarray(mesh.vertex_normals)
    raised, shade = np.zeros(len(vertices)), np.ones(len(vertices))
    for digit in hand.digits:
        joints = np.array([digit[0].start, *(bone.end for bone in digit)])
        ways = [lofts.unit(bone.end - bone.start) for bone in digit]
        axis = np.cross(ways[0], ways[-1])
        axis = lofts.unit(axis) if np.linalg.norm(axis) > 1e-3 else hand.broad
        bulge = joints[1:-1].mean(axis=0) - joints[[0, -1]].mean(axis=0)
        axis = axis if np.cross(axis, ways[0]) @ bulge > 0 else -axis  # the back is outside of the bend
        for k, (bone, way) in enumerate(zip(digit, ways, strict=True)):
            radius, from_tip = bone.radii[1], vertices - bone.end
            if k + 1 < len(digit):
                way = lofts.unit(way + ways[k + 1])
            back = np.cross(axis, way)
            along, out, aside = from_tip @ way, from_tip @ back, from_tip @ axis
            about = np.hypot(out, aside) < 1.7 * radius
            if k + 1 < len(digit):
                behind = 1 / (1 + np.exp(-4 * out / radius))  # 1 on the back, 0 on the palm's side
                fold = np.exp(-((along / 1.1) ** 2)) * (1 - behind) + 0.4 * behind * _folds(along)
                raised -= 0.9 * about * fold
                shade *= 1 - 0.25 * about * fold
                shade *= 1 - 0.1 * behind * np.exp(-(np.sum(from_tip**2, axis=1) / (1.6 * radius) ** 2))
            else:
                over = (np.abs((along + 0.35 * radius) / radius) ** 3 + np.abs(aside / (0.68 * radius)) ** 3) ** (
                    1 / 3
                )  # 1 at the rim
                nail = (out > 0.3 * radius) & (out < 1.5 * radius)
                rim = np.exp(-(((over - 1.1) / 0.14) ** 2))
                raised -= 0.35 * nail * rim
                shade *= 1 + nail * (0.2 / (1 + np.exp(20 * np.minimum(over - 1, 2))) - 0.12 * rim)
    back = np.cross(hand.broad, hand.forearm)
    back = back if back @ (np.mean([bone.end for bone in hand.bones[2:6]], axis=0) - _middle(hand)) > 0 else -back
    for bone in hand.bones[2:6]:
        part = np.clip((vertices - bone.start) @ (bone.end - bone.start) / np.sum((bone.end - bone.start) ** 2), 0, 1)
        away = vertices - bone.start - part[:, None] * (bone.end - bone.start)
        aside = away - (away @ back)[:, None] * back
        on_back = (away @ back > 0) & (np.linalg.norm(away, axis=1) < 1.6 * max(bone.radii))
        raised += 1.1 * on_back * np.exp(-np.sum(aside**2, axis=1) / 2.6**2) * np.sin(np.pi * np.clip(part, 0.05, 1)) ** 0.5
    mottled = 0.05 * smooth_noise(vertices, 25.0, rng) + 0.03 * smooth_noise(vertices, 5.0, rng)
    albedo = rng.uniform(*SKIN) * shade * np.exp(mottled)
    return trimesh.Trimesh(vertices + raised[:, None] * normals, mesh.faces, process=False), np.float32(albedo)


def _folds(along: Array) -> Array:
    """Three wrinkles across a knuckle."""
    return sum(np.exp(-(((along - place) / 0.8) ** 2)) for place in (-3.2, 0.0, 3.2))


def _middle(hand: Skeleton) -> Array:
    """Of the fingers, which lie on the palm's side of the knuckles."""
    return np.mean([bone.end for digit in hand.digits[1:] for bone in digit[1:]], axis=0)


def _skin_part(rng: np.random.Generator, hand: Skeleton, arm_mm: float, voxel: float) -> Part:
    mesh, albedo = skin(hand, arm_mm, voxel), None
    if voxel <= CLOSE_MM:
        mesh, albedo = look(rng, hand, mesh)
    return Part("skin", mesh, True, albedo)


def clothed(rng: np.random.Generator, skeleton: Skeleton, voxel: float = VOXEL_MM) -> list[Part]:
    """Skin, of voxels some mm wide, and a sleeve, the cuff of a glove, a watch or nothing on the forearm."""
    kind = rng.choice(["sleeve", "watch", "glove", "bare"], p=[0.4, 0.2, 0.12, 0.28])
    if kind == "sleeve":
        start = rng.uniform(5, 110)
        bare = start + 40
        cloth = _cuff(skeleton, start, rng.uniform(280, 380), rng.uniform(3, 9))
    elif kind == "watch":
        start, bare = rng.uniform(8, 22), rng.uniform(280, 380)
        wide = rng.uniform(16, 30)
        strap = _cuff(skeleton, start, start + wide, rng.uniform(1.2, 2.5))
        side = np.cross(skeleton.forearm, skeleton.broad) * rng.choice([-1, 1])
        spot = skeleton.wrist + (start + wide / 2) * skeleton.forearm + 21 * skeleton.size * side
        face = lofts.prism(lofts.superellipse((18, 18), rng.choice([2, 5]), 32), 9, 1)
        face = lofts.placed(face, lofts.frame(spot, side, skeleton.forearm))
        cloth = lofts.joined([strap, face])
    elif kind == "glove":
        start, bare = rng.uniform(0, 15), rng.uniform(280, 380)
        cloth = _cuff(skeleton, start, start + rng.uniform(40, 90), rng.uniform(1.5, 4))
    else:
        return [_skin_part(rng, skeleton, rng.uniform(280, 380), voxel)]
    return [_skin_part(rng, skeleton, bare, voxel), Part("sleeve", cloth, True)]


def _arm(along: ArrayLike, size: float) -> tuple[Array, Array]:
    """Half width and half thickness : (n,) mm of a forearm at distances from the wrist."""
    part = np.clip(np.asarray(along, float) / 250, 0, 1) ** 0.8
    return size * (29 + 14 * part), size * (21 + 17 * part)


def _hand(bones: list[Bone], thumb: list[Bone], knuckles: Array, wrist: Array, out: Array, broad: Array, size: float) -> Skeleton:
    """Complete fingers and thumb by the palm and the stump of the forearm; the palm comes first, to melt into one body."""
    broad = lofts.unit(broad - (broad @ out) * out)
    inside = []
    for shift in (-1, 1):
        ends = []
        for along in (0.0, STUMP_MM):
            wide, thick = _arm(along, size)
            ends.append((wrist + along * out + shift * (wide - thick) * broad, float(thick)))
        inside.append(Bone(ends[0][0], ends[1][0], (ends[0][1], ends[1][1]), 14))
    spread = broad if (knuckles[0] - knuckles[-1]) @ broad > 0 else -broad
    carpals = [wrist + (1.5 - k) * 9 * size * spread for k in range(4)]
    palm = [Bone(carpals[k], knuckles[k], (15 * size, (11.6, 11.8, 11.2, 10.2)[k] * size), 12) for k in range(4)]
    heads = [Bone(knuckles[k], knuckles[k + 1], (10.0 * size, 9.6 * size), 8) for k in range(3)]
    return Skeleton((*inside, *palm, *heads, *thumb, *bones), wrist, out, broad, size)


def _finger(joints: Array, radius: float) -> list[Bone]:
    """Bones between joints : (k, 3) that thin out to the tip, slightly thicker at the joints."""
    radii = radius * np.linspace(1.05, 0.80, len(joints))
    bones = []
    for k in range(len(joints) - 1):
        bones.append(Bone(joints[k], joints[k + 1], (radii[k], radii[k + 1]), 4.0 if k == 0 else 2.5))
    return bones


def _distance(bone: Bone, axes: list[NDArray[np.float32]]) -> NDArray[np.float32]:
    """Distance to a tapered capsule on a grid, mm, negative inside; exact for equal radii, near enough for a slight taper."""
    along = (bone.end - bone.start).astype(np.float32)
    x, y, z = (axis - np.float32(start) for axis, start in zip(axes, bone.start, strict=True))
    x, y, z = x[:, None, None], y[None, :, None], z[None, None, :]
    part = np.clip((x * along[0] + y * along[1] + z * along[2]) / max(float(along @ along), 1e-6), 0, 1)
    squared = (x - part * along[0]) ** 2 + (y - part * along[1]) ** 2 + (z - part * along[2]) ** 2
    return np.sqrt(squared) - np.float32(bone.radii[0]) - part * np.float32(bone.radii[1] - bone.radii[0])


def _smooth_minimum(a: NDArray[np.float32], b: NDArray[np.float32], width: float) -> NDArray[np.float32]:
    """The smaller of two distances, rounded by a parabola where they differ by less than `width` mm."""
    near = np.maximum(1 - np.abs(a - b) / np.float32(width), 0)
    return np.minimum(a, b) - near**2 * np.float32(width / 4)


@dataclass(frozen=True, eq=False)
class _Round:
    """A convex outline by its support: of each of 180 directions the outline's farthest point."""

    farthest: Array  # (180, 2), mm
    normals: Array  # (180, 2), unit

    def at(self, distance: float) -> Array:
        """The outline grown by a distance : (180, 2) mm."""
        return self.farthest + distance * self.normals


def _round(outline: Array) -> _Round:
    turn = 2 * np.pi * np.arange(180) / 180
    normals = np.stack([np.cos(turn), np.sin(turn)], axis=-1)
    return _Round(outline[(outline @ normals.T).argmax(axis=0)], normals)


def _support(outline: Array, angle: float) -> float:
    return float((outline @ [np.cos(angle), np.sin(angle)]).max())


def _walk(outline: _Round, distances: Array, start: float, lengths: Array, way: int) -> Array:
    """Joints : (k + 1, 2) around a convex outline, each a segment's length on from the last.

    distances : (k + 1,) mm, of the joints from the outline: a segment between two of them bulges away less than they stand off.
    """
    turn = start + way * DEGREES
    ways = np.stack([np.cos(turn), np.sin(turn)], axis=-1)
    joints, first = [], 0
    for k, distance in enumerate(distances):
        contour = outline.at(distance)
        angle = np.arctan2(contour[:, 1], contour[:, 0])
        points = np.interp(turn, angle, np.hypot(*contour.T), period=2 * np.pi)[:, None] * ways
        if k:
            far = np.flatnonzero(np.linalg.norm(points[first:] - joints[-1], axis=1) >= lengths[k - 1])
            first = first + int(far[0]) if len(far) else 359
        joints.append(points[first])
    return np.array(joints)


def _bent(start: Array, end: Array, lengths: Array, bulge: Array) -> Array:
    """A chain : (4, 3) of three segments from start to end that bulges to one side as far as its lengths allow."""
    straight = float(np.linalg.norm(end - start))
    spare = np.sqrt(max(lengths.sum() ** 2 - straight**2, 0.0)) / 2.6
    parts = np.cumsum(lengths)[:-1] / lengths.sum()
    inner = [start + part * (end - start) + spare * height * bulge for part, height in zip(parts, (1.0, 0.75), strict=True)]
    return np.array([start, *inner, end])
