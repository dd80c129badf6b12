"""The paper's experiments in a reduced form: one laboratory, few poses of the board, both methods on the same images."""

import pytest

from sonotwin import study_accuracy
from twin.studies import beside_paper

FEW = ["over={conditions: [lifelike]}", "seeds=1", "first_seed=3", "poses.count=8"]


@pytest.fixture(scope="module")
def kept(tmp_path_factory):
    return tmp_path_factory.mktemp("paper")


@pytest.mark.slow
@pytest.mark.parametrize("name", ["planes", "sphere"])
def test_ours_keeps_its_bars_where_the_papers_method_is_farther_off(kept, name):
    """Under lifelike conditions; where noise limits a figure, ours is within a fourth of that."""
    config, done = study_accuracy.study(kept, name, *FEW)
    compared = beside_paper.compare(config.beside, done)
    assert len(compared) == len(config.beside) and all(one.bar_met for one in compared)
    assert all(one.paper.max() > one.ours.max() for one in compared)
    assert all(one.ours.max() < 1.25 * one.limit for one in compared if one.figure.limit)
    assert len(list((kept / "trials").glob("*.json"))) == 1  # planes and sphere are figures of the same laboratory
