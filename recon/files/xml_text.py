"""XML of any origin: elements of bounded depth, or refused in one line; no document type, so no entities."""

import codecs
import re
from pathlib import Path
from xml.etree.ElementTree import Element, ParseError, XMLParser

from recon.errors import InputError
from recon.files.regular import read_bytes, shown

MOST_BYTES = 1 << 24
DECLARED = re.compile(rb"<\?xml[^>]*?\bencoding\s*=\s*[\"']([A-Za-z][A-Za-z0-9._-]{0,40})[\"']")
MARKS = {codecs.BOM_UTF8: "utf-8-sig", codecs.BOM_UTF16_LE: "utf-16", codecs.BOM_UTF16_BE: "utf-16"}


def read(path: Path, expected: str = "a file") -> Element:
    """The root of an XML file.

    Raises
    ------
    InputError
        If the file is missing, no regular one or no XML, has a document type, or elements nested too deeply.
    """
    return parsed(path, read_bytes(path, MOST_BYTES, expected))


def parsed(path: Path, data: bytes) -> Element:
    """The root of an XML text that stood in a file; raises InputError as `read` does."""
    named = DECLARED.match(data)
    encoding = next(
        (name for mark, name in MARKS.items() if data.startswith(mark)), named[1].decode("ascii") if named else "utf-8"
    )
    try:
        text = data.decode(encoding)
    except (LookupError, UnicodeError):
        raise InputError(f"{shown(path)}: expected XML, found text that isn't in {encoding}") from None
    if "<!DOCTYPE" in text:
        raise InputError(f"{shown(path)}: expected XML without a document type, found one")
    try:
        parser = XMLParser()
        parser.feed(text)  # a text, so that no other encoding is believed
        root = parser.close()
    except (ParseError, ValueError) as error:
        raise InputError(f"{shown(path)}: expected XML, found it broken: {error}") from None
    layer = [root]
    most_depth = 64  # of elements within each other
    for _ in range(most_depth):
        layer = [inner for outer in layer for inner in outer]
        if not layer:
            return root
    raise InputError(f"{shown(path)}: expected XML, found elements nested too deeply")
