"""The documentation: links and anchors lead somewhere, the list of modules is complete; `make docs` builds the site."""

import re
import shlex
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path

import pytest

from sonotwin import config
from twin.experiments import result_rows

ROOT = Path(__file__).resolve().parent.parent
PAGES = [
    *(ROOT / name for name in ("README.md", "CONTRIBUTING.md", "SECURITY.md", "CHANGELOG.md")),
    *sorted((ROOT / "docs").glob("*.md")),
    *sorted((ROOT / "docs" / "users").glob("*.md")),
]
PACKAGES = ("recon", "scenes", "twin", "trainers", "sonotwin")


def anchors(page: Path) -> set[str]:
    """The anchors that a forge gives a page's headings."""
    text = re.sub(r"^(```|~~~).*?^\1", "", page.read_text(encoding="utf-8"), flags=re.MULTILINE | re.DOTALL)
    titles = re.findall(r"^#+ (.*)$", text, re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", title.lower()).strip().replace(" ", "-") for title in titles}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_and_anchors_lead_somewhere(page):
    """Every relative link names a file, and what follows `#` is a heading of that page."""
    text = re.sub(r"^(```|~~~).*?^\1", "", page.read_text(encoding="utf-8"), flags=re.MULTILINE | re.DOTALL)
    for target in re.findall(r"\]\(([^)\s]+)[^)]*\)", text):
        if re.match(r"https?:|mailto:", target):
            continue
        path, _, anchor = target.partition("#")
        there = page if not path else (page.parent / path).resolve()
        assert there.exists(), target
        assert not anchor or anchor in anchors(there), f"{target}: no such heading, but {sorted(anchors(there))}"


def test_every_page_is_on_the_site():
    """A page that no table of contents names is found by nobody."""
    listed = set(re.findall(r"^   (\S+)$", (ROOT / "docs" / "index.rst").read_text(encoding="utf-8"), re.MULTILINE))
    for page in PAGES:
        name = page.relative_to(ROOT / "docs") if page.is_relative_to(ROOT / "docs") else Path("/") / page.name
        assert str(name.with_suffix("")) in listed, page.name


@pytest.fixture
def site_pages(monkeypatch):
    """docs/site_pages.py, which makes parts of the site."""
    pytest.importorskip("sphinx")
    monkeypatch.syspath_prepend(str(ROOT / "docs"))
    return import_module("site_pages")


@pytest.mark.parametrize("package", PACKAGES)
def test_the_rooms_name_every_module(package, site_pages):
    """Each folder and module is on the site's list by a sentence of its docstring, in one line."""
    rooms = site_pages.rooms(package)
    named = {f"{folder}/{name}" for folder, modules in rooms.items() for name in modules if name != "."}
    paths = {path.relative_to(ROOT).with_suffix("").as_posix() for path in (ROOT / package).rglob("*.py")}
    assert named == {path for path in paths if not path.endswith("__init__")}
    assert not [(folder, name) for folder, modules in rooms.items() for name, says in modules.items() if not 10 < len(says) < 300]


def test_the_page_of_rows_has_each_row(site_pages):
    """Text is escaped; a browser finds group and verdict in the row."""
    rows = result_rows.read(ROOT / "docs" / "accuracy.csv")
    page = site_pages.rows_page(rows)
    assert page.count("<tr data-group=") == len(rows) and page.count('data-met="no"') == sum(row.met is False for row in rows)
    assert "<td>&lt;= 0.05</td>" in page and all(f"<option>{row.group}</option>" in page for row in rows)


@pytest.mark.parametrize("page", [page for page in PAGES if page.name != "CHANGELOG.md"], ids=lambda page: page.name)
def test_files_and_modules_that_pages_name_exist(page):
    """Paths such as `recon/model/rig.py` and dotted names such as `recon.model.rig` are those of today."""
    text = page.read_text(encoding="utf-8")
    for path in re.findall(rf"\b((?:{'|'.join(PACKAGES)}|benchmarks|conf|tests)/[\w/]+\.(?:py|yaml))\b", text):
        if not re.search(r"NAME|GROUP|VERB", path):
            assert (ROOT / path).is_file(), path
    for name in re.findall(rf"\b((?:{'|'.join(PACKAGES)})(?:\.[a-z_0-9]+)+)\b", text):
        parts = name.split(".")
        if parts[-1] in ("md", "py", "svg", "yaml", "json"):
            continue
        while len(parts) > 1 and not ((ROOT / Path(*parts)).is_dir() or (ROOT / Path(*parts)).with_suffix(".py").is_file()):
            parts.pop()  # a function or class of a module
        folder = ROOT / Path(*parts)
        rest = name.split(".")[len(parts) :]
        files = [folder / "__init__.py", folder / "__init__.pyi"] if folder.is_dir() else [folder.with_suffix(".py")]
        text_of_code = "".join(file.read_text(encoding="utf-8") for file in files if file.is_file())
        known = all(re.search(rf"\b{re.escape(part)}\b", text_of_code) for part in rest)
        assert known or not rest, name


def test_the_python_blocks_import_modules_of_today():
    """`from recon... import ...` in the pages' examples."""
    for page in PAGES:
        blocks = re.findall(r"^ *```python\n(.*?)^ *```", page.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL)
        for module, names in re.findall(r"^ *from ([\w.]+) import ([\w, ]+)", "".join(blocks), re.MULTILINE):
            if module.split(".")[0] in PACKAGES:
                place = find_spec(module)
                assert place is not None and place.origin is not None, f"{page.name}: {module}"
                text = Path(place.origin).read_text(encoding="utf-8")
                for name in re.split(r", *", names.split(" as ")[0]):
                    inside = Path(place.origin).parent / f"{name}.py"
                    assert re.search(rf"\b{name}\b", text) or inside.is_file(), f"{page.name}: {module}.{name}"


@pytest.mark.parametrize("page", sorted((ROOT / "docs" / "users").glob("*.md")), ids=lambda page: page.name)
def test_users_pages_name_verbs_and_fields_that_exist(page):
    """Each command of the pages for the four kinds of users is composed, though not run."""
    text = page.read_text(encoding="utf-8")
    commands = re.findall(r"^ *sonotwin ([a-z].*)$", text, re.MULTILINE) + re.findall(r"`sonotwin ([a-z][^`]*=[^`]*)`", text)
    for command in commands:
        verb, *fields = shlex.split(command.replace("FOLDER", "folder"))
        config.compose(verb, fields)  # raises on an unknown key, and on a field that needs a value


def test_diagrams_are_those_of_the_program(monkeypatch):
    """docs/images/*.svg are what docs/diagrams.py draws: who changes one has changed the other."""
    monkeypatch.syspath_prepend(str(ROOT / "docs"))
    diagrams = import_module("diagrams")
    for name, (boxes, arrows) in diagrams.DIAGRAMS.items():
        assert (ROOT / "docs" / "images" / f"{name}.svg").read_text(encoding="utf-8") == diagrams.svg(boxes, arrows), name
