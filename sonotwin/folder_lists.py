"""Fields of several folders: one may be given by itself, and none twice."""

import os
from pathlib import Path
from typing import Annotated

from pydantic import AfterValidator, BeforeValidator


def listed(value: object) -> object:
    """A list, of one that is given by itself."""
    return [value] if isinstance(value, str | Path) else value


def _each_once(folders: list[Path]) -> list[Path]:
    real = [os.path.realpath(folder) for folder in folders]  # of a link to itself, too, which Path.resolve doesn't take
    for folder, place in zip(folders, real, strict=True):
        if real.count(place) > 1:
            raise ValueError(f"expected each folder once, found {folder} twice")
    return folders


Folders = Annotated[list[Path], BeforeValidator(listed), AfterValidator(_each_once)]
