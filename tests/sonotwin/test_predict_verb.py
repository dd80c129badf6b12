"""`sonotwin predict` says a plane's error, what it depends on, and which change saves most for its price."""

from types import SimpleNamespace

import numpy as np

from recon.identification import rig_file
from recon.identification.estimates import Estimate, Findings
from sonotwin.choices import read_rig
from sonotwin.cli import main
from twin.experiments import predicted_session, rehearsal
from twin.experiments.predicted_session import SessionError
from twin.experiments.rehearsal import MassErrors, Rehearsed, Repeatability, Seen

CHANGES = "{rig.cam1.sensor.saturation_e: {to: 15400, price: 100}, patterns.parts.1.steps: {to: 16}}"


def test_changes_are_told_by_what_they_save_for_the_money(capsys):
    """Twice the steps or the electrons save 29 %: the former cost nothing, so they come first."""
    assert main(["predict", f"changes={CHANGES}"]) == 0
    said = capsys.readouterr().out.splitlines()
    assert said[0].startswith("predicted   plane 0.0") and "none of the rig's numbers was measured" in said[0]
    changes = [line for line in said if line.startswith("change")]
    assert changes[0].startswith("change      patterns.parts.1.steps to 16: +2") and "for 0" in changes[0]
    assert any("saturation_e to 15400: +2" in line and line.endswith("for 100") for line in changes)


def test_measured_numbers_give_an_interval(tmp_path, capsys):
    rig = rig_file.apply(read_rig(), Findings({"cam1.sensor.saturation_e": Estimate(8000.0, 200.0, "a test")}))
    rig_file.write(tmp_path / "ours.yaml", rig, {}, "a test")
    assert main(["predict", f"rig={tmp_path / 'ours.yaml'}"]) == 0
    assert "mm (95 %, by 1 measured numbers, if all others" in capsys.readouterr().out
    assert main(["predict", f"rig={tmp_path / 'ours.yaml'}", "rig.cam1.sensor.saturation_e=9000"]) == 0
    assert "none of the rig's numbers was measured" in capsys.readouterr().out, "as it was given by hand"


def test_numbers_that_were_not_measured_are_named_as_exact(tmp_path, capsys):
    """With the exposure given, flux and quantum efficiency count, about alike: of both, images show the product."""
    rig = rig_file.apply(read_rig(), Findings({"cam1.sensor.dark_noise_e": Estimate(11.0, 0.3, "a test")}))
    rig_file.write(tmp_path / "ours.yaml", rig, {}, "a test")
    assert main(["predict", f"rig={tmp_path / 'ours.yaml'}", "shooting.exposure_s=0.005"]) == 0
    depends = [line.split() for line in capsys.readouterr().out.splitlines() if line.startswith("depends")]
    known = {name: " ".join(words) for _, name, _, *words in depends}
    assert known["cam1.sensor.dark_noise_e"].startswith("(± 0.3): +")
    for name in ("projector.radiant_flux_w", "cam1.sensor.quantum_efficiency"):
        assert known[name].startswith("(taken as exact): -0.6"), name


def test_sessions_tell_errors_of_points_b_scans_and_masses(capsys):
    assert main(["predict", "conditions=lifelike", "poses=demo", "sessions=2"]) == 0
    said = capsys.readouterr().out.splitlines()
    (line,) = (line for line in said if "the centre of a mass against the skin" in line)
    assert " mm RMS (95 %) of 2 drawn sessions, " in line and sum(line.startswith("predicted") for line in said) == 5


def test_rehearsals_tell_cr1_and_masses_and_lend_sessions_their_noise(monkeypatch, capsys):
    """One of two masses is found, 0.5 mm off and a tenth too small."""
    wires = SimpleNamespace(seen=Seen(0.031, 1.24, 0.6, 0.9))
    masses = MassErrors(np.array([[0.3, 0.4, 0.0], [np.nan] * 3]), np.array([-0.1, np.nan]))
    drawn, figure = [], SessionError(0.2, 0.01, 0.3)
    monkeypatch.setattr(
        rehearsal,
        "rehearse",
        lambda settings, calibrations, sweeps, seed: Rehearsed(wires, Repeatability(0.224, 0.15, 0.1), 0.1, masses),
    )
    monkeypatch.setattr(predicted_session, "predict", lambda settings, seeds: drawn.append(settings) or {"mass_error_mm": figure})
    assert main(["predict", "rehearsals=2", "sessions=2", "white_dn=30"]) == 0
    said = capsys.readouterr().out
    assert "predicted   CR1 0.224 ± 0.044 mm (95 %)" in said and "12 B-scans each; 60 % of poses show the crossing" in said
    assert "circles 0.031 px, crossings 1.24 px; CR1 of 5 calibrations scatters by 15 %" in said
    assert "centre 0.500 mm, volume 10 % RMS, 1 of 2 found" in said
    (session,) = drawn
    assert (session.noise.circle_px, session.noise.crossing_px, session.film.white_dn) == (0.031, 1.24, 30)


def test_what_can_not_be_changed_is_refused_by_name(capsys):
    for given, told in (
        ("changes={rig.projectr.gamma: {to: 1}}", "rig.projectr.gamma"),
        ("changes={rig.projector.gamma: {to: -1}}", "rig.projector.gamma"),
        ("changes={rig.projector.gamma: {price: 1}}", "to"),
        ("sessions=1", "sessions: expected 0 or at least 2"),
        ("rehearsals=1", "rehearsals: expected 0 or at least 2"),
        ("shooting.exposure_s=0.2", "bright places saturate"),
        ("plate.centre_mm=[3000,0,660]", "in view of camera 1 and the projector"),
    ):
        assert main(["predict", given]) == 2
        said = capsys.readouterr().err
        assert told in said and said.count("\n") == 1
