"""Rows of results: one figure beside its bar and its limit; their files, and a document's short table of some of them.

Beside a document all rows stand in a CSV file, as a commit then shows which figures changed, and a forge shows and filters it;
in a folder of results they stand in one tidy Parquet file, with experiment and settings.
"""

import csv
import io
import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, fields
from fnmatch import fnmatchcase
from pathlib import Path
from re import search

import pyarrow as pa
import pyarrow.parquet as pq

from recon.errors import InputError
from recon.files import atomic, yaml_text
from twin.experiments import document_tables

MARK = "rows"  # of the short table's place in a document
TABLE = "results.parquet"
COLUMNS = 10  # of the CSV file: a row's first fields
Stays = Callable[[str], bool]  # whether a row of a text, which this run couldn't measure, stays as it was


@dataclass(frozen=True)
class Row:
    """One figure for people, with the state of the code that gave it."""

    group: str
    what: str
    measured: float
    sense: str  # <= or >=; empty without a bar
    bar: float | None
    limit: float | None  # what physics allows, or the peer's figure
    unit: str
    met: bool | None  # by all digits; none without a bar
    day: str = ""  # UTC
    commit: str = ""  # two where later steps of a measurement were repeated
    experiment: str = ""
    settings: str = ""  # of the experiment, as JSON
    figure: str = ""

    @property
    def strain(self) -> float:
        """Measured over bar, or its inverse where at least the bar is asked; without a bar below zero."""
        if self.bar is None:
            return -1.0
        above, below = (self.bar, self.measured) if self.sense == ">=" else (self.measured, self.bar)
        if math.isnan(above) or math.isnan(below):
            return math.inf
        return above / below if below > 0 else (math.inf if above > below else 0.0)

    @property
    def asked(self) -> str:
        """The bar with its sense, in a cell."""
        return "" if self.bar is None else f"{self.sense} {self.bar:.4g}"


@dataclass(frozen=True)
class Chosen:
    """A row of the short table: rows in words, of which the worst is shown."""

    quantity: str
    conditions: str
    rows: tuple[str, ...]  # patterns of `GROUP WHAT`, with * and ?


def file_of(document: Path) -> Path:
    """Path of the rows of a document: `accuracy.csv` beside `accuracy.md`."""
    return document.with_suffix(".csv")


def read(path: Path) -> list[Row]:
    """Read all rows of a CSV file; none if there is no file yet.

    Raises
    ------
    InputError
        If the file isn't one that `write` has written.
    """
    if not path.exists():
        return []
    try:
        table = list(csv.reader(path.read_text(encoding="utf-8").splitlines(), strict=True))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"{path}: expected rows as CSV, found {error}") from error
    names = [field.name for field in fields(Row)][:COLUMNS]
    if not table or table[0] != names:
        raise InputError(f"{path}: line 1: expected {','.join(names)}, found {','.join(table[0]) if table else 'nothing'}")
    found = []
    for k, cells in enumerate(table[1:], start=2):
        try:
            found.append(_row_of(*cells))
        except (TypeError, ValueError, KeyError) as error:
            raise InputError(f"{path}: line {k}: expected a row of {len(names)} cells, found {','.join(cells)}") from error
    return found


def _row_of(
    group: str, what: str, measured: str, sense: str, bar: str, limit: str, unit: str, met: str, day: str, commit: str
) -> Row:
    asked, beside = (float(text) if text else None for text in (bar, limit))
    verdict = {"": None, "yes": True, "no": False}[met]
    return Row(group, what, float(measured), sense, asked, beside, unit, verdict, day, commit)


def write(path: Path, rows: Sequence[Row]) -> None:
    """Write all rows as CSV, figures by four digits as in the tables."""
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    names = [field.name for field in fields(Row)][:COLUMNS]
    table.writerow(names)
    table.writerows([_cell(getattr(row, name)) for name in names] for row in rows)
    with atomic.new_file(path) as temporary:
        temporary.write_text(text.getvalue(), encoding="utf-8")


def _cell(value: str | float | bool | None) -> str:
    if value is None or isinstance(value, str):
        return value or ""
    return ("no", "yes")[value] if isinstance(value, bool) else f"{value:.4g}"


def read_table(path: Path) -> list[Row]:
    """Read all rows of a Parquet file; none if there is no file yet; raises InputError if it is another one."""
    if not path.exists():
        return []
    try:
        return [Row(**record) for record in pq.read_table(path).to_pylist()]
    except (OSError, pa.ArrowException, TypeError) as error:
        reason = " ".join(str(error).split())
        raise InputError(f"{path}: expected results of `sonotwin accuracy`, found {reason}; another `out`?") from error


def write_table(path: Path, group: str, measured: Sequence[Row], stays: Stays = lambda what: False) -> None:
    """Replace a group's rows in a Parquet file, with all digits, but for those that stay."""
    with atomic.new_file(path) as temporary:
        records = [asdict(row) for row in renewed(read_table(path), group, measured, stays)]
        pq.write_table(pa.Table.from_pylist(records, schema=SCHEMA), temporary)


SCHEMA = pa.schema(
    (
        field.name,
        pa.bool_() if field.name == "met" else pa.float64() if field.name in ("measured", "bar", "limit") else pa.string(),
    )
    for field in fields(Row)
)


def enter(
    document: Path, choices: Sequence[Chosen], group: str, measured: Sequence[Row], stays: Stays = lambda what: False
) -> None:
    """Replace a group's rows in the file beside a document, but for those that stay, and make the document's table anew.

    The file is locked from reading to writing, so that two processes that enter different groups lose none.
    """
    path = file_of(document)
    with atomic.new_file(path) as temporary:
        rows = renewed(read(path), group, measured, stays)
        write(temporary, rows)
        document_tables.enter(document, MARK, short_table(rows, choices))


def show(document: Path, choices: Sequence[Chosen]) -> None:
    """Make a document's table anew of the file beside it, after a change of the choices."""
    document_tables.enter(document, MARK, short_table(read(file_of(document)), choices))


def renewed(rows: Sequence[Row], group: str, measured: Sequence[Row], stays: Stays = lambda what: False) -> list[Row]:
    """Rows with those of a group replaced where they stood, but for those that stay, behind the same row; a new group last."""
    place = next((k for k, row in enumerate(rows) if row.group == group), len(rows))
    before, former, new = [row for row in rows[:place] if row.group != group], "", list(measured)
    for row in (row for row in rows if row.group == group):
        if stays(row.what):
            new.insert(next((k + 1 for k, other in enumerate(new) if other.what == former), len(new) if former else 0), row)
        former = row.what
    return [*before, *new, *(row for row in rows[place:] if row.group != group)]


def read_choices(path: Path) -> list[Chosen]:
    """Read which rows a document shows: a YAML list of `quantity`, `conditions` and `rows`, a pattern or several.

    Raises
    ------
    InputError
        If an entry has other fields.
    """
    found = []
    for k, entry in enumerate(yaml_text.read(path)):
        if not isinstance(entry, dict) or set(entry) != {"quantity", "conditions", "rows"}:
            raise InputError(f"{path}: entry {k + 1}: expected quantity, conditions and rows, found {entry}")
        rows = [entry["rows"]] if isinstance(entry["rows"], str) else entry["rows"]
        found.append(Chosen(str(entry["quantity"]), str(entry["conditions"] or ""), tuple(rows)))
    return found


def chosen_rows(rows: Sequence[Row], choice: Chosen) -> list[Row]:
    """Rows that fit a choice."""
    return [row for row in rows if any(fnmatchcase(f"{row.group} {row.what}", pattern) for pattern in choice.rows)]


def short_table(rows: Sequence[Row], choices: Sequence[Chosen]) -> str:
    """The table of a document: a line a choice, missed ones first; a missed row that no choice covers has a line of its own."""
    covered = {row for choice in choices for row in chosen_rows(rows, choice)}
    choices = [*choices, *(_alone(row) for row in rows if row.met is False and row not in covered)]
    lines, missed = [], []
    for choice in choices:
        found = chosen_rows(rows, choice) if choice.rows else [row for row in rows if _alone(row) == choice]
        worst = max(found, key=lambda row: (row.met is False, row.strain), default=None)
        (missed if worst is not None and worst.met is False else lines).append(_line(choice, worst, len(found)))
    days = sorted(row.day for row in rows) or [""]
    head = f"Measured from {days[0]} to {days[-1]}; {len(rows)} rows, {sum(row.met is False for row in rows)} missed."
    names = "| quantity | conditions | measured | bar | limit | paper | met |\n|---|---|---|---|---|---|---|"
    return "\n".join([head, "", names, *missed, *lines])


def _alone(row: Row) -> Chosen:
    return Chosen(row.what, row.group, ())


def _line(choice: Chosen, row: Row | None, count: int) -> str:
    if row is None:
        return f"| {choice.quantity} | {choice.conditions} | not measured | | | | |"
    found = search(r"[(;] ?paper(?:, [\w ]+)?: ([^);]+)", row.what)
    paper = " to ".join(dict.fromkeys(found[1].split(" to "))) if found else ""  # 0.04 to 0.04 is one figure
    figure = f"{row.measured:.4g} {row.unit}".strip() + (f", worst of {count}" if count > 1 else "")
    beside = "" if row.limit is None or math.isnan(row.limit) else f"{row.limit:.4g}"
    met = {None: "", True: "yes", False: "**no**"}[row.met]
    return f"| {choice.quantity} | {choice.conditions} | {figure} | {row.asked} | {beside} | {paper} | {met} |"


def whole_table(rows: Sequence[Row], limit: str) -> str:
    """All rows as a Markdown table; `limit` heads the column of what they are compared with.

    A dash stands for words before a colon that are those of the row above.
    """
    lines = [f"| what | measured | bar | {limit} | ok |", "|---|---|---|---|---|"]
    above = ""
    for row in rows:
        about, _, figure = row.what.rpartition(": ")
        what, above = f"– {figure}" if about and about == above else row.what, about
        measured = f"{row.measured:.4g} {row.unit}".strip()
        beside = "" if row.limit is None else f"{row.limit:.4g}"
        met = {None: "", True: "yes", False: "**no**"}[row.met]
        lines.append(f"| {what} | {measured} | {row.asked} | {beside} | {met} |")
    return "\n".join(lines)
