"""The log of checks, a line of JSON each: a rig over days. A line is added to a copy, which takes the log's place as a whole."""

import json
import math
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated

from pydantic import AwareDatetime, Field

from recon.errors import validated
from recon.files import atomic, json_text
from recon.files.regular import MOST_TEXT, read_text
from recon.model.rig import NotNegative, Part
from recon.rig_check.rig_versions import Comparison
from recon.rig_check.verdicts import State, Verdict

EPOCH, END = datetime(1970, 1, 1, tzinfo=UTC), datetime(2200, 1, 1, tzinfo=UTC)  # of times that a computer's clock shows


class Entry(Part):
    """One part in one check."""

    part: str
    state: State
    sigma: NotNegative | None = None  # None where nothing showed the part
    mm: NotNegative | None = None
    mm_sigma: NotNegative | None = None
    motion: str = ""
    rivals: tuple[str, ...] = ()


class Check(Part):
    """One check."""

    time: Annotated[AwareDatetime, Field(ge=EPOCH, lt=END)]
    name: str  # of the capture
    parts: tuple[Entry, ...] = Field(min_length=1)
    rig: Comparison | None = None  # its numbers against those of its file


def entry(verdict: Verdict) -> Entry:
    """A verdict as a record."""
    numbers = {name: getattr(verdict, name) for name in ("sigma", "mm", "mm_sigma")}
    known = {name: round(value, 5) if math.isfinite(value) else None for name, value in numbers.items()}
    return Entry(part=verdict.part, state=verdict.state, motion=verdict.motion, rivals=verdict.rivals, **known)


def check(name: str, verdicts: Sequence[Verdict], rig: Comparison | None = None) -> Check:
    """The record of a check that was made now."""
    return Check(time=datetime.now(UTC).replace(microsecond=0), name=name, parts=tuple(map(entry, verdicts)), rig=rig)


def read(path: Path) -> list[Check]:
    """All checks of a log, in its order.

    Raises
    ------
    InputError
        If it is missing, or a line is damaged: the line is named.
    """
    lines = enumerate(read_text(path, MOST_TEXT, "a log of checks").splitlines(), start=1)
    return [validated(Check, json_text.parsed(path, line), f"{path}: line {k}") for k, line in lines if line.strip()]


def add(path: Path, made: Check) -> None:
    """Add a check; one process at a time does, and whatever stops it, the log stays whole.

    Raises
    ------
    InputError
        If the log that is there is damaged: it stays as it is.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic.new_file(path) as temporary:
        checks = [*(read(path) if path.exists() else []), made]
        temporary.write_text("".join(json.dumps(one.model_dump(mode="json")) + "\n" for one in checks), encoding="utf-8")
