"""A digest of code, by which results of other code are known."""

import hashlib
from functools import cache
from importlib.util import find_spec
from pathlib import Path


@cache
def code_digest(*places: str | Path) -> str:
    """Digest of all files of packages, by their names, and of folders, but of compiled code: of their names and content.

    What editors and programs put beside a file while they write it doesn't count: hidden names, and names without an ending or
    with a tilde after it.
    """
    found = hashlib.sha256()
    for root in map(_folder, places):
        for path in sorted(path for path in root.rglob("*") if path.is_file() and _counts(path.relative_to(root))):
            found.update(f"{root.name}/{path.relative_to(root).as_posix()}\0".encode() + path.read_bytes() + b"\0")
    return found.hexdigest()[:12]


def is_unchanged(*places: str | Path) -> bool:
    """Whether packages and folders still are as this process found them when it first took their digest."""
    return code_digest.__wrapped__(*places) == code_digest(*places)


def _counts(name: Path) -> bool:
    """Whether a file may be code, or what code reads."""
    if any(part == "__pycache__" or part.startswith(".") for part in name.parts):
        return False
    return bool(name.suffix) and not name.name.endswith("~")


def _folder(place: str | Path) -> Path:
    if isinstance(place, Path):
        return place
    spec = find_spec(place)
    if spec is None or spec.origin is None:
        raise ModuleNotFoundError(f"expected the package {place}, found none", name=place)
    return Path(spec.origin).parent
