"""A reduced form of the rows under conditions of life."""

from pathlib import Path

import pytest

from recon.capture.surface_part import read_patterns
from scenes.kinds import plane
from twin.experiments import reality_accuracy
from twin.experiments.table_rows import Setup

PATTERNS = Path(__file__).resolve().parents[3] / "conf" / "patterns" / "paper_surface.yaml"


@pytest.mark.slow
def test_a_disturbed_plane_is_as_good_as_a_steady_one(rig, monkeypatch):
    """Three planes twice, with the bars of all; without corrections their errors are 1.3 and 2.1 times as large."""
    monkeypatch.setattr(reality_accuracy, "SEEDS", range(102, 104))
    setup = Setup(rig, {"paper_surface": read_patterns(PATTERNS)})
    rows = reality_accuracy.compared(setup, "planes", [plane.build(pose) for pose in plane.PAPER_POSES[:3]], "plane_plate_rms_mm")
    assert len(rows) == 5
    assert all(row.ok for row in rows), rows


@pytest.mark.slow
def test_skin_costs_modulation_and_nothing_else(rig, monkeypatch):
    """One of the ten breasts with light that spreads and with gel, with the bars of all; without, noise leaves 0.024 mm."""
    monkeypatch.setattr(reality_accuracy, "SEEDS", range(102, 103))
    rows = reality_accuracy.skins(Setup(rig, {"paper_surface": read_patterns(PATTERNS)}))
    assert all(row.ok for row in rows), rows
    assert 0.027 < rows[0].measured < 0.035
