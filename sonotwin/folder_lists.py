"""Fields of several folders: one may be given by itself, and none twice."""

from pathlib import Path
from typing import Annotated

from pydantic import AfterValidator, BeforeValidator


def listed(value: object) -> object:
    """A list, of one that is given by itself."""
    return [value] if isinstance(value, str | Path) else value


def _each_once(folders: list[Path]) -> list[Path]:
    for place, folder in enumerate(folders):
        if folder.resolve() in (other.resolve() for other in folders[:place]):
            raise ValueError(f"expected each folder once, found {folder} twice")
    return folders


Folders = Annotated[list[Path], BeforeValidator(listed), AfterValidator(_each_once)]
