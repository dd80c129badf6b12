"""Drawn sessions in which the patient moves after the fringes: tracked, masses lie under the skin as if at rest."""

import pytest

from sonotwin import choices
from twin.conditions import Conditions
from twin.experiments import patient_accuracy
from twin.experiments.experiment_setup import Setup


@pytest.mark.slow
def test_a_tracked_patient_may_move(rig):
    """By 20 mm and 5 deg; eight sessions, whose ratio errs by 0.15 (1 sigma) about the 1.08 of sixty."""
    setup = Setup(rig, lifelike=Conditions.model_validate(choices.read("conditions", "lifelike")))
    found = patient_accuracy.sessions(setup, 8)
    assert found["untracked_rms_mm"] == pytest.approx(patient_accuracy.SHIFT_MM, abs=0.5)
    assert found["moved_rms_mm"] < 0.2
    assert found["moved_over_still"] < 1.6
    assert 0.2 < found["over_sigma"] < 2.3  # chi-square of 24 numbers, to 4 standard deviations
