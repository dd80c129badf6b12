"""Light that spreads beneath a translucent surface, such as skin or silicone, before it comes out again.

Light that enters at a point leaves around it with the density of normalised diffusion [Christensen & Burley 2015],
`R(r) = (exp(-r/d) + exp(-r/3d)) / (8 pi d r)`, d the length of the spread. Over some such lengths the surface is taken as flat
and lit evenly but for the pattern: a pattern that varies along one axis of the raster is then blurred along it, with a modulation
transfer in closed form. The profiles are blurred beforehand for a series of lengths in projector px, so the spread adds no
rendering noise. It doesn't go round edges or across the border of a shadow, and the surface's gloss has none.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from recon.model.patterns import Axis
from twin.optics.instruments import ProjectorOptics, pixels_per_mm
from twin.optics.raster import AXES, OVERSAMPLING, AxisTable, Light, Profiles, within

SHORTEST_PX, LONGEST_PX = 2.0**-4, 2.0**5  # lengths that are tabulated
OCTAVE = 2  # lengths an octave; between them the modulation is off by 0.004 at most
REACH = 20.0  # lengths, beyond which nothing comes out: exp(-20 / 3)

Translucent = Sequence[tuple[mi.Shape, float]]  # shapes beneath which light spreads, and its lengths, mm


def modulation_transfer(cycles: NDArray[np.float64]) -> NDArray[np.float64]:
    """Modulation that the spread leaves of waves with some cycles a length d.

    The Fourier transform of R along any line, from that of `exp(-a r) / r` in the plane, `2 pi / sqrt(a^2 + k^2)`:
    `(1 / sqrt(1 + (d k)^2) + 3 / sqrt(1 + (3 d k)^2)) / 4` for the angular frequency k.
    """
    angle = 2 * np.pi * cycles
    return (1 / np.hypot(1, angle) + 3 / np.hypot(1, 3 * angle)) / 4


def blurred(fine: Profiles, length_px: float) -> Profiles:
    """Finely sampled profiles : (n, steps), as of `Light.fine_profiles`, after a spread of a length."""
    length = length_px * OVERSAMPLING
    beyond = int(np.ceil(REACH * length))
    padded = np.pad(fine, ((0, 0), (beyond, beyond)))
    steps = padded.shape[1]
    spread = np.fft.irfft(np.fft.rfft(padded) * modulation_transfer(length * np.fft.rfftfreq(steps)), steps)
    return np.float32(spread[:, beyond:-beyond])


@dataclass(frozen=True)
class LightSpread:
    """Light of N patterns after its spread beneath the translucent shapes of a scene."""

    size: tuple[int, int]  # width, height, px
    order: tuple[int, ...]  # see `LightTable`
    steps: dict[Axis, int]  # of one length's profiles
    tables: dict[Axis, AxisTable]  # the lengths' profiles one after the other
    translucent: Translucent

    @classmethod
    def of(cls, translucent: Translucent, light: Light) -> "LightSpread":
        """Tabulate the spread of a sequence's light."""
        lengths = np.geomspace(SHORTEST_PX, LONGEST_PX, _count())
        fine = {axis: light.fine_profiles(axis) for axis in AXES if axis in light.axes}
        tables = {
            axis: AxisTable.of(np.concatenate([blurred(profiles, length) for length in lengths], axis=1))
            for axis, profiles in fine.items()
        }
        return cls(light.size, light.order, {axis: rows.shape[1] for axis, rows in fine.items()}, tables, translucent)

    def length_mm(self, shape: mi.ShapePtr) -> mi.Float:
        """Length of the spread beneath a shape; 0 if it is opaque."""
        length = mi.Float(0)
        for one, value in self.translucent:
            length = dr.select(shape == mi.ShapePtr(one), value, length)
        return length

    def lookup(
        self, projector: ProjectorOptics, hit: mi.SurfaceInteraction3f, pixel: mi.Point2f, active: mi.Bool
    ) -> list[mi.Float]:
        """Light of each pattern where it leaves a surface; pixel : px, that lights it there. None outside the raster."""
        active &= within(self.size, pixel)
        lengths = self.length_mm(hit.shape) * pixels_per_mm(projector, hit.p, hit.n)
        values: list[mi.Float] = []
        for axis, table in self.tables.items():
            coordinate, length = (pixel.x, lengths.x) if axis == "columns" else (pixel.y, lengths.y)
            number = dr.clip(OCTAVE * dr.log2(length / SHORTEST_PX), 0, _count() - 1.001)
            shorter = mi.UInt32(number)
            low = table.lookup(coordinate, active, shorter * self.steps[axis])
            high = table.lookup(coordinate, active, (shorter + 1) * self.steps[axis])
            values += [dr.lerp(*pair, number - shorter) for pair in zip(low, high, strict=True)]
        return [values[k] for k in self.order]


def _count() -> int:
    return round(np.log2(LONGEST_PX / SHORTEST_PX)) * OCTAVE + 1
