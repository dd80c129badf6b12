"""`sonotwin identify`, from captures to a rig's file that other verbs take."""

import json
import os
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from recon.session import rig_step
from sonotwin.choices import read_rig
from sonotwin.cli import main
from tests.sonotwin.test_surface_verb import PROJECTOR, SEQUENCES, SIZE, optics, write_capture

__all__ = ["optics"]  # a fixture


@pytest.fixture(scope="module")
def capture(optics, tmp_path_factory) -> Path:
    """A plane under eight steps of grey fringes without a gamma, and Gray code."""
    folder = tmp_path_factory.mktemp("identify") / "capture"
    write_capture(folder, SEQUENCES["gray"], optics)
    return folder


def write_frames(folder: Path, level: float, noise: float, count: int = 8) -> None:
    """Frames of one brightness, with its noise."""
    folder.mkdir(parents=True)
    rng = np.random.default_rng(int(10 * level))
    for k in range(count):
        image = np.clip(np.rint(level + noise * rng.standard_normal(SIZE[::-1])), 0, 255)
        cv2.imwrite(str(folder / f"{k}.png"), image.astype(np.uint8))


@pytest.fixture(scope="module")
def frames(tmp_path_factory) -> Path:
    """Dark frames of 6 DN, and flat ones at two levels."""
    folder = tmp_path_factory.mktemp("frames")
    write_frames(folder / "dark" / "cam1", 6.0, 1.0, 16)
    for name, level in (("half", 90.0), ("full", 190.0)):
        write_frames(folder / "flat" / "cam1" / name, level, np.sqrt(1 + 0.04 * (level - 6)))
    return folder


def test_a_surface_gives_a_file_for_other_verbs(capture, frames, tmp_path, capsys):
    """The black level, light without gamma, and the optics as the capture has them."""
    given = [f"capture={capture}", f"dark={frames / 'dark'}", f"flat={frames / 'flat'}", f"out={tmp_path / 'ours'}"]
    assert main(["identify", *given, "day=2026-05-04"]) == 0
    said = capsys.readouterr().out
    found = json.loads((tmp_path / "ours" / "identified.json").read_text())
    rig = read_rig(tmp_path / "ours" / "rig.yaml")
    assert rig.cam1.optics.size == SIZE and rig.projector.optics.size == PROJECTOR
    assert rig.cam2 == read_rig().cam2
    assert (rig.version, rig.identified.capture, str(rig.identified.day)) == (1, "capture", "2026-05-04")
    for name, true in (("cam1.sensor.black_level_dn", 6.0), ("projector.gamma", 1.0)):
        known = rig.measured[name]
        assert abs(rig.number(name) - true) < 4 * known.sigma and known.sigma < 0.1 * true, name
        assert found["estimates"][name]["source"] == known.source
    assert "measured    cam1.sensor: " in said and "unknown     cam1.sensor.quantum_efficiency: " in said
    text = (tmp_path / "ours" / "rig.yaml").read_text()
    assert text.startswith("# A rig as identified from capture") and "# not measured: " in text
    conditions = (tmp_path / "ours" / "conditions.yaml").read_text()
    assert "defaults:\n- ideal\n" in conditions and "flicker" in conditions


def test_without_frames_what_they_show_is_unknown_and_files_of_others_stay(capture, tmp_path):
    """Identified anew from its own file, it is the second version, of the day of the capture."""
    out, before = tmp_path / "ours", []
    os.utime(capture / "manifest.json", (1777852800, 1777852800))
    for version in (1, 2):
        assert main(["identify", f"capture={capture}", f"out={out}", *before]) == 0
        before = [f"rig={out / rig_step.RIG}"]
        found = read_rig(out / rig_step.RIG)
        assert (found.version, str(found.identified.day)) == (version, "2026-05-04")
        (out / "mine.txt").write_text("of a person")
    rig, usual = read_rig(out / rig_step.RIG), read_rig()
    assert not [name for name in rig.measured if name.endswith(("dsnu_e", "prnu", "black_level_dn"))]
    assert rig.cam1.sensor.prnu == usual.cam1.sensor.prnu and (out / "mine.txt").is_file()


def test_what_is_no_capture_of_these_is_refused(capture, frames, tmp_path, capsys):
    """In one line, with nothing written."""
    few = tmp_path / "few" / "cam1"
    few.mkdir(parents=True)
    shutil.copy(frames / "dark" / "cam1" / "0.png", few)
    other = tmp_path / "other" / "cam1"
    other.mkdir(parents=True)
    for name in "ab":
        cv2.imwrite(str(other / f"{name}.png"), np.zeros((8, 9), np.uint8))
    own = shutil.copytree(capture, tmp_path / "own")
    (own / "dark").mkdir()
    for given, told in (
        ([f"capture={tmp_path}"], "manifest.json"),
        ([f"capture={own}"], "own/dark: expected a folder with images in cam1, found none"),
        ([f"capture={capture}", f"dark={few.parent}"], "expected two images or more of one thing, found 1"),
        ([f"capture={capture}", f"dark={other.parent}"], "expected 320x256"),
        ([f"capture={capture}", f"flat={tmp_path / 'nothing'}"], "expected a folder with images in cam1, found nothing"),
        ([f"capture={capture}", "gain=-1"], "gain"),
        ([f"capture={capture}", "adc_bits=7"], "adc_bits"),
        ([f"capture={capture}", f"room={few.parent}"], "expected two images or more of one thing, found 1"),
    ):
        assert main(["identify", *given, f"out={tmp_path / 'ours'}"]) == 2
        said = capsys.readouterr().err
        assert told in said and said.count("\n") == 1 and not (tmp_path / "ours").exists()
