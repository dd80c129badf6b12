"""Figures of experiments in a folder, a file each: kept as they are done, so that a run that was stopped, or grows, goes on.

A file's name is a digest of all that its figures depend on: code, settings and seed. Several runs may share a folder at once,
so it has no record of its own: a file is there or not.
"""

import json
import math
import os
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from typing import Any, NamedTuple

from recon.errors import InputError
from recon.files import atomic, json_text
from recon.files.metrics import Metrics
from twin.engine import Engine, results

Work = Callable[..., tuple[str, Metrics | str]]


class State(NamedTuple):
    """When and by which commit figures were measured."""

    day: str  # UTC
    commit: str


UNKNOWN = State("", "")


@dataclass(frozen=True)
class Kept:
    """A folder of figures."""

    folder: Path
    state: State = UNKNOWN  # of this run, to be written beside its figures

    def open(self) -> None:
        """Make the folder, and take away what a run that was killed left of a file."""
        self.folder.mkdir(parents=True, exist_ok=True)
        for leftover in self.folder.glob(".*.new.json"):
            atomic.remove_leftovers(self._path(leftover.name.split(".")[1]))

    def read(self, key: str) -> Metrics | None:
        """Figures that were kept before, if they are whole."""
        try:
            figures = self._record(key)["figures"].items()
            return {name: math.nan if value is None else float(value) for name, value in figures}
        except (InputError, ValueError, KeyError, AttributeError, TypeError):  # none, or damaged: done again
            return None

    def state_of(self, key: str) -> State:
        """The state that figures were kept with."""
        try:
            record = self._record(key)
            return State(*(str(record.get(name, "")) for name in State._fields))
        except (InputError, AttributeError):
            return UNKNOWN

    def forget(self, key: str) -> None:
        """Measure anew what was kept."""
        self._path(key).unlink(missing_ok=True)

    def keep(self, key: str, found: Metrics | str) -> None:
        """Keep figures; what gave none is tried again by a later run. A damaged file is set aside."""
        if isinstance(found, str) or self.read(key) is not None:  # by another run, meanwhile
            return
        path = self._path(key)
        if os.path.lexists(path):  # it wasn't kept, and so was changed by somebody
            aside = next(each for k in count(1) if not os.path.lexists(each := path.with_name(f"{path.name}.damaged{k}")))
            path.rename(aside)
        figures = {name: value if math.isfinite(value) else None for name, value in found.items()}
        with atomic.new_file(path) as temporary:
            temporary.write_text(
                json.dumps({"figures": figures} | (self.state._asdict() if any(self.state) else {})) + "\n", encoding="utf-8"
            )

    def run(self, engine: Engine, work: Work, tasks: Mapping[str, tuple]) -> Iterator[tuple[str, Metrics | str]]:
        """Key and figures of tasks, or the reason for none: kept ones first, the others as they are done.

        work : of a key and a task's arguments; gives key and figures
        """
        missing = []
        for key, task in tasks.items():
            if (figures := self.read(key)) is not None:
                yield key, figures
            else:
                missing.append((key, *task))
        for key, found in results(engine, work, missing):
            self.keep(key, found)
            yield key, found

    def _record(self, key: str) -> Any:
        return json_text.read(self._path(key))

    def _path(self, key: str) -> Path:
        return self.folder / f"{key}.json"
