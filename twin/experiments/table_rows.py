"""Rows of the tables of accuracy and speed: measured by a function, kept as JSON, shown in the docs."""

import json
import re
import subprocess
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path
from time import perf_counter

from recon.errors import InputError
from recon.files import atomic
from recon.model.patterns import Patterns
from recon.model.rig import Rig
from twin.conditions import Conditions
from twin.tracking.sampling_ranges import DataRanges
from twin.ultrasound.transducer import Transducer


@dataclass(frozen=True)
class Row:
    """One number, beside its bar and its physical limit."""

    id: str
    what: str
    measured: float
    bar: float | None  # what is asked, if anything is
    limit: float | None  # what physics allows, or the peer's figure
    unit: str
    at_least: bool = False  # whether the bar is a least value; else it is a largest one
    seconds: float = 0.0  # that the measurement took

    @property
    def ok(self) -> bool:
        """Whether the bar is met; a figure that is not a number never is, and what nothing is asked of always."""
        if self.bar is None:
            return True
        return bool(self.measured >= self.bar if self.at_least else self.measured <= self.bar)


Measurement = Callable[[], Sequence[Row]]


@dataclass(frozen=True)
class Setup:
    """Inputs of the measurements."""

    rig: Rig
    sequences: Mapping[str, Patterns]  # by their names in conf/patterns
    real: Path | None = None  # folder of real recordings
    scanners: Mapping[str, Transducer] = field(default_factory=dict)  # by their names in conf/ultrasound
    frames: DataRanges | None = None  # of tracking frames, as in conf/dataset.yaml
    out: Path | None = None  # folder for figures; without it none is drawn
    lifelike: Conditions | None = None  # as in conf/conditions/lifelike.yaml


def measure(measurements: Sequence[Measurement]) -> Iterator[Row]:
    """Run measurements one by one; their time is shared evenly by the rows that they give."""
    for measurement in measurements:
        start = perf_counter()
        rows = measurement()
        seconds = (perf_counter() - start) / len(rows)
        for row in rows:
            yield replace(row, seconds=round(seconds, 2))


def write(path: Path, rows: Sequence[Row]) -> None:
    """Write rows as JSON: a list of `{id, what, measured, bar, limit, unit, ok, seconds}`."""
    path.parent.mkdir(parents=True, exist_ok=True)
    keys = ("id", "what", "measured", "bar", "limit", "unit", "ok", "seconds")
    records = [{key: getattr(row, key) for key in keys} for row in rows]
    with atomic.new_file(path) as temporary:
        temporary.write_text(json.dumps(records, indent=2) + "\n", encoding="utf-8")


def table(rows: Sequence[Row], limit: str) -> str:
    """Rows as a Markdown table; `limit` heads the column of what they are compared with."""
    lines = [f"| id | what | measured | bar | {limit} | unit | ok |", "|---|---|---|---|---|---|---|"]
    for row in rows:
        asked = "" if row.bar is None else f"{'>=' if row.at_least else '<='} {row.bar:.4g}"
        beside = "" if row.limit is None else f"{row.limit:.4g}"
        met = "" if row.bar is None else "yes" if row.ok else "**no**"
        lines.append(f"| {row.id} | {row.what} | {row.measured:.4g} | {asked} | {beside} | {row.unit} | {met} |")
    return "\n".join(lines)


def check_place(document: Path, group: str) -> None:
    """Check that a document has a place for a group's table.

    Raises
    ------
    InputError
        If it has none, or is no file.
    """
    if not document.is_file():
        raise InputError(f"{document}: expected a Markdown file, found none")
    if not re.search(rf"<!-- {group} -->\n.*?<!-- /{group} -->", document.read_text(encoding="utf-8"), re.DOTALL):
        raise InputError(f"{document}: expected a place <!-- {group} --> ... <!-- /{group} -->, found none")


def refresh(document: Path, group: str, text: str) -> None:
    """Replace the table between `<!-- GROUP -->` and `<!-- /GROUP -->` in a document, under the date and commit of now.

    Raises
    ------
    InputError
        If the document has no place for it.
    """
    enter(document, group, f"{measured_line(document.parent)}\n\n{text}")


def enter(document: Path, group: str, text: str) -> None:
    """Replace what stands between `<!-- GROUP -->` and `<!-- /GROUP -->` in a document; raises InputError as `refresh` does."""
    check_place(document, group)
    before = document.read_text(encoding="utf-8")
    place = re.compile(rf"(<!-- {group} -->\n).*?(<!-- /{group} -->)", re.DOTALL)
    with atomic.new_file(document) as temporary:
        temporary.write_text(place.sub(lambda match: f"{match[1]}\n{text}\n\n{match[2]}", before), encoding="utf-8")


def measured_line(folder: Path) -> str:
    """The state of a folder in a sentence: `Measured 2026-01-31 at 1a2b3c4.`; without a commit the date alone."""
    day, commit = state(folder)
    return f"Measured {day} at {commit}." if commit else f"Measured {day}."


def state(folder: Path) -> tuple[str, str]:
    """Date of today, UTC, and commit of the folder, with `+changes` if other files than pages and their rows differ from it.

    Outside a git repository, or without git, the commit is empty.
    """
    day = f"{datetime.now(UTC):%Y-%m-%d}"
    written = (":(top,exclude,glob)**/*.md", ":(top,exclude)docs/*.csv")
    try:
        commit = _git(folder, "rev-parse", "--short=7", "HEAD")
        changed = _git(folder, "status", "--porcelain", "--untracked-files=no", "--", ":/", *written)
    except (OSError, subprocess.CalledProcessError):
        return day, ""
    return day, f"{commit}{'+changes' if changed else ''}"


def _git(folder: Path, *arguments: str) -> str:
    done = subprocess.run(["git", "-C", str(folder), *arguments], capture_output=True, text=True, check=True)
    return done.stdout.strip()
