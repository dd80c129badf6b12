"""Figures of a result by name, the unit in the name: `surface_rms_mm`. NaN is a figure that nothing could be said of."""

import json
import math
from collections.abc import Mapping
from pathlib import Path

from recon.errors import InputError
from recon.files import atomic, json_text

FILE = "metrics.json"  # beside every result

Metrics = dict[str, float | int]


def write(path: Path, metrics: Mapping[str, float | int]) -> None:
    """Write figures as JSON, whole or not at all. NaN becomes null, since JSON has no NaN."""
    content = {name: value if math.isfinite(value) else None for name, value in metrics.items()}
    with atomic.new_file(path) as temporary:
        temporary.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")


def read(path: Path) -> Metrics:
    """Read figures as `write` wrote them.

    Raises
    ------
    InputError
        If the file is missing or holds something else.
    """
    content = json_text.read(path, "a file of figures")
    if not isinstance(content, dict) or not all(value is None or isinstance(value, int | float) for value in content.values()):
        raise InputError(f"{path}: expected figures by name, found other or damaged data")
    return {name: math.nan if value is None else value for name, value in content.items()}


def shown(value: float, form: str, unit: str = "") -> str:
    """A figure for people: in the format given, with its unit, or `unknown`."""
    return f"{value:{form}}{unit}" if math.isfinite(value) else "unknown"
