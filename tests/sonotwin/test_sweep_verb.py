"""`sonotwin sweep`: what it writes, what the pipeline makes of it, and what it refuses before it renders."""

import json
import re
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from recon.capture import sweep_tables
from recon.capture.manifest import Device, read_manifest
from recon.capture.sweep_part import read_sweep
from recon.errors import InputError
from recon.files import volumes
from recon.geometry import rigid
from recon.model.patterns import CentreLine, Fringes, Patterns
from recon.model.tracks import Track
from scenes.catalogue import build_scene
from scenes.scene_types import Scene
from sonotwin import config
from sonotwin.cli import main
from sonotwin.verbs.sweep import Config, led_along
from tests import added
from tests.twin import small_rigs
from twin.evaluation import track_errors
from twin.filmed_sweep import Moved
from twin.session import Session, describe
from twin.ultrasound import scan_lines

PARTS = (CentreLine(), Fringes(pitch=12, steps=4))
PART = (360, 520)  # px, of the cameras' images, where a filmed sweep has its target


def small(width: int, height: int) -> list[str]:
    """A narrow, shallow image of the same scanner."""
    return [f"{part}.image_size=[{width},{height}]" for part in ("rig.probe", "ultrasound")]


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


@pytest.fixture(scope="module")
def stroke(tmp_path_factory) -> Path:
    """Nine B-scans along a cyst of the test object, 12 mm deep."""
    out = tmp_path_factory.mktemp("stroke") / "out"
    fields = ["scene=test_object", "path.start_mm=[5,-6]", "path.end_mm=[5,-2]", "clocks.scanner_jitter_s=0", *small(48, 128)]
    assert main(["sweep", f"out={out}", *fields]) == 0
    return out


def test_the_capture_is_one_of_a_calibrated_rig(stroke, rig):
    """Tracked poses, taken through the probe's calibration, are the true ones to within the tracker's noise."""
    sweep = read_sweep(stroke / "capture")
    truth = np.load(stroke / "truth" / "sweep" / "sweep.npz")
    assert (sweep.size, len(sweep.paths)) == ((48, 128), 9)
    assert sweep.times - truth["times_ns"] == pytest.approx(np.full(9, 50_000_000))
    assert sweep.probe is not None and sweep.probe.scale.tolist() == list(rig.probe.scale_mm_per_px)
    found = sweep.poses(lag_s=0.05) @ sweep.probe.target_from_image
    apart = np.linalg.norm(found[:, :3, 3] - truth["world_from_image"][:, :3, 3], axis=1)
    assert 0.005 < np.nanmax(apart) < 1.0, "0.05 deg over 91 mm are 0.08 mm an axis; five times that, and the shift"


@pytest.mark.parametrize(
    ("choice", "said"), [("stroke", "1 stroke"), ("raster", "2 strokes side by side"), ("bob", "bob"), ("wire", "wire")]
)
def test_the_path_that_was_chosen_is_said(choice, said):
    assert led_along(config.load("sweep", [f"path={choice}", "out=x"], Config).path) == said


def test_labels_say_what_the_pixels_show(stroke):
    """Pixels labelled cyst are dark, those labelled block are bright."""
    names = json.loads((stroke / "truth" / "scene.json").read_text())["labels"]
    cysts = [number for number, name in enumerate(names) if name.startswith("cyst")]
    images = np.stack(list(read_sweep(stroke / "capture").images()))
    files = sorted((stroke / "truth" / "sweep" / "labels").iterdir())
    labels = np.stack([cv2.imread(str(path), cv2.IMREAD_UNCHANGED) for path in files])
    deep = np.arange(128)[:, None] > 40  # clear of the face's ringing
    block, cyst = images[(labels == names.index("block")) & deep], images[np.isin(labels, cysts) & deep]
    assert cyst.size > 1000 and np.median(block) > np.median(cyst) + 40


def test_freehand_makes_a_volume_of_it(stroke, tmp_path):
    assert main(["freehand", f"capture={stroke / 'capture'}", "lag_s=0.05", f"out={tmp_path / 'volume'}"]) == 0
    voxels = volumes.read_volume(tmp_path / "volume" / "volume.nrrd").voxels
    assert (voxels > 0).mean() > 0.3 and 4 / 0.5 <= min(voxels.shape) <= 12, "a stroke of 4 mm, and what the hand adds"


def test_measure_lag_finds_the_lag(tmp_path):
    """A steady hand over a tank's bottom: the lag that the clocks have lies in the interval that is said."""
    fields = ["scene=tank", "ultrasound=water", "path=bob", "path.height_mm=6", "path.middle_mm=[4,-2,676]", "path.seconds=4.5"]
    fields += ["path.hand.turn_deg=0", "clocks.scanner_hz=8", "clocks.lag_s=0.083", *small(32, 280)]
    assert main(["sweep", f"out={tmp_path / 'out'}", *fields]) == 0
    assert main(["measure-lag", f"capture={tmp_path / 'out' / 'capture'}", f"out={tmp_path / 'lag'}"]) == 0
    found = json.loads((tmp_path / "lag" / "lag.json").read_text())
    low, high = found["interval_s"]
    assert low <= 0.083 <= high and high - low < 0.03


def test_wires_cross_where_the_protocol_has_them(tmp_path):
    """In the image plane near its corners, with the target at rest and no calibration given; same seed, same bytes."""
    fields = [
        "scene=crosswire",
        "ultrasound=water",
        "path=wire",
        "path.count=3",
        "path.rest_s=0.2",
        "path.miss_mm=0",
        *small(48, 128),
    ]
    for name, seed in (("one", 3), ("two", 3), ("other", 4)):
        assert main(["sweep", f"out={tmp_path / name}", f"seed={seed}", *fields]) == 0
    one, two, other = (contents(tmp_path / name) for name in ("one", "two", "other"))
    assert one == two and one.keys() == other.keys()
    assert one["capture/sweep/us/0000.png"] != other["capture/sweep/us/0000.png"]
    sweep = read_sweep(tmp_path / "one" / "capture")
    assert sweep.probe is None and np.isfinite(sweep.poses()).all(), "a lag of 50 ms within a rest of 200"
    poses = np.load(tmp_path / "one" / "truth" / "sweep" / "sweep.npz")["world_from_image"]
    places = np.stack([rigid.apply(rigid.invert(pose), [4.0, -2.0, 660.0]) for pose in poses])
    assert np.abs(places[:, 2]).max() < 1e-6
    shown = places[:, :2] / [0.1229, 0.1225 * 1488.3 / 1540]
    assert np.abs(shown / [47, 127] - 0.5) == pytest.approx(np.tile([0.44, 0.40], (3, 1)), abs=0.01)
    for image, (u, v) in zip(sweep.images(), shown, strict=True):
        u, v = round(u), round(v)
        assert image[max(v - 3, 0) : v + 4, max(u - 3, 0) : u + 4].max() > np.median(image) + 60, "an echo of the wires"


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (["scene=ball_bar"], "scene: ball_bar: expected one with acoustics (breast,"),
        (["scene=tank", "path.surface=breast"], "path.surface: expected one of tank, found breast"),
        (["scene=tank"], "path.surface: needs a value: the scene has no more than tank; give path.surface=tank"),
        (["scene=tank", "path.surface=tank", "path.start_mm=[4,90]"], "path: expected the probe over tank, found it beside at"),
        (["scene=tank", "path.surface=tank", "path.end_mm=[4,-35]"], "end_mm: expected a stroke of some length, found 0 mm"),
        (["scene=tank", "path=wire"], "path: expected a scene of two crossed wires, such as scene=crosswire, found no wires"),
        (["scene=tank", "path=bob", "path.height_mm=40"], "path: expected the probe in front of all things, found it in tank"),
        (["scene=tank", "path=bob", "path.seconds=0.04"], "path: expected one that lasts two images, found 0.040 s"),
        (
            ["scene=cylinders", "path.surface=inner", "path.start_mm=[0,-2]", "path.end_mm=[2,-2]"],
            "path: expected the probe no more than 5 mm deep in a thing, found it in outer after 0.00 s",
        ),
        (
            ["path=wires"],
            "path: expected one of bob, hold, none, raster, rows, stroke, tilts, wire, found wires; did you mean wire?",
        ),
        (["path.kind=fly"], "path.kind: expected one of 'stroke', 'hold', 'bob', 'wire', 'rows', 'tilts', found 'fly'"),
        (["path.speed_mm_s=0"], "speed_mm_s: expected greater than 0, found 0"),
        (["ultrasound.image_size=[96,96]"], "ultrasound.image_size: expected rig.probe's [321, 408], found [96, 96]"),
        (["clocks.scanner_hz=0"], "clocks.scanner_hz: expected greater than 0, found 0"),
        (["pose_noise.turn_deg=-1"], "pose_noise.turn_deg: expected greater than or equal to 0, found -1"),
        (["moved.shift_mm=[0,9,0]"], "moved: expected filmed=true with it"),
        (["seed=-1"], "seed: expected greater than or equal to 0, found -1"),
        (
            ["bodies.needle={look: {kind: needle}}"],
            "bodies: expected names of the rig's further bodies (none, such as rig=three_bodies has)",
        ),
        (
            ["rig=three_bodies", "bodies.patient={path: {kind: insertion}}"],
            "bodies.patient.path.kind: expected insertion for a body with a tip, such as a needle",
        ),
        (
            ["rig=three_bodies", "bodies.patient={path: {kind: still, place_mm: [0, 0, 650], speed: 2}}"],
            "bodies.patient.path.speed: unknown key; expected one of kind, place_mm, roll_deg\n",
        ),
    ],
)
def test_nonsense_is_refused_by_name(arguments, complaint, tmp_path, capsys):
    """One line, exit status 2, nothing written."""
    assert main(["sweep", f"out={tmp_path / 'out'}", *arguments]) == 2
    message = capsys.readouterr().err
    assert complaint in message and message.count("\n") == 1 and message.startswith("sonotwin: ")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(("count", "said"), [(1, ""), (3, " for each of 3 sweeps")])
def test_what_is_set_up_is_said_before(tmp_path, monkeypatch, capsys, count, said):
    """A patient grows for a quarter of a minute, and a window without a word seems to hang."""
    lines = []

    def plan(settings):
        lines.append(capsys.readouterr().out)
        raise InputError("enough")

    monkeypatch.setattr(f"{'sonotwin.verbs.sweep' if count == 1 else 'twin.sweep_data'}.plan_sweep", plan)
    assert main(["sweep", "scene=patient", f"count={count}", f"out={tmp_path / 'out'}"]) == 2
    assert lines == [f"scene       patient, setting it up{said}\n"]


@pytest.mark.parametrize("count", [1, 3])
def test_a_scene_of_no_kind_is_refused_before_it_is_set_up(tmp_path, capsys, count):
    assert main(["sweep", "~scene.kind", f"count={count}", f"out={tmp_path / 'out'}"]) == 2
    said = capsys.readouterr()
    assert said.out == "" and re.fullmatch(r"sonotwin: .*scene: kind: expected one of .*, found none\n", said.err)
    assert not (tmp_path / "out").exists()


def test_a_place_that_is_taken_is_refused(tmp_path, capsys):
    (tmp_path / "out" / "capture").mkdir(parents=True)
    (tmp_path / "out" / "capture" / "thesis.tex").write_text("years of work")
    assert main(["sweep", f"out={tmp_path / 'out'}"]) == 2
    assert "expected a new or empty folder" in capsys.readouterr().err
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["capture"]


def test_a_sweep_joins_a_surface_if_it_is_added(tmp_path, capsys):
    """Refused otherwise, before anything is rendered; each part keeps its settings."""
    out, size, patterns = tmp_path / "out", (64, 48), Patterns(projector_size=(128, 80), unwrap="centre_line", parts=PARTS)
    with Session(out, "surface", {"seed": 7}).write(describe(Scene("wall", ()))) as (capture, _):
        images = np.zeros((patterns.count, *size[::-1]), np.uint8)
        capture.add_surface({"cam1": images}, patterns, {"cam1": Device(size=size)})
    before = contents(out)
    fields = ["scene=crosswire", "ultrasound=water", "path=wire", "path.count=2", "path.rest_s=0.2", *small(48, 64), f"out={out}"]
    assert main(["sweep", *fields]) == 2
    assert "expected nothing or an earlier sweep of us, found a surface; choose another out, or give" in capsys.readouterr().err
    assert contents(out) == before
    assert main(["sweep", *fields, "add=true"]) == 0
    assert len(read_sweep(out / "capture").paths) == 2
    assert read_manifest(out / "capture").contents == {"surface": ("cam1",), "sweep": ("us",)}
    after = contents(out)
    changed = {name for name, content in before.items() if after[name] != content}
    assert changed <= {"capture/manifest.json", "capture/.sonotwin.json", "truth/.sonotwin.json"}
    assert json.loads(after["truth/sweep/settings.json"])["path"]["kind"] == "wire"


@pytest.fixture(scope="module")
def filmed(tmp_path_factory, rig) -> Path:
    """A short stroke over the test object, filmed by both cameras where the target is; its sweep has a name."""
    out = tmp_path_factory.mktemp("filmed") / "out"
    fields = ["scene=test_object", "path.start_mm=[5,-8]", "path.end_mm=[5,2]", "path.hand.turn_deg=0"]
    fields += ["clocks.scanner_hz=5", "clocks.camera_hz=5"]
    for name, first in (("cam1", (920, 180)), ("cam2", (800, 180))):
        centre = small_rigs.cropped(getattr(rig, name), PART, first).optics.centre_px
        fields += [f"rig.{name}.optics.size=[{PART[0]},{PART[1]}]", f"rig.{name}.optics.centre_px=[{centre[0]},{centre[1]}]"]
    assert main(["sweep", f"out={out}", "filmed=true", "name=scan", "frames.white_dn=100", *fields, *small(48, 128)]) == 0
    return out


def test_the_poses_of_a_filmed_sweep_are_in_its_frames(filmed, tmp_path, rig):
    """The tracker finds the target in each pair, to 0.1 mm, and by it the B-scans lie where they were taken."""
    read = read_manifest(filmed / "capture")
    assert read.contents == {"sweep/scan": ("us", "cam1", "cam2")}
    assert read.sweeps["scan"].track is None and read.sweeps["scan"].purpose == "volume"
    assert main(["track", f"capture={filmed / 'capture'}", "sweep=scan", "overlays=false", f"out={tmp_path / 'track'}"]) == 0
    truth = track_errors.read_truth(filmed / "truth", "scan")
    assert (truth.visible > 0.99).all(), "the hand covers nothing"
    errors = track_errors.compare(track_errors.read_track(tmp_path / "track" / "poses.csv", truth), truth)
    assert errors.found.all() and errors.shift_mm.max() < 0.1
    sweep = read_sweep(tmp_path / "track")
    found = sweep.poses(lag_s=0.05) @ rig.probe.target_from_image.matrix()
    true = np.load(filmed / "truth" / "sweep" / "scan" / "sweep.npz")["world_from_image"]
    seen = np.isfinite(found).all(axis=(1, 2))
    assert seen.sum() >= 4
    apart = np.linalg.norm(found[seen, :3, 3] - true[seen, :3, 3], axis=1)
    assert apart.max() < 0.5, "0.1 deg of the tracker over 90 mm are 0.15 mm, and the hand moves between frames at 5 Hz"


def test_the_frames_of_a_filmed_sweep_show_board_and_table(filmed):
    """A bright board before a dark table."""
    image = cv2.imread(str(filmed / "capture" / "sweep" / "scan" / "cam1" / "0002.png"), cv2.IMREAD_GRAYSCALE)
    assert image.shape == PART[::-1]
    assert np.percentile(image, 99) > 80 and np.percentile(image, 10) < 30


@pytest.mark.slow
def test_a_patient_who_moved_is_taken_out_of_the_probes_poses(tmp_path):
    """By 20 mm and 5 deg since the reference: frames show it, and poses told beside the patient don't, to the tracker's error."""
    rig = ["rig=meza2021", "+target@rig.bodies.patient=patient"]
    fields = ["scene=breast", "path.end_mm=[4,-25]", "path.hand.turn_deg=0", "clocks.scanner_hz=4", "clocks.camera_hz=4"]
    fields += ["filmed=true", "name=scan", "moved={turn_deg: [0, 3, 4], shift_mm: [12, 16, 0]}", *small(48, 128)]
    assert main(["sweep", f"out={tmp_path}", *rig, *fields]) == 0
    truth, folder = track_errors.read_truth(tmp_path / "truth", "scan"), tmp_path / "truth" / "sweep" / "scan"
    step = Moved(turn_deg=(0, 3, 4), shift_mm=(12, 16, 0)).matrix(build_scene(config.load("sweep", ["out=unused"], Config).scene))
    with np.load(folder / "bodies" / "patient.npz") as patient:
        assert (patient["visible"] > 0.99).all()
        first = rigid.invert(step) @ patient["world_from_target"][:1]
    sweep_tables.write_track(tmp_path / "reference.csv", Track(truth.times[:1], first))
    given = [f"capture={tmp_path / 'capture'}", "sweep=scan", f"reference={tmp_path / 'reference.csv'}", "overlays=false"]
    assert main(["track", *rig, *given, f"out={tmp_path / 'track'}"]) == 0
    track = track_errors.read_track(tmp_path / "track" / "poses.csv", truth)
    moved = track_errors.compare(track, truth)
    told = track_errors.compare(track, replace(truth, poses=rigid.invert(step) @ truth.poses))
    assert told.found.all() and moved.shift_mm.min() > 15 and moved.turn_deg.min() > 4
    assert told.shift_mm.max() < 0.6, "0.1 deg of the patient's target over 200 mm are 0.35 mm"


PHASED = '''
"""A phased array: a small flat face, whose lines are steered as from one place a little behind it."""

import numpy as np
from pydantic import Field

from recon.model.rig import Part


class Face(Part):
    """Steered lines from a narrow face."""

    sector_deg: float = Field(ge=1, le=170)
    lines: int = Field(ge=16, le=2048)
    behind_mm: float = Field(gt=0)
    foot_mm: float

    @property
    def pitch_mm(self):
        """On the arc about the place behind."""
        return self.behind_mm * np.deg2rad(self.sector_deg) / (self.lines - 1)

    @property
    def bend(self):
        """Of that arc."""
        return 1 / self.behind_mm

    @property
    def sagitta_mm(self):
        """Of that arc."""
        return float(self.behind_mm * (1 - np.cos(np.deg2rad(self.sector_deg / 2))))

    @property
    def chord_mm(self):
        """Of that arc."""
        return float(2 * self.behind_mm * np.sin(np.deg2rad(self.sector_deg / 2)))
'''


SIZE, PIXEL = (150, 120), 0.4  # px, mm


@pytest.fixture
def phased(tmp_path) -> list[str]:
    """Fields of a sweep by a phased array, whose module isn't there yet."""
    size, pixel = SIZE, PIXEL
    array = tmp_path / "phased.yaml"
    face = "{sector_deg: 70, lines: 96, behind_mm: 3, foot_mm: 12}"
    figures = "frequency_mhz: 3.5\nbandwidth: [0.6, 0.5]\ntransmit_focus_mm: 40\naperture_mm: 12\nreverberations: 0\n"
    figures += "scatterers_per_mm3: 1\nreceive_f_number: 3\nelevation_mm: 8\nelevation_focus_mm: 40\n"
    array.write_text(f"image_size: {list(size)}\nscale_mm_per_px: [{pixel}, {pixel}]\nphased: {face}\n{figures}")
    given = [
        "scene=tank",
        "path=bob",
        f"ultrasound={array}",
        "path.seconds=2",
        "clocks.scanner_hz=2",
        "clocks.camera_hz=10",
    ]
    given += ["path.hand.shift_mm=0", "path.hand.turn_deg=0"]
    given += [f"rig.probe.image_size={list(size)}".replace(" ", ""), f"rig.probe.scale_mm_per_px=[{pixel},{pixel}]"]
    return [*given, f"out={tmp_path / 'out'}"]


def test_a_phased_array_is_one_module(phased, tmp_path, monkeypatch, capsys):
    """Its lines fan out by 70 degrees from a place 3 mm behind the middle of its face."""
    assert main(["sweep", *phased]) == 2
    assert "ultrasound.phased: expected no such field" in capsys.readouterr().err
    added.add(monkeypatch, tmp_path / "ours", "twin.ultrasound.faces", "phased", PHASED)
    array = config.load("sweep", phased, Config).ultrasound
    lines = scan_lines.lines_of(array)
    ends = scan_lines.world_from_lines(lines, np.eye(4), np.array([0, 2 * lines.middle_mm]))
    assert np.rad2deg(np.arctan2(ends[:, 0, 1], ends[:, 1, 1])) == pytest.approx([-35, 35])
    assert rigid.apply(ends[0], np.array([0, -3.0, 0])) == pytest.approx(np.array([0, -3.0, 0]), abs=1e-9)
    assert array.foot_mm == 12 and lines.count == 96


@pytest.mark.slow
def test_a_phased_array_sees_a_mirror_squarely(phased, tmp_path, monkeypatch):
    """A tank's flat bottom is straight, where it is, and brightest where lines meet it squarely; nothing is beside the fan."""
    size, pixel = SIZE, PIXEL
    added.add(monkeypatch, tmp_path / "ours", "twin.ultrasound.faces", "phased", PHASED)
    assert main(["sweep", *phased]) == 0
    image = next(iter(read_sweep(tmp_path / "out" / "capture").images())).astype(float)
    pose = np.load(tmp_path / "out" / "truth" / "sweep" / "sweep.npz")["world_from_image"][0]
    middle = size[0] // 2
    row = (700 - pose[2, 3]) / (pose[2, 1] * pixel)
    assert abs(image[20:, middle].argmax() + 20 - row * 1540 / 1488.3) < 2, "sound in water is slower than the scanner assumes"
    v, u = np.indices(image.shape) * pixel
    beside = np.abs(u - pixel * (size[0] - 1) / 2) > 1 + np.tan(np.deg2rad(35)) * (v + 3)
    assert not image[beside].any() and beside.mean() > 0.2, "nothing is shown beside the fan"
    across = image[20:, 26:124]
    assert np.ptp(across.argmax(axis=0)) <= 2, "lines that fan out show a flat bottom straight"
    strength = across.max(axis=0)
    assert strength[[0, -1]].max() < 0.75 * strength[45:53].min(), "and a mirror most brightly where they meet it squarely"
