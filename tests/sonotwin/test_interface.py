"""The public interface: lazy, complete, the same for Python and for type checkers, and its examples run."""

import ast
import re
import subprocess
import sys
from pathlib import Path

import pytest

import sonotwin

ROOT = Path(__file__).resolve().parents[2]
PAGE = (ROOT / "docs" / "interface.md").read_text(encoding="utf-8")
EXAMPLES = re.findall(r"^```python\n(.*?)^```", PAGE, re.MULTILINE | re.DOTALL)


def test_importing_it_imports_nothing():
    """`import sonotwin` needs no package, not even NumPy; `dir` lists the names, and another one is an AttributeError."""
    program = """
import sys
before = set(sys.modules)
import sonotwin
assert set(sonotwin.__all__) <= set(dir(sonotwin))
assert not hasattr(sonotwin, "nothing_of_the_kind")
assert sonotwin.__version__[0].isdigit() and "__version__" in dir(sonotwin)
import importlib.metadata
importlib.metadata.Distribution.discover = lambda **_: iter(())  # as in a tree that isn't installed
assert not hasattr(sonotwin, "__version__")
print(sorted({name.partition(".")[0] for name in set(sys.modules) - before} & {"numpy", "pydantic", "recon", "twin", "scenes"}))
"""
    done = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (0, "[]\n"), done.stderr


def test_the_stub_and_the_page_have_the_same_names():
    """What is imported on first use is all that type checkers read; each name stands among the signatures."""
    tree = ast.parse((ROOT / "sonotwin" / "__init__.pyi").read_text(encoding="utf-8"))
    typed = {alias.asname for node in ast.walk(tree) if isinstance(node, ast.ImportFrom) for alias in node.names}
    assert sonotwin.__all__ == sorted(typed)
    signatures = (ROOT / "docs" / "reference" / "signatures.rst").read_text(encoding="utf-8")
    assert set(re.findall(r":: sonotwin\.(\w+)", signatures)) == typed


@pytest.mark.parametrize(
    ("stub", "found"),
    [
        ('"""Names."""', "none"),
        (
            "from recon.errors import InputError as InputError\nfrom recon.rig import (\n    Rig as Rig,\n)",
            r"from .* import \(",
        ),
        ("from recon.errors import InputError", "from recon.errors import InputError$"),
    ],
)
def test_a_stub_that_was_laid_out_otherwise_loses_no_name(stub, found, tmp_path):
    """As a formatter may wrap its lines: the import says so, and names the file."""
    (tmp_path / "names.pyi").write_text(stub)
    with pytest.raises(ImportError, match=rf"names\.pyi: expected lines such as .*, found {found}"):
        sonotwin._read_places(tmp_path / "names.pyi")


@pytest.mark.parametrize("name", sonotwin.__all__)
def test_each_name_is_documented(name):
    """It can be imported, has a docstring and stands on the page."""
    assert getattr(sonotwin, name).__doc__
    assert re.search(rf"\b{name}\b", PAGE)


def test_the_examples_name_what_there_is():
    """Each function has an example, and the examples use public names alone."""
    used = {node.attr for example in EXAMPLES for node in ast.walk(ast.parse(example)) if is_of_sonotwin(node)}
    assert used <= set(sonotwin.__all__)
    functions = {name for name in sonotwin.__all__ if name[0].islower()}
    assert functions - used == {
        "read_board",
        "read_film",
        "read_calibration",
        "read_probe",
        "calibrate_target",
    }  # described beside their sisters
    modules = {alias.name for example in EXAMPLES for node in ast.walk(ast.parse(example)) for alias in imports(node)}
    assert modules == {"cv2", "numpy", "sonotwin"}


def is_of_sonotwin(node: ast.AST) -> bool:
    """Whether a node is `sonotwin.NAME`."""
    return isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "sonotwin"


def imports(node: ast.AST) -> list[ast.alias]:
    """The modules of an `import`; `from ... import` would reach inside."""
    assert not isinstance(node, ast.ImportFrom)
    return node.names if isinstance(node, ast.Import) else []


@pytest.mark.slow
def test_the_examples_run(tmp_path, monkeypatch):
    """The blocks of docs/interface.md are one program, and its assertions hold."""
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {}
    for number, example in enumerate(EXAMPLES, 1):
        exec(compile(example, f"docs/interface.md, block {number}", "exec"), names)
    assert (tmp_path / "surface.ply").is_file()
