"""Decimal numbers of all settings: endless ones and those beyond all reason are refused, wherever they stand."""

import math
import types
from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from importlib import import_module
from inspect import isclass
from pathlib import Path
from typing import Annotated, Any, Union, get_args, get_origin, get_type_hints

import pytest
from pydantic import BaseModel, ValidationError

from recon.capture.lag_files import LagFile
from recon.capture.manifest import Manifest
from recon.errors import one_line
from scenes import kinds
from sonotwin.cli import VERBS
from twin.experiments.experiment_runs import Settings
from twin.tracking.sampling_ranges import DataRanges
from twin.ultrasound.transducer import Transducer

SCENES = Path(kinds.__file__).parent
ODD = (math.inf, -math.inf, math.nan, 1e308, -1e308)


def unwrapped(kind: Any) -> Iterator[Any]:
    """Types that a type is made of: those of a union, a tuple, a list or a map."""
    origin = get_origin(kind)
    if origin is Annotated:
        yield from unwrapped(get_args(kind)[0])
    elif origin in (Union, types.UnionType):
        for one in get_args(kind):
            yield from unwrapped(one)
    else:
        yield kind


def valued(kind: Any, number: float) -> Any:
    """A value of a type that holds a number wherever there may be one; None of one that holds none."""
    for one in unwrapped(kind):
        origin, inner = get_origin(one), [each for each in get_args(one) if each is not ...]
        if one is float:
            return number
        if origin in (tuple, list) and inner:
            values = [valued(each, number) for each in inner]
            if None not in values:
                return values
        if origin is dict and (value := valued(inner[1], number)) is not None:
            return {"a": value}
        if is_dataclass(one) or (isclass(one) and issubclass(one, tuple) and hasattr(one, "_fields")):
            hints = get_type_hints(one, include_extras=True)
            names = [each.name for each in fields(one)] if is_dataclass(one) else one._fields
            held = {name: valued(hints[name], number) for name in names}
            if any(value is not None for value in held.values()):
                return {name: value for name, value in held.items() if value is not None}
    return None


def models(kind: Any, seen: set[type[BaseModel]]) -> Iterator[type[BaseModel]]:
    """All models that a type has within, each once."""
    for one in unwrapped(kind):
        if isclass(one) and issubclass(one, BaseModel):
            if one not in seen:
                seen.add(one)
                yield one
                for field in one.model_fields.values():
                    yield from models(field.annotation, seen)
        else:
            for each in get_args(one):
                yield from models(each, seen) if each is not ... else ()


def every_model() -> list[type[BaseModel]]:
    seen: set[type[BaseModel]] = set()
    roots = [import_module(verb.module).Config for verb in VERBS if verb.name not in ("train", "dataset")]
    roots += [Manifest, LagFile, Settings, Transducer, DataRanges, *KINDS_OF_SCENES]
    return [model for root in roots for model in models(root, seen)]


KINDS_OF_SCENES = [import_module(f"scenes.kinds.{path.stem}").Config for path in sorted(SCENES.glob("[a-z]*.py"))]
FIELDS = [
    (model, name)
    for model in every_model()
    for name, field in model.model_fields.items()
    if valued(field.annotation, 1.0) is not None
]


def complaint(model: type[BaseModel], name: str, value: Any) -> str | None:
    """What is said of one field's value; other fields are left out, which is said, too."""
    try:
        model.model_validate({model.model_fields[name].alias or name: value})
    except ValidationError as error:
        mine = [each for each in error.errors() if each["loc"][:1] == (name,)]
        return one_line(error) if mine else None
    return None


@pytest.mark.parametrize(("model", "name"), FIELDS, ids=[f"{model.__module__}.{model.__name__}.{name}" for model, name in FIELDS])
def test_endless_numbers_and_those_beyond_all_reason_are_refused(model, name):
    annotation = model.model_fields[name].annotation
    for number in ODD:
        assert complaint(model, name, valued(annotation, number)) is not None, number


def test_fields_of_all_verbs_are_among_them():
    names = {f"{model.__module__}.{name}" for model, name in FIELDS}
    assert {"recon.model.rig.focal_length_mm", "recon.model.rig.f_number"} <= names and len(names) > 150
