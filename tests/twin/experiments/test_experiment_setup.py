"""What experiments have at hand: conditions of life are given or refused."""

import pytest

from recon.errors import InputError
from twin.conditions import IDEAL, Conditions, Frames
from twin.experiments import check_rates, lifelike_accuracy, live_poses_accuracy, paper_causes
from twin.experiments.experiment_setup import Setup


def test_conditions_go_by_their_names(rig):
    life = Conditions(frames=Frames(flicker=0.03))
    setup = Setup(rig, lifelike=life)
    assert (setup.conditions("ideal"), setup.conditions("lifelike")) == (IDEAL, life)


@pytest.mark.parametrize(
    "measure",
    [
        lambda setup: check_rates.rates(setup, "lifelike"),
        lambda setup: live_poses_accuracy.against_random(setup, "lifelike"),
        lambda setup: lifelike_accuracy.shares(setup, "all of them"),
        lambda setup: paper_causes.one_cause(setup, "no cause but noise"),
    ],
    ids=["check", "guided poses", "shares", "causes"],
)
def test_nothing_stands_for_conditions_of_life(rig, measure):
    """A row in their name would be one of ideal conditions."""
    with pytest.raises(InputError, match="conditions: expected lifelike ones"):
        measure(Setup(rig))
