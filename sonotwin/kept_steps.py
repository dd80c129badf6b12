"""Steps that are done once: each is a verb that writes a folder, which is kept as long as nothing that it was made of changes.

A record in the folder of all steps says what each was made of. It is written after the step's folder has appeared whole, so a run
that was killed anywhere goes on where it was.
"""

import hashlib
import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from importlib import import_module
from importlib.metadata import version
from pathlib import Path

from recon.errors import InputError
from recon.files import atomic
from sonotwin.config import load

RECORD = "reconstruct.json"  # by which the folder of all steps is known


@dataclass
class KeptSteps:
    """Steps in one folder. Its state is the record, and what wasn't done."""

    folder: Path
    say: Callable[[str], None]
    record: dict[str, str] = field(default_factory=dict)  # name of a step -> digest of all that it was made of
    done: list[str] = field(default_factory=list)  # names of steps whose result is there
    failed: list[str] = field(default_factory=list)  # of those that were tried in vain

    def open(self, inputs: Iterable[Path]) -> None:
        """Take up the record of an earlier run, or begin one.

        Raises
        ------
        InputError
            If something else is there, or the folder can't be written to.
        """
        atomic.check_folder(self.folder, RECORD, inputs)
        self.folder.mkdir(parents=True, exist_ok=True)
        path = self.folder / RECORD
        try:
            content = json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {}
            self.record = {name: str(digest) for name, digest in content.items()}
        except (ValueError, AttributeError):
            self.record = {}  # a damaged one costs work, and no more
        self._write()

    def do(
        self, name: str, does: str, verb: str, fields: Sequence[str], marker: str, made_of: Mapping[str, object]
    ) -> Path | None:
        """Do a step, unless its result of before is there; returns its folder, None if it can't be done.

        Parameters
        ----------
        name : of the step, and of its folder
        does : for people
        verb, fields : the command line, less `out`
        marker : file by which the folder's kind is known
        made_of : all that decides the result beside the fields: digests of files and of earlier steps
        """
        place = self.folder / name
        digest = digest_of({"version": version("sonotwin"), "verb": verb, "fields": list(fields), **made_of})
        if self.record.get(name) == digest and (place / marker).is_file():
            self.say(f"kept        {name}: {does}, as before")
            self.done.append(name)
            return place
        self.say(f"{name}: {does}")
        module = import_module(f"sonotwin.verbs.{verb.replace('-', '_')}")
        try:
            module.run(load(verb, [*fields, f"out={place}"], module.Config))
        except InputError as error:
            self.failed.append(name)
            self.leave_out(name, str(error))
            return None
        self.record[name] = digest
        self.done.append(name)
        self._write()
        return place

    def leave_out(self, name: str, reason: str) -> None:
        """Note, in one line, that a step isn't done; its result of an earlier run doesn't count any more."""
        self.say(f"left out    {name}: {reason}")
        if self.record.pop(name, None) is not None:
            self._write()

    def digest(self, *names: str) -> dict[str, str]:
        """Digests of steps that are done, for those that build on them."""
        return {name: self.record[name] for name in names if name in self.record}

    def _write(self) -> None:
        with atomic.new_file(self.folder / RECORD) as temporary:
            temporary.write_text(json.dumps(self.record, indent=2) + "\n", encoding="utf-8")


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
