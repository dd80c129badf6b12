"""The log grows by whole lines; what is damaged is named, and left alone."""

import json
from pathlib import Path

import numpy as np
import pytest

from recon.errors import InputError
from recon.rig_check import check_log, control_charts
from recon.rig_check.fault_tests import Finding
from recon.rig_check.verdicts import Verdict

MOVED = Verdict("cam2", "moved", 19.3, 0.98, 0.11, "turned by 0.020 deg, shifted by 0.06 mm", ("cam1",))
LONG_AGO = '{"time": "0001-01-01T00:00:00Z", "name": "x", "parts": [{"part": "cam1", "state": "good"}]}'
SEEN = (Verdict("cam1", "maybe", 3.0, 0.1, 0.05), MOVED, Verdict("probe", "unseen"))


def test_checks_are_read_as_they_were_added(tmp_path):
    log = tmp_path / "days" / "rig.jsonl"
    made = [check_log.check("monday", SEEN[:1]), check_log.check("tuesday", SEEN)]
    for one in made:
        check_log.add(log, one)
    both = check_log.read(log)
    assert both == made and [one.name for one in both] == ["monday", "tuesday"]
    assert both[1].parts[1].rivals == ("cam1",) and both[1].parts[2].sigma is None
    assert len(log.read_text().splitlines()) == 2 and [path.name for path in log.parent.iterdir()] == ["rig.jsonl"]


def test_a_log_of_earlier_versions_is_read_and_added_to(tmp_path):
    """Kept as written: a line by the first check, and one with a rig's numbers, both before motions were logged."""
    log = tmp_path / "rig.jsonl"
    log.write_bytes(Path(__file__).with_name("log_before_0_2_0.jsonl").read_bytes())
    monday, tuesday = check_log.read(log)
    assert (monday.name, tuesday.name, monday.time.day) == ("monday", "tuesday", 30) and monday.parts == tuesday.parts
    assert [(part.part, part.state, part.sigma) for part in monday.parts] == [
        ("cam1", "maybe", 3.0),
        ("cam2", "moved", 19.3),
        ("clock", "good", 0.5),
        ("probe", "unseen", None),
    ]
    assert monday.parts[1].rivals == ("cam1",) and not any(part.estimate for part in monday.parts)
    assert monday.rig is None and [one.name for one in tuesday.rig.changed] == ["cam1.lens.focus_mm"]
    assert tuesday.rig.before.text == "version 1 (2026-11-28, friday)"
    check_log.add(log, check_log.check("today", SEEN))
    assert check_log.read(log)[:2] == [monday, tuesday] and control_charts.charts(check_log.read(log), 3.2) == []


ESTIMATE = {"motion": [1e-3], "own": [[1e-6]], "common": [[4e-6]], "against": "x"}


def line_of(**changed) -> str:
    """A check of the clock, with an estimate that is changed."""
    part = {"part": "clock", "state": "good", "sigma": 0.5, "estimate": ESTIMATE | changed}
    return json.dumps({"time": "2026-01-01T00:00:00Z", "name": "x", "parts": [part]})


def test_motions_are_logged_with_what_they_are_against(tmp_path):
    """A line without them, of an earlier version, is read beside; digests of other numbers are others."""
    found = Finding(0.5, 1, np.array([1e-3]), np.eye(1), np.ones(1), np.array([[1e-6]]), np.array([[4e-6]]), named=False)
    log = tmp_path / "rig.jsonl"
    log.write_text('{"time": "2026-01-01T00:00:00Z", "name": "x", "parts": [{"part": "clock", "state": "good", "sigma": 0.5}]}\n')
    check_log.add(log, check_log.check("today", [Verdict("clock", "good", 0.5, finding=found, against="x")]))
    old, new = (made.parts[0].estimate for made in check_log.read(log))
    assert old is None and new == check_log.Estimate.model_validate(ESTIMATE)
    numbers = np.arange(3.0)
    first, *others = (check_log.digest(*each) for each in ([numbers], [numbers.copy()], [numbers + 1e-12], [numbers, None]))
    assert others[0] == first and first not in others[1:]


@pytest.mark.parametrize(
    ("changed", "told"),
    [
        ({"motion": [0.0, 0.0]}, "own: expected 2 rows of 2 numbers"),
        ({"motion": [0.0] * 6, "own": np.eye(6).tolist(), "common": np.eye(6).tolist()}, "expected 1 numbers of clock, found 6"),
        ({"motion": []}, "motion"),
        ({"own": [[-1e-6]]}, "own: expected a covariance"),
        (
            {"motion": [0.0] * 6, "own": np.eye(6).tolist(), "common": np.tri(6).tolist()},
            "common: expected a covariance",
        ),
        ({"common": [[1e13]]}, "common"),
        ({"against": None}, "against"),
    ],
)
def test_a_motion_that_is_none_is_refused(tmp_path, changed, told):
    """In one line, with file, line and field."""
    log = tmp_path / "rig.jsonl"
    log.write_text(line_of() + "\n")
    assert check_log.read(log)[0].parts[0].estimate is not None
    log.write_text(line_of() + "\n" + line_of(**changed) + "\n")
    with pytest.raises(InputError, match=r"rig\.jsonl: line 2") as refused:
        check_log.read(log)
    assert told in str(refused.value) and "\n" not in str(refused.value)


@pytest.mark.parametrize("line", ['{"time": "2026-01-01T00:00:00Z", "name": "x"', '{"name": "x"}', "[1, 2]", LONG_AGO])
def test_a_damaged_log_is_refused_and_stays(tmp_path, line):
    log = tmp_path / "rig.jsonl"
    check_log.add(log, check_log.check("monday", SEEN))
    damaged = log.read_text() + line + "\n"
    log.write_text(damaged)
    with pytest.raises(InputError, match=r"rig\.jsonl"):
        check_log.add(log, check_log.check("tuesday", SEEN))
    assert log.read_text() == damaged
