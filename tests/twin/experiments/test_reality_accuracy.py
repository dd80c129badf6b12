"""A reduced form of the rows under conditions of life, by cameras of half the size."""

from functools import partial
from pathlib import Path

import pytest

from recon.capture.surface_part import read_patterns
from scenes.kinds import plane
from tests.twin.experiments.asked import missed
from tests.twin.small_rigs import half
from twin.experiments import reality_accuracy
from twin.experiments.experiment_setup import Setup
from twin.experiments.surface_accuracy import experiment
from twin.optics.light_transport import Tracing

PATTERNS = Path(__file__).resolve().parents[3] / "conf" / "patterns" / "paper_surface.yaml"


@pytest.mark.slow
def test_a_disturbed_plane_is_as_good_as_a_steady_one(rig, monkeypatch):
    """Two planes twice, with the bars of all; without corrections their errors are 1.3 and 2.1 times as large."""
    monkeypatch.setattr(reality_accuracy, "SEEDS", range(102, 104))
    setup = Setup(half(rig), {"paper_surface": read_patterns(PATTERNS)})
    monkeypatch.setattr(plane, "PAPER_POSES", plane.PAPER_POSES[:3])
    assert not missed(reality_accuracy.compared, reality_accuracy.compared(setup, "planes"))


@pytest.mark.slow
def test_skin_costs_modulation_and_nothing_else(rig, monkeypatch):
    """One of the ten breasts with light that spreads and with gel, with the bars of all; without, noise leaves 0.024 mm.

    A pixel takes as many paths as four of the whole camera: with 16 they leave 2 % of the spread by themselves.
    """
    monkeypatch.setattr(reality_accuracy, "SEEDS", range(102, 103))
    monkeypatch.setattr(reality_accuracy, "experiment", partial(experiment, tracing=Tracing(samples=64, room_lux=20)))
    found = reality_accuracy.skins(Setup(half(rig), {"paper_surface": read_patterns(PATTERNS)}), spread_mm=0.4, wet=0.1)
    assert not missed(reality_accuracy.skins, found, spread_mm=0.4, wet=0.1)
    assert 0.027 < found["breast_mm"] < 0.035
