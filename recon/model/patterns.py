"""Pattern sequences: one definition that the projector shows and that the decoder reads.

A sequence is a list of parts, shown in order. Every pattern varies along one projector axis only and is a function of the
projector coordinate x in px (pixel centres at integers), with values from 0 to 1.
"""

from collections.abc import Sequence
from functools import partial
from typing import Annotated, Any, Literal, TypeVar

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, PlainValidator, model_validator

from recon import registry
from recon.model.rig import Part

Axis = Literal["columns", "rows"]  # which projector coordinate the pattern encodes
UNWRAPPINGS = "recon.structured_light.fringe_orders"  # a module each
Unwrapping = Annotated[str, PlainValidator(partial(registry.known, UNWRAPPINGS))]
Image = NDArray[np.float32]
Side = Annotated[int, Field(ge=8, le=20000)]  # px

MISPLACED = 0.05  # projector px that binary fringes may lie off their origin


class Fringes(Part):
    """N-step fringes `I_k = (1 + cos(phase + shift_k)) / 2`, `phase = 2 pi (x - origin) / pitch`."""

    kind: Literal["fringes"] = "fringes"
    axis: Axis = "columns"
    pitch: float = Field(gt=2)  # projector px a period; finer ones no raster shows
    steps: int = Field(ge=3, le=1000)  # phase shifts
    first: Annotated[int, Field(ge=-1000, le=1000)] = 0  # of the first shift: shift_k = 2 pi (first + k) / steps, k < steps
    backwards: bool | None = None  # whether that shift is negative; left out of files if it isn't, so that 0.1.0 reads them
    origin: float | None = None  # projector px where the phase is zero; the centre of the axis if not given
    waveform: Literal["sine", "binary"] = "sine"  # binary fringes become sinusoidal by defocus; see `profiles` for their origin

    @property
    def count(self) -> int:
        """Number of images."""
        return self.steps

    @property
    def shifts(self) -> NDArray[np.float64]:
        """Phase shifts : (steps,) rad."""
        turn = -2 * np.pi if self.backwards else 2 * np.pi
        return turn * (self.first + np.arange(self.steps)) / self.steps

    def zero(self, length: int) -> float:
        """Projector coordinate of phase zero on an axis of `length` px."""
        return (length - 1) / 2 if self.origin is None else self.origin

    def profiles(self, length: int) -> Image:
        """The patterns along their axis : (steps, length).

        Binary fringes light whole pixels. With an odd number of them lit a period, the origin must be a pixel's centre, with
        an even number the border of two; else all lie half a pixel off.
        """
        turns = (np.arange(length) - self.zero(length)) / self.pitch + self.shifts[:, None] / (2 * np.pi)
        if self.waveform == "binary":
            quarter = np.round(turns + 0.25, 9)  # a pixel right on an edge must not be left to rounding: half a period is lit
            return (quarter - np.floor(quarter) < 0.5).astype(np.float32)
        return ((1 + np.cos(2 * np.pi * turns)) / 2).astype(np.float32)

    def displacement(self, length: int) -> float:
        """Projector px by which the patterns' fundamental lies off its place, in the mean over an axis of `length` px."""
        profiles, s = self.profiles(length).astype(float), self.shifts[:, None]
        wave = (profiles * np.exp(-1j * s)).sum(axis=0)
        ideal = np.exp(2j * np.pi * (np.arange(length) - self.zero(length)) / self.pitch)
        return float(np.angle(np.mean(ideal * wave.conj())) * self.pitch / (2 * np.pi))


class GrayCode(Part):
    """Reflected Gray code of the period number `floor((x - start) / pitch)`, most significant bit first.

    The complementary bit is the finest bit of the same code at half the pitch: its borders lie in the middle of the periods,
    so that the period number can be read safely at the period borders.
    """

    kind: Literal["gray"] = "gray"
    axis: Axis = "columns"
    pitch: float = Field(ge=1)  # projector px a period, that of the fringes to be unwrapped; without fringes a cell
    bits: int = Field(ge=1, le=12)
    start: float | None = None  # projector px where period 0 begins; if not given, where the code is centred on the axis
    complementary: bool = False  # one more image, the next bit
    inverted: bool = False  # every image is followed by its inverse

    @model_validator(mode="after")
    def _whole_pixels(self) -> "GrayCode":
        if self.complementary and self.pitch < 2:
            raise ValueError(f"pitch: expected 2 px or more with the complementary bit, which halves it, found {self.pitch:g}")
        return self

    @property
    def count(self) -> int:
        """Number of images."""
        return (self.bits + self.complementary) * (2 if self.inverted else 1)

    def origin(self, length: int) -> float:
        """Projector coordinate at which period 0 begins, on an axis of `length` px."""
        return length / 2 - 0.5 - 2 ** (self.bits - 1) * self.pitch if self.start is None else self.start

    def profiles(self, length: int) -> Image:
        """The patterns along their axis : (count, length)."""
        offset = np.arange(length) - self.origin(length)
        bits = [gray_bit(offset / self.pitch, self.bits - 1 - i) for i in range(self.bits)]
        if self.complementary:
            bits.append(gray_bit(2 * offset / self.pitch, 0))
        patterns = np.array(bits, np.float32)
        if self.inverted:
            patterns = np.stack([patterns, 1 - patterns], axis=1).reshape(-1, length)
        return patterns


class CentreLine(Part):
    """One bright line whose projector coordinate is known."""

    kind: Literal["centre_line"] = "centre_line"
    axis: Axis = "columns"
    width: float = Field(default=2, gt=0)  # projector px
    position: float | None = None  # projector px of its middle; the centre of the axis if not given

    @property
    def count(self) -> int:
        """Number of images."""
        return 1

    def middle(self, length: int) -> float:
        """Projector coordinate of the line's middle, on an axis of `length` px."""
        return (length - 1) / 2 if self.position is None else self.position

    def profiles(self, length: int) -> Image:
        """The pattern along its axis : (1, length); a pixel counts as far as the line covers it."""
        left = np.arange(length) - 0.5
        low, high = self.middle(length) - self.width / 2, self.middle(length) + self.width / 2
        return np.clip(np.minimum(left + 1, high) - np.maximum(left, low), 0, 1).astype(np.float32)[None]


class Uniform(Part):
    """The whole field at one level: fully lit, or black."""

    kind: Literal["uniform"] = "uniform"
    axis: Axis = "columns"
    level: float = Field(default=1, ge=0, le=1)

    @property
    def count(self) -> int:
        """Number of images."""
        return 1

    def profiles(self, length: int) -> Image:
        """The pattern along its axis : (1, length)."""
        return np.full((1, length), self.level, np.float32)


def _bits(periods: float) -> int:
    """Of a code of so many periods."""
    return max(1, int(np.ceil(np.log2(periods))))


AnyPart = Annotated[Fringes | GrayCode | CentreLine | Uniform, Field(discriminator="kind")]


AKind = TypeVar("AKind", bound=Part)


def of_kind(parts: Sequence[AnyPart], kind: type[AKind], axis: Axis) -> list[AKind]:
    """Those parts of a kind that vary along an axis."""
    return [part for part in parts if isinstance(part, kind) and part.axis == axis]


def fringes_and_guide(parts: Sequence[AnyPart], axis: Axis, unwrap: str, kind: type[AKind]) -> tuple[Fringes, AKind]:
    """The one set of fringes of an axis, and the one part of a kind that unwraps it; ValueError if there are others."""
    fringes, guides = of_kind(parts, Fringes, axis), of_kind(parts, kind, axis)
    if len(fringes) != 1:
        raise ValueError(f"parts: {unwrap} unwrapping of {axis} expects one set of fringes, found {len(fringes)}")
    if len(guides) != 1:
        raise ValueError(f"parts: {unwrap} unwrapping of {axis} expects one part of that kind, found {len(guides)}")
    return fringes[0], guides[0]


class Patterns(Part):
    """A sequence of patterns and how its fringes are unwrapped; of Gray code alone `unwrap` is `gray`, too.

    Raises
    ------
    pydantic.ValidationError
        If a key is unknown, or the parts don't serve the unwrapping that is asked for.
    """

    projector_size: tuple[Side, Side]  # width, height, px
    unwrap: Unwrapping
    parts: tuple[AnyPart, ...] = Field(min_length=1, max_length=100)

    @model_validator(mode="after")
    def _consistent(self) -> "Patterns":
        if not self.axes:
            code = " or a Gray code" if GrayCode in self.unwrapping.ALONE else ""
            raise ValueError(f"parts: expected at least one set of fringes{code}, found none")
        for axis in self.axes:
            if self.has_fringes(axis):
                self.unwrapping.check(self.parts, axis)
            else:
                self._check_code_alone(axis)
        return self

    def _check_code_alone(self, axis: Axis) -> None:
        """Check that the code of an axis without fringes can be read: ValueError if there are two, or none has a threshold."""
        codes = of_kind(self.parts, GrayCode, axis)
        if len(codes) > 1:
            raise ValueError(f"parts: Gray code of {axis} without fringes expects one part of that kind, found {len(codes)}")
        levels = {part.level for part in self.parts if isinstance(part, Uniform)}
        if not codes[0].inverted and not {0.0, 1.0} <= levels:
            found = ", ".join(f"level {level:g}" for level in sorted(levels)) or "none"
            raise ValueError(
                f"parts: Gray code of {axis} without fringes expects inverted images, or uniform ones of level 0 and 1, whose "
                f"middle is the threshold, found {found}"
            )

    @model_validator(mode="after")
    def _in_place(self) -> "Patterns":
        for part in self.parts:
            length = self.length(part.axis)
            if isinstance(part, GrayCode):
                begin = part.origin(length)
                end = begin + 2**part.bits * part.pitch
                if begin > 0 or end < length - 0.5:
                    raise ValueError(
                        f"parts: Gray code of {part.axis} covers {begin:g} to {end:g} px, expected 0 to {length - 1} or more"
                    )
            if isinstance(part, Fringes) and part.waveform == "binary" and abs(off := part.displacement(length)) > MISPLACED:
                raise ValueError(
                    f"parts: binary fringes of {part.axis} lie {off:+.2f} px off their origin of {part.zero(length):g}, "
                    f"expected another, such as {part.zero(length) + off:g}"
                )
        return self

    @property
    def unwrapping(self) -> Any:
        """The module of the unwrapping, with what `recon.structured_light.fringe_orders` asks of it."""
        return registry.kind(UNWRAPPINGS, self.unwrap)

    @property
    def axes(self) -> tuple[Axis, ...]:
        """The axes that are encoded, by fringes or by Gray code alone, columns first."""
        axes: tuple[Axis, ...] = ("columns", "rows")
        encoding = (Fringes, *self.unwrapping.ALONE)
        return tuple(axis for axis in axes if any(isinstance(part, encoding) and part.axis == axis for part in self.parts))

    def on(self, size: tuple[int, int]) -> "Patterns":
        """The same sequence on another projector's raster, of width and height px.

        Pitches stay, but for those that cover the axis once, and so do starts that are given; what lies by the middle stays
        there, to the pixel. Codes get the bits that the axis needs.
        """
        if size == self.projector_size:
            return self
        parts = []
        for part in self.parts:
            before, after = (lengths[0 if part.axis == "columns" else 1] for lengths in (self.projector_size, size))
            changed: dict[str, object] = {}
            if isinstance(part, Fringes) and part.pitch >= before:
                changed["pitch"] = part.pitch * after / before
            if isinstance(part, Fringes) and part.origin is not None and part.origin >= part.pitch:
                changed["origin"] = part.origin + (after - before) // 2
            if isinstance(part, GrayCode):
                spare = part.bits - _bits(before / part.pitch)
                changed["bits"] = _bits(after / part.pitch) + max(spare, 0)
            if isinstance(part, CentreLine) and part.position is not None:
                changed["position"] = part.position + (after - before) // 2
            parts.append(part.model_copy(update=changed).model_dump())
        return Patterns.model_validate({"projector_size": size, "unwrap": self.unwrap, "parts": parts})

    def has_fringes(self, axis: Axis) -> bool:
        """Whether an axis is encoded by fringes, not by Gray code alone."""
        return any(isinstance(part, Fringes) and part.axis == axis for part in self.parts)

    @property
    def count(self) -> int:
        """Number of images in the sequence."""
        return sum(part.count for part in self.parts)

    @property
    def even_light(self) -> NDArray[np.float64]:
        """Weights : (count,) by which the images of the sequence add up to an evenly lit one.

        Each pixel is lit for the same time by the steps of a set of fringes, and by a bit with its inverse; where there is
        neither, by the brightest uniform image.
        """
        weights = np.zeros(self.count)
        for part, place in self.slices():
            if isinstance(part, Fringes) or (isinstance(part, GrayCode) and part.inverted):
                weights[place] = 1
        if not weights.any():
            levels = {place.start: part.level for part, place in self.slices() if isinstance(part, Uniform)}
            weights[max(levels, key=lambda start: levels[start])] = 1
        return weights / weights.sum()

    def length(self, axis: Axis) -> int:
        """Projector px along an axis."""
        return self.projector_size[0 if axis == "columns" else 1]

    def slices(self) -> list[tuple[AnyPart, slice]]:
        """Each part with its place in the sequence."""
        ends = np.cumsum([part.count for part in self.parts])
        return [(part, slice(int(end) - part.count, int(end))) for part, end in zip(self.parts, ends, strict=True)]

    def profiles(self) -> list[tuple[Axis, bool, Image]]:
        """Each image as (axis, whether it is binary, profile along the axis)."""
        result: list[tuple[Axis, bool, Image]] = []
        for part in self.parts:
            binary = isinstance(part, GrayCode | CentreLine) or (isinstance(part, Fringes) and part.waveform == "binary")
            result += [(part.axis, binary, profile) for profile in part.profiles(self.length(part.axis))]
        return result

    def images(self) -> Image:
        """The whole sequence as projector images : (count, height, width), from 0 to 1, before the projector's gamma."""
        width, height = self.projector_size
        rows = [profile[None, :] if axis == "columns" else profile[:, None] for axis, _, profile in self.profiles()]
        return np.stack([np.broadcast_to(row, (height, width)) for row in rows])


def gray_bit(period: NDArray[np.float64], bit: int) -> NDArray[np.bool_]:
    """Bit `bit` (0 is the finest) of the reflected Gray code of floor(period); below zero the code is mirrored."""
    number = np.floor(period).astype(np.int64)
    return ((number ^ (number >> 1)) >> bit & 1).astype(bool)
