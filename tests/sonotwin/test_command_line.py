"""Command lines printed from settings give the same settings again."""

from importlib import import_module

import pytest

from sonotwin import command_line
from sonotwin.config import load


@pytest.mark.parametrize(("verb", "fields"), [
    ("render", ["scene=sphere", "patterns=gray_surface", "out=a b/o,1"]),
    ("render", ["scene=two_objects", "+scene.parts={a:[1,2]}", "out=o"]),
    ("sweep", ["scene=crosswire", "path=wire", "path.count=7", "conditions=lifelike", "conditions.drift.focal=0.0003", "out=o"]),
    ("sweep", ["conditions.frames.shift=1e-7", "name=''", "seed=4", "out=é"]),
    ("reconstruct", ["capture=c", "out=o", "lag_s=-0.05", "lag_sigma_s=0.001", "find=tube", "slice_mm=null"]),
    ("segment", ["capture=c", "out=o", "slice_mm=[[4,0.9],[8,0.6]]", "diameter_mm=[5,20.5]"]),
    ("calibrate-optics", ["capture=c", "out=o", "devices=[cam1,projector]"]),
    ("demo", ["path=none", "poses=none", "rig.cam1.optics.size=[640,512]"]),
    ("demo", ["path=stroke", "+path.strokes=2", "tissue_m_s=1450.000000000001"]),
    ("sweep", ["out='2024'", "+path.step_seconds=1.0"]),
    ("sweep", ["out='null'"]),
    ("sweep", ["out=' a '"]),
    ("sweep", ["out=it's 50 %, {new}"]),
    ("print", ["part=board", "out='3'"]),
])  # fmt: skip
def test_printed_fields_give_the_same_settings(verb, fields):
    model = import_module(f"sonotwin.verbs.{verb.replace('-', '_')}").Config
    settings = load(verb, fields, model)
    printed = command_line.fields(verb, settings)
    assert load(verb, printed, model) == settings
    assert len(printed) <= len(fields)


def test_usual_settings_need_no_words():
    model = import_module("sonotwin.verbs.demo").Config
    assert command_line.words("demo", load("demo", [], model)) == ["demo"]
