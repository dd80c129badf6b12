"""Which package may import which: the pipeline must run on a PC that has no renderer."""

import ast
import subprocess
import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import NamedTuple

import pytest

from sonotwin import installation

ROOT = Path(__file__).resolve().parent.parent
OURS = {"recon", "scenes", "twin", "trainers", "sonotwin", "benchmarks", "campaign", "tests"}
RENDERER = {"mitsuba", "drjit"}
NEEDS = {  # parts of the requirements, as they stand in pyproject.toml
    "recon": {"core", "live"},
    "sonotwin": {"core", "train"},
    "scenes": {"core"},
    "twin": {"core", "twin", "study"},
    "trainers": {"core", "train"},
}
MAY_IMPORT = {
    "recon": {"recon"},
    "scenes": {"scenes", "recon"},
    "twin": {"twin", "scenes", "recon"} | RENDERER,
    "trainers": {"trainers", "recon"},
}
TRIES_SETS = ROOT / "twin" / "experiments" / "training_trial.py"  # by training with them, the one experiment that does


class Source(NamedTuple):
    """What these tests look at in a file."""

    imported: set[str]  # top-level names of all modules that it imports anywhere, in functions too
    compiled: dict[str, str]  # decorators of its compiled functions, by name
    called_by_kernels: set[str]


@cache
def read(path: Path) -> Source:
    """Parse a file, which takes long, once for all tests."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    imports = [node for node in statements(tree) if isinstance(node, ast.Import | ast.ImportFrom)]
    names = {alias.name for node in imports if isinstance(node, ast.Import) for alias in node.names}
    names |= {node.module or "" for node in imports if isinstance(node, ast.ImportFrom)}
    functions = [node for node in tree.body if isinstance(node, ast.FunctionDef) and node.decorator_list]
    texts = {node.name: ast.unparse(node.decorator_list[0]) for node in functions}
    kernels = [node for node in functions if texts[node.name].startswith("kernel")]
    calls = [node.func for function in kernels for node in ast.walk(function) if isinstance(node, ast.Call)]
    return Source(
        {name.partition(".")[0] for name in names},
        {name: text for name, text in texts.items() if text.startswith(("njit", "kernel"))},
        {call.id for call in calls if isinstance(call, ast.Name)},
    )


def statements(node: ast.AST) -> Iterator[ast.stmt]:
    """All statements below a node, in functions too; expressions, of which most of a file is made, hold none."""
    for part in ("body", "orelse", "finalbody", "handlers", "cases"):
        for child in getattr(node, part, []):
            if isinstance(child, ast.stmt):
                yield child
            yield from statements(child)


def modules(package: str) -> list[str]:
    """Dotted names of a package's modules."""
    paths = sorted((ROOT / package).rglob("*.py"))
    return [".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__") for path in paths]


@pytest.mark.parametrize("package", MAY_IMPORT)
def test_imports_go_one_way(package):
    forbidden = (OURS | RENDERER) - MAY_IMPORT[package]
    own = {path: read(path).imported & forbidden for path in (ROOT / package).rglob("*.py")}
    assert {str(path): bad for path, bad in own.items() if bad} == ({str(TRIES_SETS): {"trainers"}} if package == "twin" else {})


@pytest.mark.parametrize("package", NEEDS)
def test_what_is_imported_is_required(package):
    """A package of the development tools alone is missing where `make demo` has set up."""
    files = (ROOT / package).rglob("*.py")
    foreign = {name for path in files for name in read(path).imported} - OURS - set(sys.stdlib_module_names)
    assert not {name for name in foreign if installation.extra_of(name) not in NEEDS[package]}


def test_recon_runs_where_the_rest_is_missing():
    """Every module of recon is imported by a Python that refuses the others, whoever asks for them."""
    blocked = sorted((OURS - {"recon"}) | RENDERER | {"torch"})
    program = f"""
import importlib, sys
class Refuse:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {blocked}:
            raise ImportError("refused: " + name)
sys.meta_path.insert(0, Refuse())
for name in {modules("recon")}:
    importlib.import_module(name)
print("imported")
"""
    done = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (0, "imported\n"), done.stderr


def test_help_imports_nothing_heavy():
    """`sonotwin --help` and the help of a verb come without numpy, Mitsuba or what takes long to import."""
    program = """
import sys
from sonotwin.cli import main
assert main(["--help"]) == 0 and main(["doctor", "--help"]) == 0
print(sorted({"numpy", "scipy", "cv2", "numba", "rich", "mitsuba", "drjit", "hydra"} & set(sys.modules)))
"""
    done = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.stdout.splitlines()[-1] == "[]", done.stderr


def test_no_drawers():
    """A module is a topic, and a drawer called utils is none."""
    paths = [path for package in OURS - {"tests", "benchmarks"} for path in (ROOT / package).rglob("*.py")]
    assert not [path for path in paths if path.stem in ("utils", "util", "common", "misc", "base", "helpers")]


def test_kernels_call_inlined_functions_and_kernels():
    """A plain compiled function takes options, such as whether references are counted, from whoever compiles it first."""
    paths = [path for package in ("recon", "twin", "scenes") for path in (ROOT / package).rglob("*.py")]
    plain = {
        name
        for path in paths
        for name, text in read(path).compiled.items()
        if text.startswith("njit") and "inline='always'" not in text and "forceinline" not in text
    }
    offences = {str(path): bad for path in paths if (bad := read(path).called_by_kernels & plain)}
    assert not offences
    assert any(read(path).called_by_kernels for path in paths)
