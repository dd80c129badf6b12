"""What pydantic finds wrong becomes one line that a user can act on."""

import pytest
from pydantic import ValidationError

from recon.errors import LONGEST, brief, one_line, reason, short
from recon.model.patterns import Patterns

GOOD = {"projector_size": (128, 80), "unwrap": "centre_line", "parts": [{"kind": "centre_line"}]}
FRINGES = {"kind": "fringes", "pitch": 12, "steps": 4}


@pytest.mark.parametrize(
    ("change", "line"),
    [
        ({"parts": [FRINGES, {"kind": "grey"}]},
         "parts.1.kind: expected one of 'fringes', 'gray', 'centre_line', 'uniform', found 'grey'"),
        ({"parts": [{"pitch": 12}]}, "parts.0.kind: expected a value, found none"),
        ({"parts": [3]}, "parts.0: expected a map of fields, found 3"),
        ({"parts": [FRINGES | {"pitch": "wide"}]},
         "parts.0.fringes.pitch: expected number, unable to parse string as a number, found 'wide'"),
        ({"parts": [FRINGES | {"phase": 1}]}, "parts.0.fringes.phase: expected no such field, found 1"),
        ({"parts": [FRINGES | {"pha\rse": 1}]}, "parts.0.fringes.pha se: expected no such field, found 1"),
        ({"parts": [{"kind": "centre_line"}]}, "parts: expected at least one set of fringes, found none"),
        ({"projector_size": (128,)}, "projector_size.1: expected one more value, found none"),
        ({"projector_size": (1, 2, 3)}, "projector_size: expected a length of at most 2, found 3"),
        ({"parts": []}, "parts: expected a length of at least 1, found 0"),
        ({"unwrap": "guess"}, "unwrap: expected 'centre_line', 'gray' or 'heterodyne', found 'guess'"),
    ],
)  # fmt: skip
def test_a_fault_in_one_line(change, line):
    with pytest.raises(ValidationError) as fault:
        Patterns.model_validate(GOOD | change)
    assert one_line(fault.value) == line


@pytest.mark.parametrize("content", [3, None, "text", []])
def test_something_that_is_no_map(content):
    with pytest.raises(ValidationError) as fault:
        Patterns.model_validate(content)
    assert one_line(fault.value) == f"expected a map of fields, found {content!r}"


def test_whatever_was_found_is_shown_in_one_short_line():
    """By a text, a value's `repr` or a library's exception, as none of them is known beforehand."""
    for text in ("a\nb\x1b[31m" + "c" * 9000, brief({"a": ["\n" * 9000]}), reason(OSError("e\n" * 9000))):
        assert short(text).isprintable() and len(short(text)) <= LONGEST
    assert len(short("folder/" * 40, 200)) == 200
    assert brief("\0'") == repr("\0'") and reason(KeyError()) == "KeyError" and reason(ValueError("no\n number")) == "no number"
