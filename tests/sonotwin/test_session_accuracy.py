"""Rows of whole sessions: the worst counts, a mass that is missed fails, and what was measured is kept."""

from types import SimpleNamespace

import numpy as np
import pytest

from recon.errors import InputError
from scenes.catalogue import build_scene
from sonotwin import rendered_session, session_accuracy
from tests.twin.experiments import asked
from twin.conditions import speeds
from twin.evaluation import session_errors
from twin.experiments.experiment_setup import Setup

FILM = {"frames": 100, "visible": 95, "visible_found": 95, "false": 0, "shift_median_mm": 0.02, "shift_expected_mm": 0.05,
        "turn_median_deg": 0.04}  # fmt: skip
SCAN = {
    "placement_over_sigma": 1.0,
    "lag_error_ms": -0.5, "lag_covered": 1.0, "probe_worst_error_mm": 0.1, "probe_worst_sigma_mm": 0.1, "contact_bias_mm": -0.02,
    "tumours_found": 3, "tumours_false": 0, **dict.fromkeys(session_errors.PROBE_ERRORS, 0.02),
}  # fmt: skip
CYLINDERS = {"tube_diameter_error_mm": -0.04, "cover_diameter_error_mm": 0.004, "cover_wall_error_mm": 0.016}
TUMOUR = {
    "true_extent_mm": 20.0, "centre_error_mm": 0.2, "volume_mm3": 1030.0, "true_volume_mm3": 1000.0, "under_skin_mm": 8.1,
    "true_under_skin_mm": 8.0, "inside": 1, "centre_sigma_mm": 0.3, "volume_sigma_mm3": 30.0, "depth_sigma_mm": 0.2,
}  # fmt: skip


TRANSLATION = "translation in the scan, median"


def figures(**changes) -> dict:
    """Of a session that meets all bars."""
    films = {f"{name}_track_{key}": value for name in ("wires", "bottom", "scan") for key, value in FILM.items()}
    scan = {f"scan_{key}": value for key, value in SCAN.items()}
    tumours = {f"scan_tumour{k}_{key}": value for k in range(3) for key, value in TUMOUR.items()}
    return films | scan | tumours | CYLINDERS | {"cover_wall_sigma_mm": 0.016} | changes


def missed(found) -> set[str]:
    rows = asked.missed(session_accuracy.sessions, session_accuracy.together(found), conditions="ideal")
    return {row.what.partition(": ")[2] for row in rows}


def test_good_sessions_meet_all_bars():
    assert missed([figures(), figures()]) == set()


@pytest.mark.parametrize(("changes", "row"), [
    ({"scan_track_visible": 80, "scan_track_visible_found": 80}, "frames that show the whole target to both"),
    ({"wires_track_visible_found": 90}, "found, of pairs that show the target whole"),
    ({"bottom_track_false": 1}, "wrong poses in all sweeps"),
    ({"scan_lag_error_ms": -2.0}, "latency"),
    ({"scan_probe_worst_error_mm": 0.3}, "probe, the worst of five pixels"),
    ({f"scan_probe_error0_{axis}_mm": 0.1 for axis in "xyz"}, "probe, CR1, centre"),
    ({"scan_tumours_false": 1}, "tumours found inside the skin, less false ones, of 3"),
    ({"scan_tumour1_inside": 0}, "tumours found inside the skin, less false ones, of 3"),
    ({"scan_tumour2_volume_mm3": 1100.0}, "tumours' volumes"),
    ({"scan_tumour0_under_skin_mm": 8.4}, "least tissue over tumours"),
    ({"scan_contact_bias_mm": 0.2}, "array's face from the skin by light, mean"),
])  # fmt: skip
def test_one_bad_session_is_enough(changes, row):
    assert missed([figures(), figures(**changes)]) == {row}


@pytest.mark.parametrize(
    ("sigma", "row"), [(0.01, "the same ratio, at most"), (0.03, "the same, squared over its predicted variance, mean, at least")]
)
def test_a_wall_that_claims_too_much_or_too_little_fails_its_row(sigma, row):
    """Off by 0.016 mm in all sessions."""
    assert missed([figures(cover_wall_sigma_mm=sigma)] * 2) == {row}


@pytest.mark.parametrize("figure", CYLINDERS)
def test_a_wrong_length_of_the_cylinders_fails_its_row(figure):
    """And mean and spread stand beside the worst."""
    found = [figures(), figures(**{figure: -0.07}, cover_wall_sigma_mm=0.07 if "wall" in figure else 0.016)]
    rows = asked.missed(session_accuracy.sessions, session_accuracy.together(found), conditions="ideal")
    assert len(rows) == 1 and rows[0].measured == 0.07
    assert f"(mean {(CYLINDERS[figure] - 0.07) / 2:+.3f}, " in rows[0].what


def test_a_missed_mass_fails_its_rows():
    names = ("centre_error_mm", "volume_mm3", "under_skin_mm", "inside")
    lost = figures(scan_tumours_found=2, **{f"scan_tumour2_{name}": np.nan for name in names})
    assert {"tumours found inside the skin, less false ones, of 3", "tumours' volumes", "least tissue over tumours"} <= missed(
        [lost]
    )


def made_of(value: float, whole: bool = True) -> dict[str, tuple[bool, dict]]:
    """What a session gives: the reconstruction by the usual may have failed, that by what is certified hasn't."""
    return {"usual": (whole, {"figure": value}), "certified": (True, {"figure": -value})}


@pytest.mark.parametrize(("whole", "times"), [(True, 1), (False, 2)])
def test_what_was_measured_is_kept_if_no_step_failed(tmp_path, monkeypatch, whole, times):
    """Of both reconstructions of a session each by itself."""
    made = []
    monkeypatch.setattr(session_accuracy, "session", lambda work, kind, seed: made.append(seed) or made_of(float(seed), whole))
    for known, figure in (("usual", 7.0), ("certified", -7.0), ("usual", 7.0)):
        assert session_accuracy.measured(tmp_path, "lifelike", known, 7) == {"figure": figure}
    assert made == [7] * times


def test_figures_of_other_code_are_not_used(tmp_path, monkeypatch):
    monkeypatch.setattr(session_accuracy, "session", lambda work, kind, seed: made_of(1.0))
    session_accuracy.measured(tmp_path, "lifelike", "usual", 7)
    monkeypatch.setattr(session_accuracy, "code", lambda: "other")
    monkeypatch.setattr(session_accuracy, "session", lambda work, kind, seed: made_of(2.0))
    assert session_accuracy.measured(tmp_path, "lifelike", "usual", 7) == {"figure": 2.0}


def test_figures_are_not_kept_of_code_that_was_edited_meanwhile(tmp_path, monkeypatch):
    """Steps import late, so nobody can say which code they were of."""
    (code := tmp_path / "code").mkdir()
    monkeypatch.setattr(session_accuracy, "PACKAGES", (code,))
    monkeypatch.setattr(session_accuracy, "session", lambda *of: (code / "a.py").write_text("") or made_of(1.0))
    with pytest.raises(InputError, match="accuracy: expected code and conf/ as they were when the run began"):
        session_accuracy.measured(tmp_path / "out", "lifelike", "usual", 7)
    assert not list(tmp_path.glob("out/**/*.json"))


def test_a_session_of_which_a_step_failed_misses_its_bars(rig):
    """What is missing is NaN, wherever in the list of sessions it stands."""
    for found in ([{}, figures()], [figures(), {}]):
        assert {"latency", "probe, the worst of five pixels", TRANSLATION} <= missed(found)


def test_rows_are_of_what_the_lab_knew(rig, monkeypatch):
    """A session's figures are kept by what was known, and a row takes its own; none of what no session was reconstructed by."""
    monkeypatch.setattr(session_accuracy, "read_rig", lambda name: rig)
    known = {"usual": figures(scan_track_shift_median_mm=0.3), "certified": figures(scan_track_shift_median_mm=0.05)}
    monkeypatch.setattr(session_accuracy, "measured", lambda out, conditions, name, seed: known[name])
    for name, shift in (("usual", 0.3), ("certified", 0.05)):
        found = session_accuracy.sessions(Setup(rig), "lifelike", name)
        assert found["shift_mm"] == shift and found["sessions"] == len(session_accuracy.SEEDS)
    assert asked.missed(session_accuracy.sessions, found, conditions="lifelike", known="certified") == []
    with pytest.raises(InputError, match="known: expected one of usual of ideal sessions, found certified"):
        session_accuracy.sessions(Setup(rig), "ideal", "certified")


def test_a_lab_measures_its_own_board_and_tissue(tmp_path, monkeypatch):
    """The length of the printed board, not of its design, and the tissue's own speed: both within 5 sigma."""
    chosen, design = (
        session_accuracy.settings("lifelike", 3),
        np.stack([np.arange(12.0) % 4, np.arange(12.0) // 4, 0 * np.arange(12)], 1),
    )
    monkeypatch.setattr(
        session_accuracy, "read_board", lambda folder: SimpleNamespace(board=SimpleNamespace(points=lambda: design))
    )
    np.savez(tmp_path / "board.npz", points=1.0005 * design)
    by = session_accuracy.reconstruction(chosen, 3e-4, tmp_path, tmp_path / "out")
    found = session_accuracy.certified(by, chosen, tmp_path)
    length, sigma = found.board_length_mm
    assert sigma == pytest.approx(3.0015 * 2e-5) and abs(length - 3.0015) < 5 * sigma
    true = 1450.0 * speeds(chosen.conditions.sound, 3)[0]
    assert abs(found.tissue_m_s - true) < 5 * found.tissue_sigma_m_s == 25.0


def test_another_rig_is_refused(rig):
    target = rig.target.model_copy(update={"c1_mm": 30.0})
    with pytest.raises(InputError, match="rig: expected meza2021 for only=session"):
        session_accuracy.sessions(Setup(rig.model_copy(update={"target": target})), "ideal")


@pytest.mark.parametrize("kind", ["ideal", "lifelike"])
def test_the_parts_of_a_session_are_of_one_rig_under_the_same_conditions(tmp_path, kind):
    """All write into one capture, by one seed; its sweeps have the names that rows go by, and both cylinders are the same."""
    chosen = session_accuracy.settings(kind, 3)
    settings = [part.settings for part in rendered_session.parts(chosen, tmp_path, session_accuracy.BOTTOM_HZ)]
    assert all((each.seed, each.add, each.rig, each.conditions) == (3, True, chosen.rig, chosen.conditions) for each in settings)
    assert [each.name for each in settings[2:]] == ["wires", "bottom", "scan"] and all(each.filmed for each in settings[2:])
    by_light, by_sound = (part.settings for part in rendered_session.cylinders(chosen, tmp_path))
    assert by_sound.name == "tube" and by_sound.filmed
    outer, inner = (build_scene(dict(each.scene)).shapes[-1] for each in (by_light, by_sound))
    assert np.allclose(inner.point, outer.point) and inner.radius == outer.radius
