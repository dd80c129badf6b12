"""The log grows by whole lines; what is damaged is named, and left alone."""

import pytest

from recon.errors import InputError
from recon.rig_check import check_log, check_page
from recon.rig_check.verdicts import Verdict

MOVED = Verdict("cam2", "moved", 19.3, 0.98, 0.11, "turned by 0.020 deg, shifted by 0.06 mm", ("cam1",))
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


@pytest.mark.parametrize("line", ['{"time": "2026-01-01T00:00:00Z", "name": "x"', '{"name": "x"}', "[1, 2]"])
def test_a_damaged_log_is_refused_and_stays(tmp_path, line):
    log = tmp_path / "rig.jsonl"
    check_log.add(log, check_log.check("monday", SEEN))
    damaged = log.read_text() + line + "\n"
    log.write_text(damaged)
    with pytest.raises(InputError, match=r"rig\.jsonl"):
        check_log.add(log, check_log.check("tuesday", SEEN))
    assert log.read_text() == damaged


def test_the_page_says_what_moved_and_what_to_do(tmp_path):
    checks = [check_log.check("monday", SEEN), check_log.check("<tuesday>", SEEN)]
    text = check_page.write_text(checks[1], checks, 3.5)
    assert "Moved: camera 2 or camera 1. Run calibrate-optics." in text and "&lt;tuesday&gt;" in text
    assert text.count("<svg") == 2 and "turned by 0.020\u00a0deg" in text


def test_a_page_of_parts_that_nothing_showed(tmp_path):
    made = check_log.check("x", [Verdict("probe", "unseen")])
    assert "Nothing could be checked." in check_page.write_text(made, [made], 3.5)
