"""Find a scene by its kind. A kind is a module of `scenes.kinds`, with a `Config` and a `build`."""

from collections.abc import Mapping
from types import ModuleType
from typing import Any

from pydantic import ValidationError

from recon import arguments, registry
from recon.errors import InputError, one_line
from scenes.scene_types import Scene


def kinds() -> list[str]:
    """Names of all kinds of scene, in alphabetical order."""
    return registry.names("scenes.kinds")


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
    arguments.of_kind("scene", config, Mapping, way="such as {'kind': 'sphere', 'radius_mm': 19.8}")
    if "kind" not in config:
        raise InputError(f"scene: kind: expected one of {', '.join(kinds())}, found none")
    kind = config["kind"]
    if kind not in kinds():
        raise InputError(f"scene: kind: expected one of {', '.join(kinds())}, found {kind!r}")
    module = registry.kind("scenes.kinds", kind)
    try:
        return module, module.Config(**{key: value for key, value in config.items() if key != "kind"})
    except ValidationError as error:
        raise InputError(f"scene: {kind}: {one_line(error)}") from error
