"""The body of a linear-array ultrasound probe: a wide head with the lens, a waist for the hand, a neck for the cable.

Body frame: z along the probe from the array's face at z = 0 to the back, x along the array.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import PchipInterpolator

from recon.geometry import rigid
from scenes.handheld import lofts
from scenes.handheld.mesh_parts import Part

Array = NDArray[np.float64]

SIDES = 48  # of a cross-section
LENS_MM = 1.8  # by which the acoustic lens stands out of the housing
ARRAY_MM = 39.5  # for which bodies are drawn


@dataclass(frozen=True, eq=False)
class Body:
    """Cross-sections of a probe: superellipses whose half axes vary along its length."""

    length: float  # mm
    levels: Array  # (k,), fractions of the length
    half: Array  # (k, 2), mm, along the array and across it
    exponent: float
    neck: float  # mm, radius of the back where the cable leaves

    @cached_property
    def _halves(self) -> PchipInterpolator:
        return PchipInterpolator(self.levels, self.half)

    def outline_at(self, part: float) -> Array:
        """The cross-section : (SIDES, 3) mm at a fraction of the length, about the axis, z = 0."""
        half = self._halves(np.clip(part, 0.02, 0.98))
        return np.column_stack([lofts.superellipse(half, self.exponent, SIDES), np.zeros(SIDES)])


def body(rng: np.random.Generator) -> Body:
    """A random probe: T-shaped as most linear arrays, or a straight block as some."""
    length, width, thick = rng.uniform(100, 155), rng.uniform(27, 33), rng.uniform(10.5, 14.5)
    waist = rng.uniform(15, 20) if rng.uniform() < 0.75 else rng.uniform(21, 26)
    grip = thick * rng.uniform(0.95, 1.25)
    shoulder, neck = rng.uniform(0.3, 0.42), rng.uniform(8, 11)
    levels = [0, 0.012, 0.04, 0.1, shoulder - 0.1, shoulder, shoulder + 0.16, 0.72, 0.9, 0.96, 0.99, 1.0]
    wide = [0.80, 0.93, 0.99, 1.0, 0.99, 0.9]
    half = [(width * w, thick * min(1, w - 0.03 * (k < 2))) for k, w in enumerate(wide)]
    half += [(waist * 1.03, grip), (waist * rng.uniform(0.95, 1.1), grip * 1.03)]
    end = (max(0.86 * waist, neck + 2), max(0.92 * grip, neck + 1))
    half += [end, (0.92 * end[0], 0.92 * end[1]), (0.8 * end[0], 0.8 * end[1]), (0.62 * end[0], 0.62 * end[1])]
    return Body(length, np.array(levels), np.array(half), rng.uniform(2.3, 4.2), neck)


def scaled(probe: Body, array_mm: float) -> Body:
    """A body as wide as an array of a length demands."""
    return replace(probe, half=probe.half * [array_mm / ARRAY_MM, 1.0])


def lens(rng: np.random.Generator) -> Array:
    """Size of a random acoustic lens : (2,) mm, along the array and across it."""
    return np.array([rng.uniform(38, 48), rng.uniform(9, 13)])


def parts_of(probe: Body, lens_mm: Array, rng: np.random.Generator) -> list[Part]:
    """Housing, acoustic lens, and small marks upon it, in the body's frame."""
    levels = np.unique(np.concatenate([probe.levels, np.linspace(0.06, 0.94, 22)]))
    half = PchipInterpolator(probe.levels, probe.half)(levels)
    rings = [
        np.column_stack([lofts.superellipse(h, probe.exponent, SIDES), np.full(SIDES, level * probe.length)])
        for h, level in zip(half, levels, strict=True)
    ]
    parts = [Part("probe", lofts.loft(rings), True)]
    face = lofts.prism(lofts.rounded(lens_mm, 3), 3.0, 1.2)
    parts.append(Part("marking", lofts.placed(face, rigid.transform(np.eye(3), [0, 0, -LENS_MM])), True))
    for _ in range(rng.integers(1, 5)):
        parts.append(_mark(probe, rng))
    return parts


def _mark(probe: Body, rng: np.random.Generator) -> Part:
    """A label, a button or the ridge on the image's left side: low plates on the housing."""
    level = rng.uniform(0.15, 0.85)
    half = np.abs(probe.outline_at(level)).max(axis=0)
    size = np.minimum(rng.uniform(3, 22, 2), half[0] * np.array([0.9, 1.2]))
    broad = rng.uniform() < 0.7
    sign = rng.choice([-1, 1])
    normal = np.array([0, sign, 0]) if broad else np.array([sign, 0, 0])
    if not broad:
        size[0] = min(size[0], 0.8 * half[1])
    plate = lofts.prism(lofts.rounded(size, rng.uniform(0.3, 4), 3), 2.0, 0.4)
    middle = normal * (half[1] if broad else half[0]) + [0, 0, level * probe.length] - 1.3 * normal
    return Part("marking", lofts.placed(plate, lofts.frame(middle, normal, [normal[1], normal[0], 0])), True)
