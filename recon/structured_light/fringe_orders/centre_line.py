"""Fringe orders from one projected line, along the surface that it lies on."""

from collections.abc import Sequence

import numpy as np

from recon.model.patterns import AnyPart, Axis, CentreLine, fringes_and_guide
from recon.structured_light import plausibility
from recon.structured_light.gray_code import Orders
from recon.structured_light.phase import Fringe
from recon.structured_light.shots import Mask, Measured, Ordered, Shots, finest
from recon.structured_light.unwrapping import spatial

WHOLE_IMAGE = True  # the line may lie beside the board
ALONE = ()


def check(parts: Sequence[AnyPart], axis: Axis) -> None:
    """Check for one set of fringes and one line; ValueError if there are others."""
    fringes_and_guide(parts, axis, "centre_line", CentreLine)


def orders(shots: Shots, axis: Axis, sets: list[Measured], valid: Mask, light: str) -> Ordered:
    """Orders by the centre line; for rows all images are transposed, so that the line stands upright."""
    (part, fringe), (line, at) = finest(sets), shots.guide(CentreLine, axis)
    image, place, length = shots.images[at.start], f"{shots.name}: image {at.start}", shots.patterns.length(axis)
    plausibility.check_light(image, fringe, valid, place)
    turned = axis == "rows"
    if turned:
        fringe = Fringe(*(np.ascontiguousarray(m.T) for m in fringe))
        image, valid = np.ascontiguousarray(image.T), np.ascontiguousarray(valid.T)
    turns = (line.middle(length) - part.zero(length)) / part.pitch
    found = spatial.unwrap(fringe, valid, image, turns, line.width / part.pitch)
    plausibility.check_line(found.sightings, found.votes, found.residual, place)
    order, known, unreachable = (m.T if turned else m for m in (found.order, found.known, found.unreachable))
    counts = {"regions": found.regions, "islands": found.islands, "disputed": found.disputed}
    return Ordered(Orders(order, known), unreachable, counts)
