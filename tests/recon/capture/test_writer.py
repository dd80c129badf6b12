"""A capture of several parts comes back part by part; one is written anew without a change to the others."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from recon.capture import calibration_files, stereo_frames, writer
from recon.capture.board_part import read_board
from recon.capture.manifest import SCANNER, BoardPart, Device, read_manifest
from recon.capture.surface_part import read_surface
from recon.capture.sweep_part import read_sweep
from recon.capture.writer import CaptureWriter, new_capture
from recon.errors import InputError
from recon.geometry import rigid
from recon.geometry.camera import Camera
from recon.model.calibration import Calibration, Uncertainty
from recon.model.probe import ProbeCalibration
from recon.model.tracks import Track
from tests.recon.captures import BOARD, PATTERNS, PROJECTOR

SIZE, SCAN = (64, 48), (24, 16)
TIMES = {SCANNER: 50_000_000 * np.arange(5), "cam1": 25_000_000 * np.arange(3), "cam2": 25_000_000 * np.arange(3) + 7}


def optics(*names: str) -> Calibration:
    matrix = np.array([[200.0, 0, 31.5], [0, 200, 23.5], [0, 0, 1]])
    beside = rigid.from_rotation_vector([0, -0.2, 0], [150, 0, 0])
    cameras = {
        "cam1": Camera(SIZE, matrix, np.zeros(5)),
        "cam2": Camera(SIZE, matrix, np.zeros(5), beside),
        "projector": Camera(PROJECTOR, np.diag([190.0, 190, 1]), np.zeros(5), rigid.invert(beside)),
    }
    return Calibration({name: cameras[name] for name in names})


def track() -> Track:
    return Track(25_000_000 * np.arange(12), np.array([rigid.transform(np.eye(3), [k, 0, 650]) for k in range(12)]))


def probe() -> ProbeCalibration:
    return ProbeCalibration(rigid.from_rotation_vector([1.5, 0.1, 0], [-7.0, 80, 90]), np.array([0.12, 0.11]))


def noise(count: int, size, seed: int, bits: int = 8) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 1 << bits, (count, *size[::-1])).astype(np.uint8 if bits == 8 else np.uint16)


def camera(exposure_s: float, bits: int = 8) -> Device:
    return Device(size=SIZE, bits=bits, exposure_s=exposure_s)


def surface(capture: CaptureWriter, seed: int = 1) -> None:
    capture.add_calibration(optics("cam1", "projector"))
    surface_images(capture, seed)


def surface_images(capture: CaptureWriter, seed: int = 1) -> None:
    devices = {"projector": Device(size=PROJECTOR), "cam1": camera(0.01)}
    capture.add_surface({"cam1": noise(PATTERNS.count, SIZE, seed)}, PATTERNS, devices)


def board(capture: CaptureWriter, seed: int = 2) -> None:
    devices = {"projector": Device(size=PROJECTOR), "cam1": camera(0.02), "cam2": camera(0.02)}
    poses = []
    for number in range(2):
        first, second, *fringes = noise(PATTERNS.count + 2, SIZE, 10 * seed + number)
        poses.append(
            writer.write_pose(capture.folder, f"{number:02d}", {"cam1": first, "cam2": second}, {"cam1": np.array(fringes)})
        )
    capture.add_board(BoardPart(board=BOARD, patterns=PATTERNS, poses=tuple(poses)), devices)


def frames(seed: int = 3):
    """Both cameras' frames in turn, in between the B-scans."""
    scans = noise(5, SCAN, seed)
    yield from ((SCANNER, scan) for scan in scans[:2])
    for first, second in zip(noise(3, SIZE, seed + 1, 10), noise(3, SIZE, seed + 2, 10), strict=True):
        yield from (("cam1", first), ("cam2", second))
    yield from ((SCANNER, scan) for scan in scans[2:])


def sweep(capture: CaptureWriter, seed: int = 3) -> None:
    capture.add_calibration(optics("cam1", "cam2"))
    devices = {SCANNER: Device(size=SCAN), "cam1": camera(0.005, bits=10), "cam2": camera(0.005, bits=10)}
    capture.add_sweep(TIMES, frames(seed), devices, track())
    capture.add_probe(probe())


def scans_alone(capture: CaptureWriter) -> None:
    capture.add_sweep(
        {SCANNER: TIMES[SCANNER]}, ((SCANNER, scan) for scan in noise(5, SCAN, 9)), {SCANNER: Device(size=SCAN)}, track()
    )


PARTS = {"surface": surface, "board": board, "sweep": sweep}


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


@pytest.fixture
def whole(tmp_path) -> Path:
    """All parts, written at once."""
    with new_capture(tmp_path / "whole", "session") as capture:
        for add in PARTS.values():
            add(capture)
    return tmp_path / "whole"


def check(folder: Path) -> None:
    """The surface, the board and both kinds of images of the sweep are those that were written."""
    found = read_surface(folder)
    assert np.array_equal(found.images, noise(PATTERNS.count, SIZE, 1)) and found.name == "session"
    read = read_board(folder)
    assert read.poses == ("00", "01") and read.devices["cam1"].exposure_s == 0.02
    lit, _, *fringes = noise(PATTERNS.count + 2, SIZE, 21)
    assert np.array_equal(read.pose(1).lit["cam1"], lit) and np.array_equal(read.pose(1).fringes, np.array(fringes))
    scans = read_sweep(folder)
    assert np.array_equal(np.stack(list(scans.images())), noise(5, SCAN, 3)) and len(scans.track.times) == 12
    assert scans.probe is not None and np.array_equal(scans.probe.scale, probe().scale)
    film = stereo_frames.read_film(folder)
    assert film.bits == 10 and film.times.tolist() == TIMES["cam1"].tolist()
    assert np.array_equal(np.stack([pair[1] for pair in film.pairs()]), noise(3, SIZE, 5, 10))


def test_all_parts_come_back_from_one_capture(whole):
    check(whole)
    manifest = read_manifest(whole)
    assert manifest.contents == {"surface": ("cam1",), "board": ("cam1", "cam2"), "sweep": (SCANNER, "cam1", "cam2")}
    assert [manifest.devices_of(part)["cam1"].exposure_s for part in PARTS] == [0.01, 0.02, 0.005]
    assert [manifest.devices_of(part)["cam1"].bits for part in PARTS] == [8, 8, 10]


@pytest.mark.parametrize("order", [("surface", "board", "sweep"), ("sweep", "board", "surface"), ("board", "sweep", "surface")])
def test_parts_may_be_added_one_by_one(tmp_path, whole, order):
    for part in order:
        with new_capture(tmp_path / "grown", "session", add=part) as capture:
            PARTS[part](capture)
    check(tmp_path / "grown")
    same = {"manifest.json", "calibration/optics.yaml", ".sonotwin.json"}  # but for the order of devices
    grown, once = contents(tmp_path / "grown"), contents(whole)
    assert {name: grown[name] for name in grown.keys() - same} == {name: once[name] for name in once.keys() - same}


@pytest.mark.parametrize("part", PARTS)
def test_a_part_alone_is_written_as_if_it_were_added_to_nothing(tmp_path, part):
    """A capture of one part has no entry of its own devices: it is what it was before there were several."""
    for name, add in (("alone", None), ("added", part)):
        with new_capture(tmp_path / name, "one", add=add) as capture:
            PARTS[part](capture)
    assert contents(tmp_path / "alone") == contents(tmp_path / "added")
    content = json.loads((tmp_path / "alone" / "manifest.json").read_text())
    assert "devices" not in content[part] and content.keys() & PARTS.keys() == {part}


def test_only_the_part_of_the_same_name_is_replaced(whole):
    before = contents(whole)
    with new_capture(whole, "other", add="sweep") as capture:
        scans_alone(capture)
    after = contents(whole)
    kept = {name for name in before if name.startswith(("surface/", "board/"))}
    assert {name: after[name] for name in kept} == {name: before[name] for name in kept}
    assert {name for name in after if name.startswith("sweep/cam")} == set() and "calibration/probe.yaml" not in after
    assert read_sweep(whole).probe is None and read_sweep(whole).name == "session"
    assert np.array_equal(read_surface(whole).images, noise(PATTERNS.count, SIZE, 1))


def test_devices_of_a_replaced_part_go_with_it(tmp_path):
    """The exposure of a part that is gone stays nowhere, and those of the others stay what they were."""
    for part in ("surface", "board", "sweep"):
        with new_capture(tmp_path / "capture", add=part) as capture:
            PARTS[part](capture)
    with new_capture(tmp_path / "capture", add="surface") as capture:
        capture.add_surface(
            {"cam2": noise(PATTERNS.count, SIZE, 4)}, PATTERNS, {"projector": Device(size=PROJECTOR), "cam2": camera(0.04)}
        )
    manifest = read_manifest(tmp_path / "capture")
    assert [manifest.devices_of("board")[name].exposure_s for name in ("cam1", "cam2")] == [0.02, 0.02]
    assert [manifest.devices_of("sweep")[name].exposure_s for name in ("cam1", "cam2")] == [0.005, 0.005]
    assert manifest.devices_of("surface")["cam2"].exposure_s == 0.04
    assert "0.01" not in (tmp_path / "capture" / "manifest.json").read_text()
    assert manifest.devices["projector"] == Device(size=PROJECTOR)


def test_the_calibration_of_other_devices_stays(tmp_path):
    for part in ("surface", "sweep"):
        with new_capture(tmp_path / "capture", add=part) as capture:
            PARTS[part](capture)
    assert list(read_surface(tmp_path / "capture").calibration.cameras) == ["cam1", "projector", "cam2"]


def test_a_measured_calibration_is_completed_and_never_changed(whole):
    """Only devices that it lacks are added; its covariance stays, and with nothing to add every byte of it."""
    path = whole / "calibration" / "optics.yaml"
    measured = Camera(SIZE, np.diag([201.0, 202, 1]), np.zeros(5))
    calibration_files.write(path, Calibration({"cam1": measured}, Uncertainty(("cam1.fx",), np.array([[0.04]]))))
    for names in (("cam1", "projector"), ("cam1",)):
        before = path.read_bytes()
        with new_capture(whole, add="surface") as capture:
            capture.complete_calibration(optics(*names))
            surface_images(capture)
        found = read_surface(whole).calibration
        assert list(found.cameras) == ["cam1", "projector"] and np.array_equal(found.cameras["cam1"].matrix, measured.matrix)
        assert found.uncertainty is not None and found.uncertainty.covariance == 0.04
    assert path.read_bytes() == before


def test_two_processes_may_add_parts_at_a_time(tmp_path):
    """The second waits for the first, so that each finds the other's part."""
    program = "from tests.recon.capture.test_writer import *; print('begin', flush=True); add_alone(Path('capture'), 'board')"
    env = os.environ | {"PYTHONPATH": str(Path(__file__).resolve().parents[3])}
    with new_capture(tmp_path / "capture", "session", add="surface") as capture:
        surface(capture)
        other = subprocess.Popen([sys.executable, "-c", program], cwd=tmp_path, env=env, stdout=subprocess.PIPE, text=True)
        assert other.stdout.readline() == "begin\n"
        with pytest.raises(subprocess.TimeoutExpired):
            other.wait(1)
    assert other.wait() == 0
    assert read_manifest(tmp_path / "capture").contents.keys() == {"surface", "board"}


def add_alone(folder: Path, part: str) -> None:
    """Add a part from a process of its own."""
    with new_capture(folder, "session", add=part) as capture:
        PARTS[part](capture)


def test_a_failed_part_leaves_the_capture_as_it_was(whole):
    before = contents(whole)

    def breaks_off():
        yield from list(frames(7))[:4]
        raise KeyboardInterrupt

    devices = {SCANNER: Device(size=SCAN), "cam1": camera(0.005, bits=10), "cam2": camera(0.005, bits=10)}
    with pytest.raises(KeyboardInterrupt), new_capture(whole, add="sweep") as capture:
        capture.add_sweep(TIMES, breaks_off(), devices, track())
    assert contents(whole) == before and [path.name for path in whole.parent.iterdir()] == ["whole"]


def test_a_device_of_another_size_is_refused(whole):
    small = Device(size=(32, 24))
    complaint = r"surface\.devices\.cam1: expected one of the devices, of the same size, found 32x24"
    with pytest.raises(ValueError, match=complaint), new_capture(whole, add="surface") as capture:
        capture.add_surface({"cam1": noise(PATTERNS.count, (32, 24), 1)}, PATTERNS, {"cam1": small})
    check(whole)


def test_a_capture_with_files_elsewhere_is_not_added_to(whole):
    path = whole / "manifest.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"root": "../elsewhere"}))
    with (
        pytest.raises(InputError, match=r"root: expected \., as in a capture that holds all its files"),
        new_capture(whole, add="sweep"),
    ):
        pass


def test_a_manifest_of_the_fewest_keys_is_added_to(whole):
    """As one writes it by hand: without a name, calibration, probe or settings of the devices."""
    path = whole / "manifest.json"
    read = json.loads(path.read_text())
    board = {name: read["board"][name] for name in ("board", "patterns", "poses")}
    devices = {name: {"size": device["size"]} for name, device in read["devices"].items()}
    path.write_text(json.dumps({"schema": read["schema"], "devices": devices, "board": board, "root": "./"}))
    with new_capture(whole, "other", add="sweep") as capture:
        scans_alone(capture)
    assert read_manifest(whole).contents == {"board": ("cam1", "cam2"), "sweep": (SCANNER,)}
    assert np.array_equal(read_board(whole).pose(0).lit["cam1"], noise(PATTERNS.count + 2, SIZE, 20)[0])


@pytest.mark.parametrize("part", ["surface", "board", "sweep"])
@pytest.mark.parametrize(
    ("place", "complaint"),
    [("{}/x", "expected none of its files in"), ("../x", "(holds all|within)"), ("/x", "(holds all|within)")],
)
def test_files_that_would_be_lost_are_refused_before_anything_is_written(whole, part, place, complaint):
    """A manifest written by hand may name files in another part's folder, or outside the capture."""
    path = whole / "manifest.json"
    read, replaced = json.loads(path.read_text()), "sweep" if part == "surface" else "surface"
    moved = {
        "surface": lambda name: read["surface"]["images"]["cam1"].__setitem__(-1, name),
        "board": lambda name: read["board"]["poses"][1]["lit"].__setitem__("cam2", name),
        "sweep": lambda name: read["sweep"].__setitem__("track", name),
    }
    moved[part](place.format(replaced))
    path.write_text(json.dumps(read))
    before = contents(whole)
    with pytest.raises(InputError, match=rf"manifest\.json: {part}[:.].*{complaint}"), new_capture(whole, add=replaced):
        pass
    assert contents(whole) == before


def test_images_must_be_those_of_the_times(tmp_path):
    def write(times, images):
        devices = {SCANNER: Device(size=SCAN), "cam1": camera(0.1)}
        with new_capture(tmp_path / "capture") as capture:
            capture.add_sweep(times, images, devices)

    scans = [(SCANNER, scan) for scan in noise(5, SCAN, 9)]
    for times, images, complaint in (
        ({SCANNER: TIMES[SCANNER]}, scans[:4], "images of us: expected 5, one a time, found 4"),
        (TIMES | {"cam2": TIMES["cam2"][::-1]}, scans, "increasing"),
        ({SCANNER: TIMES[SCANNER]}, [(SCANNER, scans[0][1][:-1])], "image 0 of us: expected 24x16 uint8"),
        ({SCANNER: TIMES[SCANNER], "cam2": TIMES["cam2"]}, scans, r"sweep\.images\.cam2: expected one of the devices us, cam1"),
    ):
        with pytest.raises(ValueError, match=complaint):
            write(times, images)
    assert not list(tmp_path.iterdir())


def named(capture: CaptureWriter, name: str, purpose: str, seed: int) -> None:
    devices = {SCANNER: Device(size=SCAN)}
    images = ((SCANNER, scan) for scan in noise(5, SCAN, seed))
    capture.add_sweep({SCANNER: TIMES[SCANNER]}, images, devices, track(), name, purpose)


def test_a_capture_holds_several_sweeps_by_name(tmp_path):
    """Each is read by its name, or by what it is for; a new one stands beside the others, or in the place of its namesake."""
    with new_capture(tmp_path / "capture") as capture:
        named(capture, "wires", "probe", 1)
        named(capture, "scan", "volume", 2)
    with new_capture(tmp_path / "capture", add="sweep/again") as capture:
        named(capture, "again", "volume", 3)
    with new_capture(tmp_path / "capture", add="sweep/scan") as capture:
        named(capture, "scan", "volume", 4)
    assert sorted(read_manifest(tmp_path / "capture").contents) == ["sweep/again", "sweep/scan", "sweep/wires"]
    for name, seed in (("wires", 1), ("again", 3), ("scan", 4)):
        assert np.array_equal(np.stack(list(read_sweep(tmp_path / "capture", name).images())), noise(5, SCAN, seed))
    assert np.array_equal(read_sweep(tmp_path / "capture", purpose="probe").image(0), noise(5, SCAN, 1)[0])


@pytest.mark.parametrize(("name", "purpose", "found"), [
    ("", "volume", "found 2 for this; give sweep=NAME"),
    ("", "latency", "found none for this; give sweep=NAME"),
    ("phantom", "volume", "found phantom, which isn't among them"),
])  # fmt: skip
def test_a_sweep_that_isn_t_meant_is_not_guessed(tmp_path, name, purpose, found):
    with new_capture(tmp_path / "capture") as capture:
        for number, (own, meant) in enumerate({"wires": "probe", "scan": "volume", "again": "volume"}.items()):
            named(capture, own, meant, number)
    with pytest.raises(InputError, match=f"sweeps: expected the name of one of wires, scan, again, {found}"):
        read_sweep(tmp_path / "capture", name, purpose)


def test_a_sweep_without_a_name_has_no_place_beside_named_ones(tmp_path):
    with new_capture(tmp_path / "capture") as capture:
        named(capture, "wires", "probe", 1)
        with pytest.raises(ValueError, match="sweep: expected none beside sweeps, which are wires, found one"):
            scans_alone(capture)


def test_further_bodies_come_back_with_their_sweep(tmp_path):
    """And stay where they are when another part is added."""
    needle = Track(track().times, np.linalg.inv(track().poses))
    images = ((SCANNER, scan) for scan in noise(5, SCAN, 9))
    with new_capture(tmp_path / "capture", "session") as capture:
        capture.add_sweep(
            {SCANNER: TIMES[SCANNER]}, images, {SCANNER: Device(size=SCAN)}, track(), "scan", None, {"needle": needle}
        )
    with new_capture(tmp_path / "capture", add="surface") as capture:
        surface(capture)
    for found in (read_sweep(tmp_path / "capture"), read_sweep(tmp_path / "capture", "scan")):
        assert list(found.bodies) == ["needle"] and np.array_equal(found.bodies["needle"].poses, needle.poses)
    assert (tmp_path / "capture" / "sweep" / "scan" / "bodies" / "needle" / "poses.csv").is_file()
