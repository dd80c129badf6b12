"""A rendered digital twin of an imaging rig, and the rig's software: the public Python interface.

The names of `__all__` and `__version__` are the interface; `docs/interface.md` documents each with an example. They are imported
on first use, so `import sonotwin` is instant and needs none of the packages. Everything else is internal and may change between
versions. The stub beside this file lists the names for this module and for editors and type checkers alike, one a line.
"""

import re
from importlib import import_module
from pathlib import Path
from typing import Any


def _read_places(stub: Path) -> dict[str, tuple[str, str]]:
    """Places of the public names, as the stub lists them: name -> module, and name in it; ImportError where it has others."""
    lines = [line for line in stub.read_text(encoding="utf-8").splitlines() if line.startswith(("from ", "import "))]
    matches = [re.fullmatch(r"from (\S+) import (\w+) as (\w+)", line) for line in lines]
    if not lines or None in matches:
        found = lines[matches.index(None)] if lines else "none"
        raise ImportError(f"{stub}: expected lines such as 'from recon.errors import InputError as InputError', found {found}")
    return {match[3]: (match[1], match[2]) for match in matches if match is not None}


_PLACES = _read_places(Path(__file__).with_suffix(".pyi"))
__all__ = sorted(_PLACES)


def __getattr__(name: str) -> Any:
    """Import a public name on first use (PEP 562)."""
    if name == "__version__":
        from importlib.metadata import PackageNotFoundError, version

        try:
            return version(__name__)
        except PackageNotFoundError:
            raise AttributeError(f"module {__name__!r} isn't installed: it has no version") from None
    if name not in _PLACES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module, there = _PLACES[name]
    value = getattr(import_module(module), there)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    """List the public names, imported or not."""
    return sorted({*globals(), *__all__, "__version__"})
