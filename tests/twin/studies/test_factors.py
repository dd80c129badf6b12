"""Factors are read as written, fill their space evenly, and put their values in place."""

import numpy as np
import pytest
from scipy.stats import kstest

from recon.errors import InputError
from twin.studies import factors
from twin.studies.factors import Choices, Normal, Range

SETTINGS = {
    "rig": {"cam1": {"gain": 1.0}, "cam2": {"gain": 1.0}},
    "parts": [{"kind": "line"}, {"kind": "fringes", "pitch": 12}, {"kind": "fringes", "pitch": 144}],
    "size": [1280, 800],
}
WIDE = {"a": {"from": -3.0, "to": 5.0}, "b": {"from": 0.01, "to": 100.0, "log": True}, "c": ["x", "y", "z", "w"]}


def test_factors_are_read_as_they_are_written():
    read = factors.read({"a": [1, "two", None], "b": {"from": 1, "to": 3}, "c": {"normal": [5, 2]}})
    assert isinstance(read["a"], Choices) and read["a"].values() == [1, "two", None]
    assert isinstance(read["b"], Range) and read["b"].values() == pytest.approx([1, 1.5, 2, 2.5, 3])
    assert isinstance(read["c"], Normal) and read["c"].normal == (5, 2)


def test_a_logarithmic_range_has_equal_ratios():
    (values,) = (one.values() for one in factors.read({"a": {"from": 0.001, "to": 0.016, "count": 5, "log": True}}).values())
    assert values == pytest.approx([0.001, 0.002, 0.004, 0.008, 0.016])


def test_whole_ranges_are_numbers_without_fractions():
    """Rounded, each once, for combinations and for points that fill; with log too."""
    read = factors.read(
        {"a": {"from": 3, "to": 6, "count": 7, "whole": True}, "b": {"from": 1, "to": 100, "log": True, "whole": True}}
    )
    assert [one.values() for one in read.values()] == [[3, 4, 5, 6], [1, 3, 10, 32, 100]]
    filled = [value for point in factors.filling(read, 64, "sobol") for value in point.values()]
    assert all(type(value) is int for value in [*filled, *read["a"].values()])
    assert {point["a"] for point in factors.filling(read, 64, "sobol")} == {3, 4, 5, 6}


@pytest.mark.parametrize(
    ("given", "complaint"),
    [
        ([], "choices: expected"),
        (7, "expected a map of fields, found 7"),
        ("lifelike", "expected a map of fields"),
        ({"from": 1}, "to: expected a value, found none"),
        ({"from": 1, "to": 2, "step": 1}, "step: expected no such field"),
        ({"from": 1, "to": 2, "count": 1}, "count: expected greater than or equal to 2, found 1"),
        ({"from": 1, "to": float("inf")}, "to: expected"),
        ({"from": 0, "to": 2, "log": True}, "expected from and to above 0 with log, found 0 and 2"),
        ({"from": 2, "to": 2}, "expected from below to, found 2 and 2"),
        ({"from": 5, "to": -1, "whole": True}, "expected from below to, found 5 and -1"),
        ({"normal": [1, 0]}, "normal.1: expected greater than 0, found 0"),
        ({"normal": [1]}, "normal.1: expected one more value"),
        ({"normal": [1, 2], "log": True}, "log: expected no such field"),
    ],
)
def test_nonsense_is_refused_with_its_field(given, complaint):
    with pytest.raises(InputError, match=r"over: a\.b: expected a list, \{from, to, count, log, whole\} or ") as refused:
        factors.read({"a.b": given})
    assert complaint in str(refused.value) and "\n" not in str(refused.value)


def test_all_combinations_the_last_factor_fastest():
    points = factors.factorial(factors.read({"a": [3, 1], "b": ["x", "y", "z"]}))
    assert [tuple(point.values()) for point in points] == [(a, b) for a in (3, 1) for b in "xyz"]
    assert factors.factorial({}) == [{}]


def test_a_distribution_has_no_combinations():
    with pytest.raises(InputError, match="over: b: a distribution needs points=N"):
        factors.factorial(factors.read({"a": [1], "b": {"normal": [0, 1]}}))


@pytest.mark.parametrize("by", ["sobol", "latin"])
@pytest.mark.parametrize("count", [64, 100])
def test_points_fill_their_space_evenly(by, count):
    """Each of 16 equal parts of a range, each ratio of a logarithmic one, each word of a list has its share of the points."""
    read = factors.read(WIDE)
    points = factors.filling(read, count, by)
    assert len(points) == count
    a, b = (np.array([point[name] for point in points]) for name in "ab")
    assert (a >= -3).all() and (a <= 5).all() and (b >= 0.01).all() and (b <= 100).all()
    off = 0 if count == 64 else 3 if by == "sobol" else 2  # 64 are whole shares of a power of two
    for shares in ((a + 3) / 8, np.log10(b) / 4 + 0.5):
        assert np.abs(np.bincount((16 * shares).astype(int), minlength=16) - count / 16).max() <= off
    words = [sum(point["c"] == word for point in points) for word in "xyzw"]
    assert np.abs(np.array(words) - count / 4).max() <= off


@pytest.mark.parametrize("by", ["sobol", "latin"])
def test_quantiles_of_a_normal_distribution_are_one(by):
    """512 points lie far closer to it than as many independent draws would, which come to 0.038 in the mean."""
    points = factors.filling(factors.read({"a": {"normal": [7, 0.5]}, "b": [1, 2]}), 512, by)
    values = np.array([point["a"] for point in points])
    assert kstest(values, "norm", (7, 0.5)).statistic < 0.01
    assert values.mean() == pytest.approx(7, abs=0.005) and values.std() == pytest.approx(0.5, rel=0.01)


def test_more_points_continue_sobols_sequence():
    """So that a study with more points has the trials of fewer; a Latin hypercube is another one, but the same each time."""
    read = factors.read(WIDE)
    many = factors.filling(read, 100, "sobol")
    assert all(factors.filling(read, count, "sobol") == many[:count] for count in (1, 7, 64, 65))
    assert len({repr(point) for point in many}) == 100
    assert factors.filling(read, 20, "latin") == factors.filling(read, 20, "latin") != factors.filling(read, 21, "latin")[:20]


def test_quantiles_reach_the_ends_of_a_list():
    choices = Choices(choices=["first", "last"])
    assert [choices.quantile(share) for share in (0.0, 0.499, 0.5, 1.0)] == ["first", "first", "last", "last"]


def test_no_fields_can_not_be_filled():
    with pytest.raises(InputError, match="over: expected fields to vary with points=N, found none"):
        factors.filling({}, 8, "sobol")


@pytest.mark.parametrize(
    ("name", "value", "places"),
    [
        ("rig.cam1.gain", 2.0, [("rig", "cam1", "gain")]),
        ("rig.cam1.gain+rig.cam2.gain", 2.0, [("rig", "cam1", "gain"), ("rig", "cam2", "gain")]),
        ("size.1", 720, [("size", 1)]),
        ("parts.1.pitch", 9, [("parts", 1, "pitch")]),
        ("parts.fringes.pitch", 9, [("parts", 1, "pitch"), ("parts", 2, "pitch")]),
        ("parts.line", {"kind": "gray"}, [("parts", 0)]),
        ("rig", "other", [("rig",)]),
    ],
)
def test_values_are_put_in_place_and_nowhere_else(name, value, places):
    """Keys, places in a list, kinds of its entries, fields that share a value; what it is taken from stays as it was."""
    before = repr(SETTINGS)
    changed = factors.applied(SETTINGS, {name: value})
    assert leaves(changed) == leaves(SETTINGS, dict.fromkeys(places, value))
    assert repr(SETTINGS) == before


def leaves(tree, instead=None, place=()) -> dict:
    """Values by their places."""
    instead = instead or {}
    tree = instead.get(place, tree)
    entries = tree.items() if isinstance(tree, dict) else enumerate(tree) if isinstance(tree, list) else None
    if entries is None:
        return {place: tree}
    return {name: value for key, entry in entries for name, value in leaves(entry, instead, (*place, key)).items()}


def test_values_that_are_shared_are_not_one_object():
    changed = factors.applied(SETTINGS, {"rig.cam1+rig.cam2": {"gain": 3.0}})
    changed["rig"]["cam1"]["gain"] = 4.0
    assert changed["rig"]["cam2"]["gain"] == 3.0


@pytest.mark.parametrize(
    ("name", "advice"),
    [
        ("rig.cam1.gian", "unknown key gian; expected one of gain; did you mean gain?"),
        ("rg.cam1.gain", "; did you mean rig?"),
        ("rig.cam1.gain+rig.cam2.xyz", "unknown key xyz; expected one of gain"),
        ("size.2", "unknown key 2; expected one of 0, 1"),
        ("parts.fringe.pitch", "; did you mean fringes?"),
        ("parts.fringes.pitsh", "; did you mean pitch?"),
        ("rig.cam1.gain.high", "high: expected a field, found that a value stands there already"),
    ],
)
def test_fields_that_are_not_there_are_refused_by_name(name, advice):
    with pytest.raises(InputError) as refused:
        factors.applied(SETTINGS, {name: 1})
    assert str(refused.value).startswith("over: ") and str(refused.value).endswith(advice)
    if "+" not in name:
        with pytest.raises(InputError, match="over: "):
            factors.value_at(SETTINGS, name)


def test_values_are_found_where_they_were_put():
    for name in ("rig.cam1.gain", "size.1", "parts.1.pitch", "parts.fringes.pitch"):
        assert factors.value_at(factors.applied(SETTINGS, {name: 77}), name) == 77
