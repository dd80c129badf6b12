"""The user's cache: compiled code, with what its sources were read to be, and the texts of help.

Imports nothing heavy, so that programs can name the places at once.
"""

import os
import shutil
import time
from contextlib import suppress
from functools import cache
from pathlib import Path
from secrets import token_hex

from platformdirs import user_cache_path

VARIABLE = "SONOTWIN_CACHE"  # of the environment; names a place other than the user's cache folder
UNUSED_DAYS = 30  # after which what is kept of other sources is deleted
DAY_S = 86400.0


def compiled_code() -> Path:
    """The folder of all compiled functions; deleting it is safe."""
    return _folder() / "compiled"


def help_texts() -> Path:
    """The folder of texts that the command's help shows; deleting it is safe."""
    return _folder() / "help"


def note_use(path: Path) -> None:
    """Note, once a day, that a file or folder is in use; in someone else's cache that is theirs to do."""
    with suppress(OSError):
        if time.time() - path.stat().st_mtime > DAY_S:
            os.utime(path)


@cache
def remove_unused(folder: Path) -> None:
    """Delete files and folders in a folder that are long unused, once a process; OSError where it is someone else's."""
    for old in folder.glob("*"):
        if time.time() - old.stat().st_mtime > UNUSED_DAYS * DAY_S:
            shutil.rmtree(old, ignore_errors=True) if old.is_dir() else old.unlink(missing_ok=True)


def keep(place: Path, content: bytes) -> None:
    """Write a file as a whole, and delete what is unused beside it; a cache that can't be written is none."""
    with suppress(OSError):
        place.parent.mkdir(parents=True, exist_ok=True)
        remove_unused(place.parent)
        temporary = place.with_name(f".{place.name}.{os.getpid()}.{token_hex(4)}")  # of one process, on any machine
        temporary.write_bytes(content)
        temporary.replace(place)


def _folder() -> Path:
    place = os.environ.get(VARIABLE)
    return Path(place) if place else user_cache_path("sonotwin", appauthor=False)
