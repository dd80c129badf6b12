"""A kind of one's own: one module in a folder of the user's, on the path of the package that finds kinds by name."""

import sys
from importlib import import_module, invalidate_caches
from pathlib import Path

import pytest


def add(monkeypatch: pytest.MonkeyPatch, folder: Path, package: str, name: str, source: str) -> None:
    """Write the module into a folder that is on the package's path until the test ends."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / f"{name}.py").write_text(source, encoding="utf-8")
    searched = import_module(package)
    monkeypatch.setattr(searched, "__path__", [*searched.__path__, str(folder)])
    monkeypatch.delitem(sys.modules, f"{package}.{name}", raising=False)
    monkeypatch.setattr(searched, name, None, raising=False)
    invalidate_caches()
