"""Sessions as the twin of a rig predicts them, beside those of the rig."""

from types import SimpleNamespace

import numpy as np
import pytest

from twin.experiments import predicted_session, rehearsal, session_trial
from twin.experiments.rehearsal import MassErrors, Rehearsed, Seen, Wires

ERRORS = MassErrors(np.array([[0.3, 0.0, 0.0], [0.0, 0.4, 0.0], [np.nan] * 3]), np.array([0.1, -0.1, np.nan]))


def test_errors_of_masses_add_in_quadrature_and_what_is_missing_is_counted():
    found = session_trial.compare_errors("centre_mm", ERRORS.centre_mm[:2], ERRORS.centre_mm, 0.2)
    by_segmentation = np.sqrt((0.3**2 + 0.4**2) / 2)
    assert found["centre_mm_found"] == pytest.approx(by_segmentation)
    assert found["centre_mm_predicted_over_found"] == pytest.approx(np.hypot(by_segmentation, 0.2) / by_segmentation)
    assert (found["centre_mm_masses_twin"], found["centre_mm_masses_found"]) == (2, 2)
    none = session_trial.compare_errors("volume_percent", np.full(2, np.nan), ERRORS.volume)
    assert np.isnan(none["volume_percent_predicted_over_found"]) and none["volume_percent_found"] == pytest.approx(0.1)


def test_the_prediction_is_of_the_identified_rig_alone(monkeypatch):
    """The rehearsal and the drawn sessions get its rig and its scanner; the true rig films, read by the identified optics."""

    def named(name):
        return SimpleNamespace(name=name, probe=SimpleNamespace(image_size=(4, 4)), calibration=lambda: f"optics of {name}")

    scanner = SimpleNamespace(dynamic_range_db=55.0)
    identified = SimpleNamespace(rig=named("identified"), scanner=SimpleNamespace(description={}))
    rehearsed, filmed = [], []
    wires = Wires((SimpleNamespace(calibration="probe"),) * session_trial.CALIBRATIONS, Seen(0.1, 1.0, 0.5, 0.9), ())

    def rehearse(settings, calibrations, sweeps, seed):
        rehearsed.append((settings.rig.name, settings.ultrasound, seed))
        return Rehearsed(wires, (), 0.0, ERRORS)

    def calibrate(stage, count):
        filmed.append((stage.settings.rig.name, stage.settings.ultrasound, stage.known, stage.dynamic_range_db, stage.seed))
        return wires

    monkeypatch.setattr(session_trial, "Transducer", SimpleNamespace(model_validate=lambda _: scanner))
    monkeypatch.setattr(rehearsal, "rehearse", rehearse)
    monkeypatch.setattr(rehearsal, "calibrate", calibrate)
    monkeypatch.setattr(rehearsal, "segmented", lambda stage, number, probe: filmed.append(stage.known) or ERRORS)
    monkeypatch.setattr(rehearsal, "noise_of", lambda settings, found: rehearsed.append(settings.rig.name) or settings.noise)
    monkeypatch.setattr(session_trial, "repeatabilities", lambda *_: {})
    monkeypatch.setattr(predicted_session, "predict", lambda settings, seeds: {"mass_error_mm": SimpleNamespace(rms=0.0)})
    settings = _Settings(poses=SimpleNamespace(seed=1), noise=_Settings(drawn=_Settings()))
    figures = session_trial.compare(settings, named("true"), "true scanner", identified, 7)
    assert rehearsed == [("identified", scanner, 7), "identified"]
    seed = 7 + session_trial.OTHER_SEED
    assert filmed == [
        ("true", "true scanner", "optics of identified", 55.0, seed),
        *["optics of identified"] * 2,
    ]
    assert figures["centre_mm_predicted_over_found"] == 1


class _Settings(SimpleNamespace):
    def model_copy(self, update):
        return _Settings(**vars(self) | update)
