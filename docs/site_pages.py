"""Parts of the site that are made of files: rows of accuracy that a reader filters, and the list of modules.

`.venv/bin/python docs/site_pages.py` makes the table of docs/accuracy.md anew, after a change of conf/bars/accuracy.yaml.
"""

import ast
import html
from collections.abc import Sequence
from pathlib import Path

from docutils import nodes
from docutils.parsers.rst import Directive

from sonotwin.verbs import accuracy
from twin.experiments import result_rows
from twin.experiments.result_rows import Row

ROOT = Path(__file__).resolve().parent.parent
HEADS = ("group", "what", "measured", "bar", "limit", "unit", "met", "measured on", "commit")
SCRIPT = """
const rows = [...document.querySelectorAll("#rows tbody tr")];
const [text, group, missed, count] = ["text", "group", "missed", "count"].map(id => document.getElementById(id));
function filter() {
  const words = text.value.toLowerCase().split(/\\s+/);
  for (const row of rows) {
    const all = row.textContent.toLowerCase();
    row.hidden = !words.every(word => all.includes(word)) || (group.value && row.dataset.group !== group.value)
      || (missed.checked && row.dataset.met !== "no");
  }
  count.textContent = rows.filter(row => !row.hidden).length + " of " + rows.length;
}
for (const field of [text, group, missed]) field.addEventListener("input", filter);
filter();
"""


def rows_page(rows: Sequence[Row]) -> str:
    """All rows as an HTML table with a search, a choice of the group and one of missed rows."""
    groups = "".join(f"<option>{group}</option>" for group in dict.fromkeys(row.group for row in rows))
    fields = (
        '<p><input id="text" type="search" placeholder="words"> '
        f'<select id="group"><option value="">all groups</option>{groups}</select> '
        '<label><input id="missed" type="checkbox"> missed</label> <span id="count"></span></p>'
    )
    head = "".join(f"<th>{name}</th>" for name in HEADS)
    body = "\n".join(_html_row(row) for row in rows)
    table = f'<table id="rows"><thead><tr>{head}</tr></thead><tbody>\n{body}\n</tbody></table>'
    return f'{fields}\n<div class="table-wrapper">{table}</div>\n<script>{SCRIPT}</script>'


def _html_row(row: Row) -> str:
    bar = "" if row.bar is None else f"{row.sense} {row.bar:.4g}"
    limit = "" if row.limit is None else f"{row.limit:.4g}"
    met = {None: "", True: "yes", False: "no"}[row.met]
    cells = (row.group, row.what, f"{row.measured:.4g}", bar, limit, row.unit, met, row.day, row.commit)
    return f'<tr data-group="{row.group}" data-met="{met}">{"".join(f"<td>{html.escape(cell)}</td>" for cell in cells)}</tr>'


def rooms(package: str) -> dict[str, dict[str, str]]:
    """Folders of a package, each with its modules and the first sentence of their docstrings; `.` is the folder's own."""
    found: dict[str, dict[str, str]] = {}
    for path in sorted((ROOT / package).rglob("*.py")):
        text = ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or ""
        name = "." if path.stem == "__init__" else path.stem
        found.setdefault(path.parent.relative_to(ROOT).as_posix(), {})[name] = sentence(text)
    return dict(sorted(found.items()))


def sentence(docstring: str) -> str:
    """The first sentence, in one line."""
    first = " ".join(docstring.split("\n\n")[0].split())
    end = first.find(". ")
    return first if end < 0 else first[: end + 1]


class AccuracyRows(Directive):
    """`.. accuracy-rows:: FILE`: its rows, to be filtered."""

    required_arguments = 1

    def run(self) -> list[nodes.Node]:
        """Read the file beside the page."""
        environment = self.state.document.settings.env
        path = Path(environment.doc2path(environment.docname)).parent / self.arguments[0]
        environment.note_dependency(str(path))
        return [nodes.raw("", rows_page(result_rows.read(path)), format="html")]


class Rooms(Directive):
    """`.. rooms:: PACKAGE ...`: a section a package, a list a folder."""

    required_arguments = 1
    final_argument_whitespace = True

    def run(self) -> list[nodes.Node]:
        """Read the docstrings."""
        self.state.document.settings.env.note_reread()
        return [self._section(package) for package in self.arguments[0].split()]

    def _section(self, package: str) -> nodes.section:
        section = nodes.section(ids=[f"rooms-{package}"], names=[f"rooms-{package}"])
        section += nodes.title(text=package)
        for folder, modules in rooms(package).items():
            section += nodes.paragraph("", "", nodes.strong(text=folder), nodes.Text(f": {modules.pop('.', '')}"))
            listed = nodes.bullet_list()
            for name, says in modules.items():
                listed += nodes.list_item("", nodes.paragraph("", "", nodes.literal(text=name), nodes.Text(f": {says}")))
            section += listed
        return section


if __name__ == "__main__":
    result_rows.show(ROOT / "docs" / "accuracy.md", accuracy.choices())
