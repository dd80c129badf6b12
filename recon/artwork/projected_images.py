"""The images of a pattern sequence for a projector, and in words what each shows, from the definitions that the decoder reads."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from recon.model.patterns import AnyPart, CentreLine, Fringes, GrayCode, Patterns, Uniform

FULL = 255  # of 8 bits, as projectors take them


class Shown(NamedTuple):
    """One image of a sequence."""

    kind: str  # of its part: fringes, gray, centre_line, uniform
    what: str  # in words
    axis: str  # columns or rows; empty where nothing varies
    pitch_px: float | None = None
    shift_deg: float | None = None  # of fringes
    bit: int | None = None  # of Gray code, 1 is the coarsest
    binary: bool = False  # whether it is black and white alone


def images(patterns: Patterns, gamma: float = 1.0) -> NDArray[np.uint8]:
    """The sequence as 8-bit images : (count, height, width), 255 fully on.

    Parameters
    ----------
    gamma : float
        Of the projector, `light = value ** gamma`: values become `value ** (1 / gamma)`, so that the light is as defined. By 1
        they stay as they are, as the twin projects them. Black and white are the same by any.
    """
    width, height = patterns.projector_size
    levels = [(axis, np.uint8(np.rint(FULL * profile ** (1 / gamma)))) for axis, _, profile in patterns.profiles()]
    rows = [level[None, :] if axis == "columns" else level[:, None] for axis, level in levels]
    return np.stack([np.broadcast_to(row, (height, width)) for row in rows])


def shown(patterns: Patterns) -> list[Shown]:
    """What each image of the sequence shows, in its order."""
    binary = [bool(np.isin(profile, (0, 1)).all()) for _, _, profile in patterns.profiles()]
    named = [row for part in patterns.parts for row in _of_part(part, patterns.length(part.axis))]
    return [row._replace(binary=sharp) for row, sharp in zip(named, binary, strict=True)]


def bent_by_gamma(patterns: Patterns) -> int:
    """Steps of the set of grey fringes that suffers most from a projector's gamma; 0 if none does."""
    sets = [part.steps for part in patterns.parts if isinstance(part, Fringes) and part.waveform == "sine"]
    few_steps = 5  # fewer bend the phase by the second or third harmonic, which a projector's gamma adds
    few = [steps for steps in sets if steps < few_steps]
    return min(few, default=0)


def _of_part(part: AnyPart, length: int) -> Iterator[Shown]:
    match part:
        case Fringes():
            name = "binary fringe" if part.waveform == "binary" else "fringe"
            for k, shift in enumerate(np.rad2deg(part.shifts).tolist()):
                text = f"{name} {k + 1} of {part.steps}, {part.axis}, pitch {part.pitch:g} px, shift {shift:g} deg"
                yield Shown(part.kind, text, part.axis, part.pitch, shift)
        case GrayCode():
            bits = part.bits + part.complementary
            for bit in range(1, bits + 1):
                name = "complementary bit" if bit > part.bits else f"Gray bit {bit} of {part.bits}"
                for inverse in ("", ", inverted") if part.inverted else ("",):
                    text = f"{name}{inverse}, {part.axis}, pitch {part.pitch:g} px"
                    yield Shown(part.kind, text, part.axis, part.pitch, bit=bit)
        case CentreLine():
            text = f"centre line, {part.axis}, {part.width:g} px wide at {part.middle(length):g}"
            yield Shown(part.kind, text, part.axis)
        case Uniform():
            text = {0.0: "black", 1.0: "white"}.get(part.level, f"grey, {part.level:g} of white")
            yield Shown(part.kind, text, "")
