"""The probe's target as a card to print: three black annuli, as `rig.target` describes them.

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
    outer, inner = (np.column_stack([middles, np.full(3, d / 2)]) for d in (target.outer_diameter_mm, target.inner_diameter_mm))
    return Card(target.board_mm, (Ink(False, outer), Ink(True, inner)))


def in_words(target: Target) -> str:
    """A target's lengths on one line."""
    aside = f" and {target.c2_aside_mm:g} mm aside" if target.c2_aside_mm else ""
    return (
        f"target, c1 {target.c1_mm:g} mm right of c0, c2 {target.c2_mm:g} mm above{aside}, "
        f"diameters {target.outer_diameter_mm:g} and {target.inner_diameter_mm:g} mm"
    )
