"""Errors of sessions are told with their uncertainty: RMS of what each session finds."""

import numpy as np

from twin.experiments import chain_trial, predicted_session


def test_the_rms_is_within_its_interval(monkeypatch, rng):
    """Of 300 predictions by 24 sessions whose errors are of length 0.5 mm (RMS) in three axes, 90 to 98 % hold it."""
    drawn = (0.5 / np.sqrt(3) * np.linalg.norm(rng.standard_normal((300 * 24, 3)), axis=1)).tolist()
    monkeypatch.setattr(chain_trial, "measure", lambda settings, seed: dict.fromkeys(predicted_session.FIGURES, drawn[seed]))
    found = [predicted_session.predict(None, range(24 * k, 24 * k + 24))["mass_error_mm"] for k in range(300)]
    held = np.mean([abs(one.rms - 0.5) < 1.96 * one.sigma for one in found])
    assert 0.9 < held < 0.98
    assert all(one.worst >= one.rms for one in found)
