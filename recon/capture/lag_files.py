"""Files of the scanner's measured lag, `lag.json`: `lag_s` and `sigma_s`; `interval_s` of confidence, and its `coverage`."""

import json
from pathlib import Path

from pydantic import BaseModel, ConfigDict, ValidationError

from recon.errors import InputError, one_line
from recon.files import atomic
from recon.model.rig import Finite, NotNegative

FILE = "lag.json"


class LagFile(BaseModel):
    """The lag of the scanner's images behind the cameras."""

    model_config = ConfigDict(frozen=True)

    lag_s: Finite
    sigma_s: NotNegative
    interval_s: tuple[Finite, Finite]  # low, high
    coverage: NotNegative  # of the interval


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
    try:
        return LagFile.model_validate_json(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise InputError(f"{path}: expected a measured lag, found no file; sonotwin measure-lag writes it") from None
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: expected a measured lag, found {error}") from None
    except ValidationError as error:
        raise InputError(f"{path}: {one_line(error)}") from None
