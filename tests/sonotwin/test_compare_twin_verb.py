"""`sonotwin compare-twin`: a rendered capture in place of a real one, with the rig that took it and with wrong ones."""

import json
import shutil
from pathlib import Path
from typing import Any

import pytest

from recon.identification import rig_file
from recon.model.patterns import Fringes, GrayCode, Patterns
from recon.model.rig import Rig
from scenes.catalogue import build_scene
from sonotwin.cli import main
from tests.twin.small_rigs import cropped
from twin.conditions import IDEAL
from twin.optics import surface_session
from twin.optics.light_transport import Tracing
from twin.optics.surface_session import Shooting
from twin.session import Session

SIZE = (256, 208)
pytestmark = pytest.mark.slow  # all render


@pytest.fixture(scope="module")
def small(rig) -> Rig:
    """A camera that reads out the middle of its sensor."""
    return rig.model_copy(update={"cam1": cropped(rig.cam1, SIZE)})


@pytest.fixture(scope="module")
def capture(small, tmp_path_factory) -> Path:
    """A sphere before a plane, under eight steps and Gray code."""
    folder = tmp_path_factory.mktemp("capture")
    parts = (Fringes(pitch=12, steps=8), GrayCode(pitch=12, bits=7, complementary=True))
    patterns = Patterns(projector_size=small.projector.optics.size, unwrap="gray", parts=parts)
    scene = build_scene({"kind": "sphere"})
    view = surface_session.shoot(small, scene, patterns, "cam1", Tracing(samples=32, room_lux=20), Shooting(), 5, IDEAL)
    surface_session.write_session(Session(folder, "surface", {}), small, small, scene, patterns, {"cam1": view})
    shutil.rmtree(folder / "truth")
    return folder / "capture"


def changed(part: Any, number: tuple[str, ...], share: float) -> Any:
    """A part of the rig with one of its numbers times a share."""
    if not number:
        return part
    first, *others = number
    value = getattr(part, first)
    return part.model_copy(update={first: changed(value, tuple(others), share) if others else share * value})


@pytest.mark.parametrize(
    ("number", "share", "told"),
    [
        ((), 1.0, "Nothing: all 9 statistics"),
        (("projector", "gamma"), 1.3, "Harmonics: number 2"),
        (("projector", "lens", "blur_px"), 2.5, "Blur: "),
        (("cam1", "sensor", "saturation_e"), 1.3, "Noise: its variance"),
    ],
    ids=["right", "gamma", "blur", "noise"],
)
def test_the_right_rig_explains_all_and_a_wrong_one_is_named(small, capture, number, share, told, tmp_path, capsys):
    """With another gamma, blur or noise the first line names it; nothing is read but the capture."""
    assert not (capture.parent / "truth").exists()
    rig_file.write(tmp_path / "rig.yaml", changed(small, number, share), {}, "a test")
    out = tmp_path / "out"
    assert main(["compare-twin", f"capture={capture}", f"rig={tmp_path / 'rig.yaml'}", "tracing.samples=16", f"out={out}"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert any(line.startswith("scene") and "reflectance assumed 0.80: light between places doesn't" in line for line in lines)
    said = [line for line in lines if line.startswith("unexplained")]
    assert said[0].startswith(f"unexplained {told}"), said
    figures = json.loads((out / "metrics.json").read_text())
    assert (figures["beyond_bars"] == 0) == (not number)
    page = (out / "report.html").read_text()
    assert (
        told.partition(":")[0] in page and "None of the rig’s numbers was measured" in page and "reflectance assumed 0.80" in page
    )


def test_what_does_not_fit_is_refused(small, capture, tmp_path, capsys):
    """In one line, with nothing written: no capture, a camera of another size, another camera."""
    rig_file.write(tmp_path / "rig.yaml", small, {}, "a test")
    rig = f"rig={tmp_path / 'rig.yaml'}"
    for given, told in (
        ([f"capture={tmp_path / 'nothing'}", rig], "no such folder"),
        ([f"capture={capture}"], "256x208"),
        ([f"capture={capture}", rig, "camera=cam2"], "expected surface images of cam2"),
    ):
        assert main(["compare-twin", *given, f"out={tmp_path / 'out'}"]) == 2
        said = capsys.readouterr().err
        assert told in said and said.count("\n") == 1 and not (tmp_path / "out").exists()
