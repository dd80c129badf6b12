"""Files of the scanner's measured lag, `lag.json`: `lag_s` and `sigma_s`; `interval_s` of confidence, and its `coverage`."""

import json
from pathlib import Path

from pydantic import field_validator

from recon.errors import validated
from recon.files import atomic, json_text
from recon.model.rig import Finite, NotNegative, Part

FILE = "lag.json"


class LagFile(Part):
    """The lag of the scanner's images behind the cameras."""

    lag_s: Finite
    sigma_s: NotNegative
    interval_s: tuple[Finite, Finite]  # low, high
    coverage: NotNegative  # of the interval

    @field_validator("interval_s")
    @classmethod
    def _in_order(cls, value: tuple[float, float]) -> tuple[float, float]:
        if value[0] > value[1]:
            raise ValueError(f"expected low, then high, found {value[0]:g} and {value[1]:g}")
        return value


def write(path: Path, lag: LagFile) -> None:
    """Write a measured lag, whole or not at all."""
    with atomic.new_file(path) as temporary:
        temporary.write_text(json.dumps(lag.model_dump(), indent=2) + "\n", encoding="utf-8")


def read(path: Path) -> LagFile:
    """Read a measured lag.

    Raises
    ------
    InputError
        If the file is missing or damaged.
    """
    return validated(LagFile, json_text.read(path), path)
