"""The notebooks run from the first cell to the last, with the public interface alone, and are kept without results."""

import ast
import json
from pathlib import Path

import matplotlib.pyplot as plt
import pytest

FOLDER = Path(__file__).resolve().parent.parent / "docs/notebooks"
NOTEBOOKS = sorted(path.name for path in FOLDER.glob("*.ipynb"))
ALLOWED = {"sonotwin", "numpy", "matplotlib", "cv2"}  # what a newcomer has after set-up


def cells_of(name: str) -> list[dict]:
    notebook = json.loads((FOLDER / name).read_text(encoding="utf-8"))
    assert (notebook["nbformat"], notebook["nbformat_minor"]) == (4, 5)
    return notebook["cells"]


def test_there_are_some():
    assert len(NOTEBOOKS) >= 3


@pytest.mark.parametrize("name", NOTEBOOKS)
def test_a_notebook_is_kept_without_results(name):
    cells = cells_of(name)
    assert len({cell["id"] for cell in cells}) == len(cells)
    code = [cell for cell in cells if cell["cell_type"] == "code"]
    assert all(cell["outputs"] == [] and cell["execution_count"] is None for cell in code)


@pytest.mark.parametrize("name", NOTEBOOKS)
def test_a_notebook_runs_with_the_public_interface_alone(name, tmp_path, monkeypatch):
    """Its last cell asserts what its text promises."""
    monkeypatch.chdir(tmp_path)
    sources = ["".join(cell["source"]) for cell in cells_of(name) if cell["cell_type"] == "code"]
    imported = [node for node in ast.walk(ast.parse("\n".join(sources))) if isinstance(node, (ast.Import, ast.ImportFrom))]
    assert {alias.name.partition(".")[0] for node in imported for alias in node.names} <= ALLOWED
    assert "assert" in sources[-1]
    names: dict[str, object] = {}
    plt.switch_backend("agg")
    try:
        for number, source in enumerate(sources):
            exec(compile(source, f"{name}, code cell {number}", "exec"), names)
    finally:
        plt.close("all")
