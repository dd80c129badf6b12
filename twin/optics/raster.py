"""The projector's raster: light of its micromirrors, and the table from which the ray tracer reads it.

All patterns of a sequence vary along one axis, so their light is kept as profiles along that axis, finely sampled and blurred
by the lens's point spread. Defocus is not in here: it comes from tracing through the lens.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

from recon.model.patterns import Axis, Patterns
from recon.model.rig import ProjectorDevice

OVERSAMPLING = 16  # table entries a projector px; read with linear interpolation
MARGIN = 8  # projector px of the table beyond either end of the raster
PACKET = 4  # pattern values fetched by one gather
AXES: tuple[Axis, Axis] = ("columns", "rows")

Profiles = NDArray[np.float32]


@dataclass(frozen=True)
class Light:
    """Light of a projector for a sequence of patterns, 1 for a pixel that is fully on."""

    size: tuple[int, int]  # width, height, px
    axes: tuple[Axis, ...]  # (n,) along which each pattern varies
    profiles: tuple[Profiles, ...]  # (n,) of (length of the axis,)
    blur_px: float  # standard deviation of the lens's point spread in focus

    @classmethod
    def of(cls, patterns: Patterns, device: ProjectorDevice) -> "Light":
        """Patterns as a rig's projector shows them."""
        return cls.of_profiles(patterns.projector_size, patterns.profiles(), device)

    @classmethod
    def of_profiles(
        cls, size: tuple[int, int], profiles: Sequence[tuple[Axis, bool, Profiles]], device: ProjectorDevice
    ) -> "Light":
        """The same of patterns as of `Patterns.profiles`: grey values pass gamma, binary ones don't; black is 1/contrast."""
        black = 1 / device.contrast
        emitted = []
        for _, binary, values in profiles:
            on = values if binary else (np.round(values * 255) / 255) ** device.gamma
            emitted.append(np.float32(black + (1 - black) * on))
        return cls(size, tuple(axis for axis, _, _ in profiles), tuple(emitted), device.lens.blur_px)

    @property
    def count(self) -> int:
        """Patterns."""
        return len(self.axes)

    @property
    def order(self) -> tuple[int, ...]:
        """Place of each pattern : (n,) when those along columns come first, then those along rows."""
        places = sorted(range(len(self.axes)), key=lambda k: AXES.index(self.axes[k]))  # stable
        return tuple(int(k) for k in np.argsort(places))

    def fine_profiles(self, axis: Axis) -> Profiles:
        """Profiles of the patterns of one axis behind the lens : (patterns of that axis, (length + 2 MARGIN) * OVERSAMPLING).

        Entry i lies at projector coordinate `(i + 1/2) / OVERSAMPLING - 1/2 - MARGIN`.
        """
        rows = [profile for kind, profile in zip(self.axes, self.profiles, strict=True) if kind == axis]
        mirrors = np.repeat(np.pad(np.array(rows), ((0, 0), (MARGIN, MARGIN))), OVERSAMPLING, axis=1)
        return gaussian_filter1d(mirrors, self.blur_px * OVERSAMPLING, axis=1, mode="constant") if self.blur_px else mirrors


@dataclass(frozen=True)
class AxisTable:
    """Light of the patterns of one axis at fine steps along it, one step's values side by side in memory."""

    values: mi.Float  # padded to whole packets a step
    count: int  # patterns

    @classmethod
    def of(cls, fine: Profiles) -> "AxisTable":
        """Lay out profiles : (n, steps)."""
        padded = np.pad(fine, ((0, -len(fine) % PACKET), (0, 0)))
        return cls(mi.Float(np.ascontiguousarray(padded.T).ravel()), len(fine))

    def lookup(self, coordinate: mi.Float, active: mi.Bool, before: mi.UInt32 | int = 0) -> list[mi.Float]:
        """Light of each pattern at a coordinate in px, in a table that has some steps before the axis's own."""
        packets = -(-self.count // PACKET)
        position = (coordinate + 0.5 + MARGIN) * OVERSAMPLING - 0.5
        below = dr.floor(position)
        fraction = position - below
        first = (mi.UInt32(below) + before) * packets
        values: list[mi.Float] = []
        for packet in range(packets):
            low = dr.gather(mi.Vector4f, self.values, first + packet, active)
            high = dr.gather(mi.Vector4f, self.values, first + packets + packet, active)
            values.extend(dr.lerp(low, high, fraction))
        return values[: self.count]


@dataclass(frozen=True)
class LightTable:
    """Light of N patterns at any projector coordinate."""

    size: tuple[int, int]  # width, height, px
    order: tuple[int, ...]  # (n,) place of each pattern among the values looked up: columns first, then rows
    tables: dict[Axis, AxisTable]

    @classmethod
    def of(cls, light: Light) -> "LightTable":
        """Lay out the light of a sequence."""
        return cls(
            light.size, light.order, {axis: AxisTable.of(light.fine_profiles(axis)) for axis in AXES if axis in light.axes}
        )

    @property
    def count(self) -> int:
        """Number of patterns."""
        return len(self.order)

    def lookup(self, pixel: mi.Point2f, active: mi.Bool) -> list[mi.Float]:
        """Light of each pattern at projector coordinates in px; none outside the raster."""
        active &= within(self.size, pixel)
        values: list[mi.Float] = []
        for axis, table in self.tables.items():
            values += table.lookup(pixel.x if axis == "columns" else pixel.y, active)
        return [values[k] for k in self.order]


def within(size: tuple[int, int], pixel: mi.Point2f) -> mi.Bool:
    """Whether projector coordinates in px lie on the raster of a size."""
    width, height = size
    return (pixel.x > -0.5) & (pixel.x < width - 0.5) & (pixel.y > -0.5) & (pixel.y < height - 0.5)
