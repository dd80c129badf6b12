"""Fringe orders from two or more sets of fringes of different pitches, coarse to fine."""

from collections.abc import Sequence

import numpy as np

from recon.model.patterns import AnyPart, Axis, Fringes, of_kind
from recon.structured_light import multi_frequency, plausibility
from recon.structured_light.shots import Mask, Measured, Ordered, Shots, finest

WHOLE_IMAGE = False
ALONE = ()


def check(parts: Sequence[AnyPart], axis: Axis) -> None:
    """Check for two sets or more, all of different pitches; ValueError if there are others."""
    fringes = of_kind(parts, Fringes, axis)
    if len(fringes) < 2:
        raise ValueError(f"parts: heterodyne unwrapping of {axis} expects two or more sets of fringes, found {len(fringes)}")
    if len({part.pitch for part in fringes}) < len(fringes):
        pitches = ", ".join(f"{part.pitch:g}" for part in fringes)
        raise ValueError(f"parts: heterodyne unwrapping of {axis} expects different pitches, found {pitches} px")


def orders(shots: Shots, axis: Axis, sets: list[Measured], valid: Mask, light: str) -> Ordered:
    """Orders by the ladder of pitches; see `multi_frequency`."""
    found, clear = multi_frequency.fringe_order(sets, shots.patterns.length(axis))
    sigma = finest(sets)[1].sigma
    plausibility.check_pitches(found.trusted, valid & clear, sigma, light, f"{shots.name}: fringes of {axis}")
    return Ordered(found, np.zeros(valid.shape, bool), {})
