"""Basins join where their border is continuous, in an order that doesn't let one side's tear hide another side's contact."""

from collections import Counter

import pytest

from recon.structured_light.unwrapping.merging import Borders, join


def borders(**contacts: tuple[int, int, int]) -> Borders:
    """By two letters of basins: order offset, continuous contacts and torn ones."""
    numbers = {tuple("abcdef".index(letter) for letter in pair): found for pair, found in contacts.items()}
    continuous = {pair: Counter({offset: whole}) for pair, (offset, whole, _) in numbers.items() if whole}
    return Borders(continuous, Counter({pair: torn for pair, (_, _, torn) in numbers.items() if torn}))


def test_what_lies_behind_a_bust_joins_by_its_far_end():
    """A table in front of the line (a), a bust (b, c), and the table behind: it goes on to a, and is torn off the bust."""
    found = join(
        4,
        borders(ab=(29, 195, 15), bc=(5, 133, 0), ac=(34, 103, 102), ad=(42, 138, 2), bd=(13, 105, 20), cd=(8, 59, 72)),
        {0: Counter({-23: 638}), 1: Counter({6: 164}), 2: Counter({11: 183})},
        set(),
    )
    (name,) = found.absolute
    assert set(found.region.tolist()) == {name} and not found.disputed
    assert [found.absolute[name] + int(lift) for lift in found.lift] == [-23, 6, 11, 19]


@pytest.mark.parametrize("off_b", [(1, 1, 300), (0, 25, 0), (1, 0, 300)])
def test_an_opening_in_a_torn_border_joins_nothing(off_b):
    """A wall with the line in two basins (a, b) of the same order, and an object (c) that meets one of them by chance."""
    found = join(3, borders(ab=(0, 200, 0), ac=(1, 30, 0), bc=off_b), {0: Counter({0: 100}), 1: Counter({0: 100})}, set())
    assert found.region[0] == found.region[1] != found.region[2]


@pytest.mark.parametrize(("whole", "torn", "joined"), [(90, 10, True), (80, 20, False)])
def test_a_torn_border_joins_nothing(whole, torn, joined):
    found = join(2, borders(ab=(3, whole, torn)), {0: Counter({7: 50})}, set())
    assert (found.region[0] == found.region[1]) == joined


def test_surfaces_with_the_line_join_where_one_contact_agrees():
    """And stay apart where none does: their order is the line's."""
    lines = {0: Counter({7: 50}), 1: Counter({9: 50})}
    for offset, joined in ((2, True), (3, False)):
        found = join(2, borders(ab=(offset, 10, 90)), lines, set())
        assert (found.region[0] == found.region[1]) == joined
        orders = {found.absolute[int(r)] + int(lift) for r, lift in zip(found.region, found.lift, strict=True)}
        assert orders == {7, 9}
