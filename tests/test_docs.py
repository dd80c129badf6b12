"""What the pages tell a reader to run is valid, and runs; what they link to is there."""

import ast
import json
import re
import shlex
import shutil
from functools import cache
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path

import pytest
import trimesh

from recon.capture import calibration_files
from recon.capture.manifest import Manifest
from recon.files import meshes
from recon.model.boards import Board
from recon.segmentation import containment
from sonotwin.choices import read_rig
from sonotwin.cli import VERBS, main
from sonotwin.config import load
from tests.twin.small_rigs import half, half_as_fields
from twin.optics.surface_session import calibration_of

ROOT = Path(__file__).resolve().parent.parent
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md"]
PAGES += sorted([*(ROOT / "docs").glob("*.md"), *(ROOT / "docs" / "users").glob("*.md")])
MADE = {  # what a verb writes into its folder `out`, for those that read it; "" is the folder itself
    "record": {""},
    "render": {"capture", "truth"},
    "film": {"capture", "truth"},
    "sweep": {"", "capture", "truth"},
    "demo": {"capture", "truth", "result"},
    "surface": {"", "surface.ply"},
    "track": {""},
    "dataset": {""},
    "train": {"", "detector.safetensors", "segmenter.safetensors", "masses.onnx"},
    "calibrate-optics": {"optics.yaml"},
    "calibrate-target": {"target.yaml"},
    "identify": {"", "rig.yaml", "conditions.yaml", "ultrasound.yaml"},
    "compare-twin": {"", "report.html"},
    "render-artefacts": {""},
    "render-benchmark": {"truth"},
    "calibrate-tip": {"tip.yaml"},
    "calibrate-probe": {"probe.yaml"},
    "freehand": {"sequence.igs.mha"},
    "import": {""},
    "import-sweep": {""},
    "export": {"", "screen", "poses.csv"},  # of layout=dicom and screen
    "describe": {""},
    "reconstruct": {"", "optics/optics.yaml", "volume/scan", "masses/scan", "surface"},
}
WRITTEN = ("out", "document", "log", "record")  # fields that name what is written; other paths are read
BROUGHT = {  # what a reader of the page has: by its text, from a rig, or from `make demo`
    "certificate.md": {"outputs/tool"},  # by the two before it
    "README.md": {"shots", "optics.yaml", "outputs/board/capture", "session/capture", "outputs/mine"},
    "training.md": {"shipped"},  # the word for networks that come with sonotwin
    "captures.md": {
        "capture",
        "session",
        "shots",
        "images",
        "optics.yaml",
        "wrapped",
        "dataset",
        "result/poses/scan",
        "result/probe/probe.yaml",
    },
    "freehand.md": {f"{folder}/capture" for folder in ("wires", "wall", "ball", "bottom", "sweep", "tank")}
    | {"scan.dcm", "poses.csv", "pairs.csv", "config.xml", "fcal.xml", "probe/probe.yaml", "surface/surface.ply"}
    | {"session", "tip/tip.yaml", "patient.yaml"}
    | {f"{name}.igs.mha" for name in ("sweep", "bottom", "wires", "rows", "stylus")},
    "live.md": {"session", "morning"}
    | {f"outputs/live/{name}" for name in ("result/surface/surface.ply", "result/masses/scan", "capture/calibration/optics.yaml")}
    | {
        "result/surface/surface.ply",
        "result/masses/scan",
        "result/optics/optics.yaml",
        "result/drift/optics.yaml",
        "result/probe/probe.yaml",
        "result/latency/lag.json",
    },
    "benchmark.md": {"outputs/opencv"},  # of the example beside it
    "live-check.md": {"morning", "lag/lag.json"},
    "live-skin.md": {"result/surface/surface.ply", "result/masses/scan", "result/drift/optics.yaml"}
    | {"now.ply", "before.ply", "masses", "optics.yaml"},
    "recordings.md": {"photographs", "images", "jet.yaml", "jet", "procam", "L", "caliInfo.yml", "spine.xml", "poses.csv"}
    | {"examples_ybr_color.dcm"}
    | {f"{name}.igs.mha" for name in ("SpinePhantomFreehand", "WaterTankBottomTranslationCombined")},
    "live-navigate.md": {"session/capture", "result/surface/surface.ply", "result/masses/scan"}
    | {"result/drift/optics.yaml", "result/probe/probe.yaml", "reference.csv"},
    "rig-software.md": {"board", "surface"},
    "tracking.md": {"session", "probe.yaml"},
}


def commands(text: str, fence: str = "```|~~~") -> list[list[str]]:
    """The `sonotwin` commands in a text's code blocks, without the program's name."""
    blocks = re.findall(rf"^({fence})\w*\n(.*?)^\1", text, re.MULTILINE | re.DOTALL)
    lines = [line for _, block in blocks for line in block.splitlines() if re.match("sonotwin [a-z]", line)]
    return [shlex.split(line, comments=True)[1:] for line in lines]


@cache
def read_by(recipe: tuple[str, ...]) -> tuple[str, ...]:
    """Validate a command as the command line would; returns the paths that it was given to read."""
    verb, *overrides = recipe
    model = import_module(f"sonotwin.verbs.{verb.replace('-', '_')}").Config
    config = load(verb, overrides, model)
    given = {override.partition("=")[0] for override in overrides} - set(WRITTEN)
    values = [value if isinstance(value, list) else [value] for value in (getattr(config, name, None) for name in sorted(given))]
    return tuple(str(path) for some in values for path in some if isinstance(path, Path))


def without_training(verb: str) -> bool:
    return verb == "train" and find_spec("torch") is None


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_recipes_are_valid(page):
    """Each command has a verb and fields that exist and values that fit; what it reads is brought or made by an earlier one."""
    there = set(BROUGHT.get(page.name, ()))
    for recipe in commands(page.read_text(encoding="utf-8")):
        if without_training(recipe[0]):
            continue
        assert set(read_by(tuple(recipe))) <= there, recipe
        out = [Path(field.partition("=")[2]) for field in recipe if field.startswith("out=")]
        there |= {str(folder / name) for folder in out for name in MADE.get(recipe[0], ())}


@pytest.mark.parametrize("verb", VERBS, ids=lambda verb: verb.name)
def test_examples_of_a_verb_are_valid(verb):
    """The commands in its help have verbs and fields that exist and values that fit, and show the verb itself."""
    text = ast.get_docstring(ast.parse((ROOT / (verb.module.replace(".", "/") + ".py")).read_text(encoding="utf-8")))
    examples = [tuple(shlex.split(line)[1:]) for line in text.splitlines() if re.match(" +sonotwin [a-z]", line)]
    assert verb.name in {example[0] for example in examples}
    for example in examples:
        if not without_training(example[0]):
            read_by(example)


def test_films_of_one_folder_show_one_print():
    """A target's print is drawn from the seed: who measures it by one page's film tracks another page's by the same."""
    texts = [page.read_text(encoding="utf-8") for page in PAGES]
    manuals = [(ROOT / (verb.module.replace(".", "/") + ".py")).read_text(encoding="utf-8") for verb in VERBS]
    lines = [recipe for text in texts for recipe in commands(text)]
    lines += [shlex.split(line)[1:] for text in manuals for line in re.findall(r"^ +(sonotwin film [^\n]*)$", text, re.MULTILINE)]
    seeds: dict[str, set[str]] = {}
    for fields in (dict(field.split("=", 1) for field in line[1:]) for line in lines if line[0] == "film"):
        seeds.setdefault(fields["out"], set()).add(fields.get("seed", "0"))
    assert {"outputs/film", "outputs/turned"} <= seeds.keys()
    assert all(len(found) == 1 for found in seeds.values()), seeds
    assert seeds["outputs/film"] == seeds["outputs/turned"]


@pytest.mark.slow
def test_the_readme_runs(tmp_path, monkeypatch, rig):
    """Its recipes, one after the other, on images like those that a reader would have, by cameras of half the size.

    Demonstrations come first: the board's images lie where a reader's would, and a surface's serve the recipes' own.
    """
    monkeypatch.chdir(tmp_path)
    recipes = commands((ROOT / "README.md").read_text(encoding="utf-8"), fence="```")
    assert len(recipes) >= 5
    as_bright = [f"rig.{name}.lens.f_number={2 * getattr(rig, name).lens.f_number}" for name in ("cam1", "cam2")]  # a pixel
    rays = ["tracing.samples=2", *half_as_fields(rig), *as_bright]
    few = {  # rays, pixels, poses and frames: as they stand the recipes take ten minutes
        "demo": ["poses.count=3", "film_frames=0", *rays],
        "render": rays,
        "sweep": ["path.speed_mm_s=80"],
    }
    for recipe in sorted(recipes, key=lambda recipe: recipe[0] != "demo"):
        assert main([*recipe, *few.get(recipe[0], [])]) == 0, recipe
        if not Path("shots").exists():
            shutil.copytree("outputs/bright/capture/surface/cam1", "shots")
            shutil.copy("outputs/bright/result/optics/optics.yaml", "optics.yaml")
    assert Path("outputs/sphere/surface/evaluation/metrics.json").is_file()


@pytest.mark.slow
def test_the_tour_of_the_live_rig_runs(tmp_path, monkeypatch, rig):
    """What the page has a reader run beside `make live`: the twin is recorded, its skin measured, and masses are drawn on it.

    By cameras of half the size.
    """
    monkeypatch.chdir(tmp_path)
    live = Path("outputs/live")
    (live / "capture" / "calibration").mkdir(parents=True)
    calibration_files.write(live / "capture" / "calibration" / "optics.yaml", calibration_of(half(rig)))
    page = (ROOT / "docs" / "live.md").read_text(encoding="utf-8")
    recipes = commands(page, fence="```")
    record, surface, project = [recipe for recipe in recipes if any("outputs/tour" in field for field in recipe)]
    assert main([*record, "tracing.samples=2", *half_as_fields(rig)]) == main(surface) == 0
    (live / "result" / "masses" / "scan").mkdir(parents=True)
    shutil.copytree("outputs/tour_surface", live / "result" / "surface")
    skin = containment.read_skin(live / "result" / "surface" / "surface.ply")
    lump = trimesh.creation.icosphere(3, 6.0).apply_translation(skin.vertices.mean(axis=0)).apply_translation([0, 0, 15.0])
    meshes.write_ply(live / "result" / "masses" / "scan" / "mass0.ply", lump)
    assert main(project) == 0
    assert Path("outputs/tour_light/expected_cam1.png").is_file()


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_lead_somewhere(page):
    """Every relative link of a page names a file of the repository."""
    for target in re.findall(r"\]\(([^)#\s]+)[^)]*\)", page.read_text(encoding="utf-8")):
        if not target.startswith("http"):
            assert (page.parent / target).exists(), target


def test_manifests_of_the_page_are_valid():
    """Every manifest that the page shows can be copied."""
    blocks = re.findall(
        r"^```json\n(.*?)^```", (ROOT / "docs" / "captures.md").read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL
    )
    shown = [Manifest.model_validate(json.loads(block)) for block in blocks]
    assert {part.partition("/")[0] for manifest in shown for part in manifest.contents} >= {"board", "sweep"}


def test_the_page_has_a_rig_to_begin_with(tmp_path):
    """It is one as it stands, with both cameras and the projector as it says, and the places of the usual rig."""
    (block,) = re.findall(r"^```yaml\n(.*?)^```", (ROOT / "docs" / "identify.md").read_text(encoding="utf-8"), re.M | re.S)
    (tmp_path / "our_rig.yaml").write_text(block)
    own, usual = read_rig(tmp_path / "our_rig.yaml"), read_rig()
    for name in ("cam1", "cam2"):
        camera = getattr(own, name)
        assert (camera.optics.size, camera.sensor.pixel_um, camera.lens.focus_mm) == ((1920, 1200), 5.86, 600.0)
        assert camera.optics.device_from_world == getattr(usual, name).optics.device_from_world
    assert (own.cam1.serial, own.cam2.serial) == (usual.cam1.serial, usual.cam2.serial)
    assert (own.projector.optics.size, own.projector.wavelength_nm) == ((1920, 1080), 460.0)


def test_boards_are_described_field_by_field():
    """The table has each field of each kind of board, and no other."""
    page = (ROOT / "docs" / "captures.md").read_text(encoding="utf-8")
    table = page.partition("| `board.kind` | field | meaning |")[2].partition("\n\n")[0]
    described, kind = [], ""
    for first, field in re.findall(r"^\| (?:`(\w+)` )?\| `(\w+)` \|", table, re.MULTILINE):
        kind = first or kind
        described.append((kind, field))
    fields = {board.model_fields["kind"].default: board.model_fields for board in Board.models()}
    told = list(dict.fromkeys(kind for kind, _ in described))
    assert sorted(told) == list(fields)
    assert described == [(kind, name) for kind in told for name in fields[kind] if name not in ("kind", "unusual")]
    assert "`unusual: true`" in page


def test_make_targets_exist():
    """The make targets that the pages name are in the Makefile."""
    text = "".join(page.read_text(encoding="utf-8") for page in PAGES)
    targets = set(re.findall(r"^(\w+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE))
    named = set(re.findall(r"(?:^|`)make (\w+)", text, re.MULTILINE))
    assert "demo" in named and named <= targets


def test_the_figures_of_the_physics_page_are_computed(monkeypatch):
    """docs/optics_figures.py computes from the rig's file the figures that the page gives."""
    monkeypatch.syspath_prepend(str(ROOT / "docs"))
    computed = "\n".join(import_module("optics_figures").lines())
    page = (ROOT / "docs" / "physics-optics.md").read_text(encoding="utf-8")
    for figure in ("2.17 W/", "11.4 ms", "1.86 DN", "10.3 mrad", "0.0197", "0.123"):
        assert figure in computed and figure in page, figure
