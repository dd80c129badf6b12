"""Targets for several bodies that can't be taken for each other."""

from itertools import product

import numpy as np

from recon.errors import InputError
from recon.model.rig import LEAST_PARTED_MM, Target, parted_mm

MOST = 6  # bodies
SIDES_MM = range(24, 61, 4)  # of c1 and c2 that are tried, beside those of the first target
ASIDE_MM = (0.0, 12.0, -12.0)
SCALENE_MM = 3.0  # by which sides differ: circles of which two sides are alike have names by their sense of rotation alone
WHITE_MM = 3.0  # between two circles, at least


def propose(first: Target, count: int) -> list[Target]:
    """The first target and others of its circles' sizes, each parted as far as can be from those before it.

    Of those that are parted alike the smallest board is taken.

    Raises
    ------
    InputError
        If circles are so large that so many targets can't be parted on boards of some 60 mm.
    """
    family = [first]
    while len(family) < count:
        parted = [(min(parted_mm(one, other) for other in family), one) for one in _others(first)]
        if not parted or (most := max(far for far, _ in parted)) < LEAST_PARTED_MM:
            raise InputError(
                f"family: expected up to {len(family)} targets with circles of {first.outer_diameter_mm:g} mm, found {count}; "
                "give rig.target smaller circles"
            )
        wide_mm = 3 * LEAST_PARTED_MM  # beyond which a smaller board counts more
        family.append(min((one for far, one in parted if far >= min(most, wide_mm)), key=lambda one: np.prod(one.board_mm)))
    return family


def _others(first: Target) -> list[Target]:
    """Targets of three circles whose rims keep clear of each other, with as much white around them as the first one's."""
    places = first.places
    extent = np.array([np.ptp(places.real), np.ptp(places.imag)])
    white = np.maximum(np.array(first.board_mm) - extent - first.outer_diameter_mm, 2 * WHITE_MM)
    clear = first.outer_diameter_mm + WHITE_MM
    usual = first.named(Target.USUAL)
    found = []
    for c1, c2, aside in product(SIDES_MM, SIDES_MM, ASIDE_MM):
        sides = sorted([c1, abs(complex(aside, c2)), abs(complex(c1 - aside, c2))])
        if sides[0] < clear or min(sides[1] - sides[0], sides[2] - sides[1]) < SCALENE_MM:
            continue
        around = np.array([max(c1, aside) - min(0.0, aside), c2]) + first.outer_diameter_mm + white
        lengths = {"c1_mm": float(c1), "c2_mm": float(c2), "c2_aside_mm": aside, "board_mm": tuple(np.ceil(around).tolist())}
        shared = {name: getattr(first, name) for name in ("outer_diameter_mm", "inner_diameter_mm", "tolerance_mm", "unusual")}
        try:
            found.append(usual.model_validate(shared | lengths))
        except ValueError:  # circles that can't be told from each other
            continue
    return found
