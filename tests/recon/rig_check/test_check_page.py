"""The page and the lines of a check: verdicts, limits, and a course that one check and many are read from."""

from datetime import UTC, datetime, timedelta

import numpy as np
import pytest

from recon.rig_check import check_log, check_page, control_charts
from recon.rig_check.fault_tests import Finding
from recon.rig_check.verdicts import Verdict

FIRST = datetime(2026, 5, 4, 8, 12, tzinfo=UTC)
MOVED = Verdict("cam2", "moved", 19.3, 0.982, 0.112, "turned by 0.020 deg, shifted by 0.06 mm", ("cam1",))
SEEN = (Verdict("cam1", "maybe", 3.0, 0.1, 0.05), MOVED, Verdict("probe", "unseen"))
STILL = (Verdict("cam1", "good", 0.0, 0.0004, 0.371), Verdict("cam2", "good", 0.02, 0.001, 0.112))


def checks(days, seen) -> list[check_log.Check]:
    """Checks of the same outcome, on days after the first."""
    made = check_log.check("<morning>", seen)
    return [made.model_copy(update={"time": FIRST + timedelta(days=day)}) for day in days]


def test_the_page_says_what_moved_and_what_to_do():
    log = checks((0, 1), SEEN)
    text = check_page.write_text(log[1], log, 3.5)
    assert "Moved: camera 2 or camera 1. Run calibrate-optics." in text and "&lt;morning&gt;" in text
    assert text.count("<svg") == 2 and "turned by 0.020\u00a0deg" in text
    assert "0.982\u00a0mm" in text and "0.112\u00a0mm" in text and "±" not in text


def test_parts_that_stay_open_are_in_the_verdict_and_chance_is_that_of_the_limit():
    seen = [Verdict("cam1", "good", 0.5, 0.01, 0.02), Verdict("probe", "open", 0.4, 0.2, 0.4)]
    log = checks((0,), seen)
    assert "As calibrated: camera 1. Open: probe on its bracket." in check_page.write_text(log[0], log, 3.5)
    for alarm_sigma, number in ((3.5, "2149"), (3.2, "728")):
        assert f"in one check of {number}." in check_page.write_text(log[0], log, alarm_sigma)


def test_a_page_of_parts_that_nothing_showed():
    made = check_log.check("x", [Verdict("probe", "unseen")])
    assert "Nothing could be checked." in check_page.write_text(made, [made], 3.5)


@pytest.mark.parametrize("days", [(0,), (0, 0.02), range(30), (0, 700)])
def test_the_axis_of_time_holds_all_checks_and_little_else(days):
    """Hours beside a lone check, some days beside those of a month, weeks beside those of two years."""
    log = checks(days, STILL)
    start, end = check_page.span(log)
    length = log[-1].time - log[0].time
    assert start < log[0].time <= log[-1].time < end
    assert end - start <= max(length + timedelta(hours=12), 1.07 * length)


def test_a_lone_check_is_drawn_on_its_day():
    log = checks((0,), STILL)
    text = check_page.write_text(log[0], log, 3.5)
    assert "2026-May-04" in text and "2025" not in text and "2028" not in text
    assert "1 check, " in text and "1 checks" not in text


def test_small_deviations_are_drawn_at_the_floor():
    """0 and 0.02 sigma would lie decades below the alarm, and take most of the drawing; two checks join by a level line."""
    log = checks((0, 1), STILL)
    text = check_page.write_text(log[0], log, 3.5)
    labels = [label for label in ("0.001", "0.01", "0.1", "1", "10") if f">{label}</text>" in text]
    assert labels == ["0.01", "0.1", "1", "10"]  # the first of mm, the last of standard deviations
    assert "2 checks, " in text and "at or below" in text


def test_the_limit_stands_apart_from_the_deviation():
    head, first, second, third = check_page.lines(checks((0,), SEEN)[0])
    place = head.index("limit") + len("limit, 1 σ")
    assert second[:place].endswith("0.112 mm") and "19.3 σ    0.982 mm    0.112 mm" in second
    assert second.endswith("shifted by 0.06 mm (or camera 1)") and "±" not in head + first + second
    assert third.split() == ["probe", "on", "its", "bracket", "not", "checked"]


def clocks(lags) -> list[check_log.Check]:
    """A check a day of a clock that is known to 5 ms, by checks good to 1 ms, that differ by some microseconds."""
    found = [
        Finding(0.5, 1, np.array([lag + 2e-6 * day]), np.eye(1), np.ones(1), np.array([[1e-6]]), np.array([[2.5e-5]]), False)
        for day, lag in enumerate(lags)
    ]
    verdicts = [Verdict("clock", "good", 0.5, 0.01, 0.02, finding=one) for one in found]
    made = [check_log.check("x", [one]) for one in verdicts]
    return [one.model_copy(update={"time": FIRST + timedelta(days=day)}) for day, one in enumerate(made)]


def test_the_page_and_the_verdict_say_which_part_drifts_since_when_and_how_fast():
    """A clock that errs by 4 ms all days, and one that gains 0.5 ms a day after ten days, 5 ms in all; both below the alarm."""
    for lags, told in (([4e-3] * 20, False), ([4e-3] * 10 + [4e-3 + 5e-4 * day for day in range(11)], True)):
        log = clocks(lags)
        text, said = check_page.write_text(log[-1], log, 3.2), check_page.summary(log[-1], control_charts.charts(log, 3.2))
        drift = "scanner's clock since 2026-05-14, evenly in 10 days: +5.0 ms. Run measure-lag."
        assert (drift in said) == ("in 10 days" in text) == ("in control" not in text) == told
        assert "Control charts" in text and text.count("<svg") == 3 and "have no motions" not in text


def test_days_of_earlier_versions_are_said_to_be_missing_in_charts():
    log = clocks([0.0] * 5)
    old = [one.model_copy(update={"parts": (one.parts[0].model_copy(update={"estimate": None}),)}) for one in log[:2]]
    assert "2 checks of the log have no motions" in check_page.write_text(log[-1], [*old, *log[2:]], 3.2)
    assert "Control charts" not in check_page.write_text(old[-1], old, 3.2)


def test_checks_of_one_recording_are_counted_once_and_the_page_says_so():
    log = clocks([0.0] * 5)
    again = [log[0].model_copy(update={"time": log[-1].time + timedelta(hours=k)}) for k in (1, 2)]
    assert "5 checks since" in (text := check_page.write_text(again[-1], [*log, *again], 3.2))
    assert "2 checks of a recording that was checked before don't count." in text.replace("&#x27;", "'")
    assert "1 check of a recording that was checked before" in check_page.write_text(again[0], [*log, again[0]], 3.2)
    assert "checked before" not in check_page.write_text(log[-1], log, 3.2)
