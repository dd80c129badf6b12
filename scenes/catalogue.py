"""Find a scene by its kind. A kind is a module of this package that has a `Config` and a `build`."""

from collections.abc import Mapping
from importlib import import_module
from pkgutil import iter_modules
from types import ModuleType
from typing import Any

from pydantic import ValidationError

import scenes
from recon.errors import InputError, one_line
from scenes.things import Scene


def kinds() -> list[str]:
    """Names of all kinds of scene, in alphabetical order."""
    return [name for name in _modules() if _is_scene(import_module(f"scenes.{name}"))]


def build_scene(config: Mapping[str, Any]) -> Scene:
    """Build the scene that a configuration describes, such as `conf/scene/breast.yaml`.

    Parameters
    ----------
    config : mapping
        `kind` names the scene; the other keys are the fields of that kind's `Config`.

    Raises
    ------
    InputError
        If the kind is unknown, a key is unknown or missing, a value is out of range, or the parts don't fit together.
    """
    module, parsed = parse_scene(config)
    return module.build(parsed)


def parse_scene(config: Mapping[str, Any]) -> tuple[ModuleType, Any]:
    """The module of a scene's kind, and its checked `Config`; raises InputError as `build_scene` does."""
    if "kind" not in config:
        raise InputError(f"scene: kind: expected one of {', '.join(kinds())}, found none")
    kind = config["kind"]
    module = import_module(f"scenes.{kind}") if kind in _modules() else None
    if module is None or not _is_scene(module):
        raise InputError(f"scene: kind: expected one of {', '.join(kinds())}, found {kind!r}")
    try:
        return module, module.Config(**{key: value for key, value in config.items() if key != "kind"})
    except ValidationError as error:
        raise InputError(f"scene: {kind}: {one_line(error)}") from error


def _modules() -> list[str]:
    return sorted(module.name for module in iter_modules(scenes.__path__))


def _is_scene(module: ModuleType) -> bool:
    return hasattr(module, "Config") and hasattr(module, "build")
