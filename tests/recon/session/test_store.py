"""Steps are done once, and again when anything that they are made of has changed."""

import json
import os
from pathlib import Path
from types import SimpleNamespace

import pytest
from pydantic import BaseModel

from recon.errors import InputError
from recon.files import atomic
from recon.session.store import RECORD, Store, files_of


class Settings(BaseModel):
    """Of a step with one field."""

    value: str


@pytest.fixture
def work():
    """A step that writes its field into a file; it notes its calls, and fails or is interrupted after that as told."""
    calls, fault = [], []

    def run(settings, out):
        calls.append(settings.value)
        with atomic.new_folder(out, "verb") as folder:
            for name in ("result.txt", "extra.txt", "metrics.json"):
                (folder / name).write_text(settings.value)
        if fault:
            raise fault.pop()

    return SimpleNamespace(run=run, calls=calls, fault=fault)


def done(folder: Path, work, value: str = "1", source: Path | None = None, say=lambda line: None, code: str = "a") -> Store:
    """A run of one step."""
    steps = Store(folder, say, code)
    with steps.opened([]):
        made_of = {"files": files_of([source] if source else [])}
        steps.do("part", "a part", "verb", Settings, {"value": value}, work.run, made_of)
    return steps


def test_a_step_is_done_once(tmp_path, work):
    assert done(tmp_path, work).done == ["part"] == done(tmp_path, work).done
    assert work.calls == ["1"]


def test_a_step_is_done_again_for_another_setting_a_changed_file_or_a_lost_one(tmp_path, work):
    source = tmp_path / "source.txt"
    source.write_text("a")
    out = tmp_path / "out"
    done(out, work, "1", source)
    done(out, work, "2", source)
    os.utime(source, ns=(1, 1))
    done(out, work, "2", source)
    for name in ("result.txt", "extra.txt", "metrics.json"):
        (out / "part" / name).unlink()
        done(out, work, "2", source)
    assert work.calls == ["1", "2", "2", "2", "2", "2"]


def test_a_result_that_was_changed_is_not_kept_nor_lost(tmp_path, work):
    """Its change is another's work, which is named, and stays where it is until it is moved away."""
    lines, changed = [], tmp_path / "part" / "extra.txt"
    done(tmp_path, work)
    changed.write_text("2")
    assert done(tmp_path, work, say=lines.append).done == []
    assert "extra.txt: expected nothing or a file as verb wrote it, found it changed since" in lines[-1]
    changed.rename(tmp_path.with_suffix(".txt"))
    assert done(tmp_path, work).done == ["part"]


def test_a_step_that_fails_is_left_out_in_one_line_and_tried_again(tmp_path, work):
    lines = []
    done(tmp_path, work)
    work.fault.append(InputError("capture: expected frames, found none"))
    steps = done(tmp_path, work, "2", say=lines.append)
    assert list(steps.failed) == ["part"] and steps.digest("part") == {} and steps.done == []
    assert lines[-1] == f"left out    part: capture: expected frames, found none; {tmp_path / 'part'} is of an earlier run"
    done(tmp_path, work, "1")
    assert work.calls == ["1", "2", "1"], "the result of before no longer counts"


def test_settings_that_do_not_fit_fail_one_step_in_one_line(tmp_path, work):
    """What one step refuses of the settings of all is no end of the others."""
    lines = []
    steps = Store(tmp_path, lines.append, "a")
    with steps.opened([]):
        assert steps.do("part", "a part", "verb", Settings, {"value": 3}, work.run, {}) is None
        assert steps.do("other", "another", "verb", Settings, {"value": "1"}, work.run, {}) is not None
    assert lines[0].startswith("left out    part: verb: value: expected") and "\n" not in lines[0]
    assert (list(steps.failed), steps.done, work.calls) == (["part"], ["other"], ["1"])


@pytest.mark.parametrize("before", [None, "1"])
def test_an_interrupted_step_is_done_by_the_next_run(tmp_path, work, before):
    """Also where the run was stopped after the folder had been replaced: what is there is of other settings then."""
    if before:
        done(tmp_path, work, before)
    work.fault.append(KeyboardInterrupt())
    with pytest.raises(KeyboardInterrupt):
        done(tmp_path, work, "2")
    assert json.loads((tmp_path / RECORD).read_text()) == {}
    assert done(tmp_path, work, "1").done == ["part"] and work.calls[-1] == "1"
    assert (tmp_path / "part" / "result.txt").read_text() == "1"


def test_a_step_is_done_again_by_other_code(tmp_path, work):
    for code in "aab":
        done(tmp_path, work, code=code)
    assert work.calls == ["1", "1"]


def test_what_builds_on_a_step_changes_with_it(tmp_path, work):
    first, second = (done(tmp_path, work, value).digest("part", "another") for value in "12")
    assert list(first) == ["part"] and second != first


def test_results_that_are_no_part_of_a_run_are_named_once(tmp_path, work):
    lines = []
    done(tmp_path, work)
    for _ in range(2):
        with Store(tmp_path, lines.append, "a").opened([]):
            pass
    assert lines == ["stale       part: of an earlier run, and no part of this result"]


def test_a_beginning_that_was_killed_is_no_obstacle(tmp_path, work):
    """Its list was not yet there, but the hidden files by which it is written."""
    for name in ("..sonotwin.json.lock", "..sonotwin.77.new.json"):
        (tmp_path / name).write_text("")
    assert done(tmp_path, work).done == ["part"]


@pytest.mark.parametrize("content", ["not JSON", "[1, 2]", ""])
def test_a_changed_record_is_refused_and_a_lost_one_costs_work_alone(tmp_path, work, content):
    done(tmp_path, work)
    (tmp_path / RECORD).write_text(content)
    with pytest.raises(
        InputError,
        match=r"reconstruct\.json: expected nothing or a file as reconstruct wrote it, found it changed since",
    ):
        done(tmp_path, work)
    (tmp_path / RECORD).unlink()
    assert done(tmp_path, work).done == ["part"] and work.calls == ["1", "1"]


def test_a_folder_of_something_else_is_refused(tmp_path, work):
    (tmp_path / "thesis.txt").write_text("mine")
    with pytest.raises(InputError, match=r"expected a new or empty folder, or one that reconstruct wrote"):
        done(tmp_path, work)
