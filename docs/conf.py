"""Settings of the documentation site: Sphinx reads the pages of the root folder and docs/; `make docs` builds it.

The source folder is the repository's root, so that links between these pages are the same on the site and on a forge.
"""

import inspect
import logging
import re
import sys
from collections.abc import Callable
from functools import cache
from importlib import metadata
from pathlib import Path

from docutils import nodes
from docutils.utils.math.latex2mathml import tex2mathml
from sphinx import addnodes
from sphinx.application import Sphinx
from sphinx.domains.python import ObjectEntry, PythonDomain

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT), str(ROOT / "docs")]  # the packages beside these pages, whatever is installed

project = "sonotwin"
author = "The sonotwin authors"
version = release = metadata.version("sonotwin")
root_doc = "docs/index"
include_patterns = ["README.md", "CHANGELOG.md", "CONTRIBUTING.md", "SECURITY.md", "docs/**"]
exclude_patterns = [".*", "build", "dist", "outputs", "tests", "docs/site"]

extensions = ["myst_parser", "sphinx.ext.apidoc", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
myst_enable_extensions = ["dollarmath"]
myst_heading_anchors = 4  # as forges have them
html_theme = "furo"
html_title = "sonotwin"
html_extra_path = ["site"]  # index.html, which leads to the front page
html_math_renderer = "mathml"
html_show_copyright = False
html_copy_source = False

autodoc_member_order = "bysource"
autodoc_typehints_format = "short"
autodoc_default_options = {
    "members": True,
    "undoc-members": False,
    "exclude-members": "model_config, model_post_init",
    "ignore-module-all": True,  # the public names stand on the page of signatures, not again on their package's
}
suppress_warnings = ["ref.python"]  # a docstring's short name, such as Noise, may be that of several classes: then it is no link
autodoc_preserve_defaults = True
autodoc_use_type_comments = False  # there are none, and each function's source would be parsed for them
napoleon_google_docstring = False
napoleon_use_rtype = False
napoleon_use_ivar = True
apidoc_module_first = True
apidoc_automodule_options = {"members", "show-inheritance"}
apidoc_modules = [  # a page a package, made anew at each build
    {"path": f"../{package}", "destination": f"docs/reference/packages/{package}", "max_depth": 2}
    for package in ("recon", "scenes", "twin", "trainers", "sonotwin")
]

ARRAY = re.compile(r"~?(?:numpy\.)?ndarray\[tuple\[[~\w.]*Any, \.\.\.\], ~?(?:numpy\.)?dtype\[(?:[^\[\]]|\[[^\]]*\])*\]\]")
ARRAY_LIKE = re.compile(r"~?(?:[\w.]+\.)?_Buffer \| .*?_NestedSequence\[~?(?:builtins\.)?complex \| bytes \| str\]")
SECTION = re.compile(r"^-{3,}$")


def as_rst(app: Sphinx, what: str, name: str, found: object, options: object, lines: list[str]) -> None:
    """Turn a docstring's plain text into reStructuredText: `code`, literal asterisks and bars, indented blocks as they stand."""
    sections = next((k - 1 for k, line in enumerate(lines) if SECTION.match(line.strip())), len(lines))
    text: list[str] = []
    for k, line in enumerate(lines):
        indented = line.startswith(" ") and line.strip()
        if k < sections and indented and text and (not text[-1].strip() or not text[-1].startswith(" ")):
            text += ["", "::", "", line] if not text[-1].startswith(" ") else [line]
        elif k < sections and indented:
            text.append(line)
        else:
            if k < sections and line.strip() and text and text[-1].startswith(" "):
                text.append("")
            text.append(_escaped(line))
    if what in ("attribute", "property") and text:
        text[0] = text[0].replace(" : ", ", ")  # napoleon would take the words before for a type
    lines[:] = text


def _escaped(line: str) -> str:
    parts = re.split(r"(`[^`]*`)", line)
    for k, part in enumerate(parts):
        if k % 2:
            parts[k] = f"`{part}`"
        else:
            parts[k] = re.sub(r"([*|`])|(?<=\w)(_)(?!\w)", lambda match: f"\\{match[0]}", part)
    return "".join(parts)


def imported(app: Sphinx, what: str, name: str, found: object, skipped: bool, options: object) -> bool | None:
    """Skip what a module imports: autodoc leaves it out, too, but has read its signature and source by then, for each module."""
    module = app.env.current_document.autodoc_module
    of_others = (inspect.isclass(found) or inspect.isfunction(found)) and found.__module__ not in (None, module)
    return True if what == "module" and of_others else None


def short_types(app: Sphinx, what: str, name: str, found: object, options: object, signature: str, returned: str) -> tuple:
    """Write NumPy's long array types as Array and ArrayLike."""
    short = (None if text is None else ARRAY_LIKE.sub("ArrayLike", ARRAY.sub("Array", text)) for text in (signature, returned))
    return tuple(short)


def mathml(formula: str, block: bool) -> str:
    """Turn LaTeX into MathML; docutils lacks two commands, which change only sizes and dots."""
    return tex2mathml(re.sub(r"\\[bB]ig(?![a-zA-Z])", "", formula).replace(r"\dots", r"\ldots"), as_block=block)


def inline_math(translator: nodes.NodeVisitor, node: nodes.math) -> None:
    """Write a formula as MathML, which browsers show without a script or a network."""
    translator.body.append(mathml(node.astext(), False))
    raise nodes.SkipNode


def block_math(translator: nodes.NodeVisitor, node: nodes.math_block) -> None:
    """Write a displayed formula as MathML."""
    translator.body.append(f'<div class="math">{mathml(node.astext(), True)}</div>\n')
    raise nodes.SkipNode


class ShortNames(PythonDomain):
    """Python's domain, which looks for a name among those that end alike: among all of them it took half of the build."""

    _by_end: dict[str, dict[str, ObjectEntry]] | None = None
    _alike: dict[str, ObjectEntry] | None = None

    @property
    def objects(self) -> dict[str, ObjectEntry]:
        """All names, or while one is looked for, those that end as it does."""
        return super().objects if self._alike is None else self._alike

    def find_obj(self, env: object, modname: str, classname: str, name: str, *more: object) -> list[tuple[str, ObjectEntry]]:
        """As Sphinx' own."""
        if self._by_end is None:  # pages are read before the first name is looked for
            self._by_end = {}
            for whole, entry in self.objects.items():
                self._by_end.setdefault(whole.rpartition(".")[2], {})[whole] = entry
        self._alike = self._by_end.get(name.removesuffix("()").rpartition(".")[2], {})
        try:
            return super().find_obj(env, modname, classname, name, *more)
        finally:
            self._alike = None


@cache
def titles(app: Sphinx) -> dict[str, nodes.bullet_list]:
    """Tables of contents of all pages, which are read by then, without what is on the pages: titles and pages below them."""
    found = {page: contents.deepcopy() for page, contents in app.env.tocs.items()}
    for entry in (entry for contents in found.values() for entry in contents if len(entry) > 1):
        if pages := list(entry.findall(addnodes.toctree)):
            entry[1][:] = pages
        else:
            entry.pop(1)
    return found


def tree_of_titles(app: Sphinx, page: str, template: str, context: dict, document: nodes.document | None) -> None:
    """Make a page's tree of all pages from their titles: Sphinx copies all that is on them, then drops it, for each page anew."""
    whole: Callable[..., str] = context["toctree"]

    def tree(**options: object) -> str:
        kept = app.env.tocs
        app.env.tocs = titles(app) if options.get("titles_only") else kept
        try:
            return whole(**options)
        finally:
            app.env.tocs = kept

    context["toctree"] = tree


def setup(app: Sphinx) -> None:
    """Connect the steps above."""
    import evidence_pages  # of this folder
    import site_pages

    logging.getLogger("sphinx").setLevel(logging.INFO)  # else a record for each of a quarter of a million events
    inspect.getsource = cache(inspect.getsource)  # autodoc looks for each default's text in it, and parses a class's whole file
    app.add_domain(ShortNames, override=True)
    app.add_directive("accuracy-rows", site_pages.AccuracyRows)
    app.add_directive("rooms", site_pages.Rooms)
    evidence_pages.connect(app)
    app.connect("autodoc-process-docstring", as_rst, priority=100)  # before napoleon
    app.connect("autodoc-skip-member", imported)
    app.connect("autodoc-process-signature", short_types)
    app.connect("html-page-context", tree_of_titles, priority=100)  # before the theme draws the tree
    app.add_html_math_renderer("mathml", (inline_math, None), (block_math, None))
