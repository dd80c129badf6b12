"""What the pages tell a reader to run does run, and what they link to is there."""

import re
import shutil
from pathlib import Path

import pytest

from sonotwin.cli import VERBS, main

ROOT = Path(__file__).resolve().parent.parent
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]


def commands(page: Path) -> list[list[str]]:
    """The `sonotwin` commands in a page's code blocks, without the program's name."""
    blocks = re.findall(r"^```\w*\n(.*?)^```", page.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL)
    return [line.split()[1:] for block in blocks for line in block.splitlines() if re.match("sonotwin [a-z]", line)]


def test_the_readme_runs(tmp_path, monkeypatch):
    """Its recipes, one after the other, on images like those that a reader would have."""
    monkeypatch.chdir(tmp_path)
    assert main(["render", "engine.samples=2", "out=made"]) == 0
    shutil.copytree("made/capture/surface/cam1", "shots")
    shutil.copy("made/capture/calibration/optics.yaml", "optics.yaml")
    recipes = commands(ROOT / "README.md")
    assert len(recipes) >= 5
    few = {  # rays, poses and frames: as they stand the recipes take ten minutes
        "demo": ["poses.count=3", "film_frames=0", "engine.samples=2"],
        "render": ["engine.samples=2"],
        "film": ["frames=6"],
        "sweep": ["path.speed_mm_s=80"],
    }
    assert main(["demo", *few["demo"], "scene=sphere", "out=demo"]) == 0  # the board's images lie where a reader's would
    for recipe in recipes:
        assert main([*recipe, *few.get(recipe[0], [])]) == 0, recipe
    assert Path("outputs/sphere/surface/evaluation/metrics.json").is_file()


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_lead_somewhere(page):
    """Every relative link of a page names a file of the repository."""
    for target in re.findall(r"\]\(([^)#\s]+)[^)]*\)", page.read_text(encoding="utf-8")):
        if not target.startswith("http"):
            assert (page.parent / target).exists(), target


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_commands_name_verbs_that_exist(page):
    """No page shows a verb that the command doesn't have."""
    assert {command[0] for command in commands(page)} <= {verb.name for verb in VERBS}


def test_make_targets_exist():
    """The make targets that the pages name are in the Makefile."""
    text = "".join(page.read_text(encoding="utf-8") for page in PAGES)
    targets = set(re.findall(r"^(\w+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE))
    named = set(re.findall(r"(?:^|`)make (\w+)", text, re.MULTILINE))
    assert "demo" in named and named <= targets


def test_the_physics_page_computes_its_figures(monkeypatch, capsys):
    """The program in section 8 runs in the repository's root and prints the figures that the text gives."""
    monkeypatch.chdir(ROOT)
    page = (ROOT / "docs" / "physics-optics.md").read_text(encoding="utf-8")
    (program,) = re.findall(r"^```python\n(.*?)^```", page, re.MULTILINE | re.DOTALL)
    exec(compile(program, "physics-optics.md", "exec"), {})
    printed = capsys.readouterr().out
    for figure in ("2.17 W/", "11.4 ms", "1.86 DN", "10.3 mrad", "0.0197", "0.123"):
        assert figure in printed and figure in page, figure
