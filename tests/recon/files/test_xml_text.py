"""XML of any origin gives elements, or one line."""

from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from recon.errors import InputError
from recon.files import xml_text
from tests.recon.files.mutations import damaged

PLACE = Path("file.xml")
LAUGHS = (
    '<!DOCTYPE a [<!ENTITY a "ha">'
    + "".join(f'<!ENTITY {n} "{f"&{b};" * 10}">' for b, n in zip("abcdefgh", "bcdefghi", strict=True))
    + "]>"
)


@pytest.mark.parametrize(
    "data",
    [
        b'<a b="\xc3\xa9"/>',
        b'\xef\xbb\xbf<?xml version="1.0" encoding="utf-8"?><a b="\xc3\xa9"/>',
        b'<?xml version="1.0" encoding="iso-8859-1"?><a b="\xe9"/>',
        '<?xml version="1.0" encoding="utf-16"?><a b="é"/>'.encode("utf-16"),
    ],
)
def test_usual_encodings_are_read(data):
    assert xml_text.parsed(PLACE, data).get("b") == "é"


@pytest.mark.parametrize(
    ("data", "complaint"),
    [
        (f"{LAUGHS}<a>&i;</a>".encode(), "expected XML without a document type, found one"),
        (f'<?xml version="1.0" encoding="utf-16"?>{LAUGHS}<a>&i;</a>'.encode("utf-16"), "expected XML without a document type"),
        (
            f'<?xml version="1.0" encoding="utf-7"?>{LAUGHS}<a>&i;</a>'.encode("utf-7"),
            "expected XML without a document type",
        ),
        (b'<!DOCTYPE a SYSTEM "file:///etc/passwd"><a/>', "expected XML without a document type, found one"),
        (b"<a>" * 100_000 + b"</a>" * 100_000, "expected XML, found elements nested too deeply"),
        (b"", "expected XML, found it broken"),
        (b"<a>&b;</a>", "expected XML, found it broken"),
        (b'<?xml version="1.0" encoding="rot13"?><a/>', "expected XML, found text that isn't in rot13"),
        (b"<a>\xff</a>", "expected XML, found text that isn't in utf-8"),
        (b"<a>\0</a>", "expected XML, found it broken"),
    ],
)
def test_odd_files_are_refused_at_once(data, complaint):
    with pytest.raises(InputError) as refusal:
        xml_text.parsed(PLACE, data)
    assert str(refusal.value).startswith(f"file.xml: {complaint}")


@settings(max_examples=300, deadline=None)
@given(data=st.data())
def test_a_damaged_file_gives_elements_or_one_line(data):
    whole = '<?xml version="1.0" encoding="utf-8"?>\n<a b="1 0 0"><!-- c --><d e=\'é\'>1. 2.</d><f/></a>\n'.encode()
    try:
        xml_text.parsed(PLACE, data.draw(damaged(whole)))
    except InputError as error:
        assert "\n" not in str(error)
