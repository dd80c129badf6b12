"""`sonotwin identify`, from captures to a rig's file that other verbs take."""

import contextlib
import io
import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from recon.capture.manifest import read_manifest
from recon.identification import rig_file
from recon.identification.estimates import Estimate, Findings
from recon.session import rig_step
from sonotwin.choices import read, read_rig
from sonotwin.cli import main
from tests.recon.session import speckle_captures
from tests.sonotwin.test_surface_verb import PROJECTOR, SEQUENCES, optics, write_capture
from twin.ultrasound.transducer import Transducer

__all__ = ["optics"]  # a fixture

SIZE, CORNER = (48, 38), (136, 109)  # a part of the images: 1 500 pixels show what a projector does
NARROW = tuple(f"{part}.image_size=[96,408]" for part in ("rig.probe", "ultrasound"))


@pytest.fixture(scope="module")
def capture(optics, tmp_path_factory) -> Path:
    """A plane under eight steps of grey fringes without a gamma, and Gray code."""
    folder = tmp_path_factory.mktemp("identify") / "capture"
    whole = optics.cameras["cam1"]
    part = replace(whole, size=SIZE, matrix=whole.matrix - np.array([[0, 0, CORNER[0]], [0, 0, CORNER[1]], [0, 0, 0]]))
    write_capture(folder, SEQUENCES["gray"], replace(optics, cameras=optics.cameras | {"cam1": part}))
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


@pytest.fixture(scope="module")
def identified(capture, frames, tmp_path_factory) -> tuple[Path, str]:
    """The result of capture and frames, and what was said."""
    out = tmp_path_factory.mktemp("identified") / "ours"
    given = [f"capture={capture}", f"dark={frames / 'dark'}", f"flat={frames / 'flat'}", f"out={out}"]
    with contextlib.redirect_stdout(io.StringIO()) as said:
        assert main(["identify", *given, "day=2026-05-04"]) == 0
    return out, said.getvalue()


def test_a_surface_gives_a_file_for_other_verbs(identified):
    """The black level, light without gamma, and the optics as the capture has them."""
    out, said = identified
    found = json.loads((out / "identified.json").read_text())
    rig = read_rig(out / "rig.yaml")
    assert rig.cam1.optics.size == SIZE and rig.projector.optics.size == PROJECTOR
    assert rig.cam2 == read_rig().cam2
    assert (rig.version, rig.identified.capture, str(rig.identified.day)) == (1, "capture", "2026-05-04")
    for name, true in (("cam1.sensor.black_level_dn", 6.0), ("projector.gamma", 1.0)):
        known = rig.measured[name]
        assert abs(rig.number(name) - true) < 4 * known.sigma and known.sigma < 0.1 * true, name
        assert found["estimates"][name]["source"] == known.source
    assert f"\nmeasured    projector\n  gamma  {rig_file.in_words(Estimate(**found['estimates']['projector.gamma']))}  " in said
    assert "\n  black_level_dn  " in said and "unknown     cam1.sensor.quantum_efficiency: " in said
    text = (out / "rig.yaml").read_text()
    assert text.startswith("# A rig as last identified from capture") and "# not measured: " in text
    conditions = (out / "conditions.yaml").read_text()
    assert re.search(r"\n  flicker: [0-9.]+  # ± [0-9.e-]+: ", conditions) and "tremor_mm: 0.0  # not measured: " in conditions


def test_without_frames_what_they_show_is_unknown_and_files_of_others_stay(identified, capture, tmp_path, capsys):
    """In the place of an earlier result, but not of the version that it begins with."""
    out = shutil.copytree(identified[0], tmp_path / "ours")
    (out / "mine.txt").write_text("of a person")
    assert main(["identify", f"capture={capture}", f"out={out}"]) == 0
    capsys.readouterr()
    assert main(["identify", f"capture={capture}", f"rig={out / rig_step.RIG}", f"out={out}"]) == 2
    assert "found version 1, as of rig, which would be lost; give another folder" in capsys.readouterr().err
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
        ([f"capture={capture}", f"dark={other.parent}"], f"expected {SIZE[0]}x{SIZE[1]}"),
        ([f"capture={capture}", f"flat={tmp_path / 'nothing'}"], "expected a folder with images in cam1, found nothing"),
        ([f"capture={capture}", "gain=-1"], "gain"),
        ([f"capture={capture}", "adc_bits=7"], "adc_bits"),
        ([f"capture={capture}", f"room={few.parent}"], "expected two images or more of one thing, found 1"),
    ):
        assert main(["identify", *given, f"out={tmp_path / 'ours'}"]) == 2
        said = capsys.readouterr().err
        assert told in said and said.count("\n") == 1 and not (tmp_path / "ours").exists()


@pytest.fixture(scope="module")
def sweeps(tmp_path_factory) -> Path:
    """B-scans of made speckle, and some that can't be identified."""
    rng, folder = np.random.default_rng(8), tmp_path_factory.mktemp("sweeps") / "capture"
    images = {"tissue": speckle_captures.speckle(6, -22.0, rng), "air": speckle_captures.in_air(3, rng)}
    images |= {"lifted": speckle_captures.in_air(6, rng), "short": images["tissue"][:2], "black": 0 * images["tissue"]}
    speckle_captures.write(folder, images, rng)
    return folder


def test_what_shows_no_scanner_is_refused(sweeps, capture, tmp_path, capsys):
    """In one line, with nothing written."""
    coloured, other = tmp_path / "coloured", tmp_path / "other"
    for folder, size in ((coloured, speckle_captures.SIZE), (other, (40, 300))):
        folder.mkdir()
        for k in range(4):
            doppler = np.random.default_rng(k).integers(0, 255, (*size[::-1], 3 if folder == coloured else 1))
            cv2.imwrite(str(folder / f"{k}.png"), doppler.astype(np.uint8))
    scale = "mm_per_px=[0.12,0.08]"
    for given, told in (
        (["tissue=tisue", scale], "tissue: expected one of the capture's sweeps tissue, air, lifted, short, black or a folder of "
         "images, found tisue; did you mean tissue?"),
        ([], "but sweeps tissue, air, lifted, short, black; give tissue=NAME"),
        (["air=air"], "tissue: expected a sweep or a folder of even tissue with air, found none"),
        ([f"tissue={coloured}", scale], "0.png: expected a grey B-scan, found"),
        (["tissue=short", scale], "tissue: expected 3 B-scans or more, found 2 in short"),
        (["tissue=black", scale], "tissue: expected even tissue all over, found 100 % black in black: no contact?"),
        (["tissue=lifted", "air=air", scale], "tissue: expected B-scans brighter than those in air"),
        (["tissue=tissue", f"air={other}", scale], "air: expected B-scans of 48x300 as those of tissue, found 40x300"),
        (["tissue=tissue", f"steps={other}", "step_mm=0.2", scale], "steps: expected B-scans of 48x300 as those of tissue"),
        (["tissue=tissue"], "mm_per_px: expected the size of a pixel"),
        (["tissue=tissue", "steps=tissue", scale], "step_mm: expected mm from one B-scan to the next"),
        (["tissue=tissue", "ultrasound=curved", scale], "ultrasound: expected the description of a linear array"),
        (["tissue=tissue", "clip=[100,0,10,300]", scale], "clip: expected a part of an image"),
        (["tissue=tissue", "frequency_mhz=1000", scale], "frequency_mhz"),
        (["tissue=tissue", f"dark={coloured}", scale], "dark: expected a capture with a board or a surface under fringes"),
    ):  # fmt: skip
        assert main(["identify", f"capture={sweeps}", *given, f"out={tmp_path / 'ours'}"]) == 2, given
        said = capsys.readouterr().err
        assert told in said and said.count("\n") == 1 and not (tmp_path / "ours").exists(), said


@pytest.mark.slow
def test_a_rendered_phantom_gives_a_scanner_for_other_verbs(tmp_path, capsys):
    """Sweeps alone, over gelatin and in air: no number is off by more than 4 standard deviations; and a sweep by the result."""
    out, hz = tmp_path / "rendered", "clocks.scanner_hz"
    stroke = ["scene=gelatin", "path.start_mm=[4,-68]", "path.end_mm=[4,48]", "path.speed_mm_s=20", f"{hz}=2"]
    slide = [
        "scene=gelatin",
        "path.start_mm=[4,58]",
        "path.end_mm=[4,62]",
        "path.speed_mm_s=2",
        f"{hz}=10",
        "path.hand={shift_mm: 0, turn_deg: 0}",
    ]
    air = ["scene=tank", "path=bob", "path.middle_mm=[4,-2,600]", "path.seconds=0.2"]
    for name, given in (("tissue", stroke), ("steps", slide), ("air", air)):
        assert main(["sweep", *NARROW, *given, f"name={name}", "add=true", f"out={out}"]) == 0
    named = [f"{name}={name}" for name in ("tissue", "air", "steps")]
    sheet = ["attenuation_db_per_cm_mhz=0.5", "echo_db=0", "ultrasound.dynamic_range_db=70", "ultrasound.elevation_mm=6"]
    ours = tmp_path / "ours"
    assert main(["identify", f"capture={out / 'capture'}", *named, *sheet, f"out={ours}"]) == 0
    said = capsys.readouterr().out
    assert "measured    ultrasound\n  dynamic_range_db  " in said and "wrote " in said and "ultrasound.yaml" in said
    truth, found = Transducer(), json.loads((ours / "identified.json").read_text())["estimates"]
    read_back = Transducer.model_validate(read("ultrasound", ours / "ultrasound.yaml"))
    for name in ("dynamic_range_db", "receive_f_number", "transmit_focus_mm", "gain_db", "tgc_db_per_cm_mhz", "elevation_mm"):
        sigma = found[f"ultrasound.{name}"]["sigma"]
        assert abs(getattr(read_back, name) - getattr(truth, name)) < 4 * sigma < 0.5 * abs(getattr(truth, name)), name
    assert read_back.image_size == (96, 408) and read_rig(ours / "rig.yaml").probe.image_size == (96, 408)
    again = [f"rig={ours / 'rig.yaml'}", f"ultrasound={ours / 'ultrasound.yaml'}", *stroke, "path.end_mm=[4,-40]"]
    assert main(["sweep", *again, f"out={tmp_path / 'again'}"]) == 0
    assert read_manifest(tmp_path / "again" / "capture").devices["us"].size == (96, 408)


def test_images_stored_as_jpeg_show_no_sensor_unless_they_are_to(capture, frames, tmp_path, capsys, monkeypatch):
    """Reasons in the rig's file, and a warning that names the file and what to set; the projector's light is left out here."""
    monkeypatch.setattr(rig_step.projector, "identify", lambda *_, **__: Findings())
    flat = shutil.copytree(frames / "flat", tmp_path / "flat")
    cv2.imwrite(str(flat / "cam1" / "half" / "9.jpg"), np.full(SIZE[::-1], 90, np.uint8))
    given = [f"capture={capture}", f"dark={frames / 'dark'}", f"flat={flat}"]
    assert main(["identify", *given, f"out={tmp_path / 'ours'}"]) == 0
    said = capsys.readouterr()
    assert "cam1: images aren't raw: 9.jpg is a JPEG: set raw grey images, gamma 1" in said.err + said.out
    measured = read_rig(tmp_path / "ours" / "rig.yaml").measured
    assert not [name for name in measured if name.startswith("cam1.sensor")]
    assert main(["identify", *given, "processed=true", f"out={tmp_path / 'asked'}"]) == 0
    assert "cam1.sensor.black_level_dn" in read_rig(tmp_path / "asked" / "rig.yaml").measured
