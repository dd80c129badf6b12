"""`sonotwin navigate`, from a drawn recording to a view, with stand-ins for the networks."""

import re
import socket
from importlib import import_module
from pathlib import Path
from time import monotonic

import numpy as np
import pytest
import trimesh
from rich.console import Console

from recon.capture.manifest import CAMERAS, SCANNER, Device
from recon.capture.writer import new_capture
from recon.devices.interfaces import DeviceError
from recon.errors import InputError
from recon.files import meshes
from recon.navigation.browser_view import LOOPBACK, BrowserView
from recon.navigation.publishing import StillScene
from recon.tracking import networks
from sonotwin import config, live_sources
from sonotwin.cli import main
from sonotwin.verbs import navigate
from tests.patience import PATIENCE_S
from tests.recon import probe_motions
from tests.recon.acquisition.stand_ins import Bench, BenchCamera
from tests.recon.tracking import films
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


def test_what_is_wrong_is_said_in_one_line(recorded, moments, tmp_path, capsys):
    def complaint(*fields: str) -> str:
        assert main(["navigate", f"capture={recorded}", *fields]) == 2
        (line,) = capsys.readouterr().err.splitlines()
        return line.removeprefix("sonotwin: ")

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
