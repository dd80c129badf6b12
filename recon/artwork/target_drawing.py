"""The probe's target as a card to print: black annuli, as `rig.target` describes them.

The target's frame is seen from its front: x to the right, y upwards, c0 below at the left. On the card the circles stand in the
middle.
"""

import numpy as np

from recon.artwork.paper_sheet import Card, Ink
from recon.errors import InputError
from recon.model.circle_layout import circle_centres
from recon.model.rig import Target


def card_of(target: Target) -> Card:
    """Draw a target of the size of its board.

    Raises
    ------
    InputError
        If the board is too small for the circles.
    """
    centres = circle_centres(target)[:, :2]
    radius = target.outer_diameter_mm / 2
    low, high = centres.min(axis=0) - radius, centres.max(axis=0) + radius
    least_white_mm = 2.0  # between a rim and the card's edge: there the rim's grey levels are measured
    least = high - low + 2 * least_white_mm
    if (least > target.board_mm).any():
        found, expected = (f"{x:g}x{y:g}" for x, y in (target.board_mm, least.tolist()))
        raise InputError(f"rig.target.board_mm: expected {expected} mm or more around these circles, found {found} mm")
    middles = centres - (low + high) / 2 + np.array(target.board_mm) / 2
    outer, inner = (
        np.column_stack([middles, np.full(len(middles), d / 2)]) for d in (target.outer_diameter_mm, target.inner_diameter_mm)
    )
    return Card(target.board_mm, (Ink(False, outer), Ink(True, inner)))


def in_words(target: Target) -> str:
    """A target's lengths on one line."""
    _, (c1, _), *others = circle_centres(target)[:, :2].tolist()
    above = [f"c{k} {y:g} mm above" + (f" and {x:g} mm aside" if x else "") for k, (x, y) in enumerate(others, start=2)]
    return (
        f"target, c1 {c1:g} mm right of c0, {', '.join(above)}, "
        f"diameters {target.outer_diameter_mm:g} and {target.inner_diameter_mm:g} mm"
    )
