"""Targets of up to eight circles: the search for names, pruned, finds the target as all orders of circles do."""

from itertools import permutations

import numpy as np
import pytest
from pydantic import ValidationError

from recon.geometry.circle_outline import ellipses_of
from recon.geometry.ellipses import Ellipses
from recon.model import circle_layout
from recon.model.rig import LEAST_ASYMMETRY_MM, Target
from recon.tracking import identity
from recon.tracking.circle_detector import Candidates
from tests import added
from tests.recon.tracking import drawings

PLACES = [(0, 0), (25, 0), (0, 40), (24, 43), (51, 8), (-6, 71), (52, 61), (26, 74), (75, 35)]  # mm
CLUTTER = 4


@pytest.fixture
def target_at(monkeypatch, tmp_path, rig):
    """Targets with circles at places : (n, 2) mm."""

    def make(places, **fields) -> Target:
        name = f"circles_{len(places)}"
        lengths = ("c1_mm", *(f"c{k}{end}" for k in range(2, len(places)) for end in ("_aside_mm", "_mm")))
        lines = [
            "from typing import Literal",
            "from recon.model.rig import Target",
            "class Kind(Target):",
            f"    LENGTHS = {lengths}",
            f"    kind: Literal['{name}'] = '{name}'",
            *(f"    {length}: float" for length in lengths),
        ]
        added.add(monkeypatch, tmp_path, "recon.model.targets", name, "\n".join(lines))
        values = circle_layout.lengths_between(np.array(places, float)).tolist()
        common = {name: getattr(rig.target, name) for name in ("outer_diameter_mm", "inner_diameter_mm", "board_mm")}
        return Target.model_validate(common | {"kind": name} | dict(zip(lengths, values, strict=True)) | fields)

    return make


def shown(rig, rng, target) -> Ellipses:
    return Ellipses(*ellipses_of(rig.cam1.optics.camera(), drawings.facing(rng), *circle_layout.circles(target)))


def candidates(rng, points, sure: bool) -> Candidates:
    """The circles, named or not, among others."""
    count = len(points)
    rows = np.eye(count + 1)[[*range(count), *[count] * CLUTTER]] if sure else np.zeros((count + CLUTTER, count + 1))
    return Candidates(np.vstack([points, rng.uniform(0, 1000, (CLUTTER, 2))]), np.full(count + CLUTTER, 0.8), 0.05 + 0.8 * rows)


@pytest.mark.parametrize("count", [5, 8])
def test_circles_are_found_among_others_and_named_by_geometry(count, target_at, rig, rng):
    target = target_at(PLACES[:count])
    circles = shown(rig, rng, target)
    for sure in (True, False):
        found = identity.namings(candidates(rng, circles.centre, sure), target, 1280)
        np.testing.assert_array_equal(found[0].points, circles.centre)
    unseen = circles.centre.copy()
    unseen[2] = np.nan
    some = candidates(rng, circles.centre, True)
    without = Candidates(*(np.delete(each, 2, axis=0) for each in (some.points, some.scores, some.identity)))
    partly_seen = [each.points for each in identity.namings(without, target, 1280) if np.isnan(each.points).any()]
    np.testing.assert_array_equal(partly_seen[0], unseen)
    shuffled = rng.permutation(count)
    order, off = identity.named(circles[shuffled], target)
    assert np.array_equal(shuffled[order], np.arange(count)) and off < identity.ALIKE
    seen = np.isin(shuffled, (2, 4), invert=True)[:, None]
    partly = Ellipses(np.where(seen, circles.centre[shuffled], np.nan), circles.shape[shuffled])
    order, _ = identity.named(partly, target)
    np.testing.assert_array_equal(partly.centre[order][[0, 1, 3]], circles.centre[[0, 1, 3]])


def test_what_is_left_out_early_is_not_the_target(target_at, rig, rng, monkeypatch):
    """Beside all orders of five: none of the target's is missing, of clutter alone some are, and none is new."""
    target = target_at(PLACES[:5])
    monkeypatch.setattr(identity, "KEPT", 10**6)
    monkeypatch.setattr(identity, "HALVES", 10**6)

    def searched(first: int) -> list[tuple[set, set, list]]:
        monkeypatch.setattr(identity, "FIRST", first)
        found = [identity.namings(some, target, 1280) for some, _, _ in cases]
        every = [{each.points.tobytes() for each in one} for one in found]
        own = [
            {each.points.tobytes() for each in one if ((each.points == true) | np.isnan(each.points)).all()}
            for one, (_, _, true) in zip(found, cases, strict=True)
        ]
        return list(zip(every, own, [identity.named(each, target)[0].tolist() for _, each, _ in cases], strict=True))

    cases = []
    for _ in range(5):
        circles = shown(rig, rng, target)
        points = np.vstack([circles.centre, rng.uniform(200, 900, (3, 2))])
        some = Candidates(points, rng.uniform(0.02, 1, 8), rng.dirichlet(np.ones(6), 8))
        cases.append((some, circles[rng.permutation(5)], circles.centre))
    for (every, own, order), (whole, own_of_all, order_of_all) in zip(searched(4), searched(5), strict=True):
        assert every <= whole and own == own_of_all and len(own) == 6 and order == order_of_all


def test_which_is_which_can_be_told_unless_a_turn_maps_circles_onto_each_other(target_at, rng):
    """Pentagons with circles up to 3 mm off, of which a turn maps some onto themselves to 2 mm; plainly, by all 120 orders."""
    refused = 0
    corners = 30 * np.exp(2j * np.pi * (np.arange(5) / 5))
    for _ in range(30):
        places = corners + rng.uniform(0.3, 3) * np.exp(2j * np.pi * rng.uniform(size=5))
        middle = places - places.mean()
        off = min(
            np.abs(middle[list(order)] - middle * (turn := np.vdot(middle, middle[list(order)])) / abs(turn)).max()
            for order in list(permutations(range(5)))[1:]
        )
        try:
            target_at(np.column_stack([places.real, places.imag]))
        except ValidationError as error:
            assert off < LEAST_ASYMMETRY_MM and "which is which can't be seen" in str(error)
            refused += 1
        else:
            assert off >= LEAST_ASYMMETRY_MM
    assert 5 < refused < 25
    target_at(np.column_stack([corners.real, corners.imag]), unusual=True)


def test_more_than_eight_circles_are_refused(target_at):
    with pytest.raises(ValidationError, match="c8_mm: expected up to 8 circles, found 9"):
        target_at(PLACES)
