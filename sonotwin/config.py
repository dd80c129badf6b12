"""From YAML files and overrides on the command line to a verb's validated `Config`.

The files are those of `conf/`: `conf/VERB.yaml` has a verb's fields, and each folder beside it is a group of choices. Hydra
composes them; pydantic validates what comes out; the mistakes that either finds become one line each.
"""

import re
import shutil
from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from copy import deepcopy
from functools import cache, lru_cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError

from recon.errors import InputError, brief, did_you_mean, one_line, short
from recon.files import yaml_text

OF_ONE_VERB = {"devices/virtual": "record"}  # choices of a group that only this verb takes
MOST_NAMES = 12  # of keys in a message
MOST_DIGITS = 1000  # of a number; Hydra's parser can't take more than Python's own limit of some thousands
Model = TypeVar("Model", bound=BaseModel)


def folder() -> Path:
    """Find the folder of YAML files: inside the package in a wheel, beside it in a clone."""
    package = Path(__file__).resolve().parent
    inside = package / "conf"
    return inside if inside.is_dir() else package.parent / "conf"


def groups(verb: str) -> dict[str, list[str]]:
    """Name the choices of each group that the verb's defaults list uses and that it takes, such as `{"rig": ["meza2021"]}`."""
    defaults = _own_fields(verb).get("defaults", [])
    entries = [key for entry in defaults if isinstance(entry, dict) for key in entry]
    names = [re.sub(r"^(override |optional )*/?|@.*$", "", entry) for entry in entries]
    found = {name: sorted(choice.stem for choice in (folder() / name).glob("*.yaml")) for name in names}
    return {name: [one for one in given if OF_ONE_VERB.get(f"{name}/{one}", verb) == verb] for name, given in found.items()}


def defaults(verb: str) -> dict[str, Any]:
    """The fields of a verb as they are without overrides; `???` where one needs a value."""
    from hydra import compose as hydra_compose
    from hydra import initialize_config_dir
    from omegaconf import OmegaConf

    with initialize_config_dir(str(folder()), version_base=None):
        found = OmegaConf.to_container(hydra_compose(verb), resolve=True)
    assert isinstance(found, dict)
    return {str(key): value for key, value in found.items()}


def load(verb: str, overrides: Sequence[str], model: type[Model]) -> Model:
    """Compose a verb's configuration and validate it.

    Parameters
    ----------
    verb : str
        Names `conf/VERB.yaml`; a verb without that file starts from no fields.
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
    composed = compose(verb, overrides)
    try:
        return model.model_validate(composed, context={"overrides": overrides})
    except ValidationError as error:
        raise InputError(f"{verb}: {describe(error, model)}") from error


def compose(verb: str, overrides: Sequence[str]) -> dict[str, Any]:
    """Compose `conf/VERB.yaml` with the overrides into a plain, resolved dictionary; raises InputError as `load` does."""
    from hydra.errors import ConfigCompositionException, MissingConfigException
    from omegaconf import MissingMandatoryValue, OmegaConf
    from omegaconf.errors import OmegaConfBaseException

    name = verb if (folder() / f"{verb}.yaml").is_file() else None
    plain = [override for override in overrides if override.partition("=")[0] in _fields_named_like_groups(verb)]
    files = {k: file for k, override in enumerate(overrides) if (file := _own_choice(verb, override)) is not None}
    with TemporaryDirectory() if files else nullcontext("") as own:
        named = [_named(Path(own), k, files[k]) if k in files else override for k, override in enumerate(overrides)]
        quoted = [_literal_if_not_grammar(verb, override) for override in named if override not in plain]
        for override in quoted:
            _check_choice(verb, override)
        if files:
            quoted.append(f"hydra.searchpath=['{_escape(f'file://{own}')}']")
        try:
            composed = _composed(name, quoted)
            for override in plain:
                field, _, value = override.partition("=")
                OmegaConf.update(composed, field, _plain_value(verb, field, value))
            result = OmegaConf.to_container(composed, resolve=True, throw_on_missing=True)
        except MissingConfigException as error:
            raise InputError(f"{verb}: {_missing_choice(verb, str(error.missing_cfg_file))}") from error
        except ConfigCompositionException as error:
            other = re.match(r"Error merging override ([^=]+)=(.*)", str(error))
            if other is not None:
                raise InputError(f"{verb}: {other[1]}: expected a value of its default's kind, found {other[2]}") from error
            unknown = re.search(r"Could not override '([^']+)'", str(error))
            if unknown is None:
                raise InputError(f"{verb}: {_first_line(error)}") from error
            known = OmegaConf.to_container(_by_hydra(name, ())) if name else {}
            raise InputError(f"{verb}: {unknown[1]}: {_unknown_key(unknown[1], known)}") from error
        except MissingMandatoryValue as error:
            raise InputError(f"{verb}: {error.full_key}: needs a value; give {error.full_key}=...") from error
        except OmegaConfBaseException as error:
            raise InputError(f"{verb}: {error.full_key}: {_first_line(error)}") from error
    assert isinstance(result, dict)
    return {str(key): value for key, value in result.items()}


def _composed(name: str | None, overrides: Sequence[str]) -> Any:
    """Compose a file of `conf` with overrides, as Hydra does, which takes most of its time for the choices.

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
    composed = deepcopy(_chosen(name, choices, tuple((path, about.st_mtime_ns, about.st_size) for path, about in files)))
    try:
        for override in overrides:
            if override not in choices:
                field = OverridesParser.create().parse_override(override)
                OmegaConf.update(composed, field.key_or_group, field.value(), merge=True)
    except (HydraException, OmegaConfBaseException):
        return _by_hydra(name, overrides)  # which names what is wrong
    return composed


@lru_cache(maxsize=64)
def _chosen(name: str | None, choices: Sequence[str], state: object) -> Any:
    """Compose a file of `conf` with choices alone; `state` is that of the files."""
    return _by_hydra(name, choices)


def _by_hydra(name: str | None, overrides: Sequence[str]) -> Any:
    from hydra import compose, initialize_config_dir

    with initialize_config_dir(str(folder()), version_base=None):
        return compose(name, list(overrides))


def _own_choice(verb: str, override: str) -> tuple[str, Path] | None:
    """The group, as it was written, and the file of a choice that is the path of a YAML file."""
    key, _, value = override.partition("=")
    path = Path(value.strip("'\""))
    if key.partition("@")[0] not in groups(verb) or path.suffix not in (".yaml", ".yml") or not path.is_file():
        return None
    content = yaml_text.read(path)  # which refuses what is no YAML, in one line
    if not isinstance(content, dict | None):
        raise InputError(f"{path}: expected a map of fields, found {brief(content)}")
    defaults = (content or {}).get("defaults", [])
    entries = defaults if isinstance(defaults, list) else [None]
    choices = [name for one in entries for name in (one.values() if isinstance(one, dict) and len(one) == 1 else [one])]
    if not all(isinstance(name, str) for name in choices):
        raise InputError(f"{path}: defaults: expected a list of choices, found {brief(defaults)}")
    return key, path


def _named(place: Path, number: int, choice: tuple[str, Path]) -> str:
    """An override that names a file of one's own, copied to where Hydra looks for the choices of its group."""
    key, path = choice
    group, name = key.partition("@")[0], f"own{number}"
    (place / group).mkdir(exist_ok=True)
    shutil.copyfile(path, place / group / f"{name}.yaml")
    return f"{key}={name}"


def _check_choice(verb: str, override: str) -> None:
    """Refuse null, a list or a map in place of a group's choice, at which Hydra fails."""
    group, _, value = override.partition("=")
    if (value == "null" or value[:1] in ("[", "{")) and (names := groups(verb).get(group)) is not None:
        expected = f"one of {', '.join(names)}"
        raise InputError(f"{verb}: {group}: expected {expected}, found {short(value)}; leave it out for the usual one")


def _fields_named_like_groups(verb: str) -> set[str]:
    """Fields of a verb that share a group's name without being choices of it: Hydra would take `patterns=FILE` for a choice."""
    return {field for field in _own_fields(verb) if (folder() / field).is_dir()} - set(groups(verb))


def _own_fields(verb: str) -> dict[str, Any]:
    """The fields of `conf/VERB.yaml` as they stand there; none of a verb without that file."""
    path = folder() / f"{verb}.yaml"
    return _parsed(path.read_text(encoding="utf-8")) if path.is_file() else {}


@cache
def _parsed(text: str) -> dict[str, Any]:
    """Fields of a YAML text of `conf`, parsed once, though each override asks for them; not to be changed."""
    import yaml

    return yaml.load(text, Loader=getattr(yaml, "CSafeLoader", yaml.SafeLoader)) or {}


def _plain_value(verb: str, field: str, value: str) -> object:
    """The value of a field that Hydra isn't given: null, a list or map in brackets, or else text."""
    import yaml

    if value[:1] not in ("[", "{"):
        return None if value == "null" else value.strip("'\"")
    try:
        return yaml.safe_load(value)
    except yaml.YAMLError as error:
        raise InputError(f"{verb}: {field}: expected balanced brackets and quotes, found {short(value)}") from error


def describe(error: ValidationError, model: type[BaseModel]) -> str:
    """Say the first of pydantic's complaints in one line: the field, what was expected, what was found, and how to mend it."""
    first, *others = error.errors(include_url=False)
    field = ".".join(str(part) for part in first["loc"])
    match first["type"]:
        case "extra_forbidden":
            text = f"{field}: {_unknown_key(field, dict.fromkeys(model.model_fields))}"
        case "missing":
            text = f"{field}: needs a value; give {field}=..."
        case _:
            text = one_line(error)
    return text + (f" (and {len(others)} more)" if others else "")


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
    return f"{key}='{_escape(value)}'"


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


def _escape(text: str) -> str:
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
    missing = key.split(".")[min(len(way), key.count("."))]
    near = did_you_mean(missing, names, ".".join([*way, ""]))
    if not names:
        return f"unknown key; expected none{' below ' + '.'.join(way) if way else ''}"
    listed = ", ".join(names) if len(names) <= MOST_NAMES else f"{', '.join(names[:MOST_NAMES])}, ..."
    return f"unknown key; expected one of {listed}{near}"


def _first_line(error: Exception) -> str:
    return str(error).strip().splitlines()[0]
