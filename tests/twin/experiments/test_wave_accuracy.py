"""Sound's ways through tissue against k-Wave's figures, as far as they are quick; and other media than its own are told apart."""

import copy
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

from tests.twin.experiments.asked import missed
from twin.experiments import wave_accuracy
from twin.experiments.experiment_runs import PACKAGES

RAYS = 7  # over the aperture, as conf/ultrasound/clinic.yaml has it
MET = [
    (wave_accuracy.delays, {"rays": RAYS}, "late_percent"),
    (wave_accuracy.shifts, {"rays": RAYS, "medium": "slant"}, "shift_percent"),
    (wave_accuracy.shadow, {"rays": RAYS}, "speckle_width_percent"),
    (wave_accuracy.losses, {"rays": RAYS}, "slope_percent"),
    (wave_accuracy.speckle, {"seeds": 8}, "flat_lateral_percent"),
]
NAMES = [figure for _, _, figure in MET]
OTHER = [  # which the figures follow
    lambda peer: peer["layers"][1].__setitem__(1, 1465.0),
    lambda peer: peer["slant"].update(tilt_deg=25.0),
    lambda peer: peer["disc"].update(radius_mm=3.1),
    lambda peer: peer.update(loss_db_per_cm_mhz=0.82),
    lambda peer: peer["array"].update(frequency_mhz=2.0),
]


@pytest.mark.parametrize(("function", "settings", "figure"), MET, ids=NAMES)
def test_the_twin_is_within_ten_percent_of_the_peer(function, settings, figure):
    """All rows that ask it."""
    figures = function(None, **settings)
    named = {name: value for name, value in settings.items() if name != "seeds"}
    off = [row.what for row in missed(function, figures, **named)]
    assert not off and figures[figure] < 10


@pytest.mark.parametrize(("case", "change"), list(zip(MET, OTHER, strict=True)), ids=NAMES)
def test_another_medium_is_told_apart(case, change, monkeypatch):
    """Fat, a border, a disc, a loss and a frequency other than the peer's miss the bar that its own meet."""
    other = copy.deepcopy(wave_accuracy.peer())
    change(other)
    monkeypatch.setattr(wave_accuracy, "peer", lambda: other)
    function, settings, figure = case
    assert function(None, **settings)[figure] > 10


def test_without_refraction_nothing_is_shown_aside(monkeypatch):
    """Behind a slanted border, where the peer shows points 0.2 to 0.4 mm aside."""
    array = wave_accuracy.array(RAYS).model_copy(update={"refraction": False})
    monkeypatch.setattr(wave_accuracy, "array", lambda rays: array)
    assert wave_accuracy.shifts(None, RAYS, "slant")["shift_percent"] > 95


def test_points_behind_a_lobule_are_shown_on_the_peers_side():
    """Within a quarter: straight rays know nothing of waves that bend round its sides."""
    figures = wave_accuracy.shifts(None, RAYS, "lobule")
    count = len(wave_accuracy.peer()["shifts_lobule"])
    ratio = np.array([figures[f"shift{k}_mm"] / figures[f"peer{k}_mm"] for k in range(count)])
    assert ((ratio > 0.75) & (ratio < 1.25)).all()


def test_the_peers_loss_falls_behind_the_centre_frequencys():
    """By what a Gaussian spectrum loses in frequency on the way: half the squared loss of its standard deviation, in nepers.

    So does the twin's, where it loses high frequencies first.
    """
    record = wave_accuracy.peer()
    last, array = record["losses"][-1], record["array"]
    at_centre = 0.2 * record["loss_db_per_cm_mhz"] * array["frequency_mhz"] * last["depth_mm"]
    nepers = at_centre * np.log(10) / 20 * array["bandwidth"] / np.sqrt(8 * np.log(2))
    gained = 20 / np.log(10) * nepers**2 / 2
    assert at_centre - last["loss_db"] == pytest.approx(gained, rel=0.3)
    twins = [wave_accuracy.losses(None, rays) for rays in (1, RAYS)]
    assert [at_centre - found["deepest_db"] for found in twins] == pytest.approx([gained] * 2, rel=0.1)


def test_the_peers_figures_count_as_code():
    """Else rows that were kept would survive other figures of the peer."""
    assert any(wave_accuracy.PEER.is_relative_to(Path(find_spec(name).origin).parent) for name in PACKAGES)
