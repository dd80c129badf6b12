"""`sonotwin navigate`, from a drawn recording to a view, with stand-ins for the networks."""

import csv
import re
import socket
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from time import monotonic

import numpy as np
import pytest
import trimesh
from rich.console import Console

from recon.capture import sweep_tables, tip_files
from recon.capture.manifest import CAMERAS, SCANNER, Device
from recon.capture.writer import new_capture
from recon.devices.interfaces import DeviceError
from recon.errors import InputError
from recon.files import meshes
from recon.geometry import rigid
from recon.model.tip import Tip
from recon.model.tracks import Track
from recon.navigation import tool_distances
from recon.navigation.browser_view import LOOPBACK, BrowserView
from recon.navigation.navigation_record import RecordTable
from recon.navigation.publishing import StillScene
from recon.session import poses_step
from recon.tracking import networks
from sonotwin import choices, config, live_sources
from sonotwin.cli import main
from sonotwin.verbs import navigate
from tests.patience import PATIENCE_S
from tests.recon import probe_motions
from tests.recon.acquisition.stand_ins import Bench, BenchCamera
from tests.recon.tracking import drawings, films
from tests.recon.tracking.stand_ins import Told

pytest.importorskip("viser")

LAG_S = 0.02
SCAN = (80, 100)  # width, height, px
COUNT = 4


@pytest.fixture(scope="module")
def recorded(rig, tmp_path_factory) -> Path:
    """Four pairs of frames and six B-scans of a target that moves evenly."""
    folder = tmp_path_factory.mktemp("recorded") / "capture"
    pairs = films.draw(rig, films.places(COUNT), np.random.default_rng(4))
    frames = [frame for pair in pairs for frame in zip(CAMERAS, pair, strict=True)]
    scans = [(SCANNER, np.full(SCAN[::-1], 40 * k, np.uint8)) for k in range(6)]
    stamps = films.stamps(COUNT)
    times = dict.fromkeys(CAMERAS, stamps) | {SCANNER: stamps[0] + 20_000_000 * np.arange(6)}
    with new_capture(folder, "drawn") as capture:
        capture.add_calibration(films.optics(rig))
        capture.add_probe(probe_motions.true_probe(rig))
        capture.add_sweep(times, frames + scans, films.devices(rig) | {SCANNER: Device(size=SCAN)})
    return folder


@pytest.fixture
def moments(rig, monkeypatch):
    """All that is shown, with a detector that is told where the target is at first."""
    shown, publish = [], BrowserView.publish
    monkeypatch.setattr(networks, "load", lambda *_: Told(films.centres(rig, films.places(1)[0])))
    monkeypatch.setattr(BrowserView, "publish", lambda view, moment: (shown.append(moment), publish(view, moment)))
    return shown


def free_port():
    with socket.socket() as any_port:
        any_port.bind((LOOPBACK, 0))
        return any_port.getsockname()[1]


def composed(*fields: str) -> navigate.Config:
    return config.load("navigate", list(fields), navigate.Config)


@pytest.mark.parametrize(("verb", "given"), [("navigate", []), ("project", ["skin=a.ply", "calibration=b.yaml", "out=c"])])
def test_the_devices_that_are_offered_are_taken(verb, given):
    """And the twin's, which aren't, are refused by a line that says what to do without any."""
    model = import_module(f"sonotwin.verbs.{verb}").Config
    offered = config.groups(verb)["devices"]
    assert "basler" in offered and all(config.load(verb, [*given, f"devices={name}"], model).devices for name in offered)
    with pytest.raises(InputError, match=f"{verb}: devices: expected those of a laboratory, .* found virtual, .*; "):
        config.load(verb, [*given, "devices=virtual"], model)


def test_a_taken_port_of_openigtlink_leaves_no_page_open():
    port = free_port()
    with socket.create_server((LOOPBACK, 0)) as other:
        taken = other.getsockname()[1]
        fields = composed("capture=x", f"view.port={port}", f"igtl.port={taken}")
        with pytest.raises(DeviceError, match=f"OpenIGTLink server 127.0.0.1:{taken}: expected a free port"):
            navigate.publishers_of(fields, StillScene(np.eye(4)), Console())
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection((LOOPBACK, port), 1).close()


@pytest.mark.parametrize("refuses", ["set_exposure", "start"])
def test_a_camera_that_refuses_a_setting_is_closed(monkeypatch, refuses):
    """It is opened again every second, which a camera that is still open would refuse for ever."""
    camera = BenchCamera("cam1", Bench())
    closed = []

    def refuse(*_):
        raise DeviceError(f"cam1: {refuses} is refused")

    monkeypatch.setattr(camera, refuses, refuse)
    monkeypatch.setattr(camera, "close", lambda: closed.append(True))
    monkeypatch.setattr(live_sources, "open_camera", lambda devices, name: camera)
    sources = navigate.sources_of(composed("devices=basler"))
    with pytest.raises(DeviceError, match=refuses):
        sources.cam1.open()
    assert closed == [True]


@pytest.mark.slow
def test_a_recording_is_navigated(recorded, moments, tmp_path, capsys, monkeypatch):
    """Until enough was shown, however long that takes on a busy machine."""
    begun = monotonic()

    def clock() -> float:
        enough = sum(moment.world_from_target is not None for moment in moments) > 5 and any(moment.scan for moment in moments)
        return float(enough or monotonic() - begun > PATIENCE_S)

    monkeypatch.setattr(navigate, "monotonic", clock)
    skin, masses = tmp_path / "skin.ply", tmp_path / "masses"
    masses.mkdir()
    meshes.write_ply(skin, trimesh.creation.icosphere(3, 60.0).apply_translation([0, 0, 700]))
    meshes.write_ply(masses / "mass0.ply", trimesh.creation.icosphere(2, 5.0).apply_translation([0, 0, 700]))
    port = free_port()
    fields = [
        f"skin={skin}",
        f"masses={masses}",
        f"lag_s={LAG_S}",
        f"view.port={port}",
        "igtl.port=0",
        "seconds=0.5",
        "speed=0.5",
    ]
    assert main(["navigate", f"capture={recorded}", *fields]) == 0
    told = capsys.readouterr().out.splitlines()
    assert told[0] == f"view        http://127.0.0.1:{port}"
    assert re.fullmatch(r"OpenIGTLink 127\.0\.0\.1:\d+", told[1]) and int(told[1].rpartition(":")[2]) > 0
    assert told[2].startswith("browser     ") and "poses a second" in told[2]
    found = [moment.world_from_target for moment in moments if moment.world_from_target is not None]
    known = films.places(COUNT)[:, :3, 3]
    assert len(found) > 5
    assert max(np.linalg.norm(known - pose[:3, 3], axis=1).min() for pose in found) < 0.05
    placed = [moment for moment in moments if moment.scan is not None]
    assert placed and {each.name for each in placed[-1].distances} == {"mass0"}
    assert {tuple(moment.scan.image.shape) for moment in placed} == {SCAN[::-1]}


@pytest.fixture
def complaint(recorded, capsys):
    """The line in which a run with some fields is refused."""

    def of(*fields: str) -> str:
        assert main(["navigate", f"capture={recorded}", *fields]) == 2
        (line,) = capsys.readouterr().err.splitlines()
        return line.removeprefix("sonotwin: ")

    return of


def test_what_is_wrong_with_tools_is_said_in_one_line(complaint, tmp_path):
    three = "rig=three_bodies"
    expected = "tips.nedle: expected a tool of rig.bodies, needle, found a.yaml; did you mean needle?"
    assert complaint(three, "tips.nedle=a.yaml") == expected
    assert complaint(three, "tips.patient=a.yaml").startswith("tips.patient: expected a tool of rig.bodies, needle, found")
    assert complaint("tips.needle=a.yaml") == "tips.needle: expected none, as rig.bodies names no tool, found a.yaml"
    assert complaint(three, f"tips.needle={tmp_path / 'a.yaml'}").startswith(f"{tmp_path / 'a.yaml'}: expected")
    tip_files.write(tmp_path / "stylus.yaml", replace(TIP, body="stylus"))
    expected = f"{tmp_path / 'stylus.yaml'}: body: expected the tip of needle, found that of stylus: another tool's file?"
    assert complaint(three, f"tips.needle={tmp_path / 'stylus.yaml'}").startswith(expected)
    assert complaint("measured.needle=a.yaml").startswith("measured.needle: expected none, as rig.bodies names none")
    apart = "navigate: plan: expected an entry and an aim 1 to 1000 mm apart, found"
    assert complaint("plan=[[0,0,600],[0,0,600]]") == f"{apart} 0 mm"
    assert complaint("plan=[[0,0,0.6],[0.05,0,0.65]]") == f"{apart} 0.0707 mm"  # in metres
    assert complaint("plan=[[0,0,.nan],[0,0,600]]").startswith("navigate: plan.0.2: expected")
    assert complaint("plan=[[0,0,600]]").startswith("navigate: plan")
    assert complaint("alarm.path_mm=0").startswith("navigate: alarm.path_mm: expected")
    expected = "reference: expected none without the body patient in rig.bodies, found r.csv"
    assert complaint("reference=r.csv") == expected
    empty = tmp_path / "reference.csv"
    sweep_tables.write_track(empty, Track(np.array([1]), np.full((1, 4, 4), np.nan)))
    assert complaint(three, f"reference={empty}") == f"{empty}: expected a pose of the patient, found none"


def test_a_record_that_is_there_leaves_no_page_open(moments, complaint, tmp_path):
    there, port = tmp_path / "record.csv", free_port()
    there.write_text("of others")
    line = complaint(f"record={there}", f"view.port={port}", "igtl.port=0")
    assert line == f"record: expected a new file, found {there} there already; give another name"
    assert there.read_text() == "of others"
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection((LOOPBACK, port), 1).close()


TIP = Tip(np.array([12.0, -5.0, -120.0]), np.diag([0.01] * 3 + [1e-6] * 3), np.array([0.0, 0.0, -1.0]))
MOVED = np.array([0.03, -0.04, 0.05, 9.0, -7.0, 8.0])  # of the patient, rad and mm, with all that is beside it
PLAN = np.array([[-60.0, 25.0, 700.0], [-50.0, 15.0, 790.0]])
MASSES = {"mass0": trimesh.creation.icosphere(3, 6.0).apply_translation([-60.0, 20.0, 790.0])}


def three_places(count: int) -> list[dict[str, np.ndarray]]:
    """Poses of three bodies beside the patient as it stood at the reference: the needle moves, the others rest."""
    turn = np.diag([1.0, -1.0, -1.0])
    still = {"probe": rigid.transform(turn, [-85.0, 60.0, 650.0]), "patient": rigid.transform(turn, [30.0, 5.0, 665.0])}
    return [still | {"needle": rigid.transform(turn, [-80.0 + 1.5 * k, -20.0, 640.0 + k])} for k in range(count)]


@pytest.fixture(scope="module")
def three_recorded(tmp_path_factory) -> Path:
    """Frames of three bodies after the patient has moved with them."""
    folder, rig = tmp_path_factory.mktemp("three") / "capture", choices.read_rig("three_bodies")
    rng, stamps = np.random.default_rng(9), films.stamps(COUNT)
    cameras = [getattr(rig, name).optics.camera() for name in CAMERAS]
    frames = []
    for places in three_places(COUNT):
        patient = places["patient"]
        step = rigid.moved(patient, MOVED) @ rigid.invert(patient)
        bodies = [([step @ places[name]], target) for name, target in rig.targets.items()]
        frames += [(name, drawings.together(camera, bodies, 65.0, rng)) for name, camera in zip(CAMERAS, cameras, strict=True)]
    scans = [(SCANNER, np.full(SCAN[::-1], 40, np.uint8)) for _ in range(COUNT)]
    with new_capture(folder, "drawn") as capture:
        capture.add_calibration(films.optics(rig))
        capture.add_probe(probe_motions.true_probe(rig))
        times = dict.fromkeys((*CAMERAS, SCANNER), stamps)
        capture.add_sweep(times, frames + scans, films.devices(rig) | {SCANNER: Device(size=SCAN)})
    return folder


@pytest.mark.slow
def test_a_film_of_three_bodies_gives_live_what_track_gives(three_recorded, tmp_path, monkeypatch):
    """The recorded distances are those of `track`'s poses, and the tip is where it is beside the patient as it stood."""
    reference, tip_file, masses = tmp_path / "reference.csv", tmp_path / "tip.yaml", tmp_path / "masses"
    masses.mkdir()
    for name, mesh in MASSES.items():
        meshes.write_ply(masses / f"{name}.ply", mesh)
    before = three_places(COUNT)
    sweep_tables.write_track(reference, Track(np.array([1]), before[0]["patient"][None]))
    tip_files.write(tip_file, TIP)
    written, begun = [], monotonic()
    publish = RecordTable.publish
    monkeypatch.setattr(RecordTable, "publish", lambda table, moment: (publish(table, moment), written.append(moment)))

    def clock() -> float:
        measured = sum(moment.bodies != () and moment.bodies[0].figures is not None for moment in written)
        return float(measured > 2 * COUNT or monotonic() - begun > PATIENCE_S)

    monkeypatch.setattr(navigate, "monotonic", clock)
    given = ["rig=three_bodies", f"reference={reference}", f"tips.needle={tip_file}", f"masses={masses}", "speed=0.2"]
    plan = f"plan={PLAN.tolist()}".replace(" ", "")
    shown = ["view.port=0", "igtl.port=0", "seconds=0.5", f"record={tmp_path / 'record.csv'}"]
    assert main(["navigate", f"capture={three_recorded}", *given, plan, *shown]) == 0

    rig = choices.read_rig("three_bodies")
    poses_step.run(poses_step.Settings(capture=three_recorded, rig=rig, reference=reference, overlays=False), tmp_path / "out")
    told = sweep_tables.read_track(tmp_path / "out" / "bodies" / "needle" / "poses.csv")  # beside the patient, as all but that
    surfaces = {name: tool_distances.surface_of(mesh.vertices, mesh.faces) for name, mesh in MASSES.items()}
    offline = [
        tool_distances.figures(pose, own + shared, TIP, surfaces, PLAN)
        for pose, own, shared in zip(told.poses, told.covariance, told.shared, strict=True)
    ]
    with (tmp_path / "record.csv").open(newline="") as stream:
        rows = [row for row in csv.DictReader(stream) if row["body"] == "needle" and row["tip_x_mm"]]
    stamps = films.stamps(COUNT)
    assert len(rows) > COUNT
    for row in rows:
        k = round((int(row["frame_ns"]) - int(stamps[0])) / films.PERIOD_NS) % COUNT  # of a later round, too
        expected, near = offline[k], 0.05  # mm: a start elsewhere ends at the same rims; pairs are 1.8 mm apart
        tip = np.array([float(row[f"tip_{axis}_mm"]) for axis in "xyz"])
        np.testing.assert_allclose(tip, expected.tip, atol=near)
        assert float(row["mass0_mm"]) == pytest.approx(expected.masses["mass0"].mm, abs=near)
        assert float(row["mass0_sigma_mm"]) == pytest.approx(expected.masses["mass0"].sigma_mm, rel=0.1)
        assert float(row["path_mm"]) == pytest.approx(expected.path.off_mm, abs=near)
        assert float(row["aim_mm"]) == pytest.approx(expected.path.left_mm, abs=near)
        assert float(row["path_deg"]) == pytest.approx(expected.path.angle_deg, abs=0.03)
        off = tip - rigid.apply(before[k]["needle"], TIP.tip_mm)
        assert np.linalg.norm(off) < 4 * float(row["tip_sigma_mm"])


def test_what_is_wrong_is_said_in_one_line(recorded, moments, tmp_path, complaint):
    assert complaint(f"capture={tmp_path}") == f"{tmp_path}/manifest.json: expected a file, found none"
    assert complaint(f"skin={tmp_path / 'skin.ply'}") == f"{tmp_path}/skin.ply: expected a surface as PLY, found none"
    assert "expected a folder of `sonotwin segment`" in complaint(f"masses={tmp_path}")
    assert complaint("speed=0").startswith("navigate: speed: expected")
    assert complaint("view.host=''").startswith("navigate: view.host: expected")
    with socket.socket() as other:
        other.bind((LOOPBACK, 0))
        other.listen()
        port = other.getsockname()[1]
        refused = f"view: expected to listen on 127.0.0.1:{port}, found it refused"
        assert complaint(f"view.port={port}", "igtl.serve=false").startswith(refused)
        refused = f"OpenIGTLink server 127.0.0.1:{port}: expected a free port"
        said = complaint("view.port=0", f"igtl.port={port}")
        assert said.startswith(refused) and "give another igtl.port" in said
