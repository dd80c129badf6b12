"""Files read whole, or refused in one line."""

from collections.abc import Iterable
from pathlib import Path

from recon.errors import InputError


def read_bytes(path: Path) -> bytes:
    """Content of a file; raises InputError if there is none or it can't be read."""
    try:
        return path.read_bytes()
    except FileNotFoundError:
        raise InputError(f"{path}: expected a file, found none") from None
    except OSError as error:
        raise InputError(f"{path}: expected a readable file, found {error.strerror}") from None


def check_there(paths: Iterable[Path]) -> None:
    """Check that files are there, without reading them; InputError names the first that isn't."""
    for path in paths:
        if not path.is_file():
            raise InputError(f"{path}: expected a file, found {'something else' if path.exists() else 'none'}")
