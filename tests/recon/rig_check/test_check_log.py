"""The log grows by whole lines; what is damaged is named, and left alone."""

import pytest

from recon.errors import InputError
from recon.rig_check import check_log
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


@pytest.mark.parametrize("line", ['{"time": "2026-01-01T00:00:00Z", "name": "x"', '{"name": "x"}', "[1, 2]", LONG_AGO])
def test_a_damaged_log_is_refused_and_stays(tmp_path, line):
    log = tmp_path / "rig.jsonl"
    check_log.add(log, check_log.check("monday", SEEN))
    damaged = log.read_text() + line + "\n"
    log.write_text(damaged)
    with pytest.raises(InputError, match=r"rig\.jsonl"):
        check_log.add(log, check_log.check("tuesday", SEEN))
    assert log.read_text() == damaged
