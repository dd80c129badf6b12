"""The grammar of faults: each makes another file of a valid one, and which are found doesn't depend on chance."""

import json
import os
import shutil

import pytest

from campaign import bad_inputs, field_faults
from campaign.byte_faults import faults_of_any_file
from campaign.image_faults import png_faults
from campaign.sources import COMMANDS
from campaign.text_faults import json_faults, table_faults, xml_faults, yaml_faults
from sonotwin import config

MATRIX = b"""%YAML:1.0
---
M: !!opencv-matrix
   rows: 1
   cols: 2
   dt: d
   data: [ 1.5, -2e3 ]
"""
VALID = {
    json_faults: b'{"schema": "x/1", "size": [3, 4], "parts": [{"kind": "a"}, {"kind": "b"}]}',
    yaml_faults: MATRIX,
    table_faults: b"frame,time_ns\n0,0\n1,5\n2,9\n",
    xml_faults: b'<PlusConfiguration><V OutputSpacing="0.5 0.5 0.5"/></PlusConfiguration>',
}


@pytest.mark.parametrize("grammar", VALID, ids=lambda grammar: grammar.__name__)
def test_each_fault_is_another_file(grammar):
    """With a name of its own, by which it is made again."""
    faults = list(grammar(VALID[grammar]))
    assert len(faults) >= 4 and len({name for name, _ in faults}) == len(faults)
    assert all(content != VALID[grammar] for _, content in faults)
    assert faults == list(grammar(VALID[grammar]))


def test_each_field_of_a_json_is_attacked_once():
    """Of fields that come in numbers, the first; a file stays JSON but for what the fault is."""
    faults = dict(json_faults(VALID[json_faults]))
    assert "parts.0.kind is a zero byte" in faults and "parts.1.kind is a zero byte" not in faults
    assert json.loads(faults["size.0 is a word"]) == {
        "schema": "x/1",
        "size": ["many", 4],
        "parts": [{"kind": "a"}, {"kind": "b"}],
    }


def test_files_are_replaced_not_written_to(tmp_path):
    """They are links to valid ones, which other cases need."""
    (tmp_path / "valid").write_bytes(b"content")
    for number, fault in enumerate(faults_of_any_file(tmp_path / "valid")):
        path = tmp_path / str(number)
        path.hardlink_to(tmp_path / "valid")
        fault.apply(path)
        assert not path.is_file() or path.is_symlink() or path.stat().st_size > 1 << 30 or path.read_bytes() != b"content"
        if path.exists() and not path.is_dir():
            os.unlink(path)
    assert (tmp_path / "valid").read_bytes() == b"content"


def test_pngs_of_the_grammar_keep_their_checksums():
    """Or a reader would refuse them for that alone."""
    import cv2
    import numpy as np

    content = cv2.imencode(".png", np.random.default_rng(0).integers(0, 256, (40, 50), np.uint8))[1].tobytes()
    wide = dict(png_faults(content))["a hundred thousand px wide"]
    assert int.from_bytes(wide[16:20]) == 100_000
    assert wide[:8] == content[:8] and wide.endswith(content[-12:])


@pytest.mark.parametrize("command", COMMANDS, ids=lambda command: " ".join(command.line[:2]))
def test_each_command_has_bad_fields(command, tmp_path, monkeypatch):
    """Twenty or more, none of which is the command itself."""
    made_of = {"patterns": "patterns/paper_surface", "upright": "artefacts/steel", "divots": "artefacts/divot_plate"}
    for name, choice in made_of.items():
        shutil.copy(config.folder() / f"{choice}.yaml", tmp_path / f"{name}.yaml")
    monkeypatch.chdir(tmp_path)
    named = [field.partition("=")[0] for field in command.fields if field.split("=")[-1].split("/")[0] in command.folders]
    found = list(field_faults.overrides(command.verb, command.line[1:], named))
    assert len(found) > 20 and not set(found) & set(command.line)


def test_a_verb_without_a_result_is_given_no_place_for_it():
    command = next(command for command in COMMANDS if command.verb == "navigate")
    found = list(field_faults.overrides(command.verb, command.line[1:], ["capture"]))
    assert not any(field.startswith("out=/") for field in (*command.line, *found)) and "capture=/dev/zero" in found


def test_cases_are_drawn_evenly_over_the_verbs(tmp_path):
    """As many of each, the same for the same seed."""
    few = [command for command in COMMANDS if not command.reads]
    found = bad_inputs.cases(tmp_path, few)
    some = bad_inputs.chosen(found, 60, seed=1)
    counts = [sum(case.command.verb == command.verb for case in some) for command in few]
    assert len(some) == 60 and max(counts) - min(counts) <= 1
    assert [case.fault for case in some] == [
        case.fault for case in bad_inputs.chosen(bad_inputs.cases(tmp_path, few), 60, seed=1)
    ]
