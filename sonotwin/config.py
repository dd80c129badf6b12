"""From defaults, YAML files and overrides on the command line to a verb's validated `Config`.

A verb's fields, defaults, bounds and texts stand once, in its `Config`, from where Hydra's ConfigStore gets them; each folder
of `conf/` is a group of choices. Hydra composes both; pydantic validates what comes out; the mistakes that either finds become
one line each.
"""

import ast
import inspect
import pickle
import re
import shutil
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import nullcontext
from functools import cache, lru_cache
from importlib import import_module
from importlib.util import find_spec
from itertools import pairwise
from pathlib import Path
from secrets import token_hex
from tempfile import TemporaryDirectory
from textwrap import dedent, wrap
from types import MappingProxyType, UnionType
from typing import Annotated, Any, Literal, TypeGuard, TypeVar, Union, get_args, get_origin

from pydantic import BaseModel, ValidationError
from pydantic.fields import FieldInfo
from pydantic_core import to_jsonable_python

from recon.errors import InputError, brief, did_you_mean, one_line, short
from recon.files import yaml_text
from recon.model.part import Kinds
from recon.model.rig import without_measures
from recon.registry import Choice

OF_SOME_VERBS = {  # choices of a group that only these verbs take
    "devices/virtual": ("record",),
    **dict.fromkeys(("path/hand", "path/pivot"), ("film",)),
    **dict.fromkeys(
        ("path/bob", "path/hold", "path/none", "path/raster", "path/rows", "path/stroke", "path/tilts", "path/wire"),
        ("demo", "record", "sweep"),
    ),
}
NEEDED = "???"  # Hydra's mark of a field that needs a value
BESIDE, WIDTH = 26, 100  # columns before the descriptions of fields in a verb's help, and of these
MOST_NAMES = 12  # of keys in a message
MOST_DIGITS = 1000  # of a number; Hydra's parser can't take more than Python's own limit of some thousands
Model = TypeVar("Model", bound=BaseModel)


def folder() -> Path:
    """Find the folder of YAML files: inside the package in a wheel, beside it in a clone."""
    package = Path(__file__).resolve().parent
    inside = package / "conf"
    return inside if inside.is_dir() else package.parent / "conf"


def primary(verb: str) -> dict[str, Any]:
    """What a verb starts from: its fields' defaults, ??? where a value is needed, and the list of its choices, as Hydra has them.

    They are those of the verb's `Config`, or stand in conf/VERB.yaml; of a verb that has neither there are none.
    """
    path = folder() / f"{verb}.yaml"
    return _parsed(path.read_text(encoding="utf-8")) if path.is_file() else _primary(verb)


@cache
def _parsed(text: str) -> dict[str, Any]:
    """Fields of a YAML text of `conf`, parsed once, though each override asks for them; not to be changed."""
    import yaml

    return yaml.load(text, Loader=getattr(yaml, "CSafeLoader", yaml.SafeLoader)) or {}


@cache
def _primary(verb: str) -> dict[str, Any]:
    """What a verb starts from, by its `Config`; not to be changed."""
    model = fields_of(verb)
    if model is None:
        return {}
    choices = [{name: choice.name} for name, field in model.model_fields.items() if (choice := _choice(field)) is not None]
    values = {name: _plain(field) for name, field in model.model_fields.items() if _choice(field) is None}
    return ({"defaults": [*choices, "_self_"]} if choices else {}) | values


def fields_of(verb: str) -> type[BaseModel] | None:
    """The verb's `Config`, None of what is no verb."""
    name = f"sonotwin.verbs.{verb.replace('-', '_')}"
    return import_module(name).Config if find_spec(name) is not None else None


def shown(verb: str) -> str:
    """A verb's fields in YAML with their units and reasons, as its help shows them: what needs a value first."""
    path = folder() / f"{verb}.yaml"
    if path.is_file():
        return "\n".join(line for line in path.read_text(encoding="utf-8").splitlines() if line != f"# {path.name}")
    model = fields_of(verb)
    return "" if model is None else "\n".join(_shown(model, {}, ""))


def _shown(model: type[BaseModel], values: Mapping[str, Any], before: str) -> Iterator[str]:
    """Lines of a model's fields, by their values where they differ from its own defaults."""
    fields, texts = model.model_fields, described(model)
    choices = {name: choice for name, field in fields.items() if (choice := _choice(field)) is not None}
    if choices:
        yield "defaults:"
        yield from (_beside(f"  - {name}: {choice.name or 'null'}", texts.get(name)) for name, choice in choices.items())
    plain = {name: values.get(name, _plain(field)) for name, field in fields.items() if name not in choices}
    for name in sorted(plain, key=lambda name: plain[name] != NEEDED):
        value, inner = plain[name], [one for one in _plain_types(fields[name].annotation) if _is_model(one)]
        if isinstance(value, dict) and len(inner) == 1 and value:
            yield _beside(f"{before}{name}:", texts.get(name))
            yield from _shown(inner[0], value, f"{before}  ")
            continue
        if isinstance(value, dict) and len(_flow(value)) > WIDTH:
            yield _beside(f"{before}{name}:", texts.get(name))
            yield from (f"{before}  {key}: {_flow(each)}" for key, each in value.items())
        else:
            yield _beside(f"{before}{name}: {_flow(value)}", texts.get(name))


def described(model: type[BaseModel]) -> dict[str, str]:
    """Texts of a model's fields: the strings below them, which are read for help alone, as that takes a while."""
    texts = dict[str, str]()
    for each in reversed(model.__mro__):
        if issubclass(each, BaseModel) and each is not BaseModel:
            (made,) = ast.parse(dedent(inspect.getsource(each))).body
            assert isinstance(made, ast.ClassDef)
            for field, below in pairwise(made.body):
                if isinstance(field, ast.AnnAssign) and isinstance(below, ast.Expr) and isinstance(below.value, ast.Constant):
                    texts[ast.unparse(field.target)] = inspect.cleandoc(str(below.value.value))
    return texts


def _flow(value: Any) -> str:
    """A value in one line of YAML."""
    import yaml

    if value in ("", NEEDED):
        return value or '""'
    return yaml.safe_dump(value, default_flow_style=True, sort_keys=False, width=10_000).removesuffix("...\n").strip()


def _beside(field: str, text: str | None) -> str:
    """A field with its description beside it, broken into lines."""
    if not text:
        return field
    lines = wrap(" ".join(text.split()), WIDTH)
    first, *others = lines if len(field) < BESIDE else ["", *lines]
    return "\n".join([f"{field:{BESIDE}}# {first}".rstrip(" #"), *(f"{'':{BESIDE}}# {line}" for line in others)])


def _choice(field: FieldInfo) -> Choice | None:
    return next((one for one in field.metadata if isinstance(one, Choice)), None)


def _plain(field: FieldInfo) -> Any:
    """A field's default in plain values; of a model that needs some values, its own fields'."""
    if not field.is_required():
        return to_jsonable_python(field.get_default(call_default_factory=True))
    if _is_model(field.annotation):
        return {name: _plain(inner) for name, inner in field.annotation.model_fields.items()}
    return NEEDED


def groups(verb: str) -> dict[str, list[str]]:
    """Name the choices of each group that the verb's defaults list uses and that it takes, such as `{"rig": ["meza2021"]}`."""
    entries = [key for entry in primary(verb).get("defaults", []) if isinstance(entry, dict) for key in entry]
    names = [re.sub(r"^(override |optional )*/?|@.*$", "", entry) for entry in entries]
    found = {name: sorted(choice.stem for choice in (folder() / name).glob("*.yaml")) for name in names}
    return {name: [one for one in given if verb in OF_SOME_VERBS.get(f"{name}/{one}", (verb,))] for name, given in found.items()}


def load(verb: str, overrides: Sequence[str], model: type[Model]) -> Model:
    """Compose a verb's configuration and validate it.

    Parameters
    ----------
    verb : str
        Names the fields that are composed; without any it starts from none.
    overrides : sequence of str
        Hydra's `field=value`, `group=choice`, `+new=value`, `~field`. A choice is a name in `conf/GROUP`, or the path of a YAML
        file of one's own with the same fields. A value that isn't in Hydra's grammar, such as a path
        with a comma, a bracket or an accent, is taken as it stands; quotes force text: `out='"12"'`.
    model : type
        The verb's pydantic model.

    Raises
    ------
    InputError
        One line that names the verb, the field, what was expected and what was found.
    """
    composed = compose(verb, overrides, model)
    _leave_measured(composed.get("rig"), overrides)
    try:
        return model.model_validate(composed, context={"overrides": overrides})
    except ValidationError as error:
        text = describe(error, model, composed)
        raise InputError(f"{_source(verb, overrides, text.partition(':')[0])}: {text}") from error


def _leave_measured(rig: Any, overrides: Sequence[str]) -> None:
    """Leave out of a rig's measured numbers, in place, those that are given by hand."""
    names = [override.lstrip("+~").partition("=")[0] for override in overrides]
    parts = [name.removeprefix("rig.") for name in names if name.startswith("rig.")]
    if isinstance(rig, dict) and rig.get("measured"):
        rig |= without_measures(rig, parts)


def _source(verb: str, overrides: Sequence[str], field: str) -> str:
    """Where a field's value came from: the file of a choice of one's own, or else the verb's fields."""
    group, keys = field.partition(".")[0], [override.lstrip("+~").partition("=")[0] for override in overrides]
    if any("." in key and (f"{field}.".startswith(f"{key}.") or key.startswith(f"{field}.")) for key in keys):
        return verb
    files = {key.rpartition("@")[2]: path for key, path in filter(None, (_own_choice(verb, each) for each in overrides))}
    return str(files.get(group, verb))


def compose(verb: str, overrides: Sequence[str], model: type[BaseModel] | None = None) -> dict[str, Any]:
    """Compose a verb's fields with the overrides into a plain, resolved dictionary; raises InputError as `load` does.

    The model, where one is given, has the maps that take any names, and things of several kinds, of which another may be given.
    """
    from hydra.errors import ConfigCompositionException, MissingConfigException
    from omegaconf import MissingMandatoryValue, OmegaConf
    from omegaconf.errors import OmegaConfBaseException

    name, known_groups, no_choices = verb if primary(verb) else None, groups(verb), _fields_named_like_groups(verb)
    plain = [override for override in overrides if override.partition("=")[0] in no_choices]
    files = {k: file for k, override in enumerate(overrides) if (file := _own_choice(verb, override)) is not None}
    with TemporaryDirectory() if files else nullcontext("") as own:
        named = [_named(Path(own), k, files[k]) if k in files else override for k, override in enumerate(overrides)]
        quoted = [_literal_if_not_grammar(verb, override) for override in named if override not in plain]
        quoted = [override for override in quoted if not _is_usual_null(verb, override, quoted)]
        for override in quoted:
            _check_choice(verb, override)
        chosen = [override for override in quoted if _group(override) in known_groups]
        if files:
            chosen.append(_searched(own))
            quoted.append(_searched(own))

        def known() -> Any:
            """The choices without any field that is given: what may stand there."""
            return OmegaConf.to_container(_composed(name, chosen)) if name else {}

        given = {key: value for key, _, value in (override.partition("=") for override in quoted)}
        try:
            composed = _composed(name, [part for override in quoted for part in _fitted(override, model, known, given)])
            for override in plain:
                field, _, value = override.partition("=")
                OmegaConf.update(composed, field, _plain_value(verb, field, value))
            result = OmegaConf.to_container(composed, resolve=True, throw_on_missing=True)
        except MissingConfigException as error:
            missing = str(error.missing_cfg_file)
            sources = [path for key, path in files.values() if missing.startswith(f"{_group(key)}/")]
            given = any(missing == f"{_group(override)}/{override.partition('=')[2]}" for override in quoted)
            place = sources[0] if sources and not given else verb
            raise InputError(f"{place}: {_missing_choice(verb, missing)}") from error
        except ConfigCompositionException as error:
            other = re.match(r"Error merging override ([^=]+)=(.*)", str(error))
            if other is not None:
                raise InputError(f"{verb}: {other[1]}: expected a value of its default's kind, found {other[2]}") from error
            unknown = re.search(r"Could not override '([^']+)'", str(error))
            if unknown is None:
                raise InputError(f"{verb}: {_first_line(error)}") from error
            chosen[:] = [override for override in chosen if override.partition("=")[0] != unknown[1]]  # such as rig@other
            inner = re.search(r"Key '([^']+)' is not in struct", str(error.__cause__))
            within = inner is not None and isinstance(_below(known(), unknown[1].split(".")), Mapping)
            key = f"{unknown[1]}.{inner[1]}" if inner is not None and within else unknown[1]
            tree, above = known(), key.split(".")[:-1]
            if model is not None and isinstance(there := _below(tree, above), dict):
                there |= dict.fromkeys(_of_kind(above, model, given))
            raise InputError(f"{verb}: {key}: {_unknown_key(key, tree)}") from error
        except MissingMandatoryValue as error:
            raise InputError(f"{verb}: {error.full_key}: needs a value; give {error.full_key}=...") from error
        except OmegaConfBaseException as error:
            raise InputError(f"{verb}: {error.full_key}: {_first_line(error)}") from error
    assert isinstance(result, dict)
    return {str(key): value for key, value in result.items()}


def defaults(verb: str, overrides: Sequence[str] = ()) -> dict[str, Any]:
    """The fields of a verb as they are without overrides, or with those of a file; `???` where one needs a value."""
    from omegaconf import OmegaConf

    found = OmegaConf.to_container(_composed(verb, overrides), resolve=True)
    assert isinstance(found, dict)
    return {str(key): value for key, value in found.items()}


def _composed(name: str | None, overrides: Sequence[str]) -> Any:
    """Compose a verb's fields with overrides, as Hydra does, which takes most of its time for the choices.

    Their composition is kept as long as no file of `conf` changes, and fields are put into a copy of it. Overrides of another
    kind, and those that don't fit, go to Hydra itself.
    """
    from hydra.core.override_parser.overrides_parser import OverridesParser
    from hydra.errors import HydraException
    from omegaconf import OmegaConf
    from omegaconf.errors import OmegaConfBaseException

    keys = [override.partition("=")[0] for override in overrides]
    if not all(re.fullmatch(r"(?!hydra\b)\w+(\.\w+)*", key) for key in keys):
        return _by_hydra(name, overrides)
    choices = tuple(override for key, override in zip(keys, overrides, strict=True) if (folder() / key).is_dir())
    files = ((path, path.stat()) for path in sorted(folder().rglob("*.yaml")))
    composed = pickle.loads(_chosen(name, choices, tuple((path, about.st_mtime_ns, about.st_size) for path, about in files)))
    try:
        for override in overrides:
            if override not in choices:
                field = OverridesParser.create().parse_override(override)
                OmegaConf.update(composed, field.key_or_group, field.value(), merge=True)
    except (HydraException, OmegaConfBaseException):
        return _by_hydra(name, overrides)  # which names what is wrong
    return composed


@lru_cache(maxsize=64)
def _chosen(name: str | None, choices: Sequence[str], state: object) -> bytes:
    """Compose a verb's fields with choices alone; `state` is that of the files. Pickled, as that is copied six times faster."""
    return pickle.dumps(_by_hydra(name, choices))


def _by_hydra(name: str | None, overrides: Sequence[str]) -> Any:
    from hydra import compose, initialize_config_dir
    from hydra.core.config_store import ConfigStore

    store = ConfigStore.instance()
    if name and not (folder() / f"{name}.yaml").is_file():
        store.store(name=name, node=primary(name))
    try:
        with initialize_config_dir(str(folder()), version_base=None):
            return compose(name, list(overrides))
    finally:
        store.repo.pop(f"{name}.yaml", None)  # a file of that name in another folder would be overlooked


def _own_choice(verb: str, override: str) -> tuple[str, Path] | None:
    """The group, as it was written, and the file of a choice that is the path of a YAML file."""
    key, _, value = override.partition("=")
    path = Path(value.strip("'\""))
    if path.suffix not in (".yaml", ".yml") or key.partition("@")[0] not in groups(verb) or not path.is_file():
        return None
    _checked(path)
    return key, path


def _checked(path: Path) -> dict[str, Any]:
    """Content of a choice's file, with its list of the choices that it starts from."""
    content = yaml_text.read(path)  # which refuses what is no YAML, in one line
    if not isinstance(content, dict | None):
        raise InputError(f"{path}: expected a map of fields, found {brief(content)}")
    defaults = (content or {}).get("defaults", [])
    entries = defaults if isinstance(defaults, list) else [None]
    choices = [name for one in entries for name in (one.values() if isinstance(one, dict) and len(one) == 1 else [one])]
    if not all(isinstance(name, str) for name in choices):
        raise InputError(f"{path}: defaults: expected a list of choices, found {brief(defaults)}")
    if "_self_" in choices[:-1]:
        raise InputError(f"{path}: defaults: expected _self_ last, as the file's own fields count, found it before {choices[-1]}")
    return content or {}


def read_choice(group: str, path: Path) -> dict[str, Any]:
    """Read the file of a choice, which may start from shipped ones as its `defaults` list them.

    Raises
    ------
    InputError
        If the file is missing or no YAML, or starts from what the group doesn't have.
    """
    content = _checked(path)
    if "defaults" not in content and "${" not in path.read_text(encoding="utf-8"):
        return content
    from hydra import compose as hydra_compose
    from hydra import initialize_config_dir
    from hydra.errors import ConfigCompositionException, MissingConfigException
    from omegaconf import OmegaConf
    from omegaconf.errors import OmegaConfBaseException

    with TemporaryDirectory() as own, initialize_config_dir(str(folder()), version_base=None):
        try:
            composed = hydra_compose(None, [f"+{_named(Path(own), 0, (group, path))}", _searched(own)])
            found = OmegaConf.to_container(composed[group], resolve=True)
        except MissingConfigException as error:
            missing = str(error.missing_cfg_file).rpartition("/")[2]
            names = sorted(choice.stem for choice in (folder() / group).glob("*.yaml"))
            near = did_you_mean(missing, names)
            raise InputError(f"{path}: defaults: expected one of {', '.join(names)}, found {short(missing)}{near}") from error
        except (ConfigCompositionException, OmegaConfBaseException) as error:
            raise InputError(f"{path}: {_first_line(error)}") from error
    assert isinstance(found, dict)
    return {str(key): value for key, value in found.items()}


def _searched(place: str) -> str:
    """The override that has Hydra look for choices in one more folder."""
    return f"hydra.searchpath=['{escape(f'file://{place}')}']"


def _group(override: str) -> str:
    """The group of an override that is a choice: `patterns` of `patterns@board_patterns=gray_surface`."""
    return override.partition("=")[0].partition("@")[0].lstrip("+~")


def _named(place: Path, number: int, choice: tuple[str, Path]) -> str:
    """An override that names a file of one's own, copied to where Hydra looks for the choices of its group."""
    key, path = choice
    group, name = _group(key), f"own{number}_{token_hex(4)}"  # which no file of one's own can name by mistake
    (place / group).mkdir(exist_ok=True)
    shutil.copyfile(path, place / group / f"{name}.yaml")
    return f"{key}={name}"


def _is_usual_null(verb: str, override: str, others: Sequence[str]) -> bool:
    """Whether an override gives null, at which Hydra fails, to a group without any other choice, of which it is the usual one."""
    group, _, value = override.partition("=")
    alone = all(other == override for other in others if _group(other) == group)
    return value == "null" and alone and {group: None} in primary(verb).get("defaults", [])


def _check_choice(verb: str, override: str) -> None:
    """Refuse null, a list or a map in place of a group's choice, and null of another group, at which Hydra fails."""
    group, _, value = override.partition("=")
    if value == "null" and group not in groups(verb) and (folder() / group).is_dir():
        raise InputError(f"{verb}: {group}: {_unknown_key(group, defaults(verb))}")
    if (value == "null" or value[:1] in ("[", "{")) and (names := groups(verb).get(group)) is not None:
        expected = f"one of {', '.join(names)}"
        raise InputError(f"{verb}: {group}: expected {expected}, found {short(value)}; leave it out for the usual one")


def _fields_named_like_groups(verb: str) -> set[str]:
    """Fields of a verb that share a group's name without being choices of it: Hydra would take `patterns=FILE` for a choice."""
    return {field for field in primary(verb) if (folder() / field).is_dir()} - set(groups(verb))


def _plain_value(verb: str, field: str, value: str) -> object:
    """The value of a field that Hydra isn't given: null, a list or map in brackets, or else text."""
    import yaml

    if value[:1] not in ("[", "{"):
        return None if value == "null" else value.strip("'\"")
    try:
        return yaml.safe_load(value)
    except yaml.YAMLError as error:
        raise InputError(f"{verb}: {field}: expected balanced brackets and quotes, found {short(value)}") from error


def describe(error: ValidationError, model: type[BaseModel], values: Mapping[str, Any] = MappingProxyType({})) -> str:
    """Say the first of pydantic's complaints in one line: the field, what was expected, what was found, and how to mend it.

    values : that were validated, by which a thing's kind is known
    """
    first, *others = faults = error.errors(include_url=False)
    if first["type"] == "missing":  # for want of which a misspelled field stands there
        first = next((fault for fault in faults if fault["type"] == "extra_forbidden"), first)
    way, _ = _place(model, first["loc"])
    field = ".".join(way)
    match first["type"]:
        case "extra_forbidden":
            above, types = _place(model, first["loc"][:-1])
            models = _of_the_kind(_below(values, above), [one for one in types if _is_model(one)])
            names = dict.fromkeys(name for one in models for name in one.model_fields)
            text = f"{field}: {_expected(way[-1], list(names), above)}"
        case "missing" if not isinstance(first["loc"][-1], int):
            text = f"{field}: needs a value; give {field}=..."
        case _:
            text = re.sub(rf"^{re.escape('.'.join(map(str, first['loc'])))}(?=[.:])", lambda _: field, one_line(error))
    return text + (f" (and {len(others)} more)" if others else "")


def _fitted(override: str, model: type[BaseModel] | None, known: Callable[[], Any], others: Mapping[str, str]) -> list[str]:
    """An override as Hydra takes it: maps of free names take new ones, and a thing of another kind replaces the old one.

    So do fields that a thing has by its kind, which one of the other overrides may name.
    """
    key, _, value = override.partition("=")
    if model is None or not re.fullmatch(r"\w[\w.]*", key):
        return [override]
    parts = key.split(".")
    types = _place(model, parts)[1]
    if _free(_place(model, parts[:-1])[1]) or (value[:1] == "{" and _free(types)):
        return [f"++{override}"]
    if parts[-1] in _of_kind(parts[:-1], model, others) and _below(known(), parts[:-1]) is not None:
        return [f"++{override}"]
    kinds = {name: tags for one in types if _is_model(one) for name, tags in _tags(one).items()}
    given = _tag_in(value, kinds)
    if given is None or _below(known(), [*parts, given[0]]) == given[1]:
        return [override]
    return [f"++{key}=null", f"++{override}"]


def _tag_in(value: str, tags: Collection[str]) -> tuple[str, str] | None:
    """The field that tells a thing's kind, with its value, in a map on the command line."""
    if not tags or value[:1] != "{":
        return None
    from hydra.core.override_parser.overrides_parser import OverridesParser

    given = OverridesParser.create().parse_override(f"x={value}").value()
    return next(((tag, str(given[tag])) for tag in tags if tag in given), None) if isinstance(given, dict) else None


def _of_kind(place: Sequence[str], model: type[BaseModel], given: Mapping[str, str]) -> list[str]:
    """Fields that a thing has by its kind, if that is given for it by its tag or in a map; none if it isn't."""
    key = ".".join(place)
    for one in filter(_is_model, _place(model, place)[1]):
        for tag, values in _tags(one).items():
            named = _tag_in(given.get(key, ""), [tag])
            if given.get(f"{key}.{tag}", named[1] if named else "").strip("'\"") in values:
                return list(one.model_fields)
    return []


def _of_the_kind(value: Any, models: list[type[BaseModel]]) -> list[type[BaseModel]]:
    """Of models those whose kind a value names, or has where it names none; all of them if there are none such."""
    given = value if isinstance(value, Mapping) else {}
    return [
        one for one in models if all(given.get(tag, getattr(one, "USUAL", None)) in values for tag, values in _tags(one).items())
    ] or models


def _below(tree: Any, way: Sequence[str]) -> Any:
    """The value at a place in nested maps, None where there is none."""
    for part in way:
        tree = tree.get(part) if isinstance(tree, Mapping) else None
    return tree


def _place(model: type[BaseModel], place: Sequence[str | int]) -> tuple[list[str], list[Any]]:
    """Names on the way to a place in a model's values, without the kinds that pydantic puts between them; and the types there."""
    names, types = list[str](), [model]
    for part in place:
        models = [one for one in types if _is_model(one)]
        fields = [one.model_fields[part].annotation for one in models if part in one.model_fields]
        kinds = [one for one in models if any(part in tags for tags in _tags(one).values())]
        if not fields and kinds:
            types = kinds
            continue
        inner = [get_args(one)[-1] for one in types if _free([one])]
        inner += [each for one in types if get_origin(one) in (list, tuple) for each in get_args(one) if each is not ...]
        types = [each for one in fields or inner for each in _plain_types(one)]
        names.append(str(part))
    return names, types


def _plain_types(annotation: Any) -> list[Any]:
    """The types that an annotation stands for, such as both models of `Annotated[A | B, ...] | None`, or all kinds of a thing."""
    if get_origin(annotation) is Annotated:
        return _plain_types(get_args(annotation)[0])
    if get_origin(annotation) in (Union, UnionType):
        return [each for one in get_args(annotation) for each in _plain_types(one)]
    if isinstance(annotation, type) and issubclass(annotation, Kinds) and annotation.is_any():
        return annotation.models()
    return [annotation]


def _tags(model: type[BaseModel]) -> dict[str, tuple[Any, ...]]:
    """Fields of a model that have one possible value, by which it is told from others."""
    annotations = {name: field.annotation for name, field in model.model_fields.items()}
    return {name: get_args(one) for name, one in annotations.items() if get_origin(one) is Literal and len(get_args(one)) == 1}


def _is_model(one: Any) -> TypeGuard[type[BaseModel]]:
    return isinstance(one, type) and issubclass(one, BaseModel)


def _free(types: Sequence[Any]) -> bool:
    """Whether a map of any names is among types."""
    return any(get_origin(one) is dict for one in types)


def _literal_if_not_grammar(verb: str, override: str) -> str:
    """Quote an override's value where Hydra can't read it, or would take it for a sweep over several values."""
    from hydra.core.override_parser.overrides_parser import OverridesParser
    from hydra.errors import HydraException

    key, equals, value = override.partition("=")
    if not key.startswith("~") and not (key and equals):
        raise InputError(f"{verb}: {override}: expected field=value")
    if re.search(rf"\d{{{MOST_DIGITS}}}", value):
        raise InputError(f"{verb}: {key}: expected numbers of at most {MOST_DIGITS} digits, found more")
    try:
        if not OverridesParser.create().parse_override(override).is_sweep_override():
            return override
    except HydraException as error:
        if value[:1] in ("[", "{") and not _balanced(value):
            raise InputError(f"{verb}: {key}: expected balanced brackets and quotes, found {value}") from error
        if value[:1] in ("[", "{", "'", '"') or not re.fullmatch(r"[+~]*[\w./@:-]+", key):
            raise InputError(f"{verb}: {override}: can't be read as field=value: {_first_line(error)}") from error
    except (ValueError, RecursionError) as error:  # of numbers of thousands of digits, and of brackets as deep
        raise InputError(f"{verb}: {key}: expected a value, found {short(value)}, which can't be read") from error
    return f"{key}='{escape(value)}'"


def _balanced(value: str) -> bool:
    """Whether each bracket and each quote of a value is closed, in the order of the openings."""
    pairs, open_ones, quote, before = {"]": "[", "}": "{", ")": "("}, list[str](), "", ""
    for letter in value:
        if quote:
            quote = "" if letter == quote and before != "\\" else quote
        elif letter in "'\"":
            quote = letter
        elif letter in pairs.values():
            open_ones.append(letter)
        elif letter in pairs and (not open_ones or open_ones.pop() != pairs[letter]):
            return False
        before = letter
    return not open_ones and not quote


def reads_as_text(text: str) -> bool:
    """Whether a value on a command line is read as the text that it is, not as a number, null or a switch."""
    from hydra.core.override_parser.overrides_parser import OverridesParser
    from hydra.errors import HydraException

    try:
        return OverridesParser.create().parse_override(f"x={text}").value() == text
    except HydraException:
        return True  # which is quoted where it is given


def escape(text: str) -> str:
    """Escape text for single quotes: in Hydra's grammar backslashes count only in front of a quote."""
    return re.sub(r"(\\*)('|$)", lambda match: 2 * match[1] + ("\\'" if match[2] else ""), text)


def _missing_choice(verb: str, file: str) -> str:
    """A choice that a group doesn't have, by the file that Hydra looked for, such as `rig/narow`, or `rig//home/me/mine.yaml`."""
    known = groups(verb)
    group = next((name for name in known if file.startswith(f"{name}/")), file.rpartition("/")[0])
    choice, names = file.removeprefix(f"{group}/"), known.get(group, [])
    expected = f"{group}: expected one of {', '.join(names) or 'nothing'}"
    example = folder() / group / f"{next(iter(names), 'own')}.yaml"
    if "/" in choice or choice.endswith((".yaml", ".yml")):
        return f"{expected}, or a YAML file, found none at {choice}; begin with a copy of {example}"
    if Path(f"{choice}.yaml").is_file():
        return f"{expected}, or a YAML file, found {choice}; did you mean {choice}.yaml?"
    return f"{expected}, found {choice}{did_you_mean(choice, names) or f'; a copy of {example} is given as {group}=FILE.yaml'}"


def _unknown_key(key: str, tree: Any) -> str:
    """The keys that stand where a dotted one was looked for in a nested dictionary, and the nearest of them."""
    way: list[str] = []
    for part in key.split("."):
        if not isinstance(tree, Mapping) or part not in tree:
            break
        tree = tree[part]
        way.append(part)
    names = [str(name) for name in tree] if isinstance(tree, Mapping) else []
    return _expected(key.split(".")[min(len(way), key.count("."))], names, way)


def _expected(missing: str, names: Sequence[str], way: Sequence[str]) -> str:
    """The keys below a way of names, in place of one that isn't among them, and the nearest of them."""
    near = did_you_mean(missing, names, ".".join([*way, ""]))
    if not names:
        return f"unknown key; expected none{' below ' + '.'.join(way) if way else ''}"
    listed = ", ".join(names) if len(names) <= MOST_NAMES else f"{', '.join(names[:MOST_NAMES])}, ..."
    return f"unknown key; expected one of {listed}{near}"


def _first_line(error: Exception) -> str:
    return str(error).strip().splitlines()[0]
