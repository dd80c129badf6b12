"""Parts of the site that show what is promised and what shows that it holds: requirements and their trace, SOUP, anomalies.

They are made of docs/requirements.yaml, soup.yaml, accuracy.csv and trust.md, of pyproject.toml, constraints.txt and the tests.
"""

import ast
import re
import tomllib
from collections.abc import Sequence
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import NamedTuple

from docutils import nodes
from packaging.requirements import Requirement as Needed
from packaging.utils import canonicalize_name
from pydantic import BaseModel, ConfigDict, Field
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective, SphinxRole

from recon.files import yaml_text
from twin.experiments import result_rows
from twin.experiments.result_rows import Chosen, Row

ROOT = Path(__file__).resolve().parent.parent
RUNNING = ("core", "twin", "study", "live", "train")  # extras of pyproject.toml that run with us; dev and docs are tools
NAMES = {"core": "always", "twin": "with the twin", "study": "for studies", "live": "at the live rig", "train": "for training"}


class Requirement(BaseModel):
    """An entry of docs/requirements.yaml."""

    model_config = ConfigDict(extra="forbid")

    requirement: str
    risk: str
    tests: tuple[str, ...] = Field(min_length=1)
    rows: dict[str, int] = Field(default_factory=dict)
    readme: tuple[str, ...] = ()


class Soup(BaseModel):
    """An entry of docs/soup.yaml: software of unknown provenance that runs with ours."""

    model_config = ConfigDict(extra="forbid")

    maker: str
    licence: str
    purpose: str
    anomalies: str
    known: str = ""


class Test(NamedTuple):
    """What a test's source says of when it runs."""

    slow: bool
    recorded: bool  # on recordings of others, else it is skipped


@cache
def requirements() -> dict[str, dict[str, Requirement]]:
    """Requirements by group and name."""
    groups = yaml_text.read(ROOT / "docs" / "requirements.yaml")
    return {group: {name: Requirement(**entry) for name, entry in entries.items()} for group, entries in groups.items()}


@cache
def soup() -> dict[str, Soup]:
    """What is said of each direct dependency that runs with us."""
    return {name: Soup(**entry) for name, entry in yaml_text.read(ROOT / "docs" / "soup.yaml").items()}


@cache
def rows() -> tuple[Row, ...]:
    """All rows of docs/accuracy.csv."""
    return tuple(result_rows.read(ROOT / "docs" / "accuracy.csv"))


def rows_of(*patterns: str) -> list[Row]:
    """Rows whose `GROUP WHAT` fits a pattern."""
    return result_rows.chosen_rows(rows(), Chosen("", "", patterns))


@cache
def tests_of(path: str) -> dict[str, Test]:
    """The tests of a file, read from its source."""
    module = ast.parse((ROOT / path).read_text(encoding="utf-8"))
    marks = [ast.unparse(part) for part in module.body if isinstance(part, ast.Assign)]
    all_slow = any(text.startswith("pytestmark") and "slow" in text for text in marks)
    return {
        part.name: Test(
            all_slow or any("mark.slow" in ast.unparse(mark) for mark in part.decorator_list),
            "real" in {argument.arg for argument in part.args.args},
        )
        for part in module.body
        if isinstance(part, ast.FunctionDef) and part.name.startswith("test_")
    }


class Figure(NamedTuple):
    """A figure in words, and where it stands."""

    words: str
    source: str


def versions() -> dict[str, str]:
    """Exact versions of constraints.txt, by name."""
    text = (ROOT / "constraints.txt").read_text(encoding="utf-8")
    return {canonicalize_name(name): version for name, version in re.findall(r"^([\w.-]+)==(\S+)", text, re.MULTILINE)}


def direct() -> dict[str, str]:
    """Direct dependencies that run with us, each with the first extra that needs it, in the order of pyproject.toml."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    extras = {"core": project["dependencies"], **project["optional-dependencies"]}
    found: dict[str, str] = {}
    for extra in RUNNING:
        for line in extras[extra]:
            found.setdefault(canonicalize_name(Needed(line).name), extra)
    return found


def measured(patterns: str) -> Figure:
    """The worst of the rows that fit patterns, parted by `;`: `1.069 sigma (at most 1.182 asked; worst of 2)`.

    Raises
    ------
    ValueError
        If no row fits, or several that nothing is asked of.
    """
    found = rows_of(*(pattern.strip() for pattern in patterns.split(";")))
    judged = [row for row in found if row.bar is not None]
    if not judged and len(found) != 1:
        raise ValueError(f"{patterns}: expected rows of docs/accuracy.csv with a bar, or one row, found {len(found)} without")
    worst = max(judged or found, key=lambda row: (row.met is False, row.strain))
    missed = sum(row.met is False for row in judged)
    said = [f"{ {'<=': 'at most', '>=': 'at least'}[worst.sense] } {worst.bar:.4g} asked"] if worst.bar is not None else []
    said += [f"worst of {len(judged)}"] if len(judged) > 1 else []
    said += ["missed" if len(judged) == 1 else f"{missed} missed"] if missed else []
    figure = f"{worst.measured:.4g} {worst.unit}".strip()
    source = f"{worst.group} {worst.what}; measured {worst.day} at {worst.commit}"
    return Figure(f"{figure} ({'; '.join(said)})" if said else figure, source)


def campaign(figure: str) -> Figure:
    """A figure of the campaign's tables in docs/trust.md, by its table's mark and column, as `mistakes: warned of`: `98 of 500`.

    Raises
    ------
    ValueError
        If there is no such table, column or row of all.
    """
    mark, _, column = figure.partition(": ")
    page = (ROOT / "docs" / "trust.md").read_text(encoding="utf-8")
    place = re.search(rf"<!-- {mark} -->(.*?)<!-- /{mark} -->", page, re.DOTALL)
    table = [line.strip("| ").split(" | ") for line in (place[1] if place else "").splitlines() if line.startswith("| ")]
    whole = [cells for cells in table if cells[0].split()[0] == "all"]
    if not whole or column not in table[0]:
        raise ValueError(f"{figure}: expected a table of docs/trust.md with that column and a row of all, found none")
    return Figure(f"{whole[0][table[0].index(column)]} of {whole[0][1]}", f"docs/trust.md, {mark}: {column}")


def _cells(*cells: str) -> str:
    return f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in cells)} |"


def _plain(text: str) -> str:
    return re.sub(r"([\\`*_<\[])", r"\\\1", text)


def _table(heads: Sequence[str], lines: Sequence[Sequence[str]]) -> list[str]:
    return [_cells(*heads), "|" + "---|" * len(heads), *(_cells(*line) for line in lines), ""]


def trace_sections() -> dict[str, str]:
    """Requirements with their risks, tests and figures, in MyST: what is missed, then each by its group."""
    everyone = {name: entry for entries in requirements().values() for name, entry in entries.items()}
    sections = {"At a glance": _glance(everyone)}
    for group, entries in requirements().items():
        text: list[str] = []
        for name, entry in entries.items():
            found, missed = _missed(entry)
            verdict = f" **Missed by {missed} of {found} rows.**" if missed else ""
            text += [f"({name.lower()})=", f"**{name}** {entry.requirement}{verdict}", "", f"*Risk:* {entry.risk}", ""]
            text += [f"*README:* {'; '.join(entry.readme)}", ""] * bool(entry.readme)
            text += [f"- `{node}`{_when(_test(node))}" for node in entry.tests] + [""]
            if entry.rows:
                text += _table(("rows of accuracy", "worst"), [(f"`{pattern}`", _worst(pattern)) for pattern in entry.rows])
        sections[group] = "\n".join(text)
    return sections


def _glance(entries: dict[str, Requirement]) -> str:
    tests = {node: _test(node) for entry in entries.values() for node in entry.tests}
    slow, recorded = sum(test.slow for test in tests.values()), sum(test.recorded for test in tests.values())
    traced = len({(row.group, row.what) for entry in entries.values() for row in rows_of(*entry.rows)})
    ratios = {name: _missed(entry) for name, entry in entries.items()}
    missed = [f"{_link(name)} {lost} of {found}" for name, (found, lost) in ratios.items() if lost]
    alone = [_link(name) for name, entry in entries.items() if not entry.rows]
    counted = f"{len(tests)} tests ({slow} slow, {recorded} on recordings of others)"
    return (
        f"{len(entries)} requirements, {counted}, {traced} of {len(rows())} rows of accuracy, all that have a bar among them.\n\n"
        f"Missed by rows: {', '.join(missed)}.\n\nBy tests alone, without a row: {', '.join(alone)}.\n"
    )


def _missed(entry: Requirement) -> tuple[int, int]:
    found = rows_of(*entry.rows)
    return len(found), sum(row.met is False for row in found)


def _link(name: str) -> str:
    return f"[{name}](#{name.lower()})"


def _test(node: str) -> Test:
    path, _, name = node.partition("::")
    return tests_of(path)[name]


def _when(test: Test) -> str:
    words = ["slow"] * test.slow + ["needs recordings of others"] * test.recorded
    return f" ({', '.join(words)})" if words else ""


def _worst(pattern: str) -> str:
    found = rows_of(pattern)
    if any(row.bar is not None for row in found) or len(found) == 1:
        return measured(pattern).words
    return f"{len(found)} rows, nothing asked"


def soup_sections() -> dict[str, str]:
    """Software of others that runs with ours, in MyST: direct dependencies by when they are needed, then the others."""
    pinned, said, needed = versions(), soup(), direct()
    sections = {}
    for extra in RUNNING:
        lines = []
        for name in (name for name, first in needed.items() if first == extra):
            entry = said[name]
            purpose = f"{entry.purpose}. *Known here:* {entry.known}" if entry.known else entry.purpose
            lines.append((f"{name} {pinned[name]}", entry.maker, entry.licence, purpose, f"[list]({entry.anomalies})"))
        heads = ("name and version", "maker", "licence", "used for", "anomalies")
        sections[f"Needed {NAMES[extra]}"] = "\n".join(_table(heads, lines))
    others = [(name, version, _licence(name)) for name, version in pinned.items() if name not in needed]
    sections["What these need, and tools"] = "\n".join(_table(("name", "version", "licence, by itself"), others))
    return sections


def _licence(name: str) -> str:
    try:
        told = metadata.metadata(name)
    except metadata.PackageNotFoundError:
        return "not installed where this page was made"
    classified = [text.rpartition(" :: ")[2] for text in told.get_all("Classifier") or () if text.startswith("License ::")]
    text = told.get("License-Expression") or ", ".join(classified) or (told.get("License") or "").strip()
    return _plain(text) if text and "\n" not in text else "see its files"


def anomaly_sections() -> dict[str, str]:
    """Missed rows of docs/accuracy.csv with the requirements that they concern, in MyST."""
    traced = {
        name: {(row.group, row.what) for row in rows_of(*entry.rows)}
        for entries in requirements().values()
        for name, entry in entries.items()
    }
    lines = []
    for row in (row for row in rows() if row.met is False):
        concerned = [_link(name) for name, keys in traced.items() if (row.group, row.what) in keys]
        figure = f"{row.measured:.4g} {row.unit}".strip()
        lines.append(
            (
                f"{row.group}: {_plain(row.what)}",
                figure,
                row.asked.replace("<", r"\<"),
                ", ".join(concerned),
                f"{row.day}, {row.commit}",
            )
        )
    return {"Missed bars": "\n".join(_table(("row", "measured", "asked", "concerns", "measured on"), lines))}


SECTIONS = {"requirements-trace": trace_sections, "soup": soup_sections, "anomalies": anomaly_sections}
FIGURES = {"measured": measured, "campaign": campaign}


class Made(SphinxDirective):
    """Sections of a page that a function writes in MyST; MyST itself puts headings of a part at the page's end."""

    def run(self) -> list[nodes.Node]:
        """Write it anew at each build."""
        self.env.note_reread()
        sections: list[nodes.Node] = []
        for title, text in SECTIONS[self.name]().items():
            name = nodes.make_id(title)
            sections.append(nodes.section("", nodes.title(text=title), *self.parse_text_to_nodes(text), ids=[name], names=[name]))
        return sections


class Looked(SphinxRole):
    """A figure or a requirement, looked up at each build."""

    def run(self) -> tuple[list[nodes.Node], list[nodes.system_message]]:
        """Look it up; what isn't there is an error of the build."""
        self.env.note_reread()
        try:
            if self.name in FIGURES:
                words, source = FIGURES[self.name](self.text)
                return [nodes.abbreviation("", words, explanation=source)], []
            if not any(self.text in entries for entries in requirements().values()):
                raise ValueError(f"{self.text}: expected a requirement of docs/requirements.yaml, found none")
        except ValueError as error:
            return [], [self.inliner.reporter.error(str(error), line=self.lineno)]
        return [nodes.reference("", self.text, refuri=f"lifecycle.html#{self.text.lower()}", internal=True)], []


def connect(app: Sphinx) -> None:
    """Give pages the directives and roles above."""
    for name in SECTIONS:
        app.add_directive(name, Made)
    for name in (*FIGURES, "requirement"):
        app.add_role(name, Looked())
