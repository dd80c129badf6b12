"""Where code that was compiled on this machine is kept. Imports nothing heavy, so that programs can name the place at once."""

import os
from pathlib import Path

from platformdirs import user_cache_path

VARIABLE = "SONOTWIN_CACHE"  # of the environment; names a place other than the user's cache folder


def compiled_code() -> Path:
    """The folder of all compiled functions; deleting it is safe."""
    place = os.environ.get(VARIABLE)
    return (Path(place) if place else user_cache_path("sonotwin", appauthor=False)) / "compiled"
