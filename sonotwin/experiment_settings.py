"""Settings of an experiment from fields of `conf/study.yaml`."""

from collections.abc import Mapping
from typing import Any

import yaml
from pydantic import ValidationError

from recon.model.patterns import Patterns
from recon.model.rig import Rig
from sonotwin.config import folder
from twin.experiments.experiment_runs import Settings


def settings_of(given: Mapping[str, Any]) -> dict[str, Any]:
    """Those of an experiment among fields of `conf/study.yaml`, with its patterns on the raster of its rig's projector."""
    ranges = yaml.safe_load((folder() / "dataset.yaml").read_text(encoding="utf-8"))["ranges"]
    settings = {name: value for name, value in given.items() if name in Settings.model_fields} | {"ranges": ranges}
    return settings | _on_raster(settings)


def _on_raster(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Pattern sequences on the raster of the rig's projector; those that are wrong are left for their own complaint."""
    try:
        size = Rig.model_validate(settings.get("rig")).projector.optics.size
        named = {name: Patterns.model_validate(settings.get(name)) for name in ("patterns", "board_patterns")}
        return {name: patterns.on(size) for name, patterns in named.items()}
    except ValidationError:
        return {}
