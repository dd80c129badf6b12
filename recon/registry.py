"""Find what can be added by name: a kind is a module of a package, and its file's name is the kind's.

What the package asks of a kind stands in its docstring: the same few functions for all. A kind of one's own may lie in any folder
that is a part of the package's `__path__`. Packages are named, not imported, so that a lower room can look a kind up.
"""

from dataclasses import dataclass
from importlib import import_module
from pkgutil import iter_modules
from typing import Any

from pydantic_core import PydanticKnownError


@dataclass(frozen=True)
class Choice:
    """Marks a field of settings that is chosen by name from a group of `conf/`: the usual choice in it, None for none."""

    name: str | None


def names(package: str) -> list[str]:
    """Names of all kinds in a package, in alphabetical order."""
    return sorted(module.name for module in iter_modules(import_module(package).__path__) if not module.ispkg)


def kind(package: str, name: str) -> Any:
    """The module of a kind that is there."""
    return import_module(f"{package}.{name}")


def kinds(package: str) -> dict[str, Any]:
    """All kinds of a package by name."""
    return {name: kind(package, name) for name in names(package)}


def known(package: str, name: Any) -> str:
    """The name of a kind that is there, for a field of pydantic's."""
    return one_of(name, names(package))


def one_of(name: Any, there: list[str]) -> str:
    """The name, if it is one of several; else the refusal of pydantic's literals."""
    if name not in there:
        *others, last = map(repr, there)
        raise PydanticKnownError("literal_error", {"expected": f"{', '.join(others)} or {last}" if others else last})
    return name
