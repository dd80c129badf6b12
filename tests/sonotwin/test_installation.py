"""The doctor on sound and on damaged installations, the damage simulated."""

import os
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

import sonotwin
from sonotwin import cli, installation, namesakes
from twin import llvm

ROOT = Path(__file__).resolve().parents[2]
PYPROJECT = ROOT / "pyproject.toml"


def find(findings, what: str) -> list[installation.Finding]:
    return [finding for finding in findings if finding.what == what]


def test_requirements_are_those_of_the_project():
    project = tomllib.loads(PYPROJECT.read_text())["project"]
    expected = {"core": len(project["dependencies"])} | {k: len(v) for k, v in project["optional-dependencies"].items()}
    parts = [part for part, _, _ in installation.requirements()]
    assert {part: parts.count(part) for part in expected} == expected


@pytest.mark.slow
def test_this_installation_is_sound(capsys):
    """The tests run in it, so its core is, and what is installed can be imported."""
    assert cli.main(["doctor"]) == 0
    found = capsys.readouterr().out
    assert "numpy" in found and "can't be imported" not in found


def test_a_bad_llvm_is_caught_before_it_ends_the_process(tmp_path, monkeypatch, capsys):
    bad = tmp_path / "libLLVM-15.so.1"
    bad.touch()
    monkeypatch.delenv("DRJIT_LIBLLVM_PATH", raising=False)
    monkeypatch.setattr(llvm, "candidates", lambda: [bad])
    monkeypatch.setattr(installation, "_version", lambda name: "1.5.0")
    state, verdict = list(installation._llvm())
    assert (state.state, verdict.state) == ("unused", "problem")
    assert "LLVM 15" in state.found
    assert "19" in verdict.remedy


@pytest.fixture
def others_work(monkeypatch):
    """What is installed can be imported; `test_this_installation_is_sound` tries, which takes seconds."""
    monkeypatch.setattr(installation, "_failing_imports", lambda modules: {})


def test_a_missing_core_package_is_status_2(others_work, monkeypatch, capsys):
    real = installation._version
    monkeypatch.setattr(installation, "_version", lambda name: None if name == "scipy" else real(name))
    assert cli.main(["doctor"]) == 2
    captured = capsys.readouterr()
    assert captured.err == "sonotwin: doctor: the core can't be used, because of scipy\n"
    assert "core scipy: pip install 'sonotwin'" in captured.out


def test_cameras_are_listed(monkeypatch):
    pytest.importorskip("pypylon")
    monkeypatch.setenv("PYLON_CAMEMU", "1")
    assert [one.found for one in installation._cameras()] == ["0815-0000: Emulation, CamEmu, free"]
    monkeypatch.setenv("PYLON_CAMEMU", "0")
    assert [one.state for one in installation._cameras()] == ["absent"]


def test_a_missing_twin_is_status_0(others_work, monkeypatch, capsys):
    real = installation._version
    monkeypatch.setattr(installation, "_version", lambda name: None if name in ("mitsuba", "drjit") else real(name))
    assert cli.main(["doctor"]) == 0
    assert "mitsuba; pip install 'sonotwin[twin]'" in capsys.readouterr().out


def test_a_core_alone_fits_a_screen(others_work, monkeypatch, capsys):
    """Of all that is absent there is a line an extra, which names each package."""
    real, wanted = installation._version, list(installation.requirements())
    extras = {name for part, name, _ in wanted if part != "core"}
    monkeypatch.setattr(installation, "_version", lambda name: None if name in extras else real(name))
    assert cli.main(["doctor"]) == 0
    said = capsys.readouterr().out
    assert all(name in said for name in extras) and "pip install 'sonotwin[live]'" in said
    assert len(said.splitlines()) <= 40 and max(map(len, said.splitlines())) <= 130
    assert [line.split()[:3] for line in said.splitlines()].count(["live", "packages", "absent"]) == 1


def test_a_package_that_crashes_does_not_take_the_doctor_along(tmp_path, monkeypatch):
    (tmp_path / "crashes.py").write_text("import os; os.abort()")
    (tmp_path / "lacks.py").write_text("import nothing_of_the_kind")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    failures = installation._failing_imports(["json", "crashes", "lacks", "csv"])
    assert set(failures) == {"crashes", "lacks"}
    assert "nothing_of_the_kind" in failures["lacks"]


def test_an_unwritable_cache_is_a_problem_with_a_remedy(monkeypatch, tmp_path):
    monkeypatch.setattr(installation.os, "access", lambda path, mode: False)
    findings = list(installation._folders())
    assert all(finding.state == "problem" and finding.remedy for finding in findings)


def test_the_folder_of_compiled_code_is_listed_without_the_compiler(tmp_path):
    """It is that of `recon.compiled`, wherever SONOTWIN_CACHE puts it."""
    program = """
import sys
from sonotwin import installation
print([finding.found for finding in installation._folders() if finding.what == "compiled code"], "numba" in sys.modules)
from recon import compiled
print(compiled._folder(compiled.Path(compiled.__file__).resolve(), compiled.Path(compiled.__file__).resolve().parent.parent, 0))
"""
    environment = os.environ | {"SONOTWIN_CACHE": str(tmp_path)}
    done = subprocess.run([sys.executable, "-c", program], cwd=ROOT, env=environment, capture_output=True, text=True, check=True)
    found, used = done.stdout.splitlines()
    assert found == str([f"{tmp_path}/compiled can be written"]) + " False"
    assert Path(used).is_relative_to(tmp_path / "compiled")


@pytest.mark.parametrize(
    ("module", "part"), [("matplotlib.figure", "core"), ("omegaconf", "core"), ("torch", "train"), ("recon", None)]
)
def test_a_module_belongs_to_a_part(module, part):
    assert installation.extra_of(module) == part


@pytest.mark.parametrize("name", ["recon", "scenes", "twin"])
def test_a_namesake_that_hides_ours_is_named(tmp_path, name):
    """Another distribution's package of the same name, in front of ours on the path: one line, whatever the verb."""
    (tmp_path / name).mkdir()
    (tmp_path / name / "__init__.py").touch()
    environment = os.environ | {"PYTHONPATH": f"{tmp_path}{os.pathsep}{ROOT}"}
    command = [sys.executable, "-m", "sonotwin", "doctor"]
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith(f"sonotwin: {name}: expected {ROOT / name}, found {tmp_path / name}; ")


def test_the_doctor_lists_namesakes(tmp_path, monkeypatch):
    """A hidden `trainers`, which the doctor doesn't import."""
    (tmp_path / "trainers").mkdir()
    (tmp_path / "trainers" / "__init__.py").touch()
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.delitem(sys.modules, "trainers", raising=False)  # an imported one would be found first
    found = {finding.what: finding for finding in installation._own_packages()}
    assert found["sonotwin"].state == "ok" and found["sonotwin"].found == f"recon, scenes, twin in {ROOT}"
    assert found["trainers"].state == "problem" and str(tmp_path / "trainers") in found["trainers"].found


def test_two_distributions_in_one_folder_are_named(tmp_path, monkeypatch):
    """Installed side by side their files mix, and a later one overwrites the earlier."""
    site = tmp_path / "site-packages"
    ours = [namesakes.Place(name, site / name, site / name) for name in namesakes.NAMES]
    monkeypatch.setattr(namesakes, "places", lambda: ours)
    both = {"recon": ["sonotwin", "other-recon"], "twin": ["sonotwin"]}
    monkeypatch.setattr(installation.importlib.metadata, "packages_distributions", lambda: both)
    found = {finding.what: finding for finding in installation._own_packages()}
    assert "twin" in found["sonotwin"].found and "recon" not in found["sonotwin"].found and found["recon"].state == "problem"
    assert "pip uninstall other-recon" in found["recon"].remedy


@pytest.fixture
def installed(tmp_path) -> Path:
    """The packages as a wheel has them, `conf` inside the command's own: all files but those that git ignores."""
    build = tomllib.loads(PYPROJECT.read_text())["tool"]["hatch"]["build"]["targets"]["wheel"]
    assert build.keys() == {"packages", "force-include"}, "what includes or leaves out more isn't copied here"
    ignored = shutil.ignore_patterns(*(line.strip("/") for line in (ROOT / ".gitignore").read_text().splitlines()))
    for package in build["packages"]:
        shutil.copytree(ROOT / package, tmp_path / "site" / package, ignore=ignored)
    for source, target in build["force-include"].items():
        shutil.copytree(ROOT / source, tmp_path / "site" / target)
    return tmp_path / "site"


def test_an_installation_has_the_public_names(installed, tmp_path):
    """They are read from a stub, which is no module; type checkers look for it and for `py.typed`."""
    program = "import sonotwin; print(sonotwin.__file__, *sonotwin.__all__)"
    environment = os.environ | {"PYTHONPATH": str(installed)}
    command = [sys.executable, "-c", program]
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=True)
    assert done.stdout.split() == [str(installed / "sonotwin" / "__init__.py"), *sonotwin.__all__]
    assert (installed / "sonotwin" / "py.typed").is_file()


def test_a_users_own_files_are_found_from_anywhere_once_it_is_installed(installed, tmp_path):
    """A copy of a shipped file, and one that starts from it, beside the user's data; none in the package."""
    place = tmp_path / "at home"
    place.mkdir()
    shutil.copy(installed / "sonotwin" / "conf" / "patterns" / "paper_surface.yaml", place / "ours.yaml")
    (place / "rig.yaml").write_text("defaults: [meza2021]\nprojector: {optics: {size: [640, 400]}}\n")
    (place / "ours.yaml").write_text((place / "ours.yaml").read_text().replace("[1280, 800]", "[640, 400]"))
    environment = os.environ | {"PYTHONPATH": str(installed)}
    program = """
from sonotwin.cli import main
for patterns in ("ours.yaml", "ourz.yaml"):
    print("status", main(["patterns", "rig=rig.yaml", f"patterns={patterns}", "out=images"]))
"""
    command = [sys.executable, "-c", program]
    done = subprocess.run(command, cwd=place, env=environment, capture_output=True, text=True, check=True)
    assert "9 images of 640x400 px" in done.stdout
    assert [line for line in done.stdout.splitlines() if line.startswith("status")] == ["status 0", "status 2"]
    assert len(list((place / "images").glob("*.png"))) == 9
    assert done.stderr.startswith("sonotwin: patterns: patterns: expected one of gray_alone, ")
    assert str(installed / "sonotwin" / "conf" / "patterns") in done.stderr and done.stderr.count("\n") == 1
