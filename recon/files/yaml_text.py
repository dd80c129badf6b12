"""YAML of any origin: plain values of bounded size and depth, or refused in one line.

An alias stands for a whole value, so a few hundred bytes may stand for more values than any memory holds, or for endless ones.
Therefore values are counted as if each alias were written out, before any is made.
"""

from collections.abc import Callable, Hashable
from pathlib import Path
from typing import Any, TypeVar

import yaml
from yaml.events import AliasEvent, CollectionEndEvent, CollectionStartEvent, ScalarEvent

from recon.errors import InputError
from recon.files.regular import read_text, shown

MOST_BYTES = 1 << 22
MOST_VALUES = 100_000  # with those for which aliases stand
MOST_DEPTH = 64  # of lists and maps within each other
MOST_DIGITS = 40  # of a whole number
PLAIN = ("null", "bool", "int", "float", "str", "seq", "map", "merge")
SOURCE = ' in "<unicode string>"'  # as PyYAML names a text in its messages
FAULTS = (yaml.YAMLError, ValueError, LookupError, TypeError, AttributeError, RecursionError)  # of tags that don't fit, too
PREFIX = "tag:yaml.org,2002:"

Result = TypeVar("Result")
Base: type[yaml.SafeLoader] = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


class PlainLoader(Base):
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
                raise yaml.constructor.ConstructorError(None, None, f"the key {place[1][:60]!r} twice", key.start_mark)
            seen.add(place)
        return super().construct_mapping(node, deep)


PlainLoader.yaml_implicit_resolvers = {
    letter: [(tag, pattern) for tag, pattern in rules if tag.removeprefix(PREFIX) in PLAIN]
    for letter, rules in Base.yaml_implicit_resolvers.items()
}
PlainLoader.yaml_constructors = {
    tag: make
    for tag, make in Base.yaml_constructors.items()
    if tag is None or tag.removeprefix(PREFIX) in PLAIN  # all others are refused by that of None
}
PlainLoader.add_constructor(f"{PREFIX}int", PlainLoader.construct_yaml_int)


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
    return _understood(path, lambda: yaml.load(text, Loader=PlainLoader) if _checked(path, text) else None)


def composed(path: Path, text: str) -> list[yaml.Node]:
    """Nodes of the documents of a YAML text, with tags and values as they are written; raises InputError as `read` does."""
    return _understood(path, lambda: list(yaml.compose_all(text, Loader=PlainLoader)) if _checked(path, text) else [])


def _understood(path: Path, load: Callable[[], Result]) -> Result:
    try:
        return load()
    except InputError:
        raise
    except FAULTS as error:
        text = " ".join(str(error).replace(SOURCE, "").split())
        raise InputError(f"{shown(path)}: expected YAML, found {text[:300]}") from None


def _checked(path: Path, text: str) -> bool:
    """True of a text whose values are few enough, and not too deeply nested; raises InputError else.

    The parser's events come one by one, and no value is made of them.
    """
    sizes: dict[str, int | None] = {}  # values below an anchor; None while it is open
    open_ones: list[tuple[str | None, int]] = []  # anchor, and values before it
    values = 0
    for event in yaml.parse(text, Loader=PlainLoader):
        if isinstance(event, AliasEvent):
            size = sizes.get(event.anchor, 1)
            if size is None:
                raise InputError(f"{shown(path)}: expected YAML, found a value that holds itself, *{event.anchor}")
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
        if len(open_ones) > MOST_DEPTH:
            raise InputError(f"{shown(path)}: expected YAML, found values nested too deeply")
        if values > MOST_VALUES:
            raise InputError(f"{shown(path)}: expected YAML of up to {MOST_VALUES} values, found more, written out or as aliases")
    return True
