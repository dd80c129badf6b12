"""What a release says of itself: one version, title and licence everywhere, and requirements that permit commercial use."""

import importlib.metadata
import json
import re
import tomllib
from pathlib import Path

import pytest
import yaml
from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet
from packaging.utils import canonicalize_name

ROOT = Path(__file__).resolve().parent.parent
PERMISSIVE = re.compile(r"\b(MIT|BSD|0BSD|Apache|PSF|Python Software Foundation|Zlib|ISC|CC0|BSL-1\.0|MIT-CMU)\b")
OBLIGING = re.compile(r"\b(A?GPL\w*|LGPL\w*|GNU|Affero|MPL\w*|Mozilla|EPL|CDDL|Proprietary|SSPL|CC-BY-\w+)", re.IGNORECASE)
EXCEPTIONS = {  # by what their own texts say
    "atheris": "Apache-2.0; its metadata have no licence; fuzzing alone",
    "certifi": "MPL-2.0, a list of certificates, unchanged; the documentation's alone",
    "docutils": "public domain and BSD, with one file of the GPL for editors, which isn't used; the documentation's alone",
    "hypothesis": "MPL-2.0, unchanged; tests alone",
    "pyglet": "BSD-3-Clause; its metadata have no licence",
    "pypylon": "BSD-3-Clause around Basler's own runtime, whose terms let one use it; only `live` brings it",
    "tqdm": "MPL-2.0 and MIT, unchanged; only Optuna's, of `study`",
}

ON_CONDA_FORGE = {"opencv-contrib-python-headless": "py-opencv", "matplotlib": "matplotlib-base"}


def declared(name: str) -> str:
    """The licence that an installed distribution declares: by expression, classifiers, or the first line of the free text."""
    about = importlib.metadata.metadata(name)
    if about.get("License-Expression"):
        return about["License-Expression"]
    classifiers = [each for each in about.get_all("Classifier") or [] if each.startswith("License ::")]
    return "; ".join(classifiers) or (about.get("License") or "").strip().partition("\n")[0]


def permits(licence: str) -> bool:
    return bool(PERMISSIVE.search(licence)) and not OBLIGING.search(licence)


def test_requirements_permit_commercial_use():
    """Each of constraints.txt that is installed, by its own word; that says nothing of libraries inside its binaries."""
    lines = (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()
    wanted = {canonicalize_name(line.partition("==")[0]) for line in lines if "==" in line and not line.startswith("#")}
    installed = wanted & {canonicalize_name(each.name) for each in importlib.metadata.distributions()}
    assert len(installed) > 50
    found = {name: licence for name in installed if not permits(licence := declared(name))}
    assert found.keys() <= EXCEPTIONS.keys(), {name: found[name] for name in found.keys() - EXCEPTIONS.keys()}
    assert EXCEPTIONS.keys() <= wanted and EXCEPTIONS.keys() & installed == found.keys(), "exceptions that are none"


@pytest.mark.parametrize(
    ("licence", "permitted"),
    [("MIT", True), ("", False), ("MPL-2.0 AND MIT", False), ("LGPL-2.1-or-later", False),
     ("License :: OSI Approved :: GNU Lesser General Public License v3", False), ("Apache-2.0 WITH LLVM-exception", True)],
)  # fmt: skip
def test_which_licences_permit_it(licence, permitted):
    assert permits(licence) == permitted


def test_citations_agree_with_the_project():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    zenodo = json.loads((ROOT / ".zenodo.json").read_text(encoding="utf-8"))
    expected = (project["name"], project["version"], project["license"], project["description"] + ".", project["authors"])
    assert expected == tuple(citation[key] for key in ("title", "version", "license", "abstract", "authors"))
    assert expected == tuple(zenodo[key] for key in ("title", "version", "license", "description", "creators"))
    rig = next(each for each in citation["references"] if each["notes"] == "the rig")
    assert [each["identifier"] for each in zenodo["related_identifiers"]] == [rig["doi"]]


def test_the_conda_packages_require_what_the_project_does():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    recipe = yaml.safe_load((ROOT / ".ci/conda/recipe.yaml").read_text(encoding="utf-8"))
    core, twin = (conda_requirements(output) for output in recipe["outputs"])
    assert (str(core.pop("python")), recipe["context"]["version"]) == (project["requires-python"], project["version"])
    assert core == pip_requirements(project["dependencies"])
    assert twin == pip_requirements(project["optional-dependencies"]["twin"])
    entry = recipe["outputs"][0]["build"]["python"]["entry_points"]
    assert [each.split(" = ") for each in entry] == [list(each) for each in project["scripts"].items()]


def conda_requirements(output) -> dict[str, SpecifierSet]:
    lines = [line for line in output["requirements"]["run"] if not line.startswith("${{")]
    return {name: SpecifierSet(versions) for name, _, versions in (line.partition(" ") for line in lines)}


def pip_requirements(lines) -> dict[str, SpecifierSet]:
    wanted = [Requirement(line) for line in lines]
    return {ON_CONDA_FORGE.get(each.name, each.name): each.specifier for each in wanted}


def test_the_image_has_a_python_that_the_project_runs_on_and_all_that_the_wheel_is_made_of():
    python = re.search(r"^ARG PYTHON=(.+)$", (ROOT / "Dockerfile").read_text(encoding="utf-8"), flags=re.MULTILINE)[1]
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    wheel, project = settings["tool"]["hatch"]["build"]["targets"]["wheel"], settings["project"]
    assert python in SpecifierSet(project["requires-python"])
    made_of = {*wheel["packages"], *wheel["force-include"], project["readme"], *project["license-files"], "pyproject.toml"}
    sent = {line[1:] for line in (ROOT / ".dockerignore").read_text(encoding="utf-8").splitlines() if line.startswith("!")}
    assert made_of | {"constraints.txt"} == sent
