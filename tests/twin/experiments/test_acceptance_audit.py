"""Acceptance tests of drawn rigs: intervals hold the truth, good rigs are accepted, bad ones rejected."""

import numpy as np
import pytest

from recon.acceptance.certificates import Artefacts
from recon.acceptance.conformity import Limits
from recon.model.calibration import Calibration, Uncertainty
from twin.experiments import acceptance_audit, drawn_artefacts
from twin.optics.surface_session import calibration_of

NAMES = ("projector.fx", "projector.cx", "projector.tx", "projector.rz", "cam1.cy", "cam1.k1")
SIGMAS = np.array([0.2, 0.1, 0.02, 2e-5, 0.1, 5e-4])


@pytest.fixture(scope="module")
def known(rig):
    """The rig's calibration, with errors that are known to some tenths of a px."""
    return Calibration(calibration_of(rig).cameras, Uncertainty(NAMES, np.diag(SIGMAS**2)))


@pytest.mark.slow
def test_intervals_hold_the_truth(known):
    """Of 224 values of four good rigs 95 % do, within five standard deviations of that share, 7 %; and all four are accepted."""
    audits = [acceptance_audit.audit(known, Limits(), "none", seed, repeats=60) for seed in range(4)]
    covered = [held for one in audits for _, held in one.covered]
    assert len(covered) == 224 and abs(np.mean(covered) - 0.95) < 5 * np.sqrt(0.05 * 0.95 / len(covered))
    assert all(one.acceptance.decision == "accepted" and one.acceptance.complete for one in audits)


@pytest.mark.parametrize(("fault", "told"), [("noise", "PF"), ("scale", "SD"), ("bend", "F")])
def test_a_bad_rig_is_rejected_by_what_is_wrong(known, fault, told):
    found = acceptance_audit.audit(known, Limits(), fault, 0, draws=2000, repeats=40)
    assert found.acceptance.decision == "rejected" and found.acceptance.decision_of(told) == "rejected"


def test_artefacts_are_drawn_within_their_certificates(rng):
    """Lengths scatter by certificate and temperature: 0.0015 mm, and 150 mm times 11.5e-6 times 0.58 K."""
    artefacts = acceptance_audit.ARTEFACTS
    lengths = [drawn_artefacts.draw(artefacts, rng).length_mm for _ in range(400)]
    expected = np.hypot(0.0015, 150 * 11.5e-6 / np.sqrt(3))
    assert np.std(lengths) == pytest.approx(expected, rel=5 / np.sqrt(800)) and np.mean(lengths) == pytest.approx(150, abs=5e-4)
    alone = Artefacts(plane=artefacts.plane)
    assert drawn_artefacts.draw(alone, rng) == drawn_artefacts.Actual()


def test_the_truth_of_sizes_has_what_noise_moves_in_the_mean(known, monkeypatch):
    """Noise shrinks fitted balls by 14 sigma^2 / radius; twenty times the usual makes that nearly two standard uncertainties.

    Errors of 10 sizes and 7 lengths about the mean fit are still zero in the mean, within five standard deviations.
    """
    monkeypatch.setattr(acceptance_audit, "NOISY", 20.0)
    found = acceptance_audit.audit(known, Limits(), "noise", 1, draws=1000, repeats=20)
    pairs = zip(found.acceptance.values, found.truth_mm, strict=True)
    errors = [(one.budget.value_mm - truth) / one.budget.standard_mm for one, truth in pairs if one.symbol in ("PS", "E")]
    assert len(errors) == 17 and abs(np.mean(errors)) < 5 / np.sqrt(len(errors)), np.mean(errors)
