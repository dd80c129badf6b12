"""A rig against its file: what has changed is named, and nothing of a rig that hasn't, as seldom as is said."""

from datetime import date

import numpy as np
import pytest
from scipy import stats

from recon.errors import InputError
from recon.identification import calibrated_optics, rig_file
from recon.identification.estimates import Estimate, Findings
from recon.model import calibration as calibrations
from recon.model.calibration import DRIFT_PX, Calibration
from recon.rig_check import drift, rig_versions
from scenes.board_poses import Config as Poses
from twin.conditions import IDEAL
from twin.experiments import drawn_check
from twin.experiments.drawn_session import Noise
from twin.experiments.drawn_session import calibrated_optics as calibrated

SIGMAS = {
    "cam1.lens.focus_mm": 1.0,
    "cam1.lens.f_number": 0.2,
    "cam1.sensor.black_level_dn": 0.1,
    "cam2.sensor.saturation_e": 60.0,
    "projector.gamma": 0.01,
}
ALARM = 3.2  # as `sonotwin check` has it


@pytest.fixture(scope="module")
def calibration(rig) -> Calibration:
    """Of a board in 16 poses, with its covariance."""
    return calibrated(rig, IDEAL, Noise(), Poses(count=16), 3)


def identified(rig, rng, calibration=None, **off):
    """The rig as measured with errors as large as they are said to be, some numbers off by more."""
    if calibration is not None:
        known = drift.calibration_uncertainty(calibration, None)
        drawn = Calibration(drawn_check.drawn_rig(calibration.cameras, known, rng), known)
        rig = calibrated_optics.with_devices(rig, drawn)
    changes = {name.replace("__", "."): value for name, value in off.items()}
    values = {name: rig.number(name) + sigma * rng.standard_normal() + changes.get(name, 0.0) for name, sigma in SIGMAS.items()}
    return rig_file.apply(rig, Findings({name: Estimate(value, SIGMAS[name], "a test") for name, value in values.items()}))


def test_a_rig_that_has_not_changed_is_flagged_as_seldom_as_said(rig, rng):
    """At a limit that 1 comparison of 13 should pass: within 4 binomial deviations above, and not below half of it."""
    made = [rig_versions.compare(identified(rig, rng), identified(rig, rng), 0.0, 2.5) for _ in range(200)]
    check_rate(made, len(SIGMAS))
    assert stats.kstest([one.sigma for each in made for one in each.numbers], stats.halfnorm.cdf).pvalue > 1e-3


@pytest.mark.slow
def test_optics_that_have_not_changed_differ_as_chance_has_it(rig, calibration, rng):
    """Boards are others each time: the scale, one error of one board, is drawn anew."""
    pairs = ((identified(rig, rng, calibration), identified(rig, rng, calibration)) for _ in range(100))
    made = [rig_versions.compare(*pair, 0.0, 2.5) for pair in pairs]
    check_rate(made, len(SIGMAS) + 5)
    for name in ("cam1.optics", "cam2.optics", "cam2.place", "projector.optics", "projector.place"):
        sigmas = [one.sigma for each in made for one in each.numbers if one.name == name]
        assert stats.kstest(sigmas, stats.halfnorm.cdf).pvalue > 1e-3, name


def check_rate(made, count):
    """Comparisons of so many numbers with any flagged, against the chance that they say."""
    flagged, chance = np.mean([len(one.changed) > 0 for one in made]), made[0].chance
    assert len(made[0].numbers) == count and chance == pytest.approx(12 * stats.norm.sf(2.5))
    assert chance / 2 < flagged < chance + 4 * np.sqrt(chance / len(made))


def test_what_changed_is_named_in_words(rig, rng):
    made = rig_versions.compare(identified(rig, rng), identified(rig, rng, cam1__lens__focus_mm=12.0), 0.0, ALARM)
    (changed,) = made.changed
    assert changed.name == "cam1.lens.focus_mm" and changed.title == "lens: focus"
    assert abs(changed.sigma - 12 / np.sqrt(2)) < 4  # itself a normal number's distance
    assert " ± 1.4 mm, from 6" in changed.change and changed.change.startswith("+")
    assert rig_versions.told(made.changed) == "camera 1's lens: focus"


def test_usual_drift_is_no_change_and_a_turned_camera_is(rig, calibration, rng):
    """By the covariances alone, drift would be flagged."""
    flagged = {0.0: 0, DRIFT_PX: 0}
    for _ in range(20):
        usual = drift.usual_drift(calibration.cameras, DRIFT_PX)
        warm = Calibration(drawn_check.drawn_rig(calibration.cameras, usual, rng), calibration.uncertainty)
        pair = identified(rig, rng, calibration), identified(rig, rng, warm)
        for px in flagged:
            flagged[px] += any(one.name.endswith((".optics", ".place")) for one in rig_versions.compare(*pair, px, ALARM).changed)
    assert flagged[DRIFT_PX] == 0 and flagged[0.0] > 2
    turned = Calibration(drawn_check.turned(calibration.cameras, rng, "cam2", 0.3), calibration.uncertainty)
    made = rig_versions.compare(identified(rig, rng, calibration), identified(rig, rng, turned), DRIFT_PX, ALARM)
    assert [one.name for one in made.changed] == ["cam2.place"] and "turned by 0.3" in made.changed[0].change


def test_errors_that_go_together_hide_no_change(rig, calibration, rng):
    """Distortion changes along the direction that is known best: no number of it by 3 sigma, all of them by far more."""
    known = drift.calibration_uncertainty(calibration, None)
    names = [name for name in known.names if name.startswith("cam1.")]
    places = [known.names.index(name) for name in names]
    sigma = np.sqrt(np.diag(known.covariance)[places])
    correlation = known.covariance[np.ix_(places, places)] / np.outer(sigma, sigma)
    variances, axes = np.linalg.eigh(correlation)
    step = 10 * np.sqrt(2 * variances[0]) * axes[:, 0] * sigma
    assert np.abs(step / sigma).max() < 3 * np.sqrt(2)
    moved = calibrations.moved(calibration.cameras, names, step)
    made = rig_versions.compare(
        *(calibrated_optics.with_devices(rig, Calibration(cameras, known)) for cameras in (calibration.cameras, moved)),
        0.0,
        ALARM,
    )
    assert [one.name for one in made.changed] == ["cam1.optics"] and "pixels moved by" in made.changed[0].change


def test_numbers_that_were_taken_over_do_not_count(rig, rng):
    """Today's file has four of five numbers from the one before."""
    before = identified(rig, rng)
    focus = Findings({"cam1.lens.focus_mm": Estimate(rig.cam1.lens.focus_mm + 2, 1.0, "a test")})
    today = rig_file.next_version(rig_file.apply(before, focus), "today", date(2026, 5, 4))
    made = rig_versions.compare(before, today, 0.0, ALARM)
    assert [one.name for one in made.numbers] == ["cam1.lens.focus_mm"] and made.taken_over == 4
    assert (made.before.version, made.today.text) == (0, "version 1 (2026-05-04, today)")
    with pytest.raises(InputError, match="expected numbers that were measured anew, as in rig, found 5 that are the same"):
        rig_versions.compare(before, before, 0.0, ALARM)


def test_another_rig_is_refused(rig, rng):
    optics = rig.cam2.optics.model_copy(update={"size": (640, 512)})
    other = rig.model_copy(update={"cam2": rig.cam2.model_copy(update={"optics": optics})})
    with pytest.raises(InputError, match=r"today: cam2\.optics\.size: expected 1280x1024, as of rig, found 640x512"):
        rig_versions.compare(identified(rig, rng), identified(other, rng), 0.0, ALARM)
