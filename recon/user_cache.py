"""Where compiled code and the texts of help are kept. Imports nothing heavy, so that programs can name the places at once."""

import os
from pathlib import Path

from platformdirs import user_cache_path

VARIABLE = "SONOTWIN_CACHE"  # of the environment; names a place other than the user's cache folder


def compiled_code() -> Path:
    """The folder of all compiled functions; deleting it is safe."""
    return _folder() / "compiled"


def help_texts() -> Path:
    """The folder of texts that the command's help shows; deleting it is safe."""
    return _folder() / "help"


def _folder() -> Path:
    place = os.environ.get(VARIABLE)
    return Path(place) if place else user_cache_path("sonotwin", appauthor=False)
