"""Faults of text files: fields of JSON, matrices of OpenCV's YAML, cells of tables, elements of XML."""

import json
import re
from collections.abc import Iterator
from typing import Any

DIGITS = "9" * 10_000
DEEP = "[" * 5000 + "]" * 5000
NONSENSE = {  # text of a JSON value -> its name; none is right for any field
    "nested 5000 deep": DEEP,
    "ten thousand digits": DIGITS,
    "an unknown object": '{"unknown": [1]}',
    "not a number": "NaN",
    "beyond all numbers": "1e999",
    "lists in lists": "[[[[]]]]",
}
TEXT_NONSENSE = {  # of a field that is text: a path, a kind, a version
    "a zero byte": '"a\\u0000b"',
    "half a character": '"\\ud800"',
    "out of the folder": '"../../../../etc/passwd"',
    "a device": '"/dev/zero"',
}
NUMBER_NONSENSE = {"a word": '"many"', "1e308": "1e308", "-1e308": "-1e308"}
FREE_TEXT = {"name"}  # fields of which any text is right
BOMB = "a: &a [x,x,x,x,x,x,x,x,x]\n" + "".join(
    f"{b}: &{b} [{','.join([f'*{a}'] * 9)}]\n" for a, b in zip("abcdefghi", "bcdefghij", strict=True)
)


def json_faults(content: bytes) -> Iterator[tuple[str, bytes]]:
    """Each kind of field, the first of its name, with each nonsense value; fields that no reader knows; text that isn't JSON."""
    tree = json.loads(content)
    yield "half", content[: len(content) // 2]
    yield "a list", b"[1, 2, 3]"
    yield "other letters", content.decode().encode("utf-16")
    seen = set()
    for way in _leaves(tree):
        kind = tuple(part for part in way if isinstance(part, str))
        if kind in seen or (kind and kind[-1] in FREE_TEXT):
            continue
        seen.add(kind)
        old = _at(tree, way)
        nonsense = NONSENSE | (TEXT_NONSENSE if isinstance(old, str) else NUMBER_NONSENSE if type(old) in (int, float) else {})
        for name, text in nonsense.items():
            yield f"{'.'.join(map(str, way))} is {name}", _with(tree, way, text)


def _leaves(tree: Any, way: tuple = ()) -> Iterator[tuple]:
    if isinstance(tree, dict) and tree:
        for key, value in tree.items():
            yield from _leaves(value, (*way, key))
    elif isinstance(tree, list) and tree:
        for number, value in enumerate(tree):
            yield from _leaves(value, (*way, number))
    elif way:
        yield way


def _at(tree: Any, way: tuple) -> Any:
    for part in way:
        tree = tree[part]
    return tree


def _with(tree: Any, way: tuple, text: str) -> bytes:
    """The JSON of a tree with another value at a place, given as text."""
    copy = json.loads(json.dumps(tree))
    _at(copy, way[:-1])[way[-1]] = "@here@"
    return json.dumps(copy).replace('"@here@"', text).encode()


def yaml_faults(content: bytes) -> Iterator[tuple[str, bytes]]:
    """Tags and aliases that no file needs; matrices whose header and numbers don't agree; numbers that are none."""
    text = content.decode()
    yield "aliases of aliases", BOMB.encode()
    yield "aliases of aliases with OpenCV's header", b"%YAML:1.0\n---\n" + BOMB.encode()
    yield "a command to run", b'a: !!python/object/apply:os.system ["touch stolen"]\n'
    yield "a zero byte", content[:60] + b"\0" + content[60:]
    if not text.startswith("%YAML"):
        yield "an unknown field", content + b"unknown: 1\n"
        for name in re.findall(r"^(\w+):", text, re.MULTILINE):
            for value in ("{unknown: [1]}", DIGITS, ".nan", "2001-01-01", "!!binary aGFsbG8="):
                yield f"{name} is {value[:20]}", _without_field(text, name).encode() + f"{name}: {value}\n".encode()
        return
    yield "half", content[: len(content) // 2]
    for name, pattern in (("rows", r"rows: \d+"), ("cols", r"cols: \d+"), ("dt", r"dt: \w+"), ("data", r"data: \[[^\]]*\]")):
        yield f"a matrix without {name}", re.sub(rf"\n\s*{pattern}", "", text, count=1).encode()
    numbers, list_of_numbers = r"[-\d.][-\d.e+]*", r"data: \[[^\]]*\]"
    for name, pattern, value in (
        ("dt: u", r"dt: \w+", "dt: u"), ("dt: nonsense", r"dt: \w+", "dt: nonsense"), ("dt: 9999d", r"dt: \w+", "dt: 9999d"),
        ("a billion rows", r"rows: \d+", "rows: 1000000000"), ("-1 columns", r"cols: \d+", "cols: -1"),
        ("no numbers", list_of_numbers, "data: [ ]"), ("words for numbers", list_of_numbers, "data: [ many, more ]"),
        ("NaN for all numbers", list_of_numbers, lambda found: re.sub(numbers, ".Nan", found[0])),
        ("1e308 for all numbers", list_of_numbers, lambda found: re.sub(numbers, "1e308", found[0])),
        ("a number of thousands of digits", list_of_numbers, lambda found: re.sub(numbers, DIGITS, found[0], count=1)),
    ):  # fmt: skip
        yield name, re.sub(pattern, value, text, count=1).encode()


def _without_field(text: str, name: str) -> str:
    return re.sub(rf"^{name}:.*\n(?:[ -].*\n)*", "", text, flags=re.MULTILINE)


def table_faults(content: bytes) -> Iterator[tuple[str, bytes]]:
    """A table without its header, with cells that are no numbers, with a row too short, with letters of another coding."""
    header, *rows = content.decode().splitlines()
    middle = len(rows) // 2
    cells = rows[middle].split(",")

    def with_row(row: str) -> bytes:
        return "\n".join([header, *rows[:middle], row, *rows[middle + 1 :], ""]).encode()

    yield "no header", "\n".join([*rows, ""]).encode()
    yield "only the header", f"{header}\n".encode()
    yield "a column renamed", content.replace(header.split(",")[0].encode(), b"unknown", 1)
    yield "half a row", with_row(",".join(cells[: max(len(cells) // 2, 1)]) if len(cells) > 1 else "")
    yield "other letters", content.decode().encode("utf-16")
    yield "one line of 50 MB", header.encode() + b"\n" + b"1" * 50_000_000
    last = len(cells) - 1
    for name, value, places in (  # a row without a pose may hold anything that is no finite number
        ("a word", "many", {0, last}), ("1e308", "1e308", {0, last}), ("ten thousand digits", DIGITS, {0, last}),
        ("a zero byte", "1\0", {0, last}), ("not a number", "nan", {0}), ("beyond all numbers", "1e999", {0}),
    ):  # fmt: skip
        for place in sorted(places):
            yield f"{name} in column {place}", with_row(",".join(value if k == place else cell for k, cell in enumerate(cells)))


def xml_faults(content: bytes) -> Iterator[tuple[str, bytes]]:
    """Entities of entities, files from elsewhere, fields that are no numbers."""
    bomb = "".join(f'<!ENTITY {b} "{f"&{a};" * 10}">' for a, b in zip("abcdefgh", "bcdefghi", strict=True))
    yield "half", content[: len(content) // 2]
    yield (
        "entities of entities",
        f'<!DOCTYPE x [<!ENTITY a "aaaaaaaaaa">{bomb}]><PlusConfiguration>&i;</PlusConfiguration>'.encode(),
    )
    stolen = '<!DOCTYPE x [<!ENTITY a SYSTEM "file:///etc/passwd">]><PlusConfiguration>&a;</PlusConfiguration>'
    yield "a file from elsewhere", stolen.encode()
    spacing = b"0.5 0.5 0.5"
    for value in (b"many", b"nan nan nan", b"-1 -1 -1", b"1e-9 1e-9 1e-9", DIGITS.encode()) if spacing in content else ():
        yield f"a spacing of {value[:20].decode()}", content.replace(spacing, value)
    yield "nested 100 000 deep", b"<PlusConfiguration>" + b"<a>" * 100_000
