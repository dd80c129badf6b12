"""What the campaign takes for right and for wrong."""

import subprocess
import sys
import time

import numpy as np
import pytest

from campaign import commands, kills, results, soak
from campaign.commands import Outcome


def outcome(**changed) -> Outcome:
    return Outcome(**{"status": 2, "said": "sonotwin: x: expected y\n", "seconds": 1.0, "peak_mb": 100.0} | changed)


def test_a_refusal_is_one_line_and_nothing_else():
    assert outcome().refused
    for wrong in ({"status": 0}, {"status": 1}, {"said": ""}, {"said": "libpng error\nsonotwin: x\n"}, {"changed": ("new",)}):
        assert not outcome(**wrong).refused


@pytest.mark.parametrize("change", ["new", "gone", "longer", "same length", "a folder", "a link"])
def test_changes_of_a_folder_are_seen(tmp_path, change):
    (tmp_path / "a").write_text("old")
    before = commands.snapshot(tmp_path)
    assert commands.changes(before, commands.snapshot(tmp_path)) == ()
    time.sleep(0.01)
    place = tmp_path / "b"
    {
        "new": lambda: place.write_text(""),
        "gone": (tmp_path / "a").unlink,
        "longer": lambda: (tmp_path / "a").write_text("longer"),
        "same length": lambda: (tmp_path / "a").write_text("new"),
        "a folder": place.mkdir,
        "a link": lambda: place.symlink_to("a"),
    }[change]()
    assert commands.changes(before, commands.snapshot(tmp_path)) == ("b" if place.exists() else "a",)


def test_a_command_is_measured(tmp_path):
    """Status, line, and a memory that a Python with NumPy has; nothing is written."""
    found = commands.run(["surface", "capture=none", "out=new"], tmp_path, 60.0)
    assert found.refused and "none" in found.said and 50 < found.peak_mb < 1000 and 0 < found.seconds < 60


def test_half_a_result_is_seen():
    """A mixture of files of both, where the folder is exchanged as a whole; a file that is neither, where it grows."""
    old, new = {"a": "1", "b": "2"}, {"a": "3", "b": "4"}
    assert kills._torn(old, old, new, False) == kills._torn(new, old, new, False) == []
    assert kills._torn({"a": "1", "b": "4"}, old, new, False) and kills._torn({}, old, new, False)
    assert kills._torn({"a": "1", "b": "4"}, old, new, True) == []
    assert kills._torn({"a": "5", "b": "4"}, old, new, True) == ["a"] and kills._torn({"a": "1"}, old, new, True) == ["b"]
    assert kills._torn({"a": "1"}, {"a": "1"}, new, True) == []  # the rest is still to come


def test_leftovers_and_orphans_are_found(tmp_path):
    for name in (".new.123.new", ".new.123.old", ".shard-1.55.new.tar", ".new.lock", "new"):
        (tmp_path / name).write_text("")
    assert results.leftovers(tmp_path) == [".new.123.new", ".new.123.old", ".new.lock", ".shard-1.55.new.tar"]
    process = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"], start_new_session=True)
    assert results.processes_of(process.pid) == [process.pid]
    results.end([process.pid])
    process.wait()
    assert results.processes_of(process.pid) == []


def test_growth_and_pace_are_of_the_last_tenth():
    """A run that leaks 1 MB an item and ends half as fast."""
    took = np.concatenate([np.full(80, 1.0), np.full(20, 2.0)])
    found = soak.Soak("x", np.cumsum(took), np.arange(100.0))
    assert found.growth_mb == pytest.approx(80.0) and found.slowing == pytest.approx(1.0)
    flat = soak.Soak("x", np.arange(100.0), np.full(100, 300.0))
    assert flat.growth_mb == 0 and flat.slowing == 0 and flat.sample_s == pytest.approx(1.0)
