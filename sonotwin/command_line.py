"""Command lines that are printed from settings: the fields of a verb that differ from its defaults, choices of groups by name."""

import re
from collections.abc import Iterator, Mapping
from typing import Annotated, Any

from pydantic import BaseModel, TypeAdapter

from recon.files import yaml_text
from sonotwin import config

ABSENT = object()


def words(verb: str, settings: BaseModel) -> list[str]:
    """The words after `sonotwin` that give a verb these settings: `load` makes the same of them."""
    return [verb, *fields(verb, settings)]


def fields(verb: str, settings: BaseModel) -> list[str]:
    """Overrides of a verb's defaults, those of groups first, then what needs a value.

    Of a group this is the choice that is nearest, and what differs from it.
    """
    groups, usual, found = config.groups(verb), config.defaults(verb), list[str]()
    known_fields: dict[str, Any] = type(settings).model_fields
    types = {name: TypeAdapter(Annotated[field.annotation, field]) for name, field in known_fields.items()}
    values = settings.model_dump(mode="json")
    for name in sorted(values, key=lambda name: 0 if name in groups else 1 if usual.get(name) == config.NEEDED else 2):
        known = usual.get(name, ABSENT)
        default = known_fields[name].get_default(call_default_factory=True) if known is ABSENT else known
        if name not in groups or values[name] == _parsed(types[name], known):
            found += _differences(name, values[name], _parsed(types[name], default), known)
            continue
        choices = {one: yaml_text.read(config.folder() / name / f"{one}.yaml") for one in groups[name]}
        written = {one: content.get(name, content) for one, content in choices.items()}  # "none" has a null
        parsed = {one: _parsed(types[name], content) for one, content in written.items()}
        apart = {one: list(_differences(name, values[name], parsed[one], written[one])) for one in choices}
        nearest = min(apart, key=lambda one: (len(" ".join(apart[one])), one))
        found += [*([] if parsed[nearest] == _parsed(types[name], known) else [f"{name}={nearest}"]), *apart[nearest]]
    return found


def _parsed(kind: TypeAdapter, value: Any) -> Any:
    """A value of YAML as the settings hold it, in JSON's kinds; as it stands where it is none of its field."""
    try:
        return kind.dump_python(kind.validate_python(value), mode="json")
    except ValueError:
        return value


def _differences(name: str, value: Any, default: Any, written: Any) -> Iterator[str]:
    """Overrides, leaf by leaf, that make the value of its default; `+` where YAML leaves that to the model."""
    if value == default:
        return
    if not (isinstance(value, Mapping) and isinstance(default, Mapping)):
        yield f"{'+' if written is ABSENT else ''}{name}={_text(value)}"
        return
    inner = written if isinstance(written, Mapping) else {}
    for key in value:
        yield from _differences(f"{name}.{key}", value[key], default.get(key, ABSENT), inner.get(key, ABSENT))
    yield from (f"~{name}.{key}" for key in inner if key not in value)


def _text(value: Any) -> str:
    """A value in Hydra's grammar, which reads it as the same again."""
    match value:
        case None:
            return "null"
        case bool():
            return str(value).lower()
        case int() | float():
            return repr(value)
        case Mapping():
            return "{" + ",".join(f"{key}:{_text(one)}" for key, one in value.items()) + "}"
        case list() | tuple():
            return "[" + ",".join(map(_text, value)) + "]"
        case _:
            plain = re.fullmatch(r"[\w./@%-][\w./@%: -]*(?<! )", str(value)) and config.reads_as_text(str(value))
            return str(value) if plain else "'" + config.escape(str(value)) + "'"
