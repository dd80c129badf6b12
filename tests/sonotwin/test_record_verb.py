"""The verb `record`: what virtual devices record is read, and reconstructed as what is rendered into a folder."""

import json
import sys
import time
from datetime import date
from io import StringIO
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from recon.acquisition.guidance import Step
from recon.acquisition.recording import open_recording
from recon.acquisition.target_checks import target_places
from recon.capture import calibration_files
from recon.capture.board_part import read_board
from recon.capture.manifest import Device, read_manifest
from recon.capture.sweep_tables import read_stamps
from recon.devices.interfaces import DeviceError
from recon.errors import InputError
from recon.model.tracks import MAX_GAP_S
from sonotwin import cli, config
from sonotwin.choices import read_rig
from sonotwin.open_devices import LiveDevices
from sonotwin.terminal_operator import TerminalOperator
from sonotwin.verbs import record
from sonotwin.verbs.record import Config
from tests.twin.small_rigs import half, half_as_fields
from twin.optics.surface_session import calibration_of

QUIET = ("preview.serve=false", "tracing.samples=2")
STROKE = ("path.start_mm=[-18,-2]", "path.end_mm=[-18,0]", "path.speed_mm_s=20", "frames.quality.rim=2")


@pytest.mark.slow
def test_a_recorded_surface_is_as_good_as_a_rendered_one(tmp_path, rig):
    """Of a sphere, under the same light and exposure: errors over a quarter of a million points agree within a twentieth."""
    scene = ("scene=sphere", "tracing.samples=4", *half_as_fields(rig))
    assert cli.main(["render", *scene, "cameras=[cam1]", f"out={tmp_path}/made"]) == 0
    exposure = f"exposing.exposure_s={read_manifest(tmp_path / 'made/capture').devices['cam1'].exposure_s}"
    optics = f"calibration={tmp_path}/made/capture/calibration/optics.yaml"
    fields = (*scene, "preview.serve=false", "cameras=[cam1]", exposure, optics)
    assert cli.main(["record", "part=surface", *fields, f"out={tmp_path}/own"]) == 0
    rms = {}
    for name, capture in (("made", "made/capture"), ("own", "own")):
        assert cli.main(["surface", f"capture={tmp_path}/{capture}", f"out={tmp_path}/{name}-surface"]) == 0
        assert cli.main(["evaluate", f"surface={tmp_path}/{name}-surface", f"truth={tmp_path}/made/truth"]) == 0
        rms[name] = json.loads((tmp_path / f"{name}-surface/evaluation/metrics.json").read_text())["surface_rms_mm"]
    assert rms["own"] == pytest.approx(rms["made"], rel=0.05)


@pytest.mark.slow
def test_frames_beside_a_recorded_surface_are_found_by_identify(tmp_path, rig):
    """Black level, gain and PRNU within 5 standard deviations, of a camera of half the size; and a contrast at all.

    Few rays a pixel put gamma and contrast off by more than they are said to be.
    """
    session = tmp_path / "session"
    optics, small = tmp_path / "optics.yaml", half(rig)
    calibration_files.write(optics, calibration_of(small))
    quiet = ("scene=sphere", "cameras=[cam1]", "preview.serve=false", "tracing.samples=2", *half_as_fields(rig), f"out={session}")
    surface = ("part=surface", "patterns=gray_surface", f"calibration={optics}")
    for part in (surface, ("part=room",), ("part=dark",), ("part=flat",)):
        assert cli.main(["record", *part, *quiet]) == 0
    assert cli.main(["identify", f"capture={session}", *half_as_fields(rig), f"out={tmp_path / 'ours'}"]) == 0
    found = read_rig(tmp_path / "ours/rig.yaml")
    for name in ("cam1.sensor.black_level_dn", "cam1.sensor.saturation_e", "cam1.sensor.prnu"):
        assert abs(found.number(name) - small.number(name)) < 5 * found.measured[name].sigma, name
    assert "projector.contrast" in found.measured
    assert found.identified.capture == "session"


def test_frames_without_a_surface_are_refused(tmp_path, capsys):
    """In one line, with nothing left."""
    assert cli.main(["record", "part=dark", *QUIET, f"out={tmp_path / 'session'}"]) == 2
    said = capsys.readouterr().err
    assert "expected a surface or a board, as dark frames are exposed, found neither; record part=surface first" in said
    assert said.count("\n") == 1 and not (tmp_path / "session").exists()


@pytest.mark.slow
def test_boards_and_sweeps_grow_in_one_capture(tmp_path, capsys, rig):
    out = f"out={tmp_path}/session"
    quiet = (*QUIET, *half_as_fields(rig))
    board = ["record", "part=board", "patterns=paper_calibration", "cameras=[cam1,cam2]", "count=1", *quiet, out]
    assert cli.main(board) == 0 and cli.main([*board, "seed=1"]) == 0
    assert cli.main(["record", "part=sweep", "name=scan", "purpose=volume", *STROKE, *quiet, out]) == 0
    captured = read_board(tmp_path / "session")
    assert captured.poses == ("00", "01") and set(captured.pose(1).lit) == {"cam1", "cam2"}
    read = read_manifest(tmp_path / "session")
    assert set(read.contents["sweep/scan"]) == {"cam1", "cam2", "us"} and read.sweeps["scan"].purpose == "volume"
    assert cli.main(["record", "part=sweep", "name=scan", *STROKE, *quiet, out]) == 2
    assert "give another name=NAME" in capsys.readouterr().err


@pytest.mark.slow
def test_shots_of_virtual_wires_are_a_sweep_of_stills(tmp_path, capsys, rig, monkeypatch):
    """One a pose of the path, at rest, each with two pairs of frames near enough in time, however slowly they are judged; no
    terminal is needed.
    """

    def slow(networks, target):
        places = target_places(networks, target)
        return lambda image, bits: (time.sleep(1), places(image, bits))[1]

    monkeypatch.setattr(record, "target_places", slow)
    wires = ("scene=crosswire", "path=wire", "path.count=2", "path.roll_deg=35", "name=wires", "purpose=probe", "shots=true")
    out = tmp_path / "session"
    assert cli.main(["record", "part=sweep", *wires, *QUIET, *half_as_fields(rig), "frames.quality.rim=2", f"out={out}"]) == 0
    assert "recorded 2 shots" in capsys.readouterr().out
    scans, pairs, others = (read_stamps(out / "sweep/wires" / name / "timestamps.csv")[1] for name in ("us", "cam1", "cam2"))
    assert len(scans) == 2 and (pairs == others).all()
    before, after = pairs.reshape(2, 2).T
    assert (before < scans).all() and (scans <= after).all() and (after - before <= 1e9 * MAX_GAP_S).all()
    assert read_manifest(out).sweeps["wires"].purpose == "probe"


def composed(*overrides: str) -> Config:
    return config.load("record", ["part=surface", "out=x", *overrides], Config)


def test_the_laboratorys_choice_is_valid():
    devices = composed("devices=basler").devices
    assert isinstance(devices, LiveDevices) and set(devices.cameras) == {"cam1", "cam2"}


def test_images_have_up_to_as_many_bits_as_the_virtual_sensor():
    assert composed("devices.bits=10").devices.bits == 10
    finer = ("rig.cam1.sensor.adc_bits=12", "rig.cam2.sensor.adc_bits=12")
    assert composed("devices.bits=12", *finer).devices.bits == 12


@pytest.mark.parametrize(
    ("overrides", "reason"),
    [
        (["part=board"], "patterns: expected fringes or Gray code along both axes of a board, found none along rows"),
        (["part=board", "patterns=paper_calibration", "cameras=[cam2]"], "cameras: expected cam1"),
        (["part=film"], "part: expected"),
        (["ultrasound.receive_f_number=many"], "ultrasound.receive_f_number: expected"),
        (["path=stroke", "path.speed_mm_s=fast"], "path"),
        (["devices.bits=12"], "devices.bits: expected at most the 10 of rig.cam1.sensor.adc_bits, found 12"),
        (["devices.kind=other"], "devices.kind: expected one of"),
        (["reach.depth_mm=[700,600]"], "reach.depth_mm: expected the nearest depth, then a farther one, found 700 and 600"),
        (["exposing.level=2"], "exposing.level: expected less than 1"),
        (["scene=board", "scene.kind=nothing"], "scene: kind: expected one of"),
        (["calibration=missing.yaml", "scene=plane"], "missing.yaml"),
        (["tracing.samples=3"], "record: tracing: samples: expected a power of two"),
        (["shots=true"], "shots: expected with part=sweep, and without seconds, found part=surface"),
        (["part=sweep", "shots=true", "seconds=3"], "shots: expected with part=sweep, and without seconds, found seconds=3"),
        (["most_moved_px=0"], "most_moved_px: expected"),
        (["part=sweep", "path=none"], "record: path: expected one that leads the probe"),
    ],
)
def test_mistakes_are_named_in_one_line(tmp_path, capsys, overrides, reason):
    assert cli.main(["record", "part=surface", f"out={tmp_path}/out", "preview.serve=false", *overrides]) == 2
    said = capsys.readouterr().err
    assert reason in said and said.count("\n") == 1 and list(tmp_path.iterdir()) == []


def test_other_files_are_left_alone(tmp_path, capsys):
    (tmp_path / "letter.txt").write_text("dear")
    assert cli.main(["record", "part=surface", f"out={tmp_path}", "preview.serve=false"]) == 2
    assert "found other files" in capsys.readouterr().err and [path.name for path in tmp_path.iterdir()] == ["letter.txt"]


def test_a_link_to_itself_is_refused(tmp_path, capsys):
    (tmp_path / "loop").symlink_to("loop")
    assert cli.main(["record", "part=surface", f"out={tmp_path / 'loop'}", "preview.serve=false"]) == 2
    assert "expected a folder or nothing, found a loop of links" in capsys.readouterr().err


CAMERA, PROJECTOR = Device(size=(32, 24), exposure_s=0.01, gain=1.0), Device(size=(1280, 800))


def with_surface(folder: Path) -> Path:
    """A capture with a surface of black images."""
    patterns = composed().patterns
    with open_recording(folder) as capture:
        images = np.zeros((patterns.count, 24, 32), np.uint8)
        capture.add_surface({"cam1": images}, patterns, {"cam1": CAMERA, "projector": PROJECTOR})
    return folder


def refused(capsys, *fields: str) -> str:
    """Why a recording is refused, before its preview is served."""
    assert cli.main(["record", *fields]) == 2
    said = capsys.readouterr()
    assert said.out == "" and said.err.count("\n") == 1
    return said.err


def test_a_taken_name_is_refused_before_anything_is_opened(tmp_path, capsys):
    out = tmp_path / "session"
    with open_recording(out) as capture, capture.sweep("scan", None, {"us": CAMERA}) as growing:
        growing.add("us", 0, 5, np.zeros((24, 32), np.uint8))
    assert "give another name=NAME" in refused(capsys, "part=sweep", "name=scan", f"out={out}")


def test_the_first_line_says_which_devices_record(tmp_path, monkeypatch, capsys):
    """The twin, or a laboratory's by their numbers, before any is opened."""
    (tmp_path / "ours.yaml").write_text("defaults: [basler]\ncameras: {cam1: {serial: '40012345'}}\nscanner: null\n")
    monkeypatch.setattr(record, "still", lambda config, recording, console, say, show: say("opens"))
    for devices, told in (
        ("virtual", "virtual: a rendered rig, nothing is recorded from hardware"),
        (tmp_path / "ours.yaml", "live: cam1 40012345, cam2 00000001, projector"),
    ):
        assert cli.main(["record", "part=surface", f"devices={devices}", "preview.serve=false", f"out={tmp_path}/session"]) == 0
        assert capsys.readouterr().out.splitlines() == [f"devices     {told}", "surface     opens"]


def test_a_folder_around_a_capture_is_named(tmp_path, capsys):
    with_surface(tmp_path / "demo/capture")
    found = refused(capsys, "part=surface", f"out={tmp_path}/demo")
    assert f"which has manifest.json, found other files; is {tmp_path}/demo/capture meant?" in found


@pytest.mark.parametrize(("made", "given"), [("session", "session/capture"), ("made/capture", "made")])
def test_a_folder_too_deep_or_not_deep_enough_is_named(tmp_path, made, given):
    """What is recorded into OUT is OUT, what is rendered into OUT is OUT/capture."""
    with_surface(tmp_path / made)
    with pytest.raises(InputError, match=rf"expected a file, found none; is {tmp_path}/{made} meant\?"):
        read_manifest(tmp_path / given)


def test_a_surface_is_replaced_only_if_told(tmp_path, capsys, monkeypatch):
    """Its truth may stand beside it, and a recorded one may be all there is of it. What is replaced is said by its day."""
    rendered, recorded = with_surface(tmp_path / "demo/capture"), with_surface(tmp_path / "demo/own")
    (tmp_path / "demo/truth/surface").mkdir(parents=True)
    for there in (rendered, recorded):
        assert "replace=true" in refused(capsys, "part=surface", f"out={there}")

    def none(*_):
        raise DeviceError("cam1: not there")

    monkeypatch.setattr(record, "still_devices", none)
    for fields in ([f"out={rendered}", "replace=true"], [f"out={recorded}", "replace=true"]):
        assert cli.main(["record", "part=surface", "preview.serve=false", *fields]) == 2
        assert f"replaces the surface of {date.today()}" in capsys.readouterr().out
    assert read_manifest(rendered).surface == read_manifest(recorded).surface


def test_the_terminal_is_read_while_cameras_go_on(monkeypatch):
    monkeypatch.setattr(sys, "stdin", StringIO("\n\nk\nd\ne\n\n"))
    shown = StringIO()
    operator = TerminalOperator(Console(file=shown, soft_wrap=True))
    operator.ask(Step("hold the board in the middle"))
    answers = []
    while len(answers) < 6:
        answers += [answer] if (answer := operator.answer()) != "wait" else []
    assert answers == ["take", "take", "keep", "drop", "end", "end"] and "hold the board" in shown.getvalue()
