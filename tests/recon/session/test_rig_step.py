"""One identification after another, of unlike captures: what was measured before stays, with its sigmas and sources."""

import json
import os
import shutil
from datetime import date
from pathlib import Path

import numpy as np
import pytest

from recon.capture.manifest import CAMERAS, MANIFEST, SCANNER, Device, read_manifest, write_manifest
from recon.capture.writer import new_capture
from recon.identification.estimates import Estimate, Findings
from recon.model.calibration import Calibration, Uncertainty
from recon.session import hand_step, rig_step, scanner_step
from sonotwin.choices import read, read_rig
from sonotwin.cli import main
from tests.recon.identification import made_recordings
from tests.recon.session import speckle_captures
from tests.recon.tracking import films
from tests.sonotwin.test_surface_verb import SEQUENCES, optics, write_capture
from tests.twin.small_rigs import half, half_as_fields
from twin.conditions import Conditions
from twin.ultrasound.transducer import Transducer

__all__ = ["optics"]  # a fixture

HAND = made_recordings.Hand(tremor_mm=0.3, tremor_deg=0.3, led_mm=10, count=110)
FLICKER, BLACK = Estimate(0.013, 0.002, "fringes of a test"), Estimate(4.2, 0.1, "dark frames of a test")
SCALE = "mm_per_px=[0.12,0.08]"


@pytest.fixture(scope="module")
def surface(optics, tmp_path_factory) -> Path:
    """A plane under fringes, by a calibration that knows two of its errors."""
    folder = tmp_path_factory.mktemp("surface") / "capture"
    known = Uncertainty(("cam1.fx", "projector.fx"), np.array([[4.0, 1.0], [1.0, 9.0]]), has_scale=True)
    write_capture(folder, SEQUENCES["gray"], Calibration(optics.cameras, known))
    return folder


@pytest.fixture(scope="module")
def session(tmp_path_factory) -> Path:
    """B-scans of made speckle, and a film, whose frames show nothing, beside them."""
    folder, rng = tmp_path_factory.mktemp("session") / "capture", np.random.default_rng(8)
    small = half(read_rig())
    frame = np.full(small.cam1.optics.size[::-1], 10, np.uint8)
    with new_capture(folder, "session") as made:
        made.add_calibration(films.optics(small))
        for name, images in (("tissue", speckle_captures.speckle(6, -22.0, rng)), ("air", speckle_captures.in_air(3, rng))):
            times = np.rint(1e9 * (np.arange(len(images)) / speckle_captures.HZ + 1)).astype(np.int64)
            shown = ((SCANNER, image) for image in images)
            made.add_sweep({SCANNER: times}, shown, {SCANNER: Device(size=speckle_captures.SIZE)}, name=name)
        pair = zip(CAMERAS, (frame, frame + 1), strict=True)
        made.add_sweep(dict.fromkeys(CAMERAS, films.stamps(1)), pair, films.devices(small), name="hand")
    return folder


@pytest.fixture
def made(monkeypatch) -> None:
    """Estimates by light, which take long, are given; the hand's recording is made, as though the film had shown it."""
    monkeypatch.setattr(
        rig_step.sensors, "identify_sensor", lambda name, *_, **__: Findings({f"{name}.sensor.black_level_dn": BLACK})
    )
    monkeypatch.setattr(rig_step.projector, "identify", lambda *_, **__: Findings({"conditions.frames.flicker": FLICKER}))
    monkeypatch.setattr(hand_step, "track", lambda *_: made_recordings.record(half(read_rig()), HAND, 3))


def identify(capture: Path, out: Path, *fields: str) -> Path:
    """The folder of the result."""
    assert main(["identify", f"capture={capture}", *fields, f"out={out}"]) == 0
    return out


def conditions_of(folder: Path) -> Conditions:
    return Conditions.model_validate(read("conditions", folder / rig_step.CONDITIONS))


def before(folder: Path) -> list[str]:
    """Fields that begin with an earlier result."""
    return [f"{name}={folder / name}.yaml" for name in ("rig", "conditions")]


def test_one_call_measures_the_scanner_and_the_hand(session, made, tmp_path):
    """The hand as alone, the grey map and the tremor within 4 sigma; no number of one hides any of the other."""
    small, hand = half_as_fields(read_rig()), "hand=[hand]"
    alone, both = (
        json.loads((identify(session, tmp_path / name, *small, hand, *given) / rig_step.FIGURES).read_text())
        for name, given in (("alone", []), ("both", ["tissue=tissue", "air=air", SCALE]))
    )
    found = both["estimates"]
    assert alone["estimates"].items() <= found.items() and alone["unknown"].items() <= both["unknown"].items()
    assert {name.partition(".")[0] for name in found.keys() - alone["estimates"].keys()} == {"ultrasound"}
    for name, true in (
        ("ultrasound.dynamic_range_db", 255 / speckle_captures.GREYS_A_DB),
        ("conditions.motion.tremor_mm", HAND.tremor_mm),
    ):
        assert abs(found[name]["value"] - true) < 4 * found[name]["sigma"] < true, name
    array = Transducer.model_validate(read("ultrasound", tmp_path / "both" / "ultrasound.yaml"))
    assert array.image_size == read_rig(tmp_path / "both" / "rig.yaml").probe.image_size == speckle_captures.SIZE
    assert conditions_of(tmp_path / "both") == conditions_of(tmp_path / "alone")


def test_unlike_captures_one_after_another_lose_nothing(surface, session, made, tmp_path, monkeypatch):
    """Of the optics' light, then the scanner's sweeps, then the hand's film: each adds its own numbers, and leaves all others."""
    shown = Findings({"ultrasound.dynamic_range_db": Estimate(61.3, 0.4, "B-scans of a test")})
    monkeypatch.setattr(scanner_step.scanner, "identify", lambda *_: shown)
    first = identify(surface, tmp_path / "first", "day=2026-03-02")
    rig = read_rig(first / "rig.yaml")
    assert (rig.version, rig.identified.capture) == (1, "capture") and rig.measured["projector.optics.focal_px.0"].sigma == 3
    second = identify(session, tmp_path / "second", *before(first), "tissue=tissue", SCALE)
    with_scanner = read_rig(second / "rig.yaml")
    assert with_scanner.probe.image_size == speckle_captures.SIZE != rig.probe.image_size
    assert with_scanner.version == 2  # of which nothing but the probe's image is new
    array = f"ultrasound={second / 'ultrasound.yaml'}"
    assert read("ultrasound", second / "ultrasound.yaml")["dynamic_range_db"] == 61.3
    third = identify(session, tmp_path / "third", *before(second), array, "hand=[hand]")
    last = read_rig(third / "rig.yaml")
    new = {name: getattr(with_scanner, name) for name in ("probe", "version", "identified")}
    assert last == with_scanner == rig.model_copy(update=new)  # a film of the hand changes no rig
    assert last.measured["cam1.sensor.black_level_dn"].sigma == pytest.approx(BLACK.sigma)
    assert last.measured["cam1.sensor.black_level_dn"].source == BLACK.source and last.cam1.sensor.black_level_dn == BLACK.value
    assert conditions_of(second).frames.flicker == conditions_of(third).frames.flicker == FLICKER.value
    assert conditions_of(third).motion.tremor_mm > 0 == conditions_of(second).motion.tremor_mm
    assert not (third / "ultrasound.yaml").exists()  # of which nothing was measured: the second one stays in use
    again = identify(surface, tmp_path / "again", *before(third), "day=2026-04-05")
    renewed = read_rig(again / "rig.yaml")
    assert (renewed.version, str(renewed.identified.day)) == (3, "2026-04-05")
    assert renewed.probe == last.probe and renewed.measured == last.measured
    assert conditions_of(again) == conditions_of(third)


def test_a_field_is_a_line_of_a_table_with_its_source():
    """As far as each number is known; a vector in one line, and one source of a whole part above it."""
    found = Findings(
        {
            "cam1.optics.focal_px.0": Estimate(1736.4712, 0.0732, "a board"),
            "cam1.optics.focal_px.1": Estimate(1742.2294, 0.11, "a board"),
            "cam1.optics.distortion.0": Estimate(-0.138967, 0.00056, "a board"),
            "cam1.sensor.saturation_e": Estimate(27504.3, 480.0, "flat frames"),
            "cam1.sensor.prnu": Estimate(0.0032401, 1e-5, "bright flat frames"),
            "dark_columns.12": Estimate(0.0, 0.0, "tissue"),
        },
        {"cam1.sensor.adc_bits": "see the data sheet"},
    )
    assert list(rig_step.describe(found)) == [
        "measured    cam1.optics: a board",
        "  focal_px    1736.471 ± 0.073, 1742.23 ± 0.11",
        "  distortion  -0.13897 ± 0.00056",
        "measured    cam1.sensor",
        "  saturation_e  27504 ± 480          flat frames",
        "  prnu          0.003240 ± 0.000010  bright flat frames",
        "measured    dark_columns",
        "  12  0 ± 0  tissue",
        "unknown     cam1.sensor.adc_bits: see the data sheet",
    ]


def test_conditions_begin_from_those_given(surface, made, tmp_path, capsys):
    """An earlier film's tremor stays, flicker is measured again; without them it is said that they are lost."""
    earlier = tmp_path / "earlier.yaml"
    earlier.write_text("defaults: [ideal]\nframes: {flicker: 0.15}\nmotion: {tremor_mm: 0.31}\n", encoding="utf-8")
    first = identify(surface, tmp_path / "first", f"conditions={earlier}")
    assert (conditions_of(first).motion.tremor_mm, conditions_of(first).frames.flicker) == (0.31, FLICKER.value)
    assert f"flicker: 0.013  # ± 0.002: {FLICKER.source}" in (first / rig_step.CONDITIONS).read_text(encoding="utf-8")
    told = "conditions=FILE keeps those of an earlier identification"
    assert told not in capsys.readouterr().out
    identify(surface, tmp_path / "lost", f"rig={first / 'rig.yaml'}")
    assert told in capsys.readouterr().out


def test_conditions_that_cannot_be_are_refused(surface, made, tmp_path, capsys, monkeypatch):
    """In one line, with nothing written."""
    wild = Findings({"conditions.frames.flicker": Estimate(0.4, 0.1, "fringes")})
    monkeypatch.setattr(rig_step.projector, "identify", lambda *_, **__: wild)
    assert main(["identify", f"capture={surface}", f"out={tmp_path / 'ours'}"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "conditions: as measured, they can't be: frames.flicker" in line and not (tmp_path / "ours").exists()


def test_a_number_that_conditions_do_not_have_is_named_as_theirs(surface, made, tmp_path, capsys, monkeypatch):
    unknown = Findings({"conditions.frames.colour": Estimate(0.4, 0.1, "fringes")})
    monkeypatch.setattr(rig_step.projector, "identify", lambda *_, **__: unknown)
    assert main(["identify", f"capture={surface}", f"out={tmp_path / 'ours'}"]) == 2
    told = "conditions: expected the name of one of its numbers, found frames.colour"
    assert told in capsys.readouterr().err and not (tmp_path / "ours").exists()


def test_the_day_is_that_on_which_the_newest_part_was_recorded(surface, made, tmp_path):
    """However late the folder is copied; and that of the manifest's file where no part says."""
    copied = shutil.copytree(surface, tmp_path / "copied")
    os.utime(copied / MANIFEST, (0, 0))
    assert str(read_rig(identify(copied, tmp_path / "ours") / "rig.yaml").identified.day) == "1970-01-01"
    held = read_manifest(copied)
    older = held.surface.model_copy(update={"day": date(2026, 3, 2)})
    write_manifest(copied, held.model_copy(update={"surface": older}))
    assert str(read_rig(identify(copied, tmp_path / "ours") / "rig.yaml").identified.day) == "2026-03-02"


def test_parts_that_identification_does_not_use_do_not_date_a_rig(surface, session, made, tmp_path, capsys, monkeypatch):
    """A surface of one day, B-scans of later ones, and a film, which changes no rig, of the last."""
    monkeypatch.setattr(scanner_step.scanner, "identify", lambda *_: Findings())
    monkeypatch.setattr(hand_step, "identify", lambda *_: Findings({"tracker.dropped": Estimate(0.1, 0.01, "a film")}))
    both = shutil.copytree(surface, tmp_path / "both")
    shutil.copytree(session / "sweep", both / "sweep")
    sweeps = read_manifest(session)
    days = {"tissue": date(2026, 3, 4), "air": date(2026, 3, 3), "hand": date(2026, 3, 5)}
    parts = {name: part.model_copy(update={"day": days[name]}) for name, part in sweeps.sweeps.items()}
    held = read_manifest(both)
    first = held.surface.model_copy(update={"day": date(2026, 3, 2)})
    write_manifest(both, held.model_copy(update={"surface": first, "sweeps": parts, "devices": sweeps.devices | held.devices}))
    dated = "for all of the rig"
    for number, (given, day) in enumerate(
        (
            (["hand=[hand]"], "2026-03-02"),
            (["tissue=tissue", SCALE], "2026-03-04"),
            ([f"tissue={both / 'sweep/tissue/us'}", "air=air", SCALE], "2026-03-03"),
        )
    ):
        capsys.readouterr()
        out = identify(both, tmp_path / f"{number}", *given)
        assert str(read_rig(out / "rig.yaml").identified.day) == day, given
        told = [line for line in capsys.readouterr().out.splitlines() if dated in line]
        assert len(told) == (number > 0) and all(f"{day} {dated}; recorded: surface 2026-03-02, " in line for line in told)
