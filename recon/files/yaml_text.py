"""YAML of any origin: plain values of bounded size and depth, or refused in one line.

An alias stands for a whole value, so a few hundred bytes may stand for more values than any memory holds, or for endless ones.
Therefore values are counted as if each alias were written out, before any is made.
"""

from collections import deque
from collections.abc import Hashable, Iterator
from pathlib import Path
from typing import Any

import yaml
from yaml.events import AliasEvent, CollectionEndEvent, CollectionStartEvent, DocumentStartEvent, ScalarEvent

from recon.errors import InputError, brief, reason, short
from recon.files.regular import read_text, shown

MOST_BYTES = 1 << 22
MOST_VALUES = 100_000  # with those for which aliases stand
MOST_DIGITS = 40  # of a whole number
PLAIN = ("null", "bool", "int", "float", "str", "seq", "map", "merge")
FAULTS = (yaml.YAMLError, ValueError, LookupError, TypeError, AttributeError, RecursionError)  # of tags that don't fit, too
PREFIX = "tag:yaml.org,2002:"

Base: type[yaml.SafeLoader] = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


class _PlainLoader(Base):
    """Loader of null, true and false, numbers, texts, lists and maps: a date is a text, and keys of a map are different."""

    def construct_yaml_int(self, node: yaml.ScalarNode) -> int:
        """A whole number of a bounded number of digits."""
        if len(node.value) > MOST_DIGITS:
            raise yaml.constructor.ConstructorError(None, None, f"a number of {len(node.value)} digits", node.start_mark)
        return super().construct_yaml_int(node)

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Hashable, Any]:
        """A map of different keys; those that it merges from others may come again."""
        seen = set()
        for key, _ in node.value:
            if key.tag == PREFIX + "merge" or not isinstance(key, yaml.ScalarNode):
                continue
            place = key.tag, key.value
            if place in seen:
                raise yaml.constructor.ConstructorError(None, None, f"the key {brief(place[1])} twice", key.start_mark)
            seen.add(place)
        return super().construct_mapping(node, deep)


_PlainLoader.yaml_implicit_resolvers = {
    letter: [(tag, pattern) for tag, pattern in rules if tag.removeprefix(PREFIX) in PLAIN]
    for letter, rules in Base.yaml_implicit_resolvers.items()
}
_PlainLoader.yaml_constructors = {
    tag: make
    for tag, make in Base.yaml_constructors.items()
    if tag is None or tag.removeprefix(PREFIX) in PLAIN  # all others are refused by that of None
}
_PlainLoader.add_constructor(f"{PREFIX}int", _PlainLoader.construct_yaml_int)


def read(path: Path, expected: str = "a file") -> Any:
    """Values of a YAML file.

    Raises
    ------
    InputError
        If the file is missing, no regular one or no YAML; has keys twice or values of other kinds; or holds, with aliases written
        out, more values than any settings.
    """
    return loaded(path, read_text(path, MOST_BYTES, expected))


def loaded(path: Path, text: str) -> Any:
    """Values of a YAML text that stood in a file; raises InputError as `read` does."""
    deque(events(path, text, MOST_VALUES), maxlen=0)
    try:
        return yaml.load(text, Loader=_PlainLoader)
    except FAULTS as error:
        raise _fault(path, error) from None


def events(path: Path, text: str, most: int) -> Iterator[yaml.Event]:
    """Events of the parser, one by one, of a text whose values are not too deeply nested, and not more than a number.

    No value is made of them. Raises InputError as `read` does.
    """
    sizes: dict[str, int | None] = {}  # values below an anchor; None while it is open
    open_ones: list[tuple[str | None, int]] = []  # anchor, and values before it
    values = 0
    most_depth = 64  # of lists and maps within each other
    for event in _parsed(path, text):
        if isinstance(event, AliasEvent):
            size = sizes.get(event.anchor, 0)
            if not size:
                found = "a value that holds itself" if size is None else "the name of no value"
                raise InputError(f"{shown(path)}: expected YAML, found {found}, *{short(event.anchor)}")
            values += size
        elif isinstance(event, ScalarEvent):
            values += 1
            if "\0" in event.value:
                raise InputError(f"{shown(path)}: expected YAML, found a text with a zero in it")
            if event.anchor is not None:
                sizes[event.anchor] = 1
        elif isinstance(event, CollectionStartEvent):
            open_ones.append((event.anchor, values))
            values += 1
            if event.anchor is not None:
                sizes[event.anchor] = None
        elif isinstance(event, CollectionEndEvent):
            anchor, before = open_ones.pop()
            if anchor is not None:
                sizes[anchor] = values - before
        elif isinstance(event, DocumentStartEvent):
            sizes.clear()
        if len(open_ones) > most_depth:
            raise InputError(f"{shown(path)}: expected YAML, found values nested too deeply")
        if values > most:
            raise InputError(f"{shown(path)}: expected YAML of up to {most} values, found more, written out or as aliases")
        yield event


def _parsed(path: Path, text: str) -> Iterator[yaml.Event]:
    try:
        yield from yaml.parse(text, Loader=_PlainLoader)
    except FAULTS as error:
        raise _fault(path, error) from None


def _fault(path: Path, error: Exception) -> InputError:
    """A parser's complaint, with its place in the text."""
    mark, problem = getattr(error, "problem_mark", None), getattr(error, "problem", None)
    found = reason(error) if problem is None else short(problem)
    place = "" if problem is None or mark is None else f" in line {mark.line + 1}, column {mark.column + 1}"
    return InputError(f"{shown(path)}: expected YAML, found {found}{place}")
