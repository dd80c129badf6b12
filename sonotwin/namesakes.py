"""Find packages of other distributions that have the names of ours, `recon`, `scenes`, `twin` or `trainers`, and hide them.

Imports none of them, so that the command can say so before the first import fails.
"""

import importlib.util
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

NAMES = ("recon", "scenes", "twin", "trainers")  # they lie beside the package sonotwin


@dataclass(frozen=True)
class Place:
    """Where Python finds a package, and where ours is."""

    name: str
    found: Path | None
    ours: Path

    @property
    def hidden(self) -> bool:
        """Whether something else is found."""
        return self.found is not None and self.found != self.ours

    @property
    def remedy(self) -> str:
        """The way to our package."""
        where = self.ours.parent if self.found is None else self.found.parent
        return f"uninstall what brought {where / self.name}, or take {where} off PYTHONPATH, or start in another folder"


def places(names: Sequence[str] = NAMES) -> list[Place]:
    """Look for packages without importing them."""
    folder = Path(__file__).resolve().parent.parent
    return [Place(name, _found(name), folder / name) for name in names]


def _found(name: str) -> Path | None:
    """The folder or file that `import NAME` takes; None if there is none."""
    spec = importlib.util.find_spec(name)
    if spec is None:
        return None
    return Path([*(spec.submodule_search_locations or ()), spec.origin or ""][0]).resolve()
