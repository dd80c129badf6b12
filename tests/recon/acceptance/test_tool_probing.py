"""A tool's tip in divots: scatter and means with uncertainties that hold, of frames that are alike, too."""

import numpy as np
import pytest
from scipy import signal

from recon.acceptance import optical_acceptance
from recon.acceptance.certificates import Artefacts, DivotCertificate
from recon.acceptance.conformity import Limits
from recon.acceptance.optical_acceptance import Measured
from recon.acceptance.tool_probing import probe_divot

SIGMAS = np.array([0.05, 0.05, 0.2])  # mm: depth is less certain


@pytest.mark.parametrize("alike", [0.0, 0.8])
def test_uncertainties_are_the_scatter_of_recordings(rng, alike):
    """Of mean and RMS over 400 recordings; sigmas known to 4 %, and 10 % more for a persistence that is itself estimated."""
    noise = signal.lfilter([np.sqrt(1 - alike**2)], [1, -alike], rng.standard_normal((400, 350, 3)), axis=1)[:, 50:] * SIGMAS
    found = [probe_divot(one) for one in noise]
    means, rms = np.array([one.mean for one in found]), np.array([one.rms_mm for one in found])
    predicted = np.mean([np.diag(one.covariance) for one in found], axis=0)
    assert np.sqrt(predicted) == pytest.approx(means.std(axis=0), rel=0.2)
    assert np.mean([one.rms_sigma_mm for one in found]) == pytest.approx(rms.std(), rel=0.25)
    assert rms.mean() == pytest.approx(np.linalg.norm(SIGMAS), rel=0.02)


def test_a_scale_shows_in_distances_and_a_loose_tip_in_one_divot(rng):
    """A rig 1 % too large errs by 0.8 mm between divots 80 mm apart; a recording about an axis has no distance."""
    plate = DivotCertificate(places_mm=((0, 0, 0), (80, 0, 0)), expanded_mm=0.02)
    places = {"divots/00": np.zeros(3), "divots/01": np.array([80.8, 0, 0]), "divots/00-roll": np.zeros(3)}
    widths = {"divots/00-roll": 3.0}
    tips = {name: place + widths.get(name, 1.0) * SIGMAS * rng.standard_normal((200, 3)) for name, place in places.items()}
    found = optical_acceptance.judge(Measured({}, {}, {}, tips), Artefacts(divots=plate), Limits(tp_mm=0.4, td_mm=0.3))
    values = {(one.symbol, one.place): one for one in found.values}
    assert set(values) == {("TP", name) for name in places} | {("TD", "divots/00-01")}
    distance = values["TD", "divots/00-01"]
    assert distance.budget.value_mm == pytest.approx(0.8, abs=0.03) and distance.decision == "rejected"
    assert values["TP", "divots/00"].decision == "accepted" and values["TP", "divots/00-roll"].decision == "rejected"
