"""Defaults stand in the YAML files of conf/, where a person reads them, and in the models, which Python callers use: the same."""

from importlib import import_module

import pytest
import yaml
from pydantic import BaseModel, TypeAdapter
from pydantic_core import PydanticUndefined

from scenes.board_poses import Config as BoardPoses
from scenes.catalogue import parse_scene
from sonotwin.cli import VERBS
from sonotwin.config import compose, folder
from twin.optics.light_transport import Tracing
from twin.studies.experiments import Settings
from twin.ultrasound.sweep_session import AnyPath
from twin.ultrasound.transducer import Transducer

WITH_YAML = [verb for verb in VERBS if (folder() / f"{verb.name}.yaml").is_file()]
TAKEN = {f"study.{name}" for name in ("title", "of", "over", "seeds", "beside")}  # null in YAML: as the named study has it
CHOSEN = {"default.room_lux"}  # the model leaves the room dark; on a bench it is not


def differences(given: BaseModel, place: str) -> list[str]:
    """Fields, and those of models within, whose value isn't the model's default; fields without a default have none."""
    found = []
    for name, field in type(given).model_fields.items():
        value, default = getattr(given, name), field.get_default(call_default_factory=True)
        if default is PydanticUndefined:
            found += differences(value, f"{place}.{name}") if isinstance(value, BaseModel) else []
        elif value != default and f"{place}.{name}" not in CHOSEN:
            found.append(f"{place}.{name}: {value} in YAML, {default} in the model")
    return found


@pytest.mark.parametrize("verb", WITH_YAML, ids=lambda verb: verb.name)
def test_a_verbs_defaults_are_its_models(verb):
    content = yaml.safe_load((folder() / f"{verb.name}.yaml").read_text(encoding="utf-8"))
    model = import_module(verb.module).Config
    missing = [f"{name}=x" for name, value in content.items() if value == "???"]
    inner = [(name, value) for name, value in content.items() if isinstance(value, dict)]
    missing += [f"{name}.{field}=x" for name, fields in inner for field, value in fields.items() if value == "???"]
    written = {name for name, value in content.items() if name != "defaults" and value != "???"}
    composed = compose(verb.name, missing)
    found = []
    taken = {field.partition(".")[2] for field in TAKEN if field.startswith(f"{verb.name}.")}
    for name in written & set(model.model_fields) - taken:
        field = model.model_fields[name]
        default = field.get_default(call_default_factory=True)
        if default is PydanticUndefined:
            continue
        value = TypeAdapter(field.annotation).validate_python(composed[name])
        if value != default:
            found.append(f"{name}: {value} in YAML, {default} in the model")
    known = set(model.model_fields) | set(Settings.model_fields if verb.name == "study" else ())
    assert written <= known
    assert not found


CHOICES = [
    *[("scene", path.stem, lambda content: parse_scene(content)[1]) for path in sorted((folder() / "scene").glob("*.yaml"))],
    *[("path", name, lambda content: TypeAdapter(AnyPath).validate_python(content)) for name in ("bob", "stroke", "wire")],
    ("tracing", "default", Tracing.model_validate),
    ("poses", "paper", BoardPoses.model_validate),
    ("ultrasound", "linear", Transducer.model_validate),
]


@pytest.mark.parametrize(("group", "name", "parse"), CHOICES, ids=[f"{group}={name}" for group, name, _ in CHOICES])
def test_a_choices_fields_are_its_models_defaults(group, name, parse):
    """Of each kind of scene and path, and of the usual choice of the other groups."""
    content = yaml.safe_load((folder() / group / f"{name}.yaml").read_text(encoding="utf-8"))
    assert differences(parse(content), name) == []
