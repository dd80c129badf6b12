"""YAML of any origin gives plain values, or one line."""

import math
import tracemalloc
from pathlib import Path

import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from recon.errors import InputError
from recon.files import yaml_text
from tests.recon import bounded_work
from tests.recon.files.mutations import damaged

ROOT = Path(__file__).resolve().parents[3]
PLACE = Path("file.yaml")
BOMB = "a: &a [l, o, l, l, l, l, l, l, l]\n" + "".join(
    f"{name}: &{name} [{', '.join([f'*{before}'] * 9)}]\n" for before, name in zip("abcdefgh", "bcdefghi", strict=True)
)
MERGES = "a: &a {x: 1}\n" + "".join(
    f"{n}: &{n} {{<<: [{', '.join([f'*{b}'] * 9)}]}}\n" for b, n in zip("abcdefgh", "bcdefghi", strict=True)
)


def test_settings_are_read_as_before():
    for path in sorted((ROOT / "conf").rglob("*.yaml")):
        assert yaml_text.read(path) == yaml.safe_load(path.read_text(encoding="utf-8")), path


def test_aliases_merges_and_odd_words():
    found = yaml_text.loaded(
        PLACE, "a: &a {x: 1, y: 2}\nb: {<<: *a, y: 3}\nc: [*a, *a]\nd: 2001-01-01\ne: .inf\nf: 0x1F\n1: yes\n"
    )
    assert found["b"] == {"x": 1, "y": 3} and found["c"] == [{"x": 1, "y": 2}] * 2
    assert found["d"] == "2001-01-01" and found["e"] == math.inf and found["f"] == 31 and found[1] is True


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        (BOMB, "expected YAML of up to 100000 values, found more, written out or as aliases"),
        (MERGES, "expected YAML of up to 100000 values, found more, written out or as aliases"),
        ("[" + "1," * 110_000 + "]", "expected YAML of up to 100000 values"),
        ("a: &a [*a]", "expected YAML, found a value that holds itself, *a"),
        ("a: *b", "expected YAML, found "),
        ("[" * 100_000, "expected YAML, found values nested too deeply"),
        ("- " * 100_000, "expected YAML, found values nested too deeply"),
        ("a: " + "9" * 5000, "expected YAML, found a number of 5000 digits"),
        ("a: 0x" + "f" * 5000, "expected YAML, found a number of 5002 digits"),
        ("a: 1\na: 2", "expected YAML, found the key 'a' twice"),
        ("{[1]: 2}", "expected YAML, found found unhashable key in line 1, column 2"),
        ("!!python/object/apply:os.system [id]", "expected YAML, found could not determine a constructor"),
        ("!!binary aGVsbG8=", "expected YAML, found could not determine a constructor"),
        ("!!set {a, b}", "expected YAML, found could not determine a constructor"),
        ("!!timestamp x", "expected YAML, found could not determine a constructor"),
        ("!!int x", "expected YAML, found "),
        ('!!int ""', "expected YAML, found "),
        ("!!bool x", "expected YAML, found "),
        ("!!map x", "expected YAML, found "),
        ("<<: 3", "expected YAML, found "),
        ('"\\0"', "expected YAML, found a text with a zero in it"),
        ('"\\ud800"', "expected YAML, found "),
        ("\0", "expected YAML, found "),
        ("a: 1\n---\nb: 2", "expected YAML, found "),
    ],
)
def test_odd_values_are_refused_at_once(text, complaint):
    tracemalloc.start()
    with pytest.raises(InputError) as refusal, bounded_work.calls(2e6):
        yaml_text.loaded(PLACE, text)
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert str(refusal.value).startswith(f"file.yaml: {complaint}") and "\n" not in str(refusal.value)
    assert most < 1e7


WHOLE = (
    b"a: &a {x: 1, y: [2.5, .nan, 'text']}\nb: {<<: *a, y: \"\\u00e4\"}\nc:\n- *a\n- 0x1F\n- yes\nd: |\n  more\n  lines\n# end\n"
)


@settings(max_examples=200, deadline=None)
@given(data=st.data())
def test_damaged_text_gives_values_or_one_line(data):
    spoilt = data.draw(damaged(WHOLE)).decode("utf-8", "replace")
    try:
        with bounded_work.calls(1e5):
            yaml_text.loaded(PLACE, spoilt)
    except InputError as error:
        assert "\n" not in str(error)
