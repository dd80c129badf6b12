"""JSON of any origin gives plain values, or one line."""

import json
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from recon.errors import InputError
from recon.files import json_text
from tests.recon import bounded_work
from tests.recon.files.mutations import damaged

PLACE = Path("file.json")


def test_values_are_those_of_the_standard_library(tmp_path):
    text = '\ufeff{"a": [1, -2.5e3, true, null, "\\u00e4\\ud83d\\ude00\\\\ud800"], "b": {}}'
    (tmp_path / "file.json").write_text(text, encoding="utf-8")
    assert json_text.read(tmp_path / "file.json") == json.loads(text.lstrip("\ufeff"))


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("", "expected JSON, found it damaged: Expecting value"),
        ("NaN", "expected finite numbers, found NaN"),
        ("[1, -Infinity]", "expected finite numbers, found -Infinity"),
        ("1e400", "expected finite numbers, found 1e400"),
        ("9" * 5000, "expected JSON, found it damaged: a number of 5000 digits"),
        ('{"a": 1, "a": 2}', "expected JSON, found it damaged: the key 'a' twice in one object"),
        ("[" * 100_000, "expected JSON, found values nested too deeply"),
        ("[" * 65 + "]" * 65, "expected JSON, found values nested too deeply"),
        ('"\\ud800"', "expected JSON, found a text with half a letter or a zero in it, \\ud800"),
        ('{"\\udc00\\ud800": 1}', "expected JSON, found a text with half a letter or a zero in it, \\udc00"),
        ('["a\\u0000b"]', "expected JSON, found a text with half a letter or a zero in it, \\u0000"),
    ],
)
def test_odd_values_are_refused_at_once(text, complaint):
    with pytest.raises(InputError) as refusal, bounded_work.calls(1e4):
        json_text.parsed(PLACE, text)
    assert str(refusal.value).startswith(f"file.json: {complaint}")


def test_a_large_file_is_refused_before_it_is_read(tmp_path):
    with (tmp_path / "large.json").open("wb") as stream:
        stream.truncate(10 * json_text.MOST_BYTES)
    with pytest.raises(InputError, match=r"large\.json: expected a file of up to 16 MiB, found 160 MiB"):
        json_text.read(tmp_path / "large.json")


WHOLE = (
    b'{"schema": "sonotwin-capture/1", "size": [640, 480], "a": {"b": [1.5, -2e-3, null, true]}, "name": "gr\xc3\xa4y \\u00e4"}'
)


@settings(max_examples=200, deadline=None)
@given(data=st.data())
def test_damaged_text_gives_values_or_one_line(data):
    spoilt = data.draw(damaged(WHOLE)).decode("utf-8", "replace")
    try:
        with bounded_work.calls(1e4):
            value = json_text.parsed(PLACE, spoilt)
    except InputError as error:
        assert "\n" not in str(error)
    else:
        json.dumps(value, allow_nan=False).encode()
