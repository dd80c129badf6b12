"""Defaults of verbs stand once, in their `Config`; those of choices stand in the files of conf/ and in the models: the same."""

from collections.abc import Iterator
from importlib import import_module

import pytest
import yaml
from pydantic import BaseModel, TypeAdapter
from pydantic_core import PydanticUndefined

from scenes.board_poses import Config as BoardPoses
from scenes.catalogue import parse_scene
from sonotwin import config
from sonotwin.cli import VERBS
from sonotwin.config import compose, folder
from twin.experiments import identify_trial
from twin.experiments.experiment_runs import Settings
from twin.optics.light_transport import Tracing
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
    own, texts = [name for name in model.__annotations__ if name in model.model_fields], config.described(model)
    marks = [mark for name in own for mark in (texts.get(name), config._choice(model.model_fields[name])) if mark]
    assert not marks, "texts and choices stand in YAML or in the model, not in both"


def described(model: type[BaseModel], place: str) -> Iterator[str]:
    """Fields without a text, of a model and of those within that stand in the verb's help."""
    texts = config.described(model)
    for name, field in model.model_fields.items():
        if not texts.get(name):
            yield f"{place}.{name}"
        if not any(isinstance(mark, config.Choice) for mark in field.metadata):
            inner = [one for one in config._plain_types(field.annotation) if config._is_model(one)]
            yield from described(inner[0], f"{place}.{name}") if len(inner) == 1 else ()


@pytest.mark.parametrize("verb", sorted(set(VERBS) - set(WITH_YAML), key=VERBS.index), ids=lambda verb: verb.name)
def test_each_field_says_its_unit_and_reason(verb):
    """In the model alone, from which help and defaults are made; what a verb needs comes first."""
    model = import_module(verb.module).Config
    assert list(described(model, verb.name)) == []
    text, start = config.shown(verb.name), config.primary(verb.name)
    shown = yaml.safe_load(text) or {}
    assert {name: value for name, value in shown.items() if name != "defaults"} == {
        name: value for name, value in start.items() if name != "defaults"
    }
    assert shown.get("defaults", []) == start.get("defaults", ["_self_"])[:-1]


CHOICES = [
    *[
        ("scene", path.stem, lambda content: parse_scene(content)[1])
        for path in sorted((folder() / "scene").glob("*.yaml"))
        if yaml.safe_load(path.read_text(encoding="utf-8"))["kind"] == path.stem  # others are another choice of a kind
    ],
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


TARGETS = "filament_depths_mm row_x_mm cysts bright dark"  # of a test object
OF_PATIENTS = (
    "aperture_mm aperture_rays bandwidth dynamic_range_db face_ring_db face_ring_mm gain_db noise_db picture receive_f_number "
    "scatterers_per_mm3 tgc_db_per_cm_mhz transmit_f_number transmit_focus_mm"
)
OF_CURVED_ARRAYS = (
    "aperture_mm bandwidth elevation_focus_mm elevation_mm face_ring_mm frequency_mhz image_size noise_db receive_f_number "
    "reverberations scale_mm_per_px scatterers_per_mm3 tgc_limit_db transmit_f_number transmit_focus_mm"
)
OTHERS = {
    ("scene", "gelatin"): f"size_mm {TARGETS}",
    ("ultrasound", "water"): "gain_db tgc_db_per_cm_mhz",
    ("ultrasound", "bright"): OF_PATIENTS,
    ("ultrasound", "clinic"): f"{OF_PATIENTS} tgc_limit_db",
    ("ultrasound", "curved"): OF_CURVED_ARRAYS,
}


@pytest.mark.parametrize(("group", "name"), OTHERS, ids="=".join)
def test_another_choice_differs_from_the_defaults_only_where_it_is_to(group, name):
    """What it repeats of the model's defaults follows them."""
    content = yaml.safe_load((folder() / group / f"{name}.yaml").read_text(encoding="utf-8"))
    made = Transducer.model_validate(content) if group == "ultrasound" else parse_scene(content)[1]
    found = {line.partition(":")[0].removeprefix(f"{name}.") for line in differences(made, name)}
    assert found == set(OTHERS[group, name].split())


def test_all_scanners_are_held_against_the_defaults():
    there = {path.stem for path in (folder() / "ultrasound").glob("*.yaml")}
    assert there == {"linear"} | {name for group, name in OTHERS if group == "ultrasound"}


def test_the_phantom_of_the_trials_is_that_of_conf():
    """Of `study name=identify`, by which a laboratory tries the same with `scene=gelatin`."""
    gelatin = yaml.safe_load((folder() / "scene" / "gelatin.yaml").read_text(encoding="utf-8"))
    assert parse_scene(identify_trial.PHANTOM) == parse_scene(gelatin)
