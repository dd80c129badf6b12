"""A folder kept to one run for as long as it works there; a second run is refused, and told who is at work."""

import os
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

from filelock import Timeout

from recon import file_locks
from recon.errors import InputError


@contextmanager
def occupied(folder: Path) -> Iterator[None]:
    """Keep a folder, which need not exist yet, to this run; its mark lies beside it meanwhile, so the folder may be replaced.

    Raises
    ------
    InputError
        If another process or thread holds it; the line says which, where, and since when.
    """
    place = Path(os.path.realpath(folder))
    made = [parent for parent in place.parents if not parent.exists()]
    mark = _mark(place)
    with ExitStack() as after:
        after.callback(_remove_empty, made)
        try:
            after.enter_context(file_locks.held(mark))
        except Timeout:
            raise InputError(
                f"{folder}: expected a folder that no other run is writing, found {file_locks.holder(mark)} at work in it; "
                "wait for its end, or choose another folder"
            ) from None
        yield


def _mark(folder: Path) -> Path:
    """The locked file: beside the folder, or in it where nothing can be written beside it, as with a disk of its own."""
    folder.parent.mkdir(parents=True, exist_ok=True)
    beside = folder.name and os.access(folder.parent, os.W_OK)
    return (folder.parent if beside else folder) / f".{folder.name}.occupied"


def _remove_empty(folders: list[Path]) -> None:
    for folder in folders:
        with suppress(OSError):  # something lies there now
            folder.rmdir()
