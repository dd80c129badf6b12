"""Steps are done once, and again when anything that they are made of has changed."""

import json
import os
from pathlib import Path
from types import SimpleNamespace

import pytest

from recon.errors import InputError
from sonotwin import kept_steps
from sonotwin.kept_steps import RECORD, KeptSteps, files_of


@pytest.fixture
def verb(monkeypatch):
    """A verb that writes its field into a file; it notes its calls, and fails or is interrupted as told."""
    calls, fault = [], []

    def run(fields):
        calls.append(fields["value"])
        if fault:
            raise fault.pop()
        place = Path(fields["out"])
        place.mkdir(parents=True, exist_ok=True)
        (place / "result.txt").write_text(fields["value"])

    monkeypatch.setattr(kept_steps, "import_module", lambda name: SimpleNamespace(run=run, Config=dict))
    monkeypatch.setattr(kept_steps, "load", lambda verb, fields, model: dict(field.split("=", 1) for field in fields))
    return SimpleNamespace(calls=calls, fault=fault)


def opened(folder: Path) -> KeptSteps:
    steps = KeptSteps(folder, lambda line: None)
    steps.open([])
    return steps


def do(steps: KeptSteps, value: str = "1", source: Path | None = None) -> Path | None:
    return steps.do("part", "a part", "verb", [f"value={value}"], "result.txt", {"files": files_of([source] if source else [])})


def test_a_step_is_done_once(tmp_path, verb):
    assert do(opened(tmp_path)) == tmp_path / "part" == do(opened(tmp_path))
    assert verb.calls == ["1"]


def test_a_step_is_done_again_for_another_field_a_changed_file_or_a_lost_result(tmp_path, verb):
    source = tmp_path / "source.txt"
    source.write_text("a")
    out = tmp_path / "out"
    do(opened(out), "1", source)
    do(opened(out), "2", source)
    os.utime(source, ns=(1, 1))
    do(opened(out), "2", source)
    (out / "part" / "result.txt").unlink()
    do(opened(out), "2", source)
    assert verb.calls == ["1", "2", "2", "2"]


def test_a_step_that_fails_is_left_out_in_one_line_and_tried_again(tmp_path, verb):
    lines = []
    do(opened(tmp_path))
    steps = KeptSteps(tmp_path, lines.append)
    steps.open([])
    verb.fault.append(InputError("capture: expected frames, found none"))
    assert do(steps, "2") is None and steps.failed == ["part"] and steps.digest("part") == {}
    assert lines[-1] == "left out    part: capture: expected frames, found none"
    assert do(opened(tmp_path), "1") is not None
    assert verb.calls == ["1", "2", "1"], "the result of before no longer counts"


def test_an_interrupted_step_is_done_by_the_next_run(tmp_path, verb):
    verb.fault.append(KeyboardInterrupt())
    with pytest.raises(KeyboardInterrupt):
        do(opened(tmp_path))
    assert json.loads((tmp_path / RECORD).read_text()) == {}
    assert do(opened(tmp_path)) is not None and verb.calls == ["1", "1"]


def test_what_builds_on_a_step_changes_with_it(tmp_path, verb):
    steps = opened(tmp_path)
    do(steps, "1")
    first = steps.digest("part", "another")
    do(steps, "2")
    assert list(first) == ["part"] and steps.digest("part") != first


@pytest.mark.parametrize("content", ["not JSON", "[1, 2]", ""])
def test_a_damaged_record_costs_work_alone(tmp_path, verb, content):
    do(opened(tmp_path))
    (tmp_path / RECORD).write_text(content)
    assert do(opened(tmp_path)) is not None and verb.calls == ["1", "1"]


def test_a_folder_of_something_else_is_refused(tmp_path):
    (tmp_path / "thesis.txt").write_text("mine")
    with pytest.raises(InputError, match=r"expected a new or empty folder or one with reconstruct.json"):
        opened(tmp_path)
