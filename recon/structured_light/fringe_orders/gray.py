"""Fringe orders from a Gray code of the period's number."""

from collections.abc import Sequence

import numpy as np

from recon.model.patterns import AnyPart, Axis, GrayCode, fringes_and_guide
from recon.structured_light import gray_code, plausibility
from recon.structured_light.gray_code import Orders
from recon.structured_light.shots import Mask, Measured, Ordered, Shots, finest
from recon.structured_light.unwrapping import continuity

WHOLE_IMAGE = False
ALONE = (GrayCode,)


def check(parts: Sequence[AnyPart], axis: Axis) -> None:
    """Check for one set of fringes and one code, of one pitch; ValueError if there are others."""
    fringes, code = fringes_and_guide(parts, axis, "gray", GrayCode)
    if code.pitch != fringes.pitch:
        raise ValueError(f"parts: Gray code and fringes of {axis} expect one pitch, found {code.pitch:g} and {fringes.pitch:g}")


def orders(shots: Shots, axis: Axis, sets: list[Measured], valid: Mask, light: str) -> Ordered:
    """Orders by the code; without its complementary bit those near the periods' borders are carried there from both sides."""
    (part, fringe), (code, place) = finest(sets), shots.guide(GrayCode, axis)
    length = shots.patterns.length(axis)
    found, residual = gray_code.fringe_order(shots.images[place], code, part, fringe, length, shots.noise)
    plausibility.check_code(
        found.order, residual, code, part, fringe.phase, valid, length, light or shots.doubt, shots.where(place)
    )
    if not code.complementary:  # a fifth of the pixels lies too near the period borders: fill in from both sides
        cycles = fringe.phase * np.float32(1 / (2 * np.pi))
        flags = continuity.continuity(cycles, fringe.sigma, valid)
        known = found.trusted & valid
        found = Orders(*continuity.carry(found.order, known, cycles, fringe.sigma, flags, continuity.CLEAN, continuity.REACH))
    return Ordered(found, np.zeros(valid.shape, bool), {})
