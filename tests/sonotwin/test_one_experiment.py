"""One experiment: the demonstration, `reconstruct`, studies and accuracy find the same in one capture, and pass no text."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from recon.files import metrics
from scenes.catalogue import parse_scene
from scenes.kinds import plane
from sonotwin.config import load
from sonotwin.demonstration import Config
from sonotwin.verbs import demo, reconstruct
from sonotwin.verbs.study import of_conf
from twin.experiments import surface_accuracy, surface_trial
from twin.working_range import working_range

ROOT = Path(__file__).resolve().parents[2]
PRODUCT = ("recon", "twin", "scenes", "trainers", "sonotwin")
READ_BY_HAND = {"sonotwin/config.py", "sonotwin/cli.py", "sonotwin/verbs/study.py"}  # where a user's or a file's words are read
READERS = ("load", "compose", "main")  # of words
SUSPECT = rf"[\"'][+~]*[\w.@]+=|\b({'|'.join(READERS)})\("  # in a module that may pass settings as text
SEED = 2
SMALL = [  # a quarter of the size
    "rig.cam1.optics.size=[320,256]",
    "rig.cam1.optics.focal_px=[830.0,832.75]",
    "rig.cam1.optics.centre_px=[154.125,130.375]",
    "rig.cam1.sensor.pixel_um=19.2",
    "tracing.samples=2",
]
ALONE = ["scene=plane", "cameras=[cam1]", "patterns=gray_surface", "conditions=ideal", "poses=none", "path=none", "film_frames=0"]


@pytest.fixture(scope="module")
def demonstrated(tmp_path_factory) -> Config:
    """A plate of the paper's under fringes, measured by the true calibration, as the experiment of studies has it."""
    out = tmp_path_factory.mktemp("one") / "demo"
    config = load("demo", [*ALONE, *SMALL, f"seed={SEED}", f"out={out}"], Config)
    plate = working_range(config.rig).plate(plane.PAPER_POSES[SEED])
    config = config.model_copy(update={"scene": config.scene | plate.model_dump()})
    demo.run(config)
    return config


def test_one_capture_gives_one_set_of_figures(demonstrated, tmp_path):
    """Files keep fewer digits than memory, so that figures differ by a ten-thousandth at most."""
    shown = metrics.read(demonstrated.out / metrics.FILE)
    again = reconstruct.Config(**dict(demonstrated.reconstruction) | {"out": tmp_path / "result"})
    assert reconstruct.run(again) == 0
    kept = metrics.read(demonstrated.out / "result" / metrics.FILE)
    assert metrics.read(again.out / metrics.FILE) == kept and kept["surface_points"] == shown["points"]

    scene = parse_scene(demonstrated.scene)
    assert scene[1] == working_range(demonstrated.rig).plate(plane.PAPER_POSES[SEED])
    own = {name: getattr(demonstrated, name) for name in ("rig", "patterns", "tracing", "shooting", "conditions")}
    by_accuracy = surface_accuracy.experiment(scene=plane.build(scene[1]), seed=SEED, **own).metrics
    assert {name: shown[name] for name in by_accuracy} == pytest.approx(by_accuracy, rel=1e-4, nan_ok=True)

    study = of_conf("sweep", tmp_path / "study", of="surface", over={"shooting.gain": [1]}, **own)
    by_study = surface_trial.measure(study.settings, SEED)
    same = by_study.keys() & by_accuracy.keys()
    assert {"predicted_rms_mm", "coverage", "gross_error_fraction"} <= same
    assert {name: by_study[name] for name in same} == {name: by_accuracy[name] for name in same}


def texts(source: str) -> Iterator[str]:
    """Places in a module that pass settings as text: words that are read again, and lists of words made of values."""
    if not re.search(SUSPECT, source):
        return  # which spares most modules the parsing
    for node in ast.walk(ast.parse(source)):
        called = getattr(node, "func", None)  # a name, or one after a dot
        words = node.args[1:2] if getattr(called, "attr", getattr(called, "id", None)) in READERS else []
        if any(isinstance(one, ast.Constant | ast.JoinedStr | ast.List) for one in words):
            yield f"line {node.lineno}: {ast.unparse(node)}"
        elements = node.elts if isinstance(node, ast.List | ast.Tuple) else [node.elt] if isinstance(node, ast.ListComp) else []
        for one in elements:
            text = one.values[0] if isinstance(one, ast.JoinedStr) else one
            if isinstance(text, ast.Constant) and isinstance(text.value, str) and is_field(text.value):
                yield f"line {one.lineno}: {ast.unparse(one)}"


def is_field(text: str) -> bool:
    """Whether text is a field and the sign of its value, with or without the value."""
    name, sign, _ = text.lstrip("+~").partition("=")
    return bool(sign) and name.replace(".", "").replace("@", "").isidentifier()


@pytest.mark.parametrize("source", [
    'config = load("study", ["name=sweep", *place], Config)',
    'place = [f"out={kept / name}", f"trials={kept}"]',
    'fields = ["poses=demo"] if name == "board_poses" else []',
    'steps.do(*[f"{verb}.lag_s={lag}", f"spread_mm={spread}"])',
])  # fmt: skip
def test_settings_as_text_are_found(source):
    """What passed text between steps once."""
    assert list(texts(source))


def test_no_settings_pass_between_steps_as_text():
    """Command lines are made of settings in one module, for people; words that are read again are a user's, or a file's."""
    found = []
    for package in PRODUCT:
        for path in sorted((ROOT / package).rglob("*.py")):
            name = str(path.relative_to(ROOT))
            if name not in READ_BY_HAND:
                found += [f"{name}: {text}" for text in texts(path.read_text(encoding="utf-8"))]
    assert not found
