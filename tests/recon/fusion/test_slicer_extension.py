"""The module for 3D Slicer without Slicer: its tables, its command line, and what it asks of stand-ins for Slicer and Qt."""

import json
import re
import sys
from dataclasses import replace
from pathlib import Path
from types import ModuleType, SimpleNamespace

import pytest

from recon.fusion import slicer_folder
from sonotwin import config
from sonotwin.verbs.navigate import Config

ROOT = Path(slicer_folder.__file__).parents[2]
MODULE = ROOT / "slicer_extension/SonotwinNavigation"


class Node:
    """Of Slicer's scene: methods that aren't here do nothing."""

    def __init__(self, **fields):
        self.calls = []
        self.__dict__ |= fields

    def __getattr__(self, name):
        return lambda *given: self.calls.append((name, *given))


class Based:
    """A base class of a scripted module's parts."""

    def __init__(self, *_):
        pass


@pytest.fixture
def slicer(monkeypatch):
    """Stand-ins, and what was loaded."""
    loaded, nodes = [], {}

    def load(path):
        loaded.append(Path(path).name)
        return Node(GetDisplayNode=Node, GetID=lambda: "id")

    connector = Node(GetState=lambda: 2)
    scene = Node(
        AddNewNodeByClass=lambda *_: connector,
        GetNodesByName=lambda name: Node(GetNumberOfItems=lambda: int(name in nodes), GetItemAsObject=lambda _: nodes[name]),
    )
    slice_view = Node()
    widget = Node(sliceLogic=lambda: Node(GetSliceCompositeNode=lambda: slice_view), mrmlSliceNode=lambda: slice_view)
    module = ModuleType("slicer")
    module.__dict__.update(
        util=SimpleNamespace(
            loadModel=load, loadVolume=load, loadTransform=load, loadMarkups=load,
            resetThreeDViews=lambda: None, startupEnvironment=dict,
        ),
        modules=SimpleNamespace(openigtlinkif=None),
        mrmlScene=scene,
        vtkMRMLIGTLConnectorNode=SimpleNamespace(StateConnected=2),
        app=SimpleNamespace(layoutManager=lambda: SimpleNamespace(sliceWidget=lambda _: widget)),
        loaded=loaded, nodes=nodes, connector=connector, slice_view=slice_view,
    )  # fmt: skip
    parts = ModuleType("slicer.ScriptedLoadableModule")
    for part in ("", "Logic", "Test", "Widget"):
        setattr(parts, f"ScriptedLoadableModule{part}", Based)
    stand_ins = {"slicer": module, "slicer.ScriptedLoadableModule": parts, "ctk": ModuleType("ctk"), "qt": ModuleType("qt")}
    for name, stand_in in stand_ins.items():
        monkeypatch.setitem(sys.modules, name, stand_in)
    monkeypatch.syspath_prepend(str(MODULE))
    yield module
    for name in [name for name in sys.modules if name.startswith("SonotwinNavigation")]:
        del sys.modules[name]


def test_the_module_shows_a_folder_as_its_own_script_does():
    """Slicer's Python has no sonotwin, so that the text is there twice."""
    template = slicer_folder.TEMPLATES / f"slicer_{slicer_folder.SCRIPT}.txt"
    assert (MODULE / "SonotwinNavigationLib/show.py").read_bytes() == template.read_bytes()


def test_cmake_names_every_file():
    listed = re.search(r"set\(MODULE_PYTHON_SCRIPTS(.*?)\)", (MODULE / "CMakeLists.txt").read_text(), flags=re.DOTALL)[1]
    named = {line.strip().replace("${MODULE_NAME}", MODULE.name) for line in listed.split("\n") if line.strip()}
    assert named == {path.relative_to(MODULE).as_posix() for path in MODULE.rglob("*.py")}


def test_a_result_opens_with_its_figures_and_what_was_left_out(slicer, folder):
    from SonotwinNavigation import SonotwinNavigationLogic

    found = SonotwinNavigationLogic().open_result(folder.parent)
    assert found.search == "Masses were looked for: 1 was found."
    (mass,), (missing,) = found.masses, found.left_out
    assert mass.name == "mass0" and re.fullmatch(
        r"centre .* ± 0\.21 mm; volume \d+ ± 12 mm3; 7\.50 ± 0\.19 mm below.*", mass.told
    )
    assert mass.place == pytest.approx((10, -20, 660)) and (missing.name, missing.told) == ("small", "is left out")
    assert {"skin.ply", "mass0.ply", "centre_mass0.ply", "volume.nrrd", "masses.mrk.json", "left_out.mrk.json"} <= set(
        slicer.loaded
    )


def test_a_result_says_that_masses_were_not_looked_for(slicer, scene, tmp_path):
    from SonotwinNavigationLib import result

    slicer_folder.write(tmp_path / "slicer", replace(scene, masses=None, left_out=()), {}, scans=1)
    assert result.read(tmp_path / "slicer") == result.Result("Masses were not looked for.", [], [])
    (tmp_path / "slicer/search.txt").unlink()
    assert "isn't said" in result.read(tmp_path / "slicer").search


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (lambda folder: (folder / "masses.mrk.json").write_text("{"), "masses.mrk.json: expected markups of 3D Slicer"),
        (lambda folder: (folder / "masses.mrk.json").write_text('{"markups": [{}]}'), "masses.mrk.json: expected markups"),
        (lambda folder: (folder / "show.py").unlink(), "expected a result with a folder slicer"),
        (lambda folder: _turn_to_ras(folder / "masses.mrk.json"), "expected coordinateSystem LPS, found RAS"),
    ],
)
def test_a_damaged_folder_is_refused_before_anything_is_shown(spoil, said, slicer, folder):
    from SonotwinNavigation import SonotwinNavigationLogic

    spoil(folder)
    with pytest.raises(ValueError, match=said):
        SonotwinNavigationLogic().open_result(folder.parent)
    assert not slicer.loaded


def _turn_to_ras(path):
    content = json.loads(path.read_text())
    content["markups"][0]["coordinateSystem"] = "RAS"
    path.write_text(json.dumps(content))


def test_two_results_ask_which(slicer, tmp_path):
    from SonotwinNavigationLib import result

    for name in ("a", "b"):
        (tmp_path / name / "slicer").mkdir(parents=True)
        (tmp_path / name / "slicer/show.py").touch()
    with pytest.raises(ValueError, match="choose one of these"):
        result.find(tmp_path)
    assert result.find(tmp_path / "a") == tmp_path / "a/slicer"


def test_the_command_line_is_one_that_navigate_takes(slicer, tmp_path):
    from SonotwinNavigationLib import navigation

    program, verb, *fields = navigation.command("/bin/sonotwin", f"capture='{tmp_path}/a b' lag_s=0.05", 18950)
    given = config.load(verb, fields, Config)
    assert (program, given.igtl.port, given.lag_s, given.capture) == ("/bin/sonotwin", 18950, 0.05, tmp_path / "a b")


@pytest.mark.parametrize(
    ("program", "fields", "said"),
    [("", "capture=a", "program: "), ("s", "lag_s=1", "found neither"), ("s", "capture='a", "as in a shell"),
     ("s", "capture=a igtl.port=1", "in its own box")],
)  # fmt: skip
def test_a_command_line_that_cant_be_is_refused(slicer, program, fields, said):
    from SonotwinNavigationLib import navigation

    with pytest.raises(ValueError, match=said):
        navigation.command(program, fields, 18944)


def test_what_comes_is_placed_and_what_stops_is_said(slicer, monkeypatch):
    """The probe under its transform, the slice where the B-scan is; after two seconds without news a warning."""
    import SonotwinNavigation as extension

    now = [0.0]
    monkeypatch.setattr(extension.time, "monotonic", lambda: now[0])
    logic = extension.SonotwinNavigationLogic()
    logic.connect("localhost", 18944)
    assert ("SetTypeClient", "localhost", 18944) in slicer.connector.calls
    assert logic.look() == ["nothing has come yet"]
    probe, scan = Node(GetTransformNodeID=lambda: None), Node(GetID=lambda: "scan", GetMTime=lambda: 5)
    target, status = Node(GetID=lambda: "target", GetMTime=lambda: 4), Node(GetText=lambda: "tracked", GetMTime=lambda: 3)
    slicer.nodes.update(Probe=probe, BScan=scan, TargetToRAS=target, Status=status)
    assert logic.look() == ["tracked"]
    assert ("SetAndObserveTransformNodeID", "target") in probe.calls
    assert ("SetBackgroundVolumeID", "scan") in slicer.slice_view.calls and (
        "RotateToVolumePlane",
        scan,
    ) in slicer.slice_view.calls
    now[0] = 3.0
    assert logic.look() == ["nothing has come for 3 s: what is shown is old", "tracked"]
    logic.disconnect()
    assert logic.look() == [] and ("Stop",) in slicer.connector.calls
