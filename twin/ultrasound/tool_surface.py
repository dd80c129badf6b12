"""A tool's surface as facets: its tip, finer than a wavelength, whose echoes add up with their phases, and the shaft's roughness.

The whole cylinder behind the tip is left to the series of `tool_resonance`, as a line on its axis. What its roughness scatters
comes from patches all over it, each with a phase of its own, which belongs to the tool and moves with it.
"""

from collections.abc import Callable
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from scenes.handheld.shaft import Shaft

Array = NDArray[np.float64]

FACET = 1 / 8  # side of a facet in wavelengths: 1.6 rad of phase both ways
PATCH = 1 / 2  # of a rough patch
SEEN_MM = 90.0  # of a shaft from its tip, at most
SEED = 5  # of the phases of patches


class Facets(NamedTuple):
    """Facets in a tool's frame, of which x is `up`, z `along`, and the origin where the axis ends."""

    place: Array  # (n, 3) mm
    normal: Array  # (n, 3) outward
    area: Array  # (n,) mm²
    roughness: Array  # (n,) mm
    phase: Array  # (n,) rad, of what roughness scatters
    smooth: NDArray[np.bool_]  # (n,) whether it also reflects; else another counts that


class Form(NamedTuple):
    """Shape of a tool, and the length of the waves that its surface is cut into facets for."""

    kind: str
    radius: float
    bore: float
    angle: float
    ball: float
    length: float
    roughness: float
    etched: float
    etched_roughness: float
    wavelength: float  # mm


def form_of(shaft: Shaft, wavelength_mm: float) -> Form:
    """The form of a shaft, by which its facets are kept."""
    rough = shaft.material.roughness, shaft.etched, shaft.etched_roughness
    return Form(shaft.kind, shaft.radius, shaft.bore, float(shaft.angle), shaft.ball, shaft.length, *rough, wavelength_mm)


def frame_of(shaft: Shaft) -> Array:
    """Pose of a tool's frame in that of the shaft : (4, 4)."""
    pose = np.eye(4)
    pose[:3, :3] = np.column_stack([shaft.up, np.cross(shaft.along, shaft.up), shaft.along])
    pose[:3, 3] = shaft.foremost
    return pose


@lru_cache(maxsize=16)
def facets(form: Form) -> Facets:
    """Facets of a tip, and patches of the shaft behind it."""
    tip = {"bevel": _bevel, "cone": _cone, "ball": _ball}[form.kind](form)
    patches = _patches(form)
    places, normals, areas = (np.concatenate(parts) for parts in zip(tip, patches, strict=True))
    smooth = np.arange(len(areas)) < len(tip[2])
    rough = np.where(-places[:, 2] < form.etched, form.etched_roughness, form.roughness)
    phases = np.random.default_rng(SEED).uniform(0, 2 * np.pi, len(areas))
    return Facets(places, normals, areas, rough, phases, smooth)


Surface = tuple[Array, Array, Array]  # places, normals, areas


def _bevel(form: Form) -> Surface:
    """The cut wall, and the outer wall beside it: the cut leads from the point at x = -radius up to the heel at x = radius."""
    a, slope, side = form.radius, 1 / np.tan(form.angle), FACET * form.wavelength
    count = int(np.ceil(2 * np.pi * a / side))
    turn = 2 * np.pi * (np.arange(count) + 0.5) / count
    out = np.column_stack([np.cos(turn), np.sin(turn), np.zeros(count)])
    seam, cut = -2 * a * slope, -a * (1 + out[:, 0]) * slope
    wall = [_strip(out[k], a, cut[k], seam, 2 * np.pi * a / count, side) for k in range(count)]
    rings = int(np.ceil((a - form.bore) / side))
    edges = np.linspace(form.bore, a, rings + 1)
    middles, fine = (edges[1:] + edges[:-1]) / 2, int(np.ceil(2 * np.pi * a / np.sin(form.angle) / side))
    turn = 2 * np.pi * (np.arange(fine) + 0.5) / fine
    radius, turn = (each.ravel() for each in np.meshgrid(middles, turn, indexing="ij"))
    x, y = radius * np.cos(turn), radius * np.sin(turn)
    face = np.column_stack([x, y, -(a + x) * slope])
    area = radius * (a - form.bore) / rings * 2 * np.pi / fine / np.sin(form.angle)
    normal = np.tile([np.cos(form.angle), 0.0, np.sin(form.angle)], (len(x), 1))
    return _joined([*wall, (face, normal, area)])


def _strip(out: Array, radius: float, first: float, last: float, width: float, side: float) -> Surface:
    """Facets down a cylinder's wall, of which one direction : (3,) leads out, from one height to a lower one."""
    count = int(np.ceil((first - last) / side))
    heights = first + (last - first) * (np.arange(count) + 0.5) / max(count, 1)
    places = radius * out + np.outer(heights, [0.0, 0.0, 1.0])
    return places, np.tile(out, (count, 1)), np.full(count, width * (first - last) / max(count, 1))


def _cone(form: Form) -> Surface:
    """The side of a cone."""
    slant, side = form.radius / np.sin(form.angle), FACET * form.wavelength
    return _turned(np.linspace(0, slant, int(np.ceil(slant / side)) + 1), side, lambda s: (
        s * np.sin(form.angle), -s * np.cos(form.angle), np.cos(form.angle), np.sin(form.angle)
    ))  # fmt: skip


def _ball(form: Form) -> Surface:
    """A ball, but where the shaft leaves it."""
    r, side = form.ball, FACET * form.wavelength
    last = np.pi - np.arcsin(min(form.radius / r, 1.0))
    steps = np.linspace(0, last * r, int(np.ceil(last * r / side)) + 1)
    return _turned(steps, side, lambda s: (r * np.sin(s / r), r * (np.cos(s / r) - 1), np.sin(s / r), np.cos(s / r)))


def _turned(steps: Array, side: float, at: Callable[[float], tuple[float, float, float, float]]) -> Surface:
    """A body of revolution: `at` gives radius, height, and the normal in these directions, for a length along its outline."""
    parts = []
    for s, width in zip((steps[1:] + steps[:-1]) / 2, np.diff(steps), strict=True):
        radius, height, outward, onward = at(s)
        count = max(int(np.ceil(2 * np.pi * radius / side)), 4)
        turn = 2 * np.pi * (np.arange(count) + 0.5) / count
        out = np.column_stack([np.cos(turn), np.sin(turn)])
        places = np.column_stack([radius * out, np.full(count, height)])
        normals = np.column_stack([outward * out, np.full(count, onward)])
        parts.append((places, normals, np.full(count, 2 * np.pi * radius * width / count)))
    return _joined(parts)


def _patches(form: Form) -> Surface:
    """Patches all over the whole cylinder."""
    first, side = -blunt_mm(form), PATCH * form.wavelength
    last, count = -min(form.length, SEEN_MM), max(int(np.ceil(2 * np.pi * form.radius / side)), 6)
    heights = np.arange(first - side / 2, last, -side)
    turn = 2 * np.pi * (np.arange(count) + 0.5) / count
    out = np.column_stack([np.cos(turn), np.sin(turn), np.zeros(count)])
    places = (form.radius * out[None] + heights[:, None, None] * [0.0, 0.0, 1.0]).reshape(-1, 3)
    area = np.full(len(places), side * 2 * np.pi * form.radius / count)
    return places, np.tile(out, (len(heights), 1)), area


def blunt_mm(form: Form) -> float:
    """Length of the tip, before which the shaft is a whole cylinder."""
    if form.kind == "ball":
        return form.ball + float(np.sqrt(max(form.ball**2 - form.radius**2, 0.0)))
    return (2 if form.kind == "bevel" else 1) * form.radius / float(np.tan(form.angle))


def _joined(parts: list[Surface]) -> Surface:
    return tuple(np.concatenate(each) for each in zip(*parts, strict=True))
