"""Targets that can't be taken for each other: by distances, whatever the naming, and by sizes."""

from itertools import combinations

import numpy as np
import pytest
from pydantic import ValidationError

from recon.model import circle_layout
from recon.model.rig import LEAST_PARTED_MM, Rig, Target, parted_mm
from recon.model.target_family import propose
from sonotwin import choices


@pytest.fixture(scope="module")
def rig() -> Rig:
    return choices.read_rig("three_bodies")


def turned(target, first):
    """The same three circles with another one as c0, in the same sense of rotation."""
    places = np.roll(circle_layout.circle_centres(target)[:, :2], -first, axis=0)
    return circle_layout.with_lengths(target, circle_layout.lengths_between(places))


def mirrored(target):
    """The target seen from behind: c1 and c2 exchanged, which no view from the front shows."""
    places = circle_layout.circle_centres(target)[[0, 2, 1], :2]
    return circle_layout.with_lengths(target, np.abs(circle_layout.lengths_between(places)))


def test_a_renamed_target_is_the_same_and_a_mirrored_one_is_not(rig):
    """Another circle for c0 parts nothing; the mirror image of a scalene triangle can't be seen from the front."""
    for first in (0, 1, 2):
        assert parted_mm(rig.target, turned(rig.target, first)) == pytest.approx(0, abs=1e-9)
    assert parted_mm(rig.target, mirrored(rig.target)) > LEAST_PARTED_MM


def test_one_distance_parts_by_as_much_as_it_differs(rig):
    wider = rig.target.model_copy(update={"c2_mm": rig.target.c2_mm + 1.5})
    assert 1.4 < parted_mm(rig.target, wider) <= 1.5
    assert parted_mm(rig.target, wider) == pytest.approx(parted_mm(wider, rig.target))


def test_circles_of_other_sizes_part(rig):
    smaller = {"outer_diameter_mm": 14.0, "inner_diameter_mm": 5.6}
    assert np.isinf(parted_mm(rig.target, rig.target.model_copy(update=smaller)))


def test_bodies_that_can_be_confused_are_refused_with_the_distance(rig):
    like = rig.target.model_dump() | {"c2_mm": 41.0}
    with pytest.raises(ValidationError, match=r"bodies\.needle.*2 mm or more.*probe's target.*found 1\.0 mm.*family=2"):
        Rig.model_validate(rig.model_dump() | {"bodies": {"needle": like}})
    taken = Rig.model_validate(rig.model_dump() | {"bodies": {"needle": like | {"unusual": True}}})
    assert list(taken.targets) == ["probe", "needle"]
    with pytest.raises(ValidationError, match="names besides probe"):
        Rig.model_validate(rig.model_dump() | {"bodies": {"probe": like | {"c2_mm": 60.0}}})


def test_a_proposed_family_can_be_told_apart(rig):
    """Six targets, the first the rig's own, that fit the boards that they name; any two make a rig."""
    family = propose(rig.target, 6)
    assert family[0] == rig.target
    for one, other in combinations(family, 2):
        assert parted_mm(one, other) >= LEAST_PARTED_MM
    Rig.model_validate(rig.model_dump() | {"bodies": {f"body{k}": one.model_dump() for k, one in enumerate(family[1:])}})


def test_rigs_with_bodies_are_kept_by_what_they_are(rig):
    """Caches keep rigs by their hash: equal ones have one, others mostly another."""
    same, without = Rig.model_validate(rig.model_dump()), rig.model_copy(update={"bodies": {}})
    assert hash(rig) == hash(same) and len({rig, same, without}) == 2


def test_shipped_targets_make_rigs_with_the_probes_own_or_in_its_place():
    """Each design of conf/target is a body beside the probe's target, or its better: MarkerPose's marker has its distances."""
    bodies = choices.read_rig("three_bodies").bodies
    for name in ("needle", "patient"):
        assert bodies[name].model_dump() == Target.model_validate(choices.read("target", name)).model_dump()
    assert propose(choices.read_rig().target, 3)[1:] == [bodies["patient"], bodies["needle"]]  # what is printed is the rig
    marker = Target.model_validate(choices.read("target", "markerpose"))
    assert parted_mm(marker, choices.read_rig().target) == pytest.approx(0, abs=1e-9)
    Rig.model_validate(choices.read_rig("three_bodies").model_dump() | {"target": marker.model_dump()})
