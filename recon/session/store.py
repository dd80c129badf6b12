"""Steps that are done once: each writes a folder, which is kept as long as neither its files change nor what it was made of.

A record in the folder of all steps holds a digest of each step's inputs: code, settings, files and earlier steps. A step is
taken out of the record before it is done again and entered after its folder has appeared whole, so a run that was stopped
anywhere goes on where it was.
"""

import hashlib
import json
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel

from recon.errors import InputError, validated
from recon.files import atomic, json_text, metrics, written_files

RECORD = "reconstruct.json"
BY = "reconstruct"  # who writes
Settings = TypeVar("Settings", bound=BaseModel)


@dataclass
class Store:
    """Steps in one folder. Its state is the record, and the names of the steps of this run."""

    folder: Path
    say: Callable[[str], None]
    code: str  # digest of the code that does the steps
    record: dict[str, str] = field(default_factory=dict)  # name of a step -> digest of its inputs
    done: list[str] = field(default_factory=list)  # steps whose result is there
    failed: dict[str, str] = field(default_factory=dict)  # steps that could not be done, and why

    @contextmanager
    def opened(self, inputs: Iterable[Path | None]) -> Iterator[None]:
        """Take up the record of an earlier run, or begin one; another run on the same folder waits until this one has ended.

        In the end, results of earlier runs that are no part of this one leave the record, and are named.

        Raises
        ------
        InputError
            If something else is there, or the folder can't be written to.
        """
        atomic.check_folder(self.folder, BY, inputs)
        self.folder.mkdir(parents=True, exist_ok=True)
        with atomic.alone(self.folder):
            for name in (RECORD, metrics.FILE):
                atomic.check_listed(self.folder, name, BY)
                atomic.remove_leftovers(self.folder / name)
            atomic.begin_filled(self.folder, BY)
            record = self.folder / RECORD
            self.record = json_text.read(record) if record.is_file() else {}  # as it was written, by the check above
            self._write()
            yield
            for name in [name for name in self.record if name not in self.done]:
                self.say(f"stale       {name}: of an earlier run, and no part of this result")
                self._change(name, None)

    def do(
        self,
        name: str,
        does: str,
        by: str,
        model: type[Settings],
        fields: Mapping[str, Any],
        work: Callable[[Settings, Path], object],
        made_of: Mapping[str, object],
    ) -> Path | None:
        """Do a step, unless its result of before is there; returns its folder, None if it can't be done.

        Parameters
        ----------
        name : of the step, and of its folder
        does : for people
        by : name of the verb that does the same
        model, fields : of the step's settings; fields that the model refuses fail this step alone
        work : does the step by its settings, and writes its folder, whole or not at all, with the list of its files
        made_of : inputs beside the settings: digests of files and of earlier steps
        """
        place = self.folder / name
        try:
            settings = validated(model, fields, by)
            digest = digest_of([self.code, by, settings.model_dump(mode="json"), made_of])
            if self.record.get(name) == digest and written_files.is_whole(place):
                self.say(f"kept        {name}: {does}, as before")
                self.done.append(name)
                return place
            self.say(f"{name}: {does}")
            self._change(name, None)
            work(settings, place)
        except InputError as error:
            self.fail(name, str(error))
            return None
        self.done.append(name)
        self._change(name, digest)
        return place

    def leave_out(self, name: str, reason: str) -> None:
        """Say, in one line, that a step isn't done, and whether a result of an earlier run stands in its place."""
        stale = f"; {self.folder / name} is of an earlier run" if (self.folder / name).is_dir() else ""
        self.say(f"left out    {name}: {reason}{stale}")
        self._change(name, None)

    def take(self, name: str, path: Path, reason: str) -> Path:
        """Say, in one line, that a file that is there stands in a step's place; returns it."""
        self.say(f"taken       {name}: {path}, {reason}")
        return path

    def fail(self, name: str, reason: str) -> None:
        """Say, in one line, that a step could not be done though its part is there."""
        self.failed[name] = reason
        self.leave_out(name, reason)

    def digest(self, *names: str) -> dict[str, str]:
        """Digests of steps that are done, for those that build on them."""
        return {name: self.record[name] for name in names if name in self.done}

    def _change(self, name: str, digest: str | None) -> None:
        """Enter a step in the record, or take it out."""
        if digest is not None:
            self.record[name] = digest
        elif self.record.pop(name, None) is None:
            return
        self._write()

    def _write(self) -> None:
        with atomic.listed_file(self.folder, RECORD, BY) as temporary:
            temporary.write_text(json.dumps(self.record, indent=2, sort_keys=True) + "\n", encoding="utf-8")


def digest_of(content: object) -> str:
    """A short digest of what JSON can hold."""
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:16]


def files_of(paths: Iterable[Path]) -> list[tuple[str, int, int]]:
    """Name, size and time of files, those in folders included: by which a change of them shows."""
    found = []
    for path in paths:
        entries = sorted(entry for entry in path.rglob("*") if entry.is_file()) if path.is_dir() else [path]
        for entry in entries:
            if entry.exists():
                status = entry.stat()
                found.append((str(entry), status.st_size, status.st_mtime_ns))
    return found
